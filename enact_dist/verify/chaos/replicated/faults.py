"""What is done to a cell in a database: to its daemons, clients and networks.

======================  =======================================================================
kill serving daemon     SIGKILL; another one of it is started after a while
kill standby daemon     the same with one that stands by
stop serving daemon     SIGSTOP for up to three leases
stop standby daemon     the same with one that stands by
wake old daemon         SIGSTOP until another daemon has taken the shard over, and a while longer
restart …               SIGTERM, and a new process once it has ended
cut from database       a host of daemons and the hosts of the database lose each other
cut from clients        a host of daemons and those of the clients
cut off                 a host of daemons and all others
cut between databases   the two hosts of the database
one way: …              one of the two hears the other no more
======================  =======================================================================

Clients are killed and stopped, and networks spoiled, as in a cell with folders; `database_faults`
has those of the database.
"""

from __future__ import annotations

import random
import signal
import time
from typing import TYPE_CHECKING, ClassVar, Final, cast

from enact_dist.verify.chaos.cell import END_S
from enact_dist.verify.chaos.faults import (
    KILL_CLIENT,
    LOSSY,
    POLL_S,
    SLOW,
    STOP_CLIENT,
    FaultInjector,
)
from enact_dist.verify.chaos.replicated import database_faults
from enact_dist.verify.chaos.replicated.cell import AGAIN_S, DaemonPlace, ReplicatedCell
from enact_dist.verify.chaos.replicated.cuts import SharedCuts, ways_between

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future

    from enact_dist.verify.chaos.journal import Journal
    from enact_dist.verify.chaos.network.hosts import Hosts
    from enact_dist.verify.chaos.replicated.database_faults import DatabaseFaults

KILL_SERVING, KILL_STANDBY = "kill serving daemon", "kill standby daemon"
STOP_SERVING, STOP_STANDBY = "stop serving daemon", "stop standby daemon"
RESTART_SERVING, RESTART_STANDBY = "restart serving daemon", "restart standby daemon"
WAKE_OLD = "wake old daemon"
CUT_DATABASE, CUT_CLIENTS, CUT_OFF = "cut from database", "cut from clients", "cut off"
CUT_BETWEEN = "cut between databases"
_CUTS: Final = (CUT_DATABASE, CUT_CLIENTS, CUT_OFF, CUT_BETWEEN)
ONE_WAY_CUTS: Final = {f"one way: {kind}": kind for kind in _CUTS}
DECK: Final = {
    KILL_SERVING: 3,
    KILL_STANDBY: 1,
    STOP_SERVING: 2,
    STOP_STANDBY: 1,
    WAKE_OLD: 2,
    RESTART_SERVING: 1,
    RESTART_STANDBY: 1,
    KILL_CLIENT: 2,
    STOP_CLIENT: 2,
    SLOW: 1,
    LOSSY: 1,
    **dict.fromkeys(_CUTS, 1),
    **dict.fromkeys(ONE_WAY_CUTS, 1),
    **database_faults.DECK,
}
AWAKE_S: Final = 15.0
"""How long an old daemon sleeps if no other takes over."""


class ReplicatedFaults(FaultInjector):
    """Draws faults and carries them out; see `FaultInjector`.

    Args:
        places: Hosts of daemons.
        lease_s: Of the shards.
        database: What is done to the database; None: it is not the run's own.
    """

    network_kinds: ClassVar = frozenset((SLOW, LOSSY, *_CUTS, *ONE_WAY_CUTS, *database_faults.DECK))

    def __init__(
        self,
        cell: ReplicatedCell,
        hosts: Hosts,
        groups: tuple[str, ...],
        log: Journal,
        *,
        seed: int,
        ttl_s: float,
        deck: Mapping[str, int],
        places: tuple[str, ...],
        lease_s: float,
        cuts: SharedCuts,
        database: DatabaseFaults | None,
    ) -> None:
        super().__init__(cell, hosts, groups, log, seed=seed, ttl_s=ttl_s, deck=deck)
        self._hosts_of_daemons, self._lease_s, self._shared = places, lease_s, cuts
        self._database = database

    def _kinds(self) -> dict[str, Callable[[], bool]]:
        clients = list(self._cell.clients)
        kinds: dict[str, Callable[[], bool]] = {
            KILL_SERVING: lambda: self._end_daemon(KILL_SERVING, serves=True, kills=True),
            KILL_STANDBY: lambda: self._end_daemon(KILL_STANDBY, serves=False, kills=True),
            STOP_SERVING: lambda: self._stop_daemon(STOP_SERVING, serves=True),
            STOP_STANDBY: lambda: self._stop_daemon(STOP_STANDBY, serves=False),
            RESTART_SERVING: lambda: self._end_daemon(RESTART_SERVING, serves=True),
            RESTART_STANDBY: lambda: self._end_daemon(RESTART_STANDBY, serves=False),
            WAKE_OLD: self._wake_old,
            KILL_CLIENT: self._kill_client,
            STOP_CLIENT: lambda: self._stop(clients, STOP_CLIENT),
            SLOW: lambda: self._spoil(SLOW),
            LOSSY: lambda: self._spoil(LOSSY),
        }
        for kind in _CUTS:
            kinds[kind] = lambda kind=kind: self._cut(kind, kind, one_way=False)  # type: ignore[misc]
        for name, kind in ONE_WAY_CUTS.items():
            kinds[name] = lambda name=name, kind=kind: self._cut(name, kind, one_way=True)  # type: ignore[misc]
        for kind in database_faults.DECK:
            kinds[kind] = lambda kind=kind: self._harm_database(kind)  # type: ignore[misc]
        return kinds

    # ---------------------------------------------------------------- daemons

    def _daemon(self, *, serves: bool) -> DaemonPlace | None:
        """Draw a daemon to which nothing is being done."""
        places = cast("ReplicatedCell", self._cell).places
        name = self._free([n for n, p in places.items() if p.up.is_set() and p.serves == serves])
        return None if name is None else places[name]

    def _await_up(self, place: DaemonPlace, kind: str, from_ns: int) -> None:
        """Note a fault once a daemon is up again."""
        self._busy.add(place.name)

        def look() -> None:
            waited_s = (time.monotonic_ns() - from_ns) / 1e9
            if not place.up.wait(POLL_S) and waited_s < END_S:
                self._after(0.0, look)
                return
            if waited_s >= END_S:
                self._log.write("failure", "no daemon comes up again", f"{kind}: {place.name}")
            self._note(kind, [place.shard, place.name], from_ns)
            self._busy.discard(place.name)

        self._after(0.0, look)

    def _end_daemon(self, kind: str, *, serves: bool, kills: bool = False) -> bool:
        place = self._daemon(serves=serves)
        if place is None or place.process is None:
            return False
        place.ordered = True
        if kills:
            place.pause_s = self._draw.choice((0.0, AGAIN_S, 1.0, 2.0)) * self._lease_s
        from_ns = time.monotonic_ns()
        place.up.clear()
        place.process.signal(signal.SIGKILL if kills else signal.SIGTERM)
        self._await_up(place, kind, from_ns)
        return True

    def _stop_daemon(self, kind: str, *, serves: bool) -> bool:
        place = self._daemon(serves=serves)
        if place is None or place.process is None:
            return False
        self._busy.add(place.name)
        process, from_ns = place.process, time.monotonic_ns()
        process.signal(signal.SIGSTOP)

        def go_on() -> None:
            process.signal(signal.SIGCONT)
            self._note(kind, [place.shard, place.name], from_ns)
            self._busy.discard(place.name)

        self._after(self._draw.choice((0.2, 0.9, 1.1, 2.0, 3.0)) * self._lease_s, go_on)
        return True

    def _wake_old(self) -> bool:
        place = self._daemon(serves=True)
        if place is None or place.process is None:
            return False
        self._busy.add(place.name)
        process, from_ns = place.process, time.monotonic_ns()
        process.signal(signal.SIGSTOP)
        places = cast("ReplicatedCell", self._cell).places
        others = [p for p in places.values() if p.shard == place.shard and p is not place]

        def look() -> None:
            waits = (time.monotonic_ns() - from_ns) / 1e9 < AWAKE_S
            if waits and not any(other.serves for other in others):
                self._after(POLL_S, look)
            else:
                self._after(self._draw.choice((0.0, 0.1, 1.0)), wake)

        def wake() -> None:
            process.signal(signal.SIGCONT)
            self._note(WAKE_OLD, [place.shard, place.name], from_ns)
            self._busy.discard(place.name)

        self._after(POLL_S, look)
        return True

    # ---------------------------------------------------------------- networks and database

    def _cabled(self) -> tuple[str, ...]:
        databases = self._database.names if self._database is not None else ()
        return (*self._groups, *self._hosts_of_daemons, *databases)

    def _cut(self, name: str, kind: str, *, one_way: bool) -> bool:
        if kind in self._busy or self._database is None:
            return False
        draw, databases = self._draw, self._database.names
        one = draw.choice(self._hosts_of_daemons)
        if kind == CUT_BETWEEN:
            one, *others = draw.sample(databases, 2)
        elif kind == CUT_DATABASE:
            others = list(databases) if draw.random() < 0.7 else [draw.choice(databases)]
        elif kind == CUT_CLIENTS:
            others = list(self._groups)
        else:
            others = [other for other in self._cabled() if other != one]
        hears = draw.random() < 0.5
        sends, hears = (not hears, hears) if one_way else (True, True)
        ways = ways_between(one, others, sends=sends, hears=hears)
        from_ns = time.monotonic_ns()
        self._busy.add(kind)
        self._shared.cut(ways)

        def heal() -> None:
            self._shared.heal(ways)
            self._note(name, [one, *others], from_ns)
            self._busy.discard(kind)

        self._after(draw.choice((0.5, 1.5, 2.5, 5.0)) * self._lease_s, heal)
        return True

    def _harm_database(self, kind: str) -> bool:
        if self._database is None or database_faults.TARGET in self._busy:
            return False
        self._busy.add(database_faults.TARGET)
        from_ns = time.monotonic_ns()
        draw = random.Random(self._draw.random())
        done = self._database.begin(kind, draw)
        self._after(POLL_S, lambda: self._await_database(done, from_ns))
        return True

    def _await_database(self, done: Future[str], from_ns: int) -> None:
        """Note a fault of the database once that is whole again."""
        if not done.done():
            time.sleep(POLL_S)
            self._after(POLL_S, lambda: self._await_database(done, from_ns))
            return
        self._note(done.result(), [database_faults.TARGET], from_ns)
        self._busy.discard(database_faults.TARGET)
