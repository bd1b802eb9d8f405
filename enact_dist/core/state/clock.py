"""Hybrid logical time of one shard: the stamps of its commits (Kulkarni et al. 2014).

A stamp is the shard's wall clock in nanoseconds where that moves on, else one more than the last
stamp; and it exceeds every stamp that the committing client had seen, so that cause comes before
effect over all shards without synchronised clocks.

Beside it stand the other times of a shard: what becomes due when (`DueTimes`), how long things took
(`Latencies`), and when its epochs began.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left
from operator import attrgetter
from typing import TYPE_CHECKING, Final, Generic, TypeVar

from enact_dist.core.protocol.messages import CLOCK_SKEW, PROTOCOL, Refused

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId, Position, Token
    from enact_dist.core.protocol.records import Recovered

K = TypeVar("K", str, tuple[str, int])

BOUNDS_S: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0)
"""Upper bounds of the classes, seconds."""


class Latencies:
    """How long something took, counted in classes.  One thread at a time adds, any may read.

    Attributes:
        counts: One for each of `BOUNDS_S`, and one for what took longer.
        sum_s: Of all durations.
    """

    __slots__ = ("counts", "sum_s")

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS_S) + 1)
        self.sum_s = 0.0

    def add(self, took_s: float) -> None:
        """Count one duration."""
        self.counts[bisect_left(BOUNDS_S, took_s)] += 1
        self.sum_s += took_s


UNKEPT_FROM: Final = 10**11
"""Epochs from here on are milliseconds since 1970, of shards that keep nothing; lower ones are
seconds, or one more than the epoch before, of shards that do."""


def unkept_epoch(wall_ns: int) -> int:
    """Return the epoch of a shard that keeps nothing, so knows none before.

    It grows by the millisecond: two starts may come within a second.
    """
    return wall_ns // 1_000_000


def is_kept(epoch: int) -> bool:
    """Whether a shard has begun this epoch with what it had kept of the one before."""
    return epoch < UNKEPT_FROM


def device_token(token: Token) -> tuple[int, int]:
    """Return a token as an outside device compares it, whatever kind its epoch is of.

    A shard may get a folder, or lose it: both kinds are in seconds here, so that the later start
    has the larger pair unless both begin within one second.
    """
    if is_kept(token.epoch):
        return token.epoch, token.number
    second, millisecond = divmod(token.epoch, 1000)
    return second, (millisecond << 32) + token.number


def is_older(epoch: int, than: int) -> bool:
    """Whether a shard has begun one epoch before another, which an answer that is late may name.

    Epochs of the two kinds do not compare: a shard that got a folder begins with a smaller number.
    """
    return epoch < than and is_kept(epoch) == is_kept(than)


def state_of(*, grants: bool, draining: bool) -> str:
    """Say in words whether a shard grants locks, and if not, why."""
    if grants:
        return "open"
    return "drains" if draining else "waits for older leases"


AHEAD_NS_MAX: Final = 1_000_000_000
"""A stamp from elsewhere may lie this far ahead of our wall clock; more is a wrong clock."""
STAMP_NS_MAX: Final = 1 << 62
"""No stamp lies beyond this, the year 2116: from there on, clocks could not count for long."""


def newest_stamp(recovered: Recovered) -> tuple[int, str]:
    """Return the largest stamp of what a store has kept, and what has it; 0 where nothing is."""
    newest = max(recovered.slots, key=attrgetter("stamp_ns"), default=None)  # there may be many
    stamps = [(newest.stamp_ns, f"slot {newest.slot}")] if newest is not None else []
    # A fork without slots here was made as of then, too: nothing may be committed before.
    stamps += [(record.at_ns, f"world context {record.name}") for record in recovered.worlds]
    # Nor before what was forgotten with its aspect.
    stamps += [(record.at_ns, f"forgotten aspect {record.name}") for record in recovered.forgotten]
    stamps += [(one.position.stamp_ns, f"commit {one.lock}") for one in recovered.outcomes]
    stamps += [
        (record.position.stamp_ns, f"commit {record.lock}") for record in recovered.decisions
    ]
    stamps += [(record.stamp_ns, f"prepared lock {record.lock}") for record in recovered.prepared]
    return max(stamps, default=(0, "nothing"))


class Stamps:
    """The clock of one shard.  Strictly increasing.

    Attributes:
        last_ns: The newest stamp.
        ahead_ns: How far the wall clock was ahead of the monotonic one at the most.
        wall_ns_max: Where the wall clock would be now if it had never been set back.  Other shards
            of this host have stamped by the clock as it was: until their stamps are past again,
            what they have decided must not count as far ahead here.
    """

    __slots__ = ("ahead_ns", "last_ns", "wall_ns_max")

    def __init__(self, last_ns: int) -> None:
        self.last_ns = last_ns
        self.ahead_ns = -STAMP_NS_MAX
        self.wall_ns_max = 0

    def too_far_ahead(self, seen_ns: int, *, wall_ns: int) -> bool:
        """Whether a stamp from elsewhere would drag this clock away from the wall clock.

        Times that this clock or the wall clock has given are never too far ahead.
        """
        return seen_ns > max(max(wall_ns, self.wall_ns_max) + AHEAD_NS_MAX, self.last_ns)

    def next(self, *, seen_ns: int, wall_ns: int) -> int:
        """Return the stamp of a new commit by a client that has seen stamps up to `seen_ns`."""
        self.last_ns += 1
        if seen_ns >= self.last_ns:
            self.last_ns = seen_ns + 1
        if wall_ns > self.last_ns:  # noqa: PLR1730 - a call of `max` costs more than all this
            self.last_ns = wall_ns
        return self.last_ns

    def now(self, *, wall_ns: int, seen_ns: int = 0) -> int:
        """Return the present, after all that an honest client has seen.

        Every later commit gets a larger stamp.
        """
        if seen_ns > self.last_ns and not self.too_far_ahead(seen_ns, wall_ns=wall_ns):
            self.last_ns = seen_ns
        if wall_ns > self.last_ns:  # noqa: PLR1730 - as in `next`
            self.last_ns = wall_ns
        return self.last_ns

    def saw(self, stamp_ns: int) -> None:
        """Come after a stamp that was decided elsewhere."""
        self.last_ns = max(self.last_ns, stamp_ns)


def wrong_decision(
    lock: LockId, position: Position, stamps: Stamps, *, wall_ns: int
) -> Refused | None:
    """Refuse the stamp of a decision that no shard with a right clock gives.

    It would permanently become the time of this shard, since timestamps only grow.  The decision
    may be said again: it is taken once the clocks agree.  Where this host's clock was set back,
    what was promised lies ahead of it, and an honest decision a little later still.
    """
    if position.stamp_ns <= 0:
        return Refused(
            PROTOCOL,
            f"{lock} is said to be committed at stamp {position.stamp_ns}, which is none",
        )
    after_promise = position.stamp_ns <= stamps.last_ns + AHEAD_NS_MAX
    if after_promise or not stamps.too_far_ahead(position.stamp_ns, wall_ns=wall_ns):
        return None
    ahead_s = (position.stamp_ns - wall_ns) / 1e9
    return Refused(
        CLOCK_SKEW,
        f"shard {position.shard} has committed {lock} with a stamp {ahead_s:.1f} s ahead of the"
        " clock of this shard; at most 1 s is accepted; set the clocks of both hosts, then the"
        " commit is finished here, too",
        (str(ahead_s),),
    )


STALE_MAX: Final = 1024
"""Entries of dropped names that the heap may hold, beside as many as names, before it is swept."""


class DueTimes(Generic[K]):
    """Names, each under the earliest time at which it may be due.

    A lease that is renewed moves its end with each message, so the ends are corrected lazily: each
    name is kept under a time that its real one is never before, looked at then, and put back where
    it has moved on.  A look therefore costs what is due, however many names there are.
    """

    __slots__ = ("_heap", "due")

    def __init__(self) -> None:
        self.due: dict[K, int] = {}
        self._heap: list[tuple[int, K]] = []

    def __len__(self) -> int:
        return len(self.due)

    def __contains__(self, name: K) -> bool:
        return name in self.due

    def put(self, name: K, due_ns: int) -> None:
        """Keep a name, under another time than before if it is here."""
        self.due[name] = due_ns
        heapq.heappush(self._heap, (due_ns, name))
        if len(self._heap) > 2 * len(self.due) + STALE_MAX:
            self._heap = [(due_ns, name) for name, due_ns in self.due.items()]
            heapq.heapify(self._heap)

    def drop(self, name: K) -> None:
        """Forget a name, if it is here."""
        self.due.pop(name, None)

    def take(self, until_ns: int) -> list[K]:
        """Take out the names that may be due by `until_ns`, the earliest first."""
        taken = []
        while self._heap and self._heap[0][0] <= until_ns:
            due_ns, name = heapq.heappop(self._heap)
            if self.due.get(name) == due_ns:
                del self.due[name]
                taken.append(name)
        return taken

    def next_ns(self) -> int | None:
        """Return the earliest time at which a name may be due; None without names."""
        while self._heap and self.due.get(self._heap[0][1]) != self._heap[0][0]:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None
