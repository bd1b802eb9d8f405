"""The processes of a cell in a database: two daemons per shard, started again whenever they end."""

from __future__ import annotations

import signal
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.errors import LinkError
from enact_dist.link.log import READY, STANDS_BY
from enact_dist.verify.chaos.cell import END_S, TestedCell
from enact_dist.verify.chaos.replicated import daemon
from enact_dist.verify.chaos.replicated.answers import SUFFIX
from enact_dist.verify.chaos.workload import WORLDS
from enact_dist.verify.daemons import LOG_BYTES, LineProcess, last_said, write_cell

if TYPE_CHECKING:
    from pathlib import Path

    from enact_dist.verify.chaos.journal import Journal
    from enact_dist.verify.chaos.network.hosts import Hosts

AGAIN_S: Final = 0.3
"""When a daemon that ended is started again, as by a service manager."""
EVER_S: Final = 1e6
LOST: Final = {
    "has another holder": "another daemon has the shard",
    "is served by process": "another daemon was first",
    "the database warned": "the database warned",
    "SQLSTATE 53": "the database's disk is full",
}
"""Why a daemon may end by itself: what its last words contain, and what the report calls it."""
_CRITICAL: Final = " CRITICAL "
_AWAY: Final = "and the shard ends: what it has not acknowledged"
"""Last words of a daemon that is ended in good order while the database cannot be reached."""
AS_ORDERED: Final = "as ordered"
UNEXPECTED_END: Final = "a daemon ended for no reason that it may have"


@dataclass(slots=True, eq=False)
class DaemonPlace:
    """Where a daemon of a shard runs.

    Attributes:
        up: Set while a daemon serves or stands by there.
        serves: Whether it serves.
        pause_s: When the next one is started once this one has ended.
        ordered: Whether its end was wanted.
        logged: How long the log of its predecessors is.
    """

    shard: str
    host: str
    listen: str
    up: threading.Event = field(default_factory=threading.Event)
    serves: bool = False
    pause_s: float = AGAIN_S
    ordered: bool = False
    starts: int = 0
    logged: int = 0
    process: LineProcess | None = None

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"{self.shard}@{self.host}"


class ReplicatedCell(TestedCell):
    """All processes of one run; see `TestedCell`.

    Args:
        store: Address of the database.
        cell: Name of the cell, under which its shards stand there.
        places: Hosts of the daemons; each runs one of every shard.
        lease_s: Of the shards.
    """

    __test__ = False

    def __init__(
        self,
        folder: Path,
        hosts: Hosts,
        shards: tuple[str, ...],
        log: Journal,
        *,
        ttl_s: float,
        seed: int,
        store: str,
        cell: str,
        places: tuple[str, ...],
        lease_s: float,
        daemon_module: str = daemon.MODULE,
    ) -> None:
        self._places, self._store, self._lease_s, self._name = places, store, lease_s, cell
        self.places: dict[str, DaemonPlace] = {}
        self._keeping = threading.Lock()
        self._closing = threading.Event()
        super().__init__(
            folder, hosts, shards, log, ttl_s=ttl_s, seed=seed, daemon_module=daemon_module
        )

    def _write_file(self, shards: tuple[str, ...]) -> None:
        listen = {
            shard: [self._hosts.endpoint(host, index) for host in self._places]
            for index, shard in enumerate(shards)
        }
        self.file.touch(mode=0o600)  # the address may have a password
        write_cell(
            self.file,
            self._name,
            worlds=WORLDS,
            listen={shard: endpoints[0] for shard, endpoints in listen.items()},
            advertise=listen,
            pins={f"thing/{name}/*": name for name in shards},
            session_ttl_s=self._ttl_s,
            store=self._store,
            lease_s=self._lease_s,
        )
        for shard, endpoints in listen.items():
            for host, endpoint in zip(self._places, endpoints, strict=True):
                place = DaemonPlace(shard, host, endpoint)
                self.places[place.name] = place

    # ---------------------------------------------------------------- daemons

    def start_shard(self, name: str, *, offset_s: float = 0.0, down_ns: int = 0) -> None:
        """Keep two daemons of a shard running from now on."""
        for place in self.places.values():
            if place.shard == name:
                # A child dies with the thread that started it, so this one stays.
                threading.Thread(target=self._keep, args=(place,), daemon=True).start()

    def _keep(self, place: DaemonPlace) -> None:
        """Run one daemon after the other."""
        while not self._closing.is_set():
            with self._keeping:
                if self._closing.is_set():
                    return
                process = place.process = self._start(place)
            self._log.write("start", place.name, place.starts, time.monotonic_ns())
            self._listen(place, process)
            if self._closing.is_set():
                return
            self._note_end(place, process)
            self.end(process)
            self._closing.wait(place.pause_s)
            place.pause_s, place.ordered = AGAIN_S, False

    def _start(self, place: DaemonPlace) -> LineProcess:
        place.starts += 1
        place.logged = log.stat().st_size if (log := self._output(place)).exists() else 0
        answers = self._folder / f"{place.name}.{place.starts}{SUFFIX}"
        ahead_ns = str(self._hosts.clock_ahead_ns[place.host])
        what = ("shard", "run", place.shard, "--cell", str(self.file), "--standby")
        words = (ahead_ns, str(answers), *what, "--listen", place.listen)
        return self._run(self._module, words, place.name, place.host)

    def _listen(self, place: DaemonPlace, process: LineProcess) -> None:
        """Take note of what a daemon says until it ends."""
        epoch = fenced_ns = ready_ns = 0
        while True:
            try:
                line = process.expect("", timeout_s=EVER_S)
            except LinkError:
                break
            if line.startswith(daemon.FENCED):
                epoch, fenced_ns = map(int, line.split()[1:])
            elif line.startswith(READY):
                ready_ns = time.monotonic_ns()
                self._note_takeover(place, epoch, fenced_ns, ready_ns)
                place.serves = True
                place.up.set()
            elif line.startswith(STANDS_BY):
                place.up.set()
        place.up.clear()
        place.serves = False
        process.wait_ended()
        if epoch and not ready_ns:
            self._note_takeover(place, epoch, fenced_ns, time.monotonic_ns())

    def _output(self, place: DaemonPlace) -> Path:
        return self._folder / f"{place.name}.output"

    def _note_takeover(self, place: DaemonPlace, epoch: int, fenced_ns: int, ready_ns: int) -> None:
        self._log.write("restart", place.shard, epoch, fenced_ns, fenced_ns, ready_ns, ready_ns)

    def _note_end(self, place: DaemonPlace, process: LineProcess) -> None:
        status = process.status
        log = self._output(place).read_bytes()[place.logged :].decode(errors="replace")
        stops = [line for line in log.splitlines() if _CRITICAL in line]
        said = stops[-1] if stops else last_said(log[-LOG_BYTES:])
        why = next((why for text, why in LOST.items() if status == 1 and text in said), "")
        if place.ordered and (status in (0, -signal.SIGKILL) or _AWAY in said):
            why = AS_ORDERED
        self._log.write("end", place.name, status, why or said, time.monotonic_ns())
        if not why:
            self._log.write("failure", UNEXPECTED_END, f"{place.name}: {status}: {said}")

    def wait_ready(self) -> None:
        """Wait until two daemons of each shard are up.

        Raises:
            LinkError: They are not.
        """
        for place in self.places.values():
            if not place.up.wait(END_S):
                raise LinkError(f"no daemon of {place.name} comes up within {END_S:g} s")
        self.check()

    def end_shards(self) -> None:
        """End all daemons in good order."""
        for place in self.places.values():
            place.up.wait(END_S)
        with self._keeping:
            self._closing.set()
        running = [(p, p.process, p.up.is_set()) for p in self.places.values()]
        for _, process, _ in running:
            if process is not None:
                process.signal(signal.SIGTERM)
        for place, process, was_up in running:
            status = process.wait_status(END_S) if process is not None else 0
            # One that is just being started does not heed the signal yet.
            if status != 0 and (was_up or status != -signal.SIGTERM):
                self._log.write("failure", "a shard does not end well", f"{place.name}: {status}")

    def close(self) -> None:
        """End every process, however it is; twice is harmless."""
        with self._keeping:
            self._closing.set()
        super().close()
