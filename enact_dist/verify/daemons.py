"""Real shards and clients as processes of a throw-away cell, for measurements and fault injection.

A process here is asked with lines on its standard input and tells with lines on its output; the
clock that its lines quote is the machine's monotonic one, which all processes share.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from enact_dist.config.environment import without_overrides
from enact_dist.errors import LinkError
from enact_dist.link.log import in_words

LINE_S: Final = 90.0
"""How long a line may stay out before the process counts as hung; many start at once."""
LOG_BYTES: Final = 2000
"""So much of a log's end is looked at."""
COMMAND: Final = "enact_dist.cli.main"


class KeptPorts:
    """TCP ports of the loopback that the system gives to no other process before `close`.

    One that was only found free may be another's before the own daemon listens, or while that is
    killed and started again.  A socket that is bound to it and never listens keeps it; a daemon
    that says SO_REUSEADDR, as Zenoh does, listens there.
    """

    def __init__(self) -> None:
        self._kept: list[socket.socket] = []

    def free(self) -> int:
        """Return a port without a listener."""
        kept = socket.socket()
        self._kept.append(kept)
        kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        kept.bind(("127.0.0.1", 0))
        port: int = kept.getsockname()[1]
        return port

    def close(self) -> None:
        """Let the system give them away; twice is harmless."""
        while self._kept:
            self._kept.pop().close()


def last_said(log: str) -> str:
    """Return the last line of a log; if it has a traceback, the line that says what was wrong."""
    lines = [line for line in log.splitlines() if line.strip()]
    if "Traceback (most recent call last):" not in lines:
        return lines[-1] if lines else ""
    last = max((n for n, line in enumerate(lines) if line[0].isspace()), default=-1)
    return (lines[last + 1 :] or lines[-1:])[0].removeprefix("enact_dist.errors.")


class LineProcess:
    """A child process, `python -m module words…`, whose lines can be waited for.

    Args:
        module: Module to run, with `words` as its arguments.
        words: See `module`.
        log: Receives its standard error.
        before: A command that ends by running the one that follows it, such as `nsenter`.
        environment: Its variables; those of this process unless given.

    Attributes:
        started_s: Monotonic time just before it was started.
        ready_s: When it reported that it is ready; 0 for clients.
    """

    def __init__(
        self,
        module: str,
        words: Sequence[str],
        log: Path,
        *,
        before: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = f"{module} {' '.join(words)}"
        self.started_s = time.monotonic()
        self.ready_s = 0.0
        self._log = log
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        surroundings = os.environ if environment is None else environment
        with log.open("ab") as errors:
            self._popen = subprocess.Popen(
                [*before, sys.executable, "-m", module, *words],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env={**surroundings, "PYTHONUNBUFFERED": "1"},
            )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self._lines.put(in_words(line.rstrip("\n")))
        self._lines.put(None)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._popen.pid

    def expect(self, start: str, *, timeout_s: float = LINE_S) -> str:
        """Return what follows `start` on the next line that begins with it.

        Raises:
            LinkError: The process ended first, or the line stayed out.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise self._error(f"said no line {start!r} within {timeout_s:g} s") from None
            if line is None:
                raise self._error(f"ended ({self._popen.wait()}) before it said {start!r}")
            if line.startswith(start):
                return line[len(start) :].strip()

    def _error(self, found: str) -> LinkError:
        log = self._log.read_text(errors="replace")[-LOG_BYTES:].strip()
        error = LinkError(f"{self.name} {found}; its log ends with: {last_said(log) or 'nothing'}")
        error.add_note(log)  # shown only with the traceback
        return error

    def tell(self, line: str) -> None:
        """Send one line."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(line + "\n")
        self._popen.stdin.flush()

    @property
    def status(self) -> int | None:
        """Its exit status; None while it runs."""
        return self._popen.poll()

    def wait_status(self, timeout_s: float) -> int | None:
        """Wait for its end for so long; return its exit status, None while it runs."""
        try:
            return self._popen.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None

    def signal(self, number: int) -> None:
        """Send it a signal."""
        self._popen.send_signal(number)

    def kill(self) -> float:
        """SIGKILL it and wait for its end; return the monotonic time of the signal, in seconds."""
        killed_s = time.monotonic()
        self._popen.send_signal(signal.SIGKILL)
        self.wait_ended()
        return killed_s

    def wait_ended(self) -> float:
        """Wait until it has ended; return the monotonic time, in seconds."""
        self._popen.wait(LINE_S)
        return time.monotonic()

    def end(self) -> None:
        """Kill what still runs and give back everything; twice is harmless."""
        if self._popen.poll() is None:
            self._popen.kill()
        self._popen.wait()
        self._reader.join()
        for pipe in (self._popen.stdin, self._popen.stdout):
            if pipe is not None:
                pipe.close()


def write_cell(
    file: Path,
    name: str,
    *,
    worlds: Sequence[str],
    listen: Mapping[str, str],
    pins: Mapping[str, str],
    advertise: Mapping[str, Sequence[str]] | None = None,
    **options: object,
) -> None:
    """Write the file of a throw-away cell, whose data lie beside it unless it has a `store`.

    Args:
        file: Where.
        name: Of the cell.
        worlds: Its world contexts.
        listen: Shard → the endpoint at which it listens.
        pins: Entity pattern → shard.
        advertise: Shard → where it can be reached, if not where it listens.
        options: Further keys of the file.
    """
    keys: dict[str, object] = {"name": name, "worlds": list(worlds)}
    if "store" not in options:
        keys["data_folder"] = str(file.parent / "data")
    lines = [f"{key} = {json.dumps(value)}" for key, value in (keys | options).items()]
    for shard, endpoint in listen.items():
        lines += [f"[shards.{shard}]", f"listen = {json.dumps(endpoint)}"]
        if advertise is not None:
            lines.append(f"advertise = {json.dumps(advertise[shard])}")
    for pattern, shard in pins.items():
        lines += ["[[pins]]", f"entities = {json.dumps(pattern)}", f'shard = "{shard}"']
    file.write_text("\n".join(lines) + "\n")


class Processes:
    """Processes of one cell.  All of them do as the cell's file says, whatever is set here."""

    def __init__(self) -> None:
        self._all: list[LineProcess] = []

    def run(
        self, module: str, words: Sequence[str], log: Path, *, before: Sequence[str] = ()
    ) -> LineProcess:
        """Start a process; see `LineProcess`."""
        surroundings = without_overrides(os.environ)
        process = LineProcess(module, words, log, before=before, environment=surroundings)
        self._all.append(process)
        return process

    def end(self, process: LineProcess) -> None:
        """End one process before the others."""
        process.end()
        self._all.remove(process)

    def close(self) -> None:
        """End every process, however it is; twice is harmless."""
        while self._all:
            self._all.pop().end()


class CellProcesses(Processes):
    """The shards of one cell on the loopback, and clients that join it.  A context manager.

    Args:
        folder: Existing and empty: for `cell.toml`, data and logs.
        shards: Their names.
        pins: Entity pattern → shard.
        ttl_s: Session TTL of the cell.
        carrier: How messages travel, as in `cell.toml`.
    """

    def __init__(
        self,
        folder: Path,
        shards: Sequence[str],
        *,
        pins: dict[str, str],
        ttl_s: float,
        carrier: str = "auto",
    ) -> None:
        super().__init__()
        self.folder = folder
        self.file = folder / "cell.toml"
        self.shards: dict[str, LineProcess] = {}
        self._clients = 0
        self._ports = KeptPorts()
        listen = {name: f"tcp/127.0.0.1:{self._ports.free()}" for name in shards}
        write_cell(
            self.file,
            "verify",
            worlds=["online"],
            listen=listen,
            pins=pins,
            session_ttl_s=ttl_s,
            carrier=carrier,
        )

    def start_shard(self, name: str) -> LineProcess:
        """Start a shard's daemon; return once it serves."""
        words = ("shard", "run", name, "--cell", str(self.file))
        daemon = self.run(COMMAND, words, self.folder / f"{name}.log")
        self.shards[name] = daemon
        daemon.expect("ready:")
        daemon.ready_s = time.monotonic()
        return daemon

    def start_client(self, module: str, *words: str) -> LineProcess:
        """Start a client; its first word is the cell's file."""
        self._clients += 1
        log = self.folder / f"client-{self._clients}.log"
        return self.run(module, (str(self.file), *words), log)

    def __enter__(self) -> CellProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        self._ports.close()
