"""One of the daemons that may serve a shard: it stands by, takes the shard over, writes, and ends.

The shard, its lease and the rules about lost connections are the real ones; database and clocks are
simulated.  What it does between two steps is what `link.postgres` and `link.lease` do.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from enact_dist.core.failover.lease import (
    BrokenBatch,
    HolderRow,
    Lease,
    Silence,
    Standby,
    after_break,
)
from enact_dist.core.offline.ledger import Ledger
from enact_dist.core.protocol.records import Persisted
from enact_dist.verify.simulation.hosts.shard_host import ShardNode
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.takeover.database import RowChange, StatementDone

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.core.protocol.records import Effect, Event, Persist
    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.takeover.database import SimulatedDatabase, SimulatedLink

RENEW_NS = 400 * MS
LOOK_NS = 100 * MS
AGAIN_NS = 100 * MS


class SimulatedLine:
    """Acts through a connection until one is confirmed, as `link.postgres.line` does.

    Args:
        daemon: Whose.
    """

    def __init__(self, daemon: SimulatedDaemon) -> None:
        self._daemon = daemon
        self._connection: SimulatedLink | None = None
        self._act: Callable[[], None] | None = None
        self.breaks = 0

    def connection(self) -> SimulatedLink | None:
        """Return an open connection; None: there is none now."""
        if self._connection is None or not self._connection.open:
            daemon = self._daemon
            self._connection = daemon.database.connect(daemon, self._broken)
        return self._connection

    def _broken(self, connection: SimulatedLink) -> None:
        if connection is not self._connection:
            return  # it was noticed before
        self.breaks += 1
        act, self._act = self._act, None
        if act is not None:
            self._daemon.later(AGAIN_NS, act)

    def attempt(self, again: Callable[[], None]) -> SimulatedLink | None:
        """Return a connection for one act; `again` follows if there is none, or if it breaks."""
        connection = self.connection()
        if connection is None:
            self._act = None
            self.breaks += 1
            self._daemon.later(AGAIN_NS, again)
        else:
            self._act = again
        return connection

    def done(self) -> None:
        """Take note that the act came to its end."""
        self._act = None


class SimulatedDaemon(ShardNode):
    """A daemon of a shard that another one may serve as well."""

    def __init__(
        self,
        world: SimulatedWorld,
        settings: ShardSettings,
        faults: Faults,
        *,
        name: str,
        database: SimulatedDatabase,
        lease_ns: int,
        wall_offset_ns: int,
    ) -> None:
        super().__init__(world, settings, faults, wall_offset_ns=wall_offset_ns)
        self.name = name
        self.database = database
        self.lease = Lease(lease_ns)
        self.serving = False
        self._beats = world.schedule.stream(f"beats of {name}")
        self._epoch = self._batch = 0
        self._queue: list[Persist] = []
        self._writing = False

    # ---------------------------------------------------------------- standing by

    def boot(self) -> None:
        """Stand by."""
        self.up = True
        self.clock = self.new_clock()
        self.serving = self._writing = False
        self.asked.clear()
        self._queue.clear()
        self.lease = Lease(self.lease.lease_ns)
        self._silence = Silence(self.lease)
        self._lines = SimulatedLine(self), SimulatedLine(self)
        self._standby = Standby(self.lease.lease_ns)
        self._breaks = 0
        self._look()

    def _look(self) -> None:
        line = self._lines[0]
        connection = line.attempt(self._look)
        if connection is None:
            return
        if line.breaks != self._breaks:
            self._breaks = line.breaks
            self._standby.was_away()

        def seen(row: HolderRow, _persists: tuple[Persist, ...]) -> None:
            line.done()
            if self._standby.is_free(row, self.local_ns):
                self._take_over(row)
            else:
                self.later(LOOK_NS, self._look)

        self.database.read(connection, seen)

    def _take_over(self, row: HolderRow) -> None:
        """Make an epoch of one's own, if the shard's row is still the one that was seen."""
        line, sent_ns = self._lines[0], self.local_ns
        epoch = max(row.epoch + 1, self.wall_ns // S)
        connection = line.attempt(self._look)
        if connection is None:
            return

        def taken(done: StatementDone) -> None:
            line.done()
            if done.row is None:
                self.later(LOOK_NS, self._look)
            elif done.warned:
                self.ends("the database warned")
            else:
                self.lease.confirmed(sent_ns)
                self._epoch, self._batch = epoch, done.row.batch
                self._load()
                self._renew()

        self.database.write(connection, partial(self.taking, row, epoch), taken)

    def taking(self, seen: HolderRow, epoch: int, found: HolderRow) -> RowChange | None:
        """Return the row of a takeover, if the shard's row is the one that was seen."""
        if (seen.epoch, seen.beat) != (found.epoch, found.beat):
            return None
        return RowChange(HolderRow(epoch, found.batch, self._beat_after(found), self.name))

    def _beat_after(self, row: HolderRow) -> int:
        """Return a beat that no write has left before, not even one that a failover lost."""
        return row.beat + 1 + self._beats.getrandbits(30)

    def _load(self) -> None:
        line = self._lines[0]
        connection = line.attempt(self._load)
        if connection is None:
            return

        def loaded(row: HolderRow, persists: tuple[Persist, ...]) -> None:
            line.done()
            if row.epoch != self._epoch:
                self.ends("another daemon took the shard")
                return
            records = (record for persist in persists for record in persist.records)
            self.serving = True
            self.world.tally["takeovers"] += 1
            self.serve(Ledger(records).recovered(self._epoch))

        self.database.read(connection, loaded)

    # ---------------------------------------------------------------- serving

    def carry_out(self, effects: Sequence[Effect]) -> None:
        """Queue what is to be written; let the rest out only while the lease holds."""
        super().carry_out(self._silence.passing(effects, self.local_ns))

    def persist(self, persist: Persist) -> None:
        """Queue records for the next batch."""
        self._queue.append(persist)
        if not self._writing:
            self._writing = True
            self.later(0, self._write)

    def _write(self) -> None:
        batch = tuple(self._queue)
        self._queue.clear()
        self._batch += 1
        self._send(batch, uncertain=False)

    def _send(self, batch: tuple[Persist, ...], *, uncertain: bool) -> None:
        line, number, sent_ns = self._lines[0], self._batch, self.local_ns
        connection = line.attempt(lambda: self._send(batch, uncertain=True))
        if connection is None:
            return
        if uncertain:
            self._ask(connection, batch, sent_ns)
            return

        put = partial(self.putting, number, batch)
        self.database.write(connection, put, partial(self._sent, batch, sent_ns))

    def putting(self, number: int, batch: tuple[Persist, ...], row: HolderRow) -> RowChange | None:
        """Return the row of a batch with its records, if it follows the one before."""
        if (row.epoch, row.batch) != (self._epoch, number - 1):
            return None
        return RowChange(row._replace(batch=number, beat=self._beat_after(row)), batch)

    def _sent(self, batch: tuple[Persist, ...], sent_ns: int, done: StatementDone) -> None:
        if done.warned:
            self.ends("the database warned")
        elif done.row is None:  # another has the shard, or an earlier try stands
            self._lines[0].done()
            self._send(batch, uncertain=True)
        else:
            self._lines[0].done()
            self._stands(batch, sent_ns)

    def _ask(self, connection: SimulatedLink, batch: tuple[Persist, ...], sent_ns: int) -> None:
        """Ask what became of a batch whose answer was lost."""

        def seen(row: HolderRow, _persists: tuple[Persist, ...]) -> None:
            found = after_break(row[:2], epoch=self._epoch, batch=self._batch)
            if found is BrokenBatch.TAKEN:
                self.ends("another daemon took the shard")
            elif found is BrokenBatch.MISSING:
                self._lines[0].done()
                self._send(batch, uncertain=False)
            else:
                self.world.tally["batches that stood"] += 1
                self.believe(connection, batch, sent_ns)

        self.database.read(connection, seen)

    def believe(self, connection: SimulatedLink, batch: tuple[Persist, ...], sent_ns: int) -> None:
        """Believe that a batch stands once something after it is confirmed."""
        self._beat(connection, partial(self._believed, batch, sent_ns))

    def _believed(self, batch: tuple[Persist, ...], sent_ns: int, done: StatementDone) -> None:
        if done.row is None or done.warned:
            self.ends("another daemon took the shard")
        else:
            self._lines[0].done()
            self._stands(batch, sent_ns)

    def _stands(self, batch: tuple[Persist, ...], sent_ns: int) -> None:
        self.lease.confirmed(sent_ns)
        self._writing = bool(self._queue)
        if self._writing:
            self._write()
        for persist in batch:
            if persist.ticket:
                self.event(Persisted(persist.ticket))

    def _beat(self, connection: SimulatedLink, done: Callable[[StatementDone], None]) -> None:
        def beat(row: HolderRow) -> RowChange | None:
            return (
                RowChange(row._replace(beat=self._beat_after(row)))
                if row.epoch == self._epoch
                else None
            )

        self.database.write(connection, beat, done)

    def _renew(self) -> None:
        line, sent_ns = self._lines[1], self.local_ns
        connection = line.attempt(self._renew)
        if connection is None:
            return

        def renewed(done: StatementDone) -> None:
            line.done()
            if done.row is None or done.warned:
                self.ends("another daemon took the shard")
                return
            self.lease.confirmed(sent_ns)
            if self.serving:
                self.carry_out(())
            self.later(RENEW_NS, self._renew)

        self._beat(connection, renewed)

    def request(self, message: Request, reply: Callable[[Answer], None]) -> None:
        """Hand a request to the shard, if this daemon serves it."""
        if self.serving:
            super().request(message, reply)

    def event(self, event: Event) -> None:
        """Hand an event to the shard, if this daemon serves it."""
        if self.serving:
            super().event(event)

    # ---------------------------------------------------------------- the end

    def ends(self, why: str) -> None:
        """End at once, as a daemon that was fenced does, and start again as a standby."""
        self.world.tell(self.name, "ends:", why)
        self.world.tally["daemons fenced"] += 1
        self.dies(S)

    def dies(self, down_ns: int) -> bool:
        """Die, and start again after a while."""
        if not self.up:
            return False
        self.end_life()
        self.serving = False
        self.database.cut(self)
        self.world.after(down_ns, self.boot)
        return True
