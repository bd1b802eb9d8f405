"""Where benches run: a throw-away cell of real daemons, a cell that runs, or this process."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from enact_dist.bench.visit import Visit, anywhere
from enact_dist.config.read import load_config
from enact_dist.config.types import CARRIERS
from enact_dist.errors import MisuseError
from enact_dist.link.memory.shared_folder import MEMORY, SHARED_FOLDER_VARIABLE
from enact_dist.operate.supervise import SUPERVISOR_VARIABLE
from enact_dist.verify.daemons import COMMAND, KeptPorts, LineProcess, write_cell
from enact_dist.world.cell import Cell
from enact_dist.world.connecting import connect, local
from enact_dist.world.context import WorldContext

WORLD: Final = "bench"
"""The world context that all benches write into; made if it does not exist."""
EMBEDDED: Final = "embedded"
CARRIER_VARIABLE: Final = "ENACT_CARRIER"
WORKER: Final = "enact_dist.bench.worker"
PIPELINE_WORKER: Final = "enact_dist.bench.cases.pipeline_worker"
WORKERS_S: Final = 120.0
"""Many processes that start at once on few processors take this long at most."""
END_S: Final = 5.0
JOIN_S: Final = 10.0
assert EMBEDDED not in CARRIERS


@contextlib.contextmanager
def environment(**wanted: str) -> Iterator[None]:
    """Set environment variables for as long as the block runs."""
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end(process: LineProcess) -> None:
    """Ask a process to leave, so that it cleans up; end it if it does not."""
    if process.status is None:
        process.signal(signal.SIGTERM)
        process.wait_status(END_S)
    process.end()


class Place:
    """Opens cells and starts workers in them.  A context manager.

    Args:
        folder: Existing and empty: for `cell.toml`, data and logs.
        target: A cell that runs; None starts one of its own at the first use.
        shards: How many daemons that one has.
        carriers: How benches that compare them reach the cell, `EMBEDDED` among others.
        shared: What the shared folder of an own cell is to be; None for that of this user.
        said: Called with what a person should know of what stays in a cell that runs.
        names: How many names have keys and rights in an own cell; 0: it has neither.
    """

    def __init__(
        self,
        folder: Path,
        *,
        target: str | None,
        shards: int,
        carriers: tuple[str, ...],
        shared: Path | None = None,
        said: Callable[[str], None] = lambda _text: None,
        names: int = 0,
    ) -> None:
        self.folder = folder
        self.carriers = carriers
        self.own = target is None
        self.shard_names = tuple(f"s{number}" for number in range(shards)) if self.own else ()
        self._target = target
        self._names = names
        self._cells: dict[str, Cell] = {}
        self._stack = contextlib.ExitStack()
        self._logs = 0
        self._daemons: list[LineProcess] = []
        self._visit = (
            Visit(target, connected=lambda: self._opened(self.carrier), said=said)
            if target
            else None
        )
        if self.own and shared is not None:
            # No other files are there: what it grows by is ours.
            shared.mkdir(mode=0o700)
            self._stack.enter_context(environment(**{SHARED_FOLDER_VARIABLE: str(shared)}))

    def __enter__(self) -> Place:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._stack.close()
        finally:
            if self._visit is not None:
                self._visit.leave()

    @property
    def embedded(self) -> bool:
        """Whether nothing but this process is asked for."""
        return self.carriers == (EMBEDDED,)

    @property
    def near(self) -> bool:
        """Whether the cell is known to be on this host, whose floors are measured."""
        return self.own or self.way(self.carrier) == "socket"

    @property
    def carrier(self) -> str:
        """The carrier of benches that do not compare them."""
        return self.carriers[0] if len(self.carriers) == 1 else "auto"

    @property
    def target(self) -> str:
        """What clients connect to; the daemons of an own cell are started for it."""
        if self._target is None:
            self._target = self._start_daemons()
        return self._target

    def _start_daemons(self) -> str:
        file, ports = self.folder / "cell.toml", KeptPorts()
        self._stack.callback(ports.close)
        way = "tls" if self._names else "tcp"
        write_cell(
            file,
            "bench",
            worlds=[WORLD],
            listen={name: f"{way}/127.0.0.1:{ports.free()}" for name in self.shard_names},
            pins={f"{name}/**": name for name in self.shard_names},
        )
        if self._names:
            secure(file, self._names)
        # They end with us, however we end: nothing else would ever stop them.
        with environment(**{CARRIER_VARIABLE: "auto", SUPERVISOR_VARIABLE: str(os.getpid())}):
            self._daemons = [
                self._process(COMMAND, ("shard", "run", name, "--cell", str(file)))
                for name in self.shard_names
            ]
        for daemon in self._daemons:
            daemon.expect("ready:")
        return str(file)

    def _process(self, module: str, words: tuple[str, ...]) -> LineProcess:
        self._logs += 1
        process = LineProcess(module, words, self.folder / f"process-{self._logs}.log")
        self._stack.callback(_end, process)
        return process

    # ---------------------------------------------------------------- cells

    def cell(self, carrier: str) -> Cell:
        """Return the cell as this process reaches it over a carrier."""
        if carrier not in self._cells:
            self._cells[carrier] = self._stack.enter_context(self._opened(carrier))
        return self._cells[carrier]

    def world(self, carrier: str, name: str = WORLD) -> WorldContext:
        """Return a world context as this process reaches it over a carrier; made if need be."""
        self.uses(carrier, name)
        return self.cell(carrier).create_world(name)

    def uses(self, carrier: str, name: str) -> None:
        """Note a world context that is made next: of a cell that runs it goes at the end."""
        if self._visit is not None:
            self._visit.uses(self.cell(carrier), name)

    def unused(self, carrier: str, name: str) -> str:
        """Return `name`, or with a number behind it if some shard has a world context of it."""
        found, number = name, 1
        while anywhere(self.cell(carrier), found):
            number += 1
            found = f"{name}_{number}"
        return found

    def way(self, carrier: str) -> str:
        """Return how calls over a carrier travel: "socket", "zenoh" or `EMBEDDED`.

        Over several shards it is "socket" only where all are reached by one.
        """
        if carrier == EMBEDDED:
            return carrier
        self.cell(carrier).worlds()  # greets every shard, so that each says how it is reached
        ways = {shard.carrier for shard in self.cell(carrier).shards()}
        return "socket" if ways == {"socket"} else "zenoh"

    def _opened(self, carrier: str) -> Cell:
        if carrier == EMBEDDED:
            return local(self.folder / EMBEDDED, worlds=[WORLD])
        target = self.target
        with environment(**{CARRIER_VARIABLE: carrier}):
            return connect(target, actor="bench", timeout_s=JOIN_S)

    def _joined(self, carrier: str) -> str:
        """Return what workers connect to, once this process has joined it: they would die of it."""
        if not self.own:
            self.world(carrier)
        return self.target

    @contextlib.contextmanager
    def far_world(self) -> Iterator[WorldContext]:
        """Give the world context as a client of another host has it: no memory in common."""
        target = self._joined(self.carrier)
        with self._elsewhere():
            cell = connect(target, actor="bench-far", timeout_s=JOIN_S)
        with cell:
            yield cell.create_world(WORLD)

    @contextlib.contextmanager
    def _elsewhere(self) -> Iterator[None]:
        """Let what is started meanwhile be on another host, as far as it can see."""
        other = self.folder / "elsewhere"
        other.mkdir(mode=0o700, exist_ok=True)
        with environment(**{CARRIER_VARIABLE: "zenoh", SHARED_FOLDER_VARIABLE: str(other)}):
            yield

    # ---------------------------------------------------------------- workers

    @contextlib.contextmanager
    def workers(
        self,
        roles: Sequence[tuple[str, dict[str, Any]]],
        *,
        carrier: str,
        module: str = WORKER,
    ) -> Iterator[list[LineProcess]]:
        """Run a process for each role with its options; all have said ``ready:``."""
        target = self._joined(carrier)
        with environment(**{CARRIER_VARIABLE: carrier}):
            processes = [
                self._process(module, (target, role, json.dumps(options)))
                for role, options in roles
            ]
        try:
            for process in processes:
                process.expect("ready:", timeout_s=WORKERS_S)
            yield processes
        finally:
            for process in processes:
                _end(process)

    @contextlib.contextmanager
    def command(self, *words: str) -> Iterator[LineProcess]:
        """Run an `enact` command until the end of the block."""
        process = self._process(COMMAND, words)
        try:
            yield process
        finally:
            _end(process)

    @contextlib.contextmanager
    def worker(self, role: str, *, carrier: str, **options: Any) -> Iterator[LineProcess]:
        """Run `enact_dist.bench.worker` in a role; it has said ``ready:``."""
        with self.workers([(role, options)], carrier=carrier) as (process,):
            yield process

    @contextlib.contextmanager
    def far_worker(self, role: str, **options: Any) -> Iterator[LineProcess]:
        """Run a worker as on another host: it has no memory in common with any shard."""
        target = self._joined(self.carrier)
        with self._elsewhere():
            process = self._process(WORKER, (target, role, json.dumps(options)))
        try:
            process.expect("ready:", timeout_s=WORKERS_S)
            yield process
        finally:
            _end(process)

    def daemon_pids(self) -> list[int]:
        """Return the process ids of the daemons of an own cell."""
        return [daemon.pid for daemon in self._daemons]


def secure(file: Path, names: int) -> None:
    """Give keys and rights to so many names of a cell, the first of them an operator.

    Raises:
        MisuseError: This Python cannot make keys.
    """
    if find_spec("cryptography") is None:
        raise MisuseError("keys need cryptography: install the extra 'keys'")
    from enact_dist.operate.keys import Authority, make_authority, owners_of, write_keys

    programs = [f"program{number}" for number in range(1, names)]
    rules = "".join(
        f'[[rights.allow]]\nwho = "{name}"\nwrite = "{WORLD}:{name}/**"\n' for name in programs
    )
    with file.open("a", encoding="utf-8") as text:
        text.write(
            f'[security]\nkeys = "keys"\noperators = ["bench"]\n'
            f'[rights]\ndefault = "none"\nprograms = {json.dumps(programs)}\n{rules}'
        )
    make_authority(file.stem, file.parent / "authority")
    authority = Authority.load(file.parent / "authority")
    for owner in owners_of(load_config(file, environment={})):
        write_keys(authority, owner, file.parent / "keys")


@contextlib.contextmanager
def folders() -> Iterator[tuple[Path, Path]]:
    """Give two empty folders, on disk and in shared memory; both go at the end of the block."""
    made = partial(tempfile.TemporaryDirectory, prefix="enact-bench-")
    with made() as disk, made(dir=MEMORY if MEMORY.is_dir() else None) as memory:
        yield Path(disk), Path(memory)


@contextlib.contextmanager
def fresh_place(carrier: str = "auto", *, names: int = 0) -> Iterator[tuple[Place, Path]]:
    """Give a cell of one daemon that has served nothing before, and its shared folder.

    See `Place` for `names`.
    """
    with folders() as (folder, memory):
        shared = memory / "shared"
        with Place(
            folder, target=None, shards=1, carriers=(carrier,), shared=shared, names=names
        ) as place:
            yield place, shared
