"""Requests and outcomes of the clients, lock by lock: the evidence of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Slot
from enact_dist.patterns import pattern_matches, patterns_overlap
from enact_dist.terms import Access, Durability

if TYPE_CHECKING:
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import LockId
    from enact_dist.core.protocol.messages import Item
    from enact_dist.core.protocol.records import DecisionRecord
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.picture import ShardPicture

TOLD_NOT = frozenset(
    (
        Phase.RELEASED,
        Phase.LOST,
        Phase.CHANGED,
        Phase.TIMED_OUT,
        Phase.UNREACHABLE,
        Phase.REFUSED,
        Phase.MISPLACED,
    )
)
"""Ends after which nothing of a lock may ever be visible."""


@dataclass(slots=True, eq=False)
class Entry:
    """One lock of one thread.

    Attributes:
        begun_ns: When it was asked for, in true time.
        ended_ns: When its thread learned how it ended (None: never, its process died).
        told: The outcome that its thread learned.
        newer: The aspect that it writes with the newer type ("": none).
        unasked: It has ended under a kept grant, without writes and without a call.
    """

    lock: MultiLock
    items: tuple[Item, ...]
    kind: str
    begun_ns: int
    ended_ns: int | None = None
    told: Phase | None = None
    expects: bool = False
    newer: str = ""
    unasked: bool = False

    @property
    def id(self) -> LockId:
        """The lock's identity."""
        return self.lock.lock

    @property
    def past_ns(self) -> int:
        """The timestamp of its past view; 0: none."""
        return self.lock.plan.past_ns

    def readings(self) -> list[Reading]:
        """Return what the lock read under protection: its reads, and its views if expected."""
        return [
            reading
            for reading in self.lock.states
            if self.expects or any(_covers(item, reading) for item in self.items)
        ]

    def views(self) -> list[Reading]:
        """Return what the lock saw without protection, at whatever shard; not by stamp."""
        stamps = self.stamps()
        if self.past_ns:
            return []  # each datum was judged when it was shown
        return [
            reading
            for reading in self.lock.states
            if reading.state.slot not in stamps
            and not any(_covers(item, reading) for item in self.items)
        ]

    def stamps(self) -> dict[Slot, int]:
        """Return which slots it viewed by capture stamp, and by which."""
        return {
            Slot(item.context, item.entity, item.aspect): item.captured_ns
            for item in self.items
            if item.captured_ns
        }


@dataclass(slots=True)
class RunHistory:
    """All locks of a run."""

    entries: dict[LockId, Entry] = field(default_factory=dict)

    def begin(self, entry: Entry) -> None:
        """Note that a thread asks for a lock."""
        self.entries[entry.id] = entry

    def end(self, entry: Entry, *, now_ns: int) -> None:
        """Note how it ended."""
        entry.ended_ns = now_ns
        entry.told = entry.lock.phase


class Observations:
    """What is known of a run: the locks of its clients, and a picture of each shard.

    Attributes:
        absent: Slots that a lock found without a state, by shard, with that shard's epoch.
        permitted_losses: Commits that a power cut undid as their durability permits.
        decided: Commits over several shards whose decision is on disk.
        clocks_were_set: Whether commits may be refused for a wall clock.
    """

    def __init__(
        self, world: SimulatedWorld, history: RunHistory, durabilities: dict[str, Durability]
    ) -> None:
        self.world, self.history, self.durabilities = world, history, durabilities
        self.pictures: dict[str, ShardPicture] = {}
        self.absent: dict[LockId, dict[tuple[str, Slot], tuple[int, tuple[int, int]]]] = {}
        self.permitted_losses: dict[LockId, None] = {}
        self.decided: dict[LockId, DecisionRecord] = {}
        self.clocks_were_set = False

    def fail(self, rule: str, *facts: object) -> None:
        """Stop the run: a rule is broken."""
        self.world.violation(rule, *facts)

    def count(self, name: str, number: int) -> None:
        """Add to a tally of the run."""
        self.world.tally[name] += number

    def entry(self, lock: LockId) -> Entry | None:
        """Return what a client knows of its lock."""
        return self.history.entries.get(lock)

    def is_volatile(self, slot: Slot) -> bool:
        """Whether a restart loses the data of a slot."""
        return self.durabilities[slot.aspect] is Durability.VOLATILE

    def clock_was_set(self) -> None:
        """A wall clock was set: commits may be refused for it from now on."""
        self.clocks_were_set = True


def _covers(item: Item, reading: Reading) -> bool:
    slot = reading.state.slot
    access = Access(item.access)
    if not access.locks or (item.context, item.aspect) != (slot.context, slot.aspect):
        return False
    return pattern_matches(item.entity, slot.entity)


def conflict(some: tuple[Item, ...], others: tuple[Item, ...], *, columns: bool = False) -> bool:
    """Say whether two locks may not be held at once: paper, 3.2, with readers shared.

    With `columns` a pattern counts as all entities, as the shard's lock table takes it.
    """
    return any(_items_conflict(one, other, columns) for one in some for other in others)


def _items_conflict(one: Item, other: Item, columns: bool) -> bool:
    if one.context != other.context or one.aspect != other.aspect:
        return False
    mine, theirs = Access(one.access), Access(other.access)
    if not (mine.locks and theirs.locks and (mine.writes or theirs.writes)):
        return False
    if not (mine.each or theirs.each):
        return one.entity == other.entity
    if columns:
        return True
    if mine.each and theirs.each:
        return patterns_overlap(one.entity, other.entity)
    pattern, name = (one.entity, other.entity) if mine.each else (other.entity, one.entity)
    return pattern_matches(pattern, name)
