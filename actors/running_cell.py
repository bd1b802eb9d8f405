"""Cells for demonstrations: one that runs already, or processes that `enact up` starts.

Rule a change must keep: every process that was started here ends with the demonstration, also when
that is killed, and such a run starts from an empty data folder of its own; in a database, as a cell
of a name of its own, which goes with the run.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

from actors.geometry.files import write_whole
from enact_dist import connect
from enact_dist.errors import EnactError, LinkError
from enact_dist.link.signals import StopSignals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from enact_dist import Cell
    from enact_dist.recording import RecordingSummary

_LOG: Final = logging.getLogger("enact.recording")
LOOKING_ON_NICE: Final = 10
"""Nice value of the threads that record and look on: a tenth of the weight of an actor."""
UP_S: Final = 60.0
"""How long the shards may take to answer; one needs half a second on an idle machine."""
TRY_S: Final = 2.0
"""How long one try to join takes; after each it is looked whether the processes still run."""
DOWN_S: Final = 20.0
"""How long actors and shards may take to drain."""
LOOK_S: Final = 0.1
"""How often the log is looked at."""
_STORE: Final = "ENACT_STORE"


class DemoError(RuntimeError):
    """The demonstration cannot go on; the message says where to look."""


class DemoStore(NamedTuple):
    """A database for the data of a cell, which then has a standby daemon of each shard.

    Attributes:
        url: Of PostgreSQL; empty: as `ENACT_STORE` says, and if it is not set, the cell has a
            folder.
        fail_over_after: Kill the daemons that serve after so many packages; 0: never.
    """

    url: str = ""
    fail_over_after: int = 0


class DemoCell:
    """A cell that others run; a context manager that leaves it as it is.

    Attributes:
        config: Its `cell.toml`.
        log: Where to read what its processes said.
    """

    def __init__(self, config: Path, *, log: str) -> None:
        self.config, self.log = config, log

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave it as it is."""

    def check(self) -> None:
        """Raise `DemoError` if it is known to be gone."""

    def progressed(self, packages: int) -> str:
        """Take note that so many packages are done with; return what came of it, for people.

        Raises:
            DemoError: The demonstration cannot go on.
        """
        del packages
        return ""

    def shard_pid(self, name: str) -> int:
        """Return the process of a shard.

        Raises:
            DemoError: It does not run, or not under this process.
        """
        raise DemoError(f"the process of shard {name} is not known; see {self.log}")

    def processor_s(self) -> dict[str, float]:
        """Return the processor time of each process by name, where they are known."""
        return {}

    def joined(self) -> contextlib.AbstractContextManager[Cell]:
        """Join the cell as soon as its shards answer.

        Raises:
            DemoError: The processes ended, or no shard answered within `UP_S`.
        """
        deadline_s = time.monotonic() + UP_S
        while True:
            self.check()
            try:
                return connect(self.config, actor="demo", timeout_s=TRY_S)
            except LinkError as error:
                if time.monotonic() > deadline_s:
                    raise DemoError(f"no shard within {UP_S:.0f} s: {error}") from error


class RunningCell(DemoCell):
    """A cell that is up between entering and leaving the block.

    Args:
        out: Folder for `cell.toml` and `cell.log`; it exists.
        name: Of the application, for its temporary folder.
        template: The `cell.toml` of the application.
        configured: Makes the text of the run's `cell.toml` of the template's text, a data folder
            and a port for each shard.
        env: Environment variables of its processes beside this process's.
        store: Where its data are instead of a folder.
    """

    def __init__(
        self,
        out: Path,
        *,
        name: str,
        template: Path,
        configured: Callable[[str, Path, Sequence[int]], str],
        env: Mapping[str, str] | None = None,
        store: DemoStore | None = None,
    ) -> None:
        self._log = out / "cell.log"
        super().__init__(out / "cell.toml", log=str(self._log))
        store = store or DemoStore()
        self._store = store.url or os.environ.get(_STORE, "")
        self._fail_over_after = store.fail_over_after
        self._standbys: dict[str, subprocess.Popen[bytes]] = {}
        self._name, self._template, self._configured = name, template, configured
        self._env = {**(env or {}), **({_STORE: self._store} if self._store else {})}
        self._data = Path()
        self._ports: list[socket.socket] = []
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._data = Path(tempfile.mkdtemp(prefix=f"enact-{self._name}-"))
        template = self._template.read_text()
        count = len(tomllib.loads(template)["shards"])
        self._ports = kept_ports(2 * count if self._store else count)
        ports = [each.getsockname()[1] for each in self._ports]
        text = self._configured(template, self._data, ports[:count])
        if self._store:
            text = _stored(text, ports[count:])
        write_whole({self.config: text.encode()})
        self._log.write_bytes(b"")
        self._process = self._run("up", str(self.config))
        return self

    def _run(self, *words: str) -> subprocess.Popen[bytes]:
        """Start a command, which ends with this process."""
        with self._log.open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "enact_dist.cli.main", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self._env, "ENACT_SUPERVISOR_PID": str(os.getpid())},
                process_group=0,  # Ctrl-C is this process's to pass on
            )

    def __exit__(self, *_: object) -> None:
        for process in (self._process, *self._standbys.values()):
            if process is not None:
                _end(process)
        for each in self._ports:
            each.close()
        shutil.rmtree(self._data, ignore_errors=True)
        if self._store:
            self._leave_database()

    def _leave_database(self) -> None:
        """Delete what the cell had in its database."""
        erase = ("shard", "erase", "--yes", "--cell", str(self.config))
        if self._run(*erase).wait():
            _LOG.warning("rows of this run may be left in the database; see %s", self._log)

    def joined(self) -> contextlib.AbstractContextManager[Cell]:
        """Join the cell as soon as its shards answer; their standbys start then.

        Raises:
            DemoError: As of `DemoCell.joined`, or a standby did not start.
        """
        cell = super().joined()
        try:
            if self._store and not self._standbys:
                self._stand_by()
        except BaseException:
            with cell:
                raise
        return cell

    def _stand_by(self) -> None:
        """Start a second daemon of each shard; return once all of them stand by."""
        cell = str(self.config)
        for name, shard in tomllib.loads(self.config.read_text())["shards"].items():
            words = ("shard", "run", name, "--standby", "--cell", cell)
            self._standbys[name] = self._run(*words, "--listen", shard["advertise"][1])
        deadline_s = time.monotonic() + UP_S
        while self._log.read_text(errors="replace").count("\nstanding by for shard") < len(
            self._standbys
        ):
            self.check()
            if time.monotonic() > deadline_s:
                raise DemoError(f"no standby within {UP_S:.0f} s; see {self._log}")
            time.sleep(LOOK_S)

    def progressed(self, packages: int) -> str:
        """Kill the daemon that serves each shard if so many packages are enough, once.

        Raises:
            DemoError: As of `DemoCell.progressed`, or there are no standbys.
        """
        if not self._fail_over_after or packages < self._fail_over_after:
            return ""
        self._fail_over_after = 0
        if not self._standbys or any(each.poll() is not None for each in self._standbys.values()):
            raise DemoError(f"not every shard has a standby to take over; see {self._log}")
        killed = {name: self.shard_pid(name) for name in self._standbys}
        for pid in killed.values():
            os.kill(pid, signal.SIGKILL)
        told = ", ".join(f"{name} (process {pid})" for name, pid in killed.items())
        return f"killed after {packages} packages: shards {told}; their standbys take over"

    def shard_pid(self, name: str) -> int:
        """Return the process of a shard, a child of `enact up`.

        Raises:
            DemoError: It does not run.
        """
        for (kind, first), pid in self._children().items():
            if (kind, first) == ("shard", name):
                return pid
        raise DemoError(f"shard {name} does not run; see {self.log}")

    def processor_s(self) -> dict[str, float]:
        """Return the processor time that each process has used, seconds, by its first name."""
        used = {}
        for (_, name), pid in self._children().items():
            with contextlib.suppress(OSError, ValueError):
                fields = (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()
                used[name] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        return used

    def _children(self) -> dict[tuple[str, str], int]:
        """Return the processes under `enact up`: kind and first name, and the process's number."""
        supervisor = self._process.pid if self._process is not None else 0
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
            except (OSError, ValueError, IndexError):
                continue  # it ended meanwhile
            if parent == supervisor and "run" in words[3:6]:
                run = words.index("run")
                found[words[run - 1], words[run + 1]] = int(folder.name)
        return found

    def check(self) -> None:
        """Raise `DemoError` with the end of the log if the processes are gone."""
        if self._process is not None and self._process.poll() is not None:
            lines = self._log.read_text(errors="replace").splitlines()[-8:]
            raise DemoError("\n".join([f"the cell went down; the end of {self.log}:", *lines]))


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(DOWN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def until_interrupted(running: DemoCell) -> None:
    """Wait for Ctrl-C or SIGTERM, or until the cell goes down by itself."""
    with StopSignals() as signals:
        while not signals.event.wait(1.0):
            running.check()


def give_way() -> None:
    """Let this thread run only where what it watches leaves a processor idle, or nearly so.

    Who records or looks on must not make a robot's command late.
    """
    with contextlib.suppress(OSError):  # a host on which threads have no priority of their own
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), LOOKING_ON_NICE)


@contextlib.contextmanager
def recording(
    cell: Cell,
    path: Path,
    *,
    worlds: Sequence[str] = (),
    aspects: Sequence[str] = (),
    pictures: bool = True,
    gives_way: bool = True,
) -> Iterator[RecordingSummary]:
    """Record a cell while the block runs; its value says what is recorded and what is missing.

    Args:
        cell: The cell.
        path: The file; an older one is replaced.
        worlds: Names of the world contexts; all unless given.
        aspects: Names of the aspects; all unless given.
        pictures: Whether viewers such as Foxglove can show it.
        gives_way: Record only as far as the cell leaves a processor idle.

    Raises:
        DemoError: The recording failed.
    """
    from enact_dist.recording import Recorder  # of an extra, which not every demonstration needs

    path.unlink(missing_ok=True)
    recorder = Recorder(cell, path, worlds=worlds, aspects=aspects, pictures=pictures)
    stop, errors = threading.Event(), []

    def run() -> None:
        if gives_way:
            give_way()
        try:
            recorder.run(stop)
        except (EnactError, OSError) as error:
            errors.append(error)

    thread = threading.Thread(target=run, name="recorder", daemon=True)
    thread.start()
    try:
        yield recorder.summary
    finally:
        stop.set()
        thread.join()
    if missing := recorder.summary.missing:
        told = ", ".join(f"{count} {why}" for why, count in recorder.summary.gaps.items())
        _LOG.warning("the recording %s lacks %d versions: %s", path, missing, told)
    if errors:
        raise DemoError(f"the recording {path} failed: {errors[0]}") from errors[0]


def placed(config: dict[str, Any], data: Path, ports: Sequence[int]) -> None:
    """Give the shards of a parsed `cell.toml` this host's ports and a data folder.

    Args:
        config: The parsed file; it is changed.
        data: Parent of the shards' folders.
        ports: One of this host for each shard.
    """
    config["data_folder"] = str(data)
    for shard, port in zip(config["shards"].values(), ports, strict=True):
        shard["listen"] = f"tcp/127.0.0.1:{port}"


def _stored(text: str, ports: Sequence[int]) -> str:
    """Return a `cell.toml` whose data are in a database, with a second place for each shard.

    Which database is for the environment to say: an address may have a password.

    Args:
        text: The file of a cell with a data folder.
        ports: Another one of this host for each shard.
    """
    config = tomllib.loads(text)
    del config["data_folder"]
    config["name"] += f"-{secrets.token_hex(4)}"
    for shard, port in zip(config["shards"].values(), ports, strict=True):
        shard["advertise"] = [shard["listen"], f"tcp/127.0.0.1:{port}"]
    return toml_of(config)


def kept_ports(count: int) -> list[socket.socket]:
    """Return sockets, each of which reserves a port of this host without a listener.

    The system gives it to no other process, before a shard listens there or while it restarts;
    who says SO_REUSEADDR, as Zenoh does, listens beside a socket that does not listen.
    """
    kept = [socket.socket() for _ in range(count)]
    for each in kept:
        each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        each.bind(("127.0.0.1", 0))
    return kept


def toml_of(config: dict[str, Any]) -> str:
    """Write tables of two levels, lists of tables and plain values as TOML."""
    lines = [f"{key} = {_value(value)}" for key, value in config.items() if not _nested(value)]
    for name, tables in config.items():
        if isinstance(tables, dict):
            named = [(f"[{name}.{key}]", table) for key, table in tables.items()]
        else:
            named = [(f"[[{name}]]", table) for table in tables] if _nested(tables) else []
        for head, table in named:
            lines += ["", head, *(f"{key} = {_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _nested(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], dict))


def _value(value: object) -> str:
    """Write one value; strings, numbers, truth values and lists of them look as in JSON."""
    if isinstance(value, dict):
        items = (f"{json.dumps(key)} = {_value(item)}" for key, item in value.items())
        return "{ " + ", ".join(items) + " }"
    return json.dumps(value)
