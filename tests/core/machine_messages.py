"""What can be said about one lock: a message of each kind, whatever state the lock is in.

An honest client says few of these at any moment, a late or repeated message says the others; what
no message of the protocol can say (two words of one primary) is left out by the machine.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import count
from typing import TYPE_CHECKING

from machine_pair import ENTITIES, SLOTS
from reference_parts import CAPTURED_NS, captured_of
from reference_table import lines_of
from shard_bench import datum

from enact_dist.core.protocol.datum import LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import (
    Acquire,
    Break,
    Commit,
    Fetch,
    Finish,
    Finished,
    ForceAbort,
    Goodbye,
    Hello,
    Item,
    KeepAlive,
    LaneView,
    Outcome,
    Prepare,
    Release,
    Resolve,
    Resolved,
    SlotVersion,
    TakeView,
    Validate,
    WriteItem,
)
from enact_dist.core.protocol.records import Called
from enact_dist.terms import Access

if TYPE_CHECKING:
    from machine_pair import Pair

MS = 1_000_000
TTLS = {"ann": 400 * MS, "bob": 600 * MS, "cyd": 1000 * MS}
HOLDS = (150 * MS, 500 * MS, 60_000 * MS)
SLICES = (0, 30 * MS, 90 * MS, 250 * MS)
FAR_TOKEN = Token(7, 7)
INVENTED = 999_999
"""Number of a token that was never given."""


_MASK = (1 << 64) - 1


class Pick:
    """Choices drawn from one number.

    Hypothesis prefers small numbers, whose later choices would all be the first option; so the
    number is spread over 64 bits first (as SplitMix does).
    """

    def __init__(self, number: int) -> None:
        number = (number + 1) * 0x9E3779B97F4A7C15 & _MASK
        number = (number ^ number >> 30) * 0xBF58476D1CE4E5B9 & _MASK
        self.left = number ^ number >> 27

    def below(self, limit: int) -> int:
        """Return a number from 0 to `limit` - 1."""
        self.left, found = divmod(self.left, limit)
        return found

    def one(self, options):
        """Return one of the options."""
        return options[self.below(len(options))]


@dataclass
class Plans:
    """What clients know of their locks, and the far primary of what is prepared here.

    Attributes:
        items: What each lock asked for.
        alone: Whether it lies on this shard alone.
        far: What its far primary has decided.
    """

    pair: Pair
    items: dict[LockId, tuple[Item, ...]] = field(default_factory=dict)
    alone: dict[LockId, bool] = field(default_factory=dict)
    far: dict[LockId, Position | None] = field(default_factory=dict)
    counts: count = field(default_factory=lambda: count(1))
    values: count = field(default_factory=lambda: count(1))

    def of(self, lock: LockId, pick: Pick) -> tuple[Item, ...]:
        """Return what a lock asks for, chosen on first use."""
        if lock not in self.items:
            self.items[lock] = tuple(_items(pick))
            self.alone[lock] = pick.below(4) == 0
        return self.items[lock]

    def token(self, lock: LockId) -> Token:
        """Return the token of a lock, or one that nobody has."""
        return self.pair.tokens.get(lock) or Token(self.pair.shard.epoch, INVENTED)

    def writes(self, lock: LockId, pick: Pick) -> tuple[WriteItem, ...]:
        """Return writes that a lock allows, one or two."""
        lines = lines_of(self.of(lock, pick))
        allowed = [slot for slot in SLOTS if any(line.allows(slot) for line in lines)]
        chosen = {pick.one(allowed) for _ in range(1 + pick.below(2))} if allowed else set()
        return tuple(WriteItem(slot, self._datum(pick)) for slot in sorted(chosen))

    def _datum(self, pick):
        if pick.below(6) == 0:
            return None
        text = str(next(self.values))
        return replace(datum(text), stamp_ns=captured_of(text))

    def seen_ns(self, pick: Pick) -> int:
        """Return a stamp that a client may have seen."""
        return self.pair.floor_ns if pick.below(2) else 0

    def expects(self, pick: Pick) -> tuple[SlotVersion, ...]:
        """Return a view that stands, or one that moved on."""
        slot = pick.one(SLOTS)
        version = self.pair.reference.slots.get(slot, (0, None))[0]
        return (SlotVersion(slot, version + (pick.below(3) == 0)),)

    # ---------------------------------------------------------------- by its client

    def acquire(self, lock: LockId, pick: Pick):
        items = self.of(lock, pick)
        return Acquire(
            lock,
            self.pair.shard.epoch,
            1,
            next(self.counts),
            items,
            pick.one(SLICES),
            pick.one(HOLDS),
            self.seen_ns(pick),
            alone=self.alone[lock],
        )

    def commit(self, lock, pick):
        return Commit(lock, self.token(lock), self.writes(lock, pick), self.seen_ns(pick))

    def keep(self, lock, pick):
        """Commits and asks to keep the grant."""
        return replace(self.commit(lock, pick), keep=True)

    def use(self, lock, later, pick):
        """A later lock commits under the grant of this one, and mostly asks to keep it."""
        keep, held_ns = pick.below(8) > 0, pick.below(3) * MS
        expects = self.expects(pick) if pick.below(6) == 0 else ()
        writes, token = self.writes(lock, pick), self.token(lock)
        return Commit(later, token, writes, self.seen_ns(pick), expects, keep=keep, held_ns=held_ns)

    def look(self, lock, later, pick):
        """A later lock asks whether the grant of this one is still held."""
        expects = self.expects(pick) if pick.below(6) == 0 else ()
        return Validate(later, self.token(lock), expects, pick.below(8) > 0)

    def late_use(self, lock, pick):
        """A lock that its lane has left behind, or just reached, commits or asks under a token."""
        lane = pick.below(2)
        known = self.pair.reference.lanes.get(lock.session, {}).get(lane)
        seq = max(1, (known.top if known else 0) - pick.below(3))
        late = LockId(lock.session, lane, seq)
        return self.look(lock, late, pick) if pick.below(4) == 0 else self.use(lock, late, pick)

    def decide(self, lock, pick):
        writes, seen_ns = self.writes(lock, pick), self.seen_ns(pick)
        return Commit(lock, self.token(lock), writes, seen_ns, (), ("far",))

    def expect(self, lock, pick):
        writes, seen_ns = self.writes(lock, pick), self.seen_ns(pick)
        return Commit(lock, self.token(lock), writes, seen_ns, self.expects(pick))

    def overreach(self, lock, pick):
        """Writes what is not held, or one slot twice."""
        writes = self.writes(lock, pick)
        if writes and pick.below(2):
            writes *= 2
        else:
            writes = tuple(WriteItem(slot, self._datum(pick)) for slot in SLOTS)
        return Commit(lock, self.token(lock), writes, 0)

    def forge(self, lock, pick):
        """Writes, perhaps twice, under a token that was never given, or not in this epoch."""
        token = self.token(lock)
        wrong = pick.one((Token(token.epoch, INVENTED + 1), Token(token.epoch - 1, token.number)))
        return Commit(lock, wrong, self.writes(lock, pick) * (1 + pick.below(2)), 0)

    def outcome(self, lock, _):
        return Outcome(lock)

    def validate(self, lock, pick):
        token, kind = self.token(lock), pick.below(3)
        if kind == 0:
            return Validate(lock, Token(token.epoch, 0), self.expects(pick))
        return Validate(lock, token, self.expects(pick) if kind == 1 else ())

    def prepare(self, lock, pick):
        writes, seen_ns = self.writes(lock, pick), self.seen_ns(pick)
        expects = self.expects(pick) if pick.below(4) == 0 else ()
        return Prepare(lock, self.token(lock), writes, seen_ns, expects, "far", FAR_TOKEN)

    def release(self, lock, _):
        return Release(lock)

    def fetch(self, lock, pick):
        slot = pick.one(SLOTS)
        version = self.pair.reference.slots.get(slot, (0, None))[0] - (pick.below(4) == 0)
        return Fetch(lock, self.pair.shard.epoch, slot, version, 0, 100)

    def view(self, lock, pick):
        """A view of now, or as of a stamp that was told; by capture stamp, too."""
        access = pick.one((Access.VIEW, Access.VIEW, Access.VIEW_EACH))
        aspect = pick.one(("count", "note", "frame"))
        entity = "**" if access is Access.VIEW_EACH else pick.one(ENTITIES)
        at_ns, captured_ns = self.pair.floor_ns if pick.below(2) else 0, 0
        moved = [slot for slot, versions in self.pair.reference.replaced.items() if versions]
        if access is Access.VIEW and pick.below(3):
            if moved and pick.below(4):
                _, entity, aspect = pick.one(moved)
            captured_ns = pick.one(CAPTURED_NS)
            stamps = [ns for ns, *_ in self.pair.history[Slot("online", entity, aspect)]]
            at_ns = pick.one((at_ns, pick.one(stamps)))
        items = (Item(access, "online", entity, aspect, 0, captured_ns),)
        n = next(self.counts)
        return TakeView(lock, self.pair.shard.epoch, 1, n, items, self.seen_ns(pick), at_ns)

    # ---------------------------------------------------------------- by its session

    def hello(self, lock, pick):
        epoch = self.pair.shard.epoch
        known = pick.one((epoch, epoch, epoch - 1, 0))
        return Hello(lock.session, known, TTLS[lock.session], lock.session, "host", 1, False)

    def keep_alive(self, lock, pick, *, above=0):
        """Renews, and wants everything from this seq (or above it) on."""
        view = (LaneView(lock.lane, lock.seq + above),)
        epoch = self.pair.shard.epoch - (pick.below(12) == 0)
        wait_ns = pick.one((0, 0, 50 * MS, 60_000 * MS)) if not above else 0
        mine = [life for life in self.pair.reference.of(lock.session) if life.far]
        heard = tuple(life.token.number for life in mine if pick.below(2))
        return KeepAlive(lock.session, epoch, next(self.counts), view, b"", wait_ns, heard)

    def unwanted(self, lock, pick):
        return self.keep_alive(lock, pick, above=1)

    def goodbye(self, lock, _):
        return Goodbye(lock.session)

    # ---------------------------------------------------------------- by other shards, by people

    def resolve(self, lock, pick):
        return Resolve(lock, self.token(lock), "far")

    def position(self, lock):
        """Return where the far primary has committed a lock: after its promise."""
        if self.far.get(lock) is None:
            life = self.pair.reference.lives.get(lock)
            self.far[lock] = Position((life.stamp_ns if life else self.pair.wall_ns) + 1, "far")
        return self.far[lock]

    def finish(self, lock, _):
        return Finish(lock, self.position(lock))

    def word(self, lock, kind, position):
        return Called("far", Resolve(lock, FAR_TOKEN, "s0"), Resolved(lock, kind, position))

    def told_committed(self, lock, _):
        return self.word(lock, "committed", self.position(lock))

    def told_aborted(self, lock, _):
        self.far[lock] = None
        return self.word(lock, "aborted", Position(0, "far"))

    def told_open(self, lock, _):
        return self.word(lock, "open", Position(0, "far"))

    def peer_finished(self, lock, _):
        return Called("far", Finish(lock, Position(1, "s0")), Finished(lock))

    def number(self, lock):
        """Return the number under which people know a lock; 0 if none."""
        life = self.pair.reference.lives.get(lock)
        return life.number if life is not None else 0

    def broken(self, lock, _):
        return Break(self.number(lock), "by hand")

    def force_abort(self, lock, _):
        return ForceAbort(self.number(lock), "by hand")


def _items(pick: Pick) -> list[Item]:
    accesses = pick.one(
        (
            (Access.WRITE,),
            (Access.WRITE,),
            (Access.WRITE, Access.READ),
            (Access.WRITE, Access.VIEW),
            (Access.WRITE_EACH,),
            (Access.READ,),
            (Access.READ_EACH, Access.WRITE),
            (Access.WRITE, Access.WRITE),
        )
    )
    items: dict[tuple, Item] = {}
    for access in accesses:
        each = access in (Access.WRITE_EACH, Access.READ_EACH)
        entity = pick.one(("tray/*", "**")) if each else pick.one(ENTITIES)
        aspect = pick.one(("count", "note", "frame", "count"))
        asked = access in (Access.VIEW, Access.READ) and pick.below(2)
        captured_ns = pick.one(CAPTURED_NS) if asked else 0
        item = Item(access, "online", entity, aspect, 0, captured_ns)
        items.setdefault((entity, aspect), item)
    return list(items.values())
