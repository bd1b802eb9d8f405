"""A Docker engine of the tests' own: nothing of an engine that runs here, or of its images, is touched.

It lives in namespaces of its own (mounts, processes, network) and dies with the process that
started it, however that ends; its bridges and firewall rules go with it.  Containers reach each
other and nothing else: builds run with `network: none`.
"""

from __future__ import annotations

import fcntl
import os
import select
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "deploy"))

import kept  # noqa: E402
from polling import until  # noqa: E402

PREFIX = "enact-engine-"
POOL = "base=198.18.64.0/18,size=24"
"""Addresses of networks: of the range for tests of devices, that nothing on the Internet has."""

START_S = 180.0
END_S = 120.0
CALL_S = 900.0
CGROUPS = Path("/sys/fs/cgroup")


class NoEngineError(Exception):
    """Why there can be no engine here, in the words of who said so."""


class Engine:
    """A running engine and its command line.

    Args:
        folder: Holds all of it, and is removed by `end`.
        process: Its death takes the engine along.
        command: A Docker command line with BuildKit.
    """

    def __init__(self, folder: Path, process: subprocess.Popen[bytes], command: str) -> None:
        self.folder = folder
        self._process = process
        self._command = command
        self.environment = {
            **os.environ,
            **engine_variables(folder),
            "DOCKER_BUILDKIT": "1",
            "PYTHON_IMAGE": kept.BASE_TAG,
            "ENACT_BUILD_NETWORK": "none",
        }

    def docker(self, *words: object, check: bool = True, wait_s: float = CALL_S):
        """Run `docker WORDS`; return what it said (`stdout`, `stderr`) and its `returncode`.

        Raises:
            AssertionError: It failed and `check` is set; the text says what it said.
        """
        done = subprocess.run(
            [self._command, *map(str, words)],
            env=self.environment,
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
            timeout=wait_s,
        )
        if check and done.returncode:
            said = (done.stdout + done.stderr).strip()
            raise AssertionError(f"docker {' '.join(map(str, words))}: {done.returncode}\n{said}")
        return done

    def compose(self, *words: object, check: bool = True, wait_s: float = CALL_S):
        """Run `docker compose WORDS` as `docker` does."""
        return self.docker("compose", *words, check=check, wait_s=wait_s)

    def daemon(self) -> int:
        """Return the number of the process that ends last of the engine's, and takes all along."""
        children = f"/proc/{self._process.pid}/task/{self._process.pid}/children"
        return int(Path(children).read_text("utf-8").split()[0])

    def inside(self, *words: object, network_of: str | None = None):
        """Run a program of this host (`ip`, `iptables`, `tc`) among the engine's processes.

        Args:
            words: The program and its arguments.
            network_of: The container whose network it sees; the engine's own if not given.
        """
        enter = ["nsenter", "--target", str(self.daemon()), "--mount", "--pid", "--net"]
        if network_of is not None:
            number = self.docker("inspect", "--format", "{{.State.Pid}}", network_of).stdout
            enter += ["nsenter", "--target", number.strip(), "--net"]
        return subprocess.run(
            [*enter, *map(str, words)], capture_output=True, text=True, check=True, timeout=120
        )

    def end(self) -> None:
        """Kill all of it, wait until all of it is dead, and remove what it left."""
        try:
            daemon = os.pidfd_open(self.daemon())
        except (OSError, IndexError):  # it has ended by itself
            daemon = None
        self._process.kill()
        self._process.wait()
        if daemon is not None:
            select.select([daemon], [], [], END_S)
            os.close(daemon)
        remove(self.folder)


def engine_variables(folder: Path) -> dict[str, str]:
    """Return what leads a Docker command line to the engine in a folder, and to nothing else."""
    return {"DOCKER_HOST": f"unix://{folder}/docker.sock", "DOCKER_CONFIG": f"{folder}/config"}


def start() -> Engine:
    """Start an engine and return it once it answers.

    Raises:
        NoEngineError: Something that it needs is missing here, or the engine itself gave up.
    """
    sweep()
    path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
    if shutil.which("dockerd", path=path) is None:
        raise NoEngineError("dockerd: command not found (Debian package docker.io)")
    command = kept.docker_command()
    if not command:
        raise NoEngineError("docker: no command line with BuildKit (Debian package docker.io)")
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    claim(folder)
    plugins = folder / "config" / "cli-plugins"
    plugins.mkdir(parents=True)
    plugin = kept.found_compose_plugin()
    if plugin is not None:
        (plugins / "docker-compose").symlink_to(plugin)
    variables = engine_variables(folder)
    daemon = (
        f"ip link set lo up && dockerd --data-root {folder}/data --exec-root {folder}/exec"
        f" --pidfile {folder}/docker.pid --host {variables['DOCKER_HOST']} --bridge none"
        f" --cgroup-parent /{folder.name} --default-address-pool {POOL} --log-level warn & wait $!"
    )
    with (folder / "dockerd.log").open("wb") as log:
        process = subprocess.Popen(
            [
                *("setpriv", "--pdeathsig", "KILL"),
                *("unshare", "--mount", "--pid", "--net", "--fork", "--kill-child", "--mount-proc"),
                *("sh", "-c", daemon),
            ],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**os.environ, "PATH": path},
        )
    engine = Engine(folder, process, command)
    try:
        wait_until_it_answers(engine, process)
        asked = engine.compose("version", check=False)
        if asked.returncode:
            said = asked.stderr.strip().splitlines()[0]
            raise NoEngineError(f"{said} (./deploy/images --fetch fetches it)")
    except BaseException:
        engine.end()
        raise
    return engine


def wait_until_it_answers(engine: Engine, process: subprocess.Popen[bytes]) -> None:
    """Return once the engine answers.

    Raises:
        NoEngineError: It ended, or never answered; with the end of its log.
    """

    def answers() -> bool:
        if process.poll() is not None:
            raise NoEngineError(last_words())
        return not engine.docker("version", check=False, wait_s=START_S).returncode

    def last_words() -> str:
        said = (engine.folder / "dockerd.log").read_text("utf-8").strip().splitlines()
        return "\n".join(said[-3:]) or "dockerd said nothing"

    try:
        until(answers, limit_s=START_S, pause_s=0.05, missed=last_words)
    except AssertionError as error:
        raise NoEngineError(str(error)) from None


def claim(folder: Path) -> None:
    """Hold a lock on a folder for as long as this process lives."""
    descriptor = os.open(folder / "held", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def sweep() -> None:
    """Remove what engines left whose tests were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        try:
            descriptor = os.open(folder / "held", os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            remove(folder)
        except BlockingIOError:
            pass
        finally:
            os.close(descriptor)


def remove(folder: Path) -> None:
    """Remove a dead engine's folder and its control groups."""
    shutil.rmtree(folder, ignore_errors=True)
    groups = [*CGROUPS.glob(f"{folder.name}/**/"), *CGROUPS.glob(f"*/{folder.name}/**/")]
    for group in sorted(groups, key=lambda path: len(path.parts), reverse=True):
        try:
            group.rmdir()
        except OSError:  # still held by a process that is just ending: an empty folder remains
            continue
