"""What is done to a cell under test: drawn from a seed like cards from a deck, one after the other.

======================  =======================================================================
kill shard, kill client SIGKILL, and a new process after a while; clients by preference within
                        a lock or as they send a commit
stop shard, stop client SIGSTOP for up to three TTLs; clients as above
restart shard           SIGTERM, and a new process once it has ended
set wall clock          the same with a wall clock that is wrong until the next restart: up to
                        0.4 s ahead, or an hour behind
partition               two hosts, or a host and all shards, lose each other
one-way partition       one of them hears the other no more
slow network            whatever a host sends and gets takes 5 to 50 ms, each way
lossy network           of whatever a host sends and gets 1 to 10 % is lost
======================  =======================================================================

A deck has every kind as often as `DECK` says, so that no kind is missing in a short run.
"""

from __future__ import annotations

import heapq
import itertools
import os
import random
import signal
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

from enact_dist.errors import LinkError
from enact_dist.verify.chaos.cell import END_S, StartedClient, TestedCell
from enact_dist.verify.chaos.network.switch import Cable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from enact_dist.verify.chaos.journal import Journal
    from enact_dist.verify.chaos.network.hosts import Hosts

KILL_SHARD, KILL_CLIENT = "kill shard", "kill client"
STOP_SHARD, STOP_CLIENT = "stop shard", "stop client"
RESTART, WALL_CLOCK = "restart shard", "set wall clock"
PARTITION, ONE_WAY = "partition", "one-way partition"
SLOW, LOSSY = "slow network", "lossy network"
DECK: Final = {
    KILL_SHARD: 3,
    KILL_CLIENT: 3,
    STOP_SHARD: 2,
    STOP_CLIENT: 4,
    RESTART: 1,
    WALL_CLOCK: 1,
    PARTITION: 2,
    ONE_WAY: 3,
    SLOW: 1,
    LOSSY: 1,
}
AHEAD_S_MAX: Final = 0.4
BEHIND_S: Final = -3600.0
DELAY_S: Final = (0.005, 0.05)
LOSS: Final = (0.01, 0.1)
PAUSE_S: Final = (0.7, 1.9)
"""Between the begin of one fault and the next."""
POLL_S: Final = 0.02
AIM_S: Final = 0.3


class FaultInjector:
    """Draws faults and carries them out.

    Args:
        cell: Whose processes.
        hosts: Their hosts.
        groups: Hosts of clients.
        log: Gets each fault.
        seed: What happens is drawn from it, as far as the moments repeat.
        ttl_s: Session TTL.
        deck: How many cards of each kind.

    Attributes:
        network_kinds: What needs a network of the run's own.
    """

    network_kinds: ClassVar = frozenset((PARTITION, ONE_WAY, SLOW, LOSSY))

    def __init__(
        self,
        cell: TestedCell,
        hosts: Hosts,
        groups: tuple[str, ...],
        log: Journal,
        *,
        seed: int,
        ttl_s: float,
        deck: Mapping[str, int] = DECK,
    ) -> None:
        self._cell, self._hosts, self._groups, self._log = cell, hosts, groups, log
        self._draw, self._ttl_s = random.Random(seed), ttl_s
        self._deck: list[str] = []
        self._busy: set[str] = set()
        self._cuts: set[tuple[str, str]] = set()
        self._ends: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        apart = not any("partitions" in name for name in hosts.missing)
        self._cards = [
            kind
            for kind, count in deck.items()
            if apart or kind not in self.network_kinds
            for _ in range(count)
        ]

    # ---------------------------------------------------------------- time

    def run(self, seconds: float, *, progress: Callable[[float], None]) -> None:
        """Let faults happen for so long, then end all of them; `progress` gets what is left.

        Raises:
            LinkError: A process ended by itself, or a shard does not come up.
        """
        try:
            self._run(time.monotonic() + seconds, progress)
            while self._ends:  # an end may bring another one
                self._end_due(float("inf"))
        except LinkError:
            self._give_up()
            raise

    def _run(self, end_s: float, progress: Callable[[float], None]) -> None:
        due_s = time.monotonic() + self._draw.uniform(*PAUSE_S)
        while (now_s := time.monotonic()) < end_s:
            next_s = min(due_s, end_s, self._ends[0][0] if self._ends else end_s)
            time.sleep(min(0.5, max(0.0, next_s - now_s)))
            self._end_due(time.monotonic())
            self._cell.check()
            progress(end_s - time.monotonic())
            if time.monotonic() >= due_s:
                self._begin()
                due_s = time.monotonic() + self._draw.uniform(*PAUSE_S)

    def _give_up(self) -> None:
        """End what is under way once one of the ends has failed, as far as the others do not."""
        give_up_s = time.monotonic() + END_S
        while self._ends and time.monotonic() < give_up_s:
            with suppress(LinkError):
                self._end_due(float("inf"))

    def _end_due(self, now_s: float) -> None:
        while self._ends and self._ends[0][0] <= now_s:
            _, _, end = heapq.heappop(self._ends)
            end()

    def _after(self, seconds: float, end: Callable[[], None]) -> None:
        heapq.heappush(self._ends, (time.monotonic() + seconds, next(self._number), end))

    def _begin(self) -> None:
        """Carry out the next card, unless what it would hit is hit already."""
        if not self._deck:
            self._deck = list(self._cards)
            self._draw.shuffle(self._deck)
        kind = self._deck.pop()
        if not self._kinds()[kind]():
            self._deck.insert(self._draw.randint(0, len(self._deck)), kind)

    def _kinds(self) -> dict[str, Callable[[], bool]]:
        """Return what carries out a fault of each kind, if it can now."""
        return {
            KILL_SHARD: self._kill_shard,
            KILL_CLIENT: self._kill_client,
            STOP_SHARD: lambda: self._stop(self._up(), STOP_SHARD),
            STOP_CLIENT: lambda: self._stop(list(self._cell.clients), STOP_CLIENT),
            RESTART: lambda: self._restart(RESTART),
            WALL_CLOCK: lambda: self._restart(WALL_CLOCK),
            PARTITION: lambda: self._partition(one_way=False),
            ONE_WAY: lambda: self._partition(one_way=True),
            SLOW: lambda: self._spoil(SLOW),
            LOSSY: lambda: self._spoil(LOSSY),
        }

    def _free(self, names: list[str]) -> str | None:
        """Draw one of `names` that nothing is being done to."""
        free = [name for name in names if name not in self._busy]
        return self._draw.choice(free) if free else None

    def _note(self, kind: str, targets: list[str], from_ns: int) -> None:
        self._log.write("fault", kind, targets, from_ns, time.monotonic_ns())

    # ---------------------------------------------------------------- shards and clients

    def _kill_shard(self) -> bool:
        name = self._free(self._up())
        if name is None:
            return False
        self._busy.add(name)
        process, from_ns = self._cell.shards[name].process, time.monotonic_ns()
        self._cell.shards[name].ready.clear()
        process.kill()
        self._cell.end(process)
        pause_s = self._draw.choice((0.0, 0.0, 0.2, 1.0, 2.0)) * self._ttl_s
        self._after(pause_s, lambda: self._start_shard(name, KILL_SHARD, from_ns))
        return True

    def _up(self) -> list[str]:
        return [name for name, shard in self._cell.shards.items() if shard.ready.is_set()]

    def _start_shard(self, name: str, kind: str, from_ns: int, *, offset_s: float = 0.0) -> None:
        self._cell.start_shard(name, offset_s=offset_s, down_ns=from_ns)
        self._wait_shard(name, kind, from_ns)

    def _wait_shard(self, name: str, kind: str, from_ns: int) -> None:
        if not self._cell.shards[name].ready.is_set():
            self._cell.shards[name].ready.wait(POLL_S)
            self._after(0.0, lambda: self._wait_shard(name, kind, from_ns))
            return
        self._note(kind, [name], from_ns)
        self._busy.discard(name)

    def _restart(self, kind: str) -> bool:
        name = self._free(self._up())
        if name is None:
            return False
        self._busy.add(name)
        offset_s = 0.0
        if kind == WALL_CLOCK:
            ahead_s = self._draw.uniform(-AHEAD_S_MAX, AHEAD_S_MAX)
            offset_s = self._draw.choice((ahead_s, BEHIND_S))
        shard, from_ns = self._cell.shards[name], time.monotonic_ns()
        shard.ready.clear()
        shard.process.signal(signal.SIGTERM)

        def again() -> None:
            if shard.process.wait_status(POLL_S) is None:
                if time.monotonic_ns() > from_ns + END_S * 1e9:
                    raise LinkError(f"shard {name} does not end {END_S:g} s after SIGTERM")
                self._after(0.0, again)
                return
            self._cell.end(shard.process)
            self._start_shard(name, kind, from_ns, offset_s=offset_s)

        self._after(0.0, again)
        return True

    def _kill_client(self) -> bool:
        name = self._free(list(self._cell.clients))
        if name is None:
            return False
        client = self._cell.clients[name]
        self._aim(client)
        from_ns = time.monotonic_ns()
        client.process.kill()
        self._note(KILL_CLIENT, [f"{name}.{client.incarnation}"], from_ns)
        self._cell.end(client.process)
        self._cell.start_client(name, client.host, incarnation=client.incarnation + 1)
        return True

    def _aim(self, client: StartedClient) -> None:
        """Wait until the client is where it hurts: within a lock, or about to send a commit.

        Such moments are short and seldom hit by chance; without one within `AIM_S` any will do.
        """
        aim = self._draw.choice((None, b'["seen"', b'["write"'))
        deadline_s = time.monotonic() + AIM_S
        path = self._cell.journal_of(client)
        if not path.exists():
            return  # just started
        with path.open("rb") as journal:
            journal.seek(0, os.SEEK_END)
            while aim is not None and time.monotonic() < deadline_s:
                line = journal.readline()
                if line.startswith(aim):
                    return
                if not line:
                    time.sleep(0.0005)

    def _stop(self, names: list[str], kind: str) -> bool:
        ready = [
            n for n in names if n not in self._cell.shards or self._cell.shards[n].ready.is_set()
        ]
        name = self._free(ready)
        if name is None:
            return False
        self._busy.add(name)
        if name in self._cell.clients:
            self._aim(self._cell.clients[name])
        owner = self._cell.shards.get(name) or self._cell.clients[name]
        process, from_ns = owner.process, time.monotonic_ns()
        process.signal(signal.SIGSTOP)

        def go_on() -> None:
            process.signal(signal.SIGCONT)
            self._note(kind, [name], from_ns)
            self._busy.discard(name)

        self._after(self._draw.choice((0.3, 0.6, 1.2, 2.0, 3.0)) * self._ttl_s, go_on)
        return True

    # ---------------------------------------------------------------- network

    def _partition(self, *, one_way: bool) -> bool:
        draw, shards = self._draw, list(self._cell.shards)
        one = draw.choice((*self._groups, *shards))
        others = [shard for shard in shards if shard != one]
        if not others:
            return False
        others = others if draw.random() < 0.3 else [draw.choice(others)]
        hears = draw.random() < 0.5  # of a one-way partition: which of the two still hears
        cuts = set()
        for other in others:
            if not one_way or hears:
                cuts.add((one, other))
            if not one_way or not hears:
                cuts.add((other, one))
        cuts -= self._cuts
        if not cuts:
            return False
        from_ns = time.monotonic_ns()
        for source, target in cuts:
            self._hosts.cut(source, target)
        self._cuts |= cuts

        def heal() -> None:
            for source, target in cuts:
                self._hosts.heal(source, target)
            self._cuts.difference_update(cuts)
            self._note(ONE_WAY if one_way else PARTITION, [one, *others], from_ns)

        self._after(draw.choice((0.4, 1.0, 2.0, 3.0)) * self._ttl_s, heal)
        return True

    def _spoil(self, kind: str) -> bool:
        """Let all cables of one host be slow or lossy for a while."""
        if not self._busy.isdisjoint((SLOW, LOSSY)):  # the end of one would end the other
            return False
        self._busy.add(kind)
        draw = self._draw
        host = draw.choice(self._cabled())
        if kind == SLOW:
            delay_s = draw.uniform(*DELAY_S)
            cable = Cable(delay_s, jitter_s=delay_s / 4)
        else:
            cable = Cable(loss=draw.uniform(*LOSS))
        from_ns = time.monotonic_ns()
        self._lay(host, cable)

        def mend() -> None:
            self._lay(host, Cable())
            self._note(kind, [host], from_ns)
            self._busy.discard(kind)

        self._after(draw.choice((1.0, 2.0, 4.0)) * self._ttl_s, mend)
        return True

    def _cabled(self) -> tuple[str, ...]:
        """Return the hosts whose cables may be spoiled."""
        return (*self._groups, *self._cell.shards)

    def _lay(self, host: str, cable: Cable) -> None:
        for other in self._cabled():
            if other != host:
                self._hosts.lay(host, other, cable)
                self._hosts.lay(other, host, cable)


@dataclass(frozen=True, slots=True)
class StagedRun:
    """What a run starts, and what harms it."""

    hosts: Hosts
    cell: TestedCell
    injector: FaultInjector
