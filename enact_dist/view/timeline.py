"""The moments that the history of some data still holds, and steps through them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from enact_dist.core.protocol.datum import Slot


@dataclass(frozen=True, slots=True)
class Timeline:
    """Commits in order.

    Attributes:
        stamps_ns: Timestamp of each commit, ascending, each once.
        oldest_ns: The left end: the first commit of a datum that has changed since; 0 of none.
        whole_ns: From here on every datum is known; before it, some have left their retention.
    """

    stamps_ns: tuple[int, ...] = ()
    oldest_ns: int = 0
    whole_ns: int = 0

    @classmethod
    def of(cls, histories: Mapping[Slot, Sequence[tuple[int, int]]]) -> Timeline:
        """Return the timeline of histories: (version, stamp_ns) of each known version."""
        stamps = sorted({stamp for history in histories.values() for _, stamp in history if stamp})
        if not stamps:
            return cls()
        moving = [history[0][1] for history in histories.values() if len(history) > 1]
        cut = [history[0][1] for history in histories.values() if history and history[0][0] > 1]
        oldest_ns = min(moving, default=stamps[-1])
        return cls(tuple(stamps), oldest_ns, max([oldest_ns, *cut]))

    @property
    def newest_ns(self) -> int:
        """The right end; 0 of no commit."""
        return self.stamps_ns[-1] if self.stamps_ns else 0

    @property
    def span_s(self) -> float:
        """Seconds from the left end to the right one."""
        return (self.newest_ns - self.oldest_ns) / 1e9

    def at(self, seconds: float) -> int:
        """Return the moment so many seconds after the left end, within both ends."""
        return self.clamped(self.oldest_ns + round(seconds * 1e9))

    def seconds(self, at_ns: int) -> float:
        """Return where a moment lies: seconds after the left end."""
        return (self.clamped(at_ns) - self.oldest_ns) / 1e9

    def clamped(self, at_ns: int) -> int:
        """Return the moment, or the end that it lies beyond."""
        return max(self.oldest_ns, min(at_ns, self.newest_ns))

    def step(self, at_ns: int, by: int) -> int:
        """Return the moment so many commits later, or earlier (below 0)."""
        if not self.stamps_ns:
            return at_ns
        if by > 0:
            place = bisect_right(self.stamps_ns, at_ns) + by - 1
        else:
            place = bisect_left(self.stamps_ns, at_ns) + by
        return self.clamped(self.stamps_ns[max(0, min(place, len(self.stamps_ns) - 1))])

    def including(self, stamps_ns: Iterable[int]) -> Timeline:
        """Return one that also reaches to these moments."""
        more = set(stamps_ns)
        stamps = tuple(sorted({*self.stamps_ns, *more}))
        left = more | ({self.oldest_ns} if self.oldest_ns else set())
        return Timeline(stamps, min(left, default=0), self.whole_ns)


@dataclass(slots=True)
class Player:
    """Which moment a page shows.

    Attributes:
        live: It follows the present.
        timeline: Of the past that it looks at.
        at_ns: The moment, while it is not live.
        playing: Time goes on by itself.
        speed: How fast: 1 is as it was.
    """

    live: bool = True
    timeline: Timeline = Timeline()
    at_ns: int = 0
    playing: bool = False
    speed: float = 1.0

    def look_back(self, timeline: Timeline, at_ns: int = 0) -> None:
        """Stop following the present; show a moment of a timeline (0: its newest)."""
        self.live = self.playing = False
        self.timeline = timeline
        self.at_ns = timeline.clamped(at_ns or timeline.newest_ns)

    def follow(self) -> None:
        """Follow the present again."""
        self.live, self.playing = True, False

    def advance(self, seconds: float) -> None:
        """Let time pass if it plays; it stops at the right end."""
        if self.playing and not self.live:
            at_ns = self.at_ns + round(seconds * self.speed * 1e9)
            self.at_ns = self.timeline.clamped(at_ns)
            self.playing = self.at_ns < self.timeline.newest_ns
