"""The disk of one shard: written in order, synced in batches, torn by crashes.

Duty of a store (`core/protocol/records`): each `Persist` whole or not at all, in order, reported
when it survives what its durability promises.  A crash keeps any prefix that it may keep: a killed
process loses what it had not handed to the operating system, a power cut also what was not synced.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.offline.ledger import Ledger
from enact_dist.terms import Durability
from enact_dist.verify.simulation.hosts.world import MS

if TYPE_CHECKING:
    from collections.abc import Callable
    from random import Random

    from enact_dist.core.protocol.records import Persist, Recovered
    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.hosts.world import Host, SimulatedWorld


class Disk:
    """Everything that one shard ever asked to keep, as far as it has survived."""

    def __init__(self, world: SimulatedWorld, faults: Faults, name: str) -> None:
        self._world = world
        self.faults = faults
        self._batches = world.schedule.place(f"{name}-disk")
        self.log: list[Persist] = []
        self.written = 0
        self.synced = 0
        self.epoch = 0
        self._batch_end = 0
        self._sync_ns = 0
        self._busy = False

    # ---------------------------------------------------------------- a running shard

    def submit(self, host: Host, persist: Persist, done: Callable[[int], None]) -> None:
        """Keep these records; `done(ticket)` follows when they survive what they must."""
        self.log.append(persist)
        if not self._busy:
            self._begin_batch(host, done)

    def _begin_batch(self, host: Host, done: Callable[[int], None]) -> None:
        luck = self._batches.next()
        self._busy = True
        self._batch_end = len(self.log)
        self._sync_ns = MS // 4 + (luck & 0xFFFF) * (4 * MS) // 0x10000
        delay_ns = MS // 20 + (luck >> 16 & 0xFFFF) * MS // 0x10000
        slow = (luck >> 32 & 0xFFFF) < self.faults.slow_disk * 0x10000
        if slow and self._world.schedule.allows(self._batches.fault):
            more_ns = (luck >> 48 & 0xFFFF) * (500 * MS) // 0x10000
            delay_ns += more_ns
            self._world.tally["slow disk batches"] += 1
            self._world.befell(self._batches.fault, f"the disk takes {more_ns // MS} ms more")
        host.later(delay_ns, lambda: self._batch_written(host, done))

    def _batch_written(self, host: Host, done: Callable[[int], None]) -> None:
        first, self.written = self.written, self._batch_end
        batch = self.log[first : self.written]
        if any(persist.durability is Durability.DURABLE for persist in batch):
            host.later(self._sync_ns, lambda: self._batch_synced(host, batch, done))
        else:
            self._batch_done(host, batch, done)

    def _batch_synced(self, host: Host, batch: list[Persist], done: Callable[[int], None]) -> None:
        self.synced = self.written
        self._batch_done(host, batch, done)

    def _batch_done(self, host: Host, batch: list[Persist], done: Callable[[int], None]) -> None:
        self._busy = False
        if len(self.log) > self.written:
            self._begin_batch(host, done)
        for persist in batch:
            if persist.ticket:
                done(persist.ticket)

    # ---------------------------------------------------------------- a crash and what is left

    def keepable(self, *, power_cut: bool) -> range:
        """Return how many records of the log this kind of crash may leave: any prefix."""
        if power_cut:
            return range(self.synced, self.written + 1)
        return range(self.written, max(self.written, self._batch_end) + 1)

    def crash(self, *, power_cut: bool, luck: Random) -> list[Persist]:
        """Lose what this kind of crash may lose; return what was lost."""
        may_keep = self.keepable(power_cut=power_cut)
        keep = luck.choice(may_keep)
        self._world.tally["batches torn"] += may_keep[0] < keep < may_keep[-1]
        self._busy = False
        lost = self.log[keep:]
        del self.log[keep:]
        self.written = self.synced = self._batch_end = keep
        self._world.tally["torn logs"] += bool(lost)
        return lost

    def recovered(self, *, unix_s: int) -> Recovered:
        """Open the store: a new epoch, durable, and everything that has survived."""
        self.epoch = max(self.epoch + 1, unix_s)
        return self.left(len(self.log))

    def left(self, count: int) -> Recovered:
        """Return what a store holds that has kept so many records of the log, in this epoch."""
        records = (record for persist in self.log[:count] for record in persist.records)
        return Ledger(records).recovered(self.epoch)
