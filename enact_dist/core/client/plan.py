"""A lock on the client's side: its requests to each shard, and the states it received."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.messages import NO_PLACE, Alive, EpochChanged, Welcome

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.client.lease_clock import Sendings
    from enact_dist.core.protocol.datum import Token
    from enact_dist.core.protocol.messages import (
        DatumRead,
        Granted,
        Item,
        PlacementMap,
        SlotState,
        Waiting,
    )


class Phase(enum.Enum):
    """Where a lock is in its life; see the drawing in `client/lock`."""

    ACQUIRING = "acquiring"
    VIEWING = "viewing"
    HELD = "held"
    VALIDATING = "validating"
    COMMITTING = "committing"
    COMMITTED = "committed"
    RELEASED = "released"
    LOST = "lost"
    CHANGED = "changed"
    TIMED_OUT = "timed out"
    UNREACHABLE = "unreachable"
    REFUSED = "refused"
    MISPLACED = "misplaced"
    UNKNOWN = "unknown"

    busy: bool
    """Whether the lock has calls to make before it rests."""

    def __init__(self, text: str) -> None:
        self.busy = text in ("acquiring", "viewing", "validating", "committing")


OUTSIDE_NS: Final = 60_000_000_000
"""So much longer, beside its time in the queue, may a shard keep a lock that waits for news."""
OF_SESSIONS: Final = frozenset((Welcome, Alive, EpochChanged))
"""The answers that tell something about a session and not only about one lock."""


@dataclass(slots=True, eq=False)
class Part:
    """What a lock holds, or asks for, at one shard.

    Attributes:
        items: Locks and, where this is the only part, views.
        token: The grant's fencing number once granted.
        granted_count: The session's message counter when the grant arrived.
        until_ns: Until when the lease may be believed in (CLOCK_BOOTTIME).
        hold_until_ns: Until when the hold limit leaves it.
    """

    shard: str
    items: tuple[Item, ...]
    token: Token | None = None
    granted_count: int = 0
    until_ns: int = 0
    hold_until_ns: int = 0

    def granted(self, answer: Granted, sendings: Sendings, *, ttl_ns: int) -> None:
        """Take the grant of this part, and what it allows to believe."""
        self.token, self.granted_count = answer.token, sendings.count
        self.until_ns = sendings.believe_until_ns(answer.count_seen, ttl_ns)
        self.hold_until_ns = sendings.believe_until_ns(answer.count_seen, answer.hold_left_ns)


@dataclass(slots=True, eq=False)
class AwaitedNews:
    """What a lock waits for at its shard before it enters the queue.

    Attributes:
        seen: Data of its slots that were seen; anything newer is news.
        wait_ns: How long it may stay in the queue.
        outside: Whether it has no place in the queue yet, as far as is known.
    """

    seen: tuple[DatumRead, ...]
    wait_ns: int
    outside: bool = True

    def give_up_ns(self, answer: Waiting, now_ns: int) -> int | None:
        """Return until when to go on after an answer; None where it stood in the queue before."""
        before, self.outside = self.outside, answer.place == NO_PLACE
        if self.outside:
            return now_ns + self.wait_ns + OUTSIDE_NS
        return now_ns + self.wait_ns if before else None


def first_asking(parts: Iterable[Part]) -> Part | None:
    """Return the part that is asked for now: one at a time, in the order of the plan."""
    for part in parts:
        if part.token is None:
            return part
    return None


class Reading(NamedTuple):
    """The state of one slot in a grant or view, with the shard and its epoch."""

    shard: str
    epoch: int
    state: SlotState


@dataclass(frozen=True, slots=True)
class Plan:
    """The requests of one lock to each shard; both in the order of the shards' names.

    A shard appears once in each.  Locks on several shards take their views afterwards, as one cut
    that lies not before `floor_ns`, nor before anything that the locks show; views of the past lie
    at `past_ns`.  `placement` is what the lock was placed by, to its end: the client may learn
    another meanwhile, and a shard refuses what was placed by any other than its own.
    `keepable` says that its grant may stay with the session (`core.state.tenure.is_keepable`).
    """

    locks: tuple[tuple[str, tuple[Item, ...]], ...]
    views: tuple[tuple[str, tuple[Item, ...]], ...]
    placement: PlacementMap
    floor_ns: int = 0
    past_ns: int = 0
    keepable: bool = False
