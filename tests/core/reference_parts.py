"""What the reference shard remembers: plain values, one for each thing that the rules speak of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from reference_table import lines_of

from enact_dist.terms import Access

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId, Position, Slot, Token
    from enact_dist.core.protocol.messages import Acquire, Item

DURABILITY = {"count": "durable", "note": "os", "frame": "volatile"}
"""What a commit of each aspect survives."""

RETENTION = {"count": 1, "note": 3, "frame": 2}
"""How many versions of a slot of each aspect stay readable by capture stamp."""

CAPTURED_NS = (0, 100, 200, 300)
"""Capture stamps of data: each value says by itself which is its own."""

NAMED = (Access.READ, Access.WRITE)
"""What may be asked for where a grant is to stay."""

BOUND = ("committing", "deciding", "preparing", "prepared", "finishing", "aborting")
"""Phases that neither a client nor time can end."""


def captured_of(text: str | None) -> int:
    """Return when a value was captured; 0 where it does not say, or for null."""
    return 0 if text is None else CAPTURED_NS[int(text) % len(CAPTURED_NS)]


@dataclass
class Person:
    """A session: alive while it speaks, or half a TTL after its token was last seen."""

    ttl_ns: int
    renewed_ns: int
    acknowledged: bool
    durable: bool = False
    present: bool = False
    token: bool = False
    seen_ns: int | None = None
    count: int = 0

    def lease_end_ns(self, now_ns: int) -> int:
        """Return when the lease ends if no further sign of life comes."""
        ends = [self.renewed_ns + self.ttl_ns]
        if self.token:
            ends.append(now_ns + self.ttl_ns // 2)
        elif self.seen_ns is not None:
            ends.append(self.seen_ns + self.ttl_ns // 2)
        return max(ends)


@dataclass
class Lane:
    """What one thread did last: the highest seq asked for, its commit, what it validated."""

    top: int = 0
    outcome: tuple[LockId, tuple[tuple[Slot, int], ...]] | None = None
    validated: tuple[LockId, Token] | None = None
    changed: tuple | None = None


@dataclass
class Row:
    """Blocks of the same data in a row, and how many there must be until a grant stays."""

    blocks: int = 0
    needed: int = 2
    uses: int = 0


@dataclass
class Life:
    """One lock from its arrival to its end; of a grant that stays, to the end of that.

    `user` is the lock that commits under it: itself, or a later one of its session.
    """

    lock: LockId
    number: int
    items: tuple[Item, ...]
    alone: bool
    hold_ns: int
    phase: str = "waiting"
    token: Token | None = None
    told: bool = False
    hold_end_ns: int = 0
    parked: int | None = None
    slice_end_ns: int = 0
    writes: tuple[tuple[Slot, str | None], ...] = ()
    versions: tuple[tuple[Slot, int], ...] = ()
    participants: tuple[str, ...] = ()
    primary: str = ""
    primary_token: Token | None = None
    position: Position | None = None
    ask_ns: int = 0
    stamp_ns: int = 0
    replies: list[int] = field(default_factory=list)
    user: LockId | None = None
    keepable: bool = False
    asks_to_keep: bool = False
    kept: bool = False
    far: bool = False
    recalled: bool = False

    @staticmethod
    def of(message: Acquire, number: int) -> Life:
        """Return the life that a request begins."""
        life = Life(message.lock, number, message.items, message.alone, message.hold_ns)
        named = all(i.access in NAMED and not i.captured_ns for i in message.items)
        life.keepable, life.user = message.alone and named, message.lock
        return life

    @property
    def bound(self) -> bool:
        """Whether neither its client nor time can end it."""
        return self.phase in BOUND

    @property
    def held(self) -> bool:
        """Whether its locks are held."""
        return self.phase != "waiting"

    @property
    def lines(self):
        """What it keeps others from."""
        return lines_of(self.items)

    @property
    def state(self) -> str:
        """Its row in the table of cells."""
        if self.phase == "waiting":
            return "waiting" if self.parked is None else "parked"
        if self.phase == "granted" and self.kept:
            return "recalled" if self.recalled else "kept"
        if self.phase == "granted" and not self.told:
            return "untold"
        return self.phase


@dataclass
class Decision:
    """A commit that some shard has still to be told of."""

    left: list[str]
    due_ns: int
    pause_ns: int = 200_000_000


@dataclass
class Expected:
    """What one step must bring: answers by handle, records by write, calls, changed slots."""

    answers: dict[int, tuple] = field(default_factory=dict)
    persists: list[tuple] = field(default_factory=list)
    calls: list[tuple] = field(default_factory=list)
    changes: list[tuple] = field(default_factory=list)
    grants: list[LockId] = field(default_factory=list)
