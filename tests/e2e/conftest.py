"""Real daemons and real client processes on loopback, started and ended by each test."""

import contextlib
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from ports import free_port

sys.path.insert(0, str(Path(__file__).parent))

WORKER = Path(__file__).with_name("worker.py")
READY_S = 180.0


class Process:
    """A child process whose lines of output can be waited for."""

    def __init__(self, arguments, log, *, before=(), **variables):
        self.log = log
        self.lines = queue.Queue()
        self.seen = []
        with log.open("ab") as errors:
            self.popen = subprocess.Popen(
                [*before, sys.executable, *map(str, arguments)],
                stdout=subprocess.PIPE,
                stderr=errors,
                stdin=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1", **variables},
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.popen.stdout:
            self.lines.put(line.rstrip("\n"))
        self.lines.put(None)

    def expect(self, start, timeout_s=READY_S):
        """Return the rest of the next line that starts with `start`."""
        while True:
            try:
                line = self.lines.get(timeout=timeout_s)
            except queue.Empty:
                raise AssertionError(
                    f"no line {start!r} within {timeout_s} s; {self.story()}"
                ) from None
            if line is None:
                raise AssertionError(
                    f"ended ({self.popen.wait()}) before {start!r}; {self.story()}"
                )
            self.seen.append(line)
            if line.startswith(start):
                return line[len(start) :].strip()

    def story(self):
        return f"output {self.seen[-20:]}, stderr:\n{self.log.read_text()[-3000:]}"

    def tell(self, line):
        try:
            self.popen.stdin.write(line + "\n")
            self.popen.stdin.flush()
        except BrokenPipeError:
            raise AssertionError(
                f"ended ({self.popen.wait()}) before it was told {line!r}; {self.story()}"
            ) from None

    @property
    def pid(self):
        return self.popen.pid

    def signal(self, number):
        self.popen.send_signal(number)

    def finish(self, timeout_s=180.0):
        """Wait for the end and return the exit status."""
        return self.popen.wait(timeout=timeout_s)

    def end(self):
        if self.popen.poll() is None:
            self.popen.kill()
        self.popen.wait()
        self._reader.join()
        self.popen.stdout.close()
        with contextlib.suppress(BrokenPipeError):  # a line that it was told after its end
            self.popen.stdin.close()


class Cell:
    """Shard daemons of one cell, and workers that join it."""

    def __init__(self, folder, *, shards=("s0",), ttl_s=2.0, aspects="", pins=""):
        self.folder = folder
        self.ports = {name: free_port() for name in shards}
        self.file = folder / "cell.toml"
        lines = ['name = "e2e"', 'worlds = ["online", "training"]', f"session_ttl_s = {ttl_s}"]
        lines.append(f'data_folder = "{folder}/data"')
        for name, port in self.ports.items():
            lines += [f"[shards.{name}]", f'listen = "tcp/127.0.0.1:{port}"']
        self.file.write_text("\n".join(lines) + f"\n{pins}\n{aspects}\n")
        self.daemons = {}
        self.processes = []

    def start(self, name="s0", *, launcher=("-m", "enact_dist.cli.main")):
        arguments = [*launcher, "shard", "run", name, "--cell", str(self.file)]
        daemon = Process(arguments, self.folder / f"{name}.log")
        self.processes.append(daemon)
        self.daemons[name] = daemon
        daemon.expect("ready:")
        return daemon

    def start_all(self):
        for name in self.ports:
            self.start(name)
        return self

    def kill(self, name="s0"):
        self.daemons[name].signal(signal.SIGKILL)
        self.daemons[name].finish()

    def worker(self, role, *arguments):
        log = self.folder / f"{role}.{len(self.processes)}.log"
        line = [str(WORKER), role, str(self.file), *map(str, arguments)]
        process = Process(line, log)
        self.processes.append(process)
        return process

    def enact(self, *arguments):
        """Run one command line to its end."""
        return subprocess.run(
            [sys.executable, "-m", "enact_dist.cli.main", *arguments],
            capture_output=True,
            text=True,
            timeout=180,
            env={**os.environ, "ENACT_CELL": str(self.file)},
            check=False,
        )

    def end(self):
        for process in reversed(self.processes):
            process.end()


@pytest.fixture
def port():
    """A port of this host at which nobody listens."""
    return free_port()


@pytest.fixture
def make_cell(tmp_path):
    cells = []

    def make(**options):
        folder = tmp_path / f"cell{len(cells)}"
        folder.mkdir()
        cells.append(Cell(folder, **options))
        return cells[-1]

    yield make
    for cell in cells:
        for name, daemon in cell.daemons.items():  # shown where the test has failed
            print(f"shard {name}: status {daemon.popen.poll()}, {daemon.story()}")
        cell.end()


@pytest.fixture
def make_process(tmp_path):
    """Start Python processes: `make_process(*arguments, before=…)`, killed after the test."""
    processes = []

    def make(*arguments, **options):
        log = tmp_path / f"process.{len(processes)}.log"
        processes.append(Process(arguments, log, **options))
        return processes[-1]

    yield make
    for process in reversed(processes):
        process.end()


@pytest.fixture
def root(monkeypatch, request):
    """A shared folder on a file system of its own, so that its memory can be weighed."""
    folder = Path(tempfile.mkdtemp(prefix="enact-test-"))
    size = getattr(request, "param", 2 << 30)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=0700", "tmpfs", str(folder)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    if mounted.returncode:
        folder.rmdir()
        pytest.skip(f"no tmpfs can be mounted here: {mounted.stderr.strip()}")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(folder))
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)
    folder.rmdir()
