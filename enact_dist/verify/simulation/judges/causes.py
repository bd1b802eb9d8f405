"""The rule of lineage: the cause of each version names its lock and exactly what that was shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.messages import Cause, DatumRead, SlotVersion
from enact_dist.core.protocol.parts import CAUSE_COMMIT
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.messages import Notice
    from enact_dist.core.protocol.records import Content
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import Entry, RunHistory
    from enact_dist.verify.simulation.judges.picture import ShardPicture

DRIFT: Final = 1.02
"""How much faster than true time a shard's clock may run."""


def reads_of(entry: Entry) -> tuple[DatumRead, ...]:
    """Return what went into a lock's writes: all that it was shown and does not overwrite."""
    written = {item[1:4] for item in entry.items if item.access == Access.WRITE}
    shown = (reading.state for reading in entry.lock.states)
    return tuple(DatumRead(*state[:3]) for state in shown if state.slot not in written)


class CauseJudge:
    """Looks at the causes of versions when they become visible, and after restarts."""

    def __init__(self, world: SimulatedWorld, history: RunHistory) -> None:
        self._world, self._history = world, history
        self._known: dict[tuple[Slot, int, int], Cause] = {}

    def applied(self, host: ShardNode, lock: LockId, notice: Notice) -> None:
        """A commit became visible: does each of its versions say why?"""
        versions = [SlotVersion(change.slot, change.version) for change in notice.changes]
        for slot, _ in versions:
            self._check(slot, host.shard.state.slots[slot], lock, versions)

    def _check(
        self, slot: Slot, content: Content, lock: LockId, versions: Iterable[SlotVersion]
    ) -> None:
        cause, entry = content.cause, self._history.entries[lock]
        if cause is None:
            self._world.violation("every version has a cause", slot, content)
            return
        facts = slot, cause
        if (cause.kind, cause.lock, cause.actor) != (CAUSE_COMMIT, lock, entry.lock.client.actor):
            self._world.violation("a cause names the lock that committed", *facts, lock)
        if cause.stamp_ns != content.stamp_ns or tuple(versions) != cause.writes:
            self._world.violation("a cause names what was committed", *facts, content.stamp_ns)
        if (cause.reads, cause.reads_left_out) != (reads_of(entry), 0):
            self._world.violation("a cause names what its lock was shown", *facts, reads_of(entry))
        if not 0 <= cause.held_ns <= DRIFT * (self._world.now_ns - entry.begun_ns):
            self._world.violation("a cause says how long its lock was held", *facts)
        self._world.tally["causes checked"] += 1
        self._world.tally["causes that name reads"] += bool(cause.reads)
        self._known[slot, content.version, content.stamp_ns] = cause

    def booted(self, host: ShardNode, picture: ShardPicture) -> None:
        """A shard started: is the cause of each version that it has kept what it was?"""
        for slot in picture.chains:
            content = host.shard.state.slots[slot]
            if not content.version:
                continue
            writer = picture.now(slot).writer
            if not isinstance(writer, LockId):
                continue
            before = self._known.get((slot, content.version, content.stamp_ns))
            if before is None or before.lock != writer:
                # It was with the disk when the shard died; or the power failed and the clock was
                # set back, and it has the version and stamp of one that was lost.
                versions = content.cause.writes if content.cause is not None else ()
                self._check(slot, content, writer, versions)
            elif content.cause != before:
                self._world.violation("a cause survives as its version does", slot, content, before)
            self._world.tally["causes over a restart"] += 1
