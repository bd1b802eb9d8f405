"""A bounded queue of notices between whoever receives them and whoever watches.

The newest notices win: when nobody takes them, the oldest are dropped and counted.  A watcher
sees the gap in their numbers and asks for the present state, so nothing is missed unknowingly.

Who watches says what for (`Interest`).  Notices of anything else wake nobody: of a run of them only
the numbers are passed on (`Skipped`), so that a gap remains a gap.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.messages import Notice
from enact_dist.terms import pattern_matches

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.datum import Slot
    from enact_dist.core.messages import Survey

NOTICES_MAX: Final = 65_536
"""Notices kept for a watcher that does not take them: 11 minutes at 100 per second."""


KNOWN_MAX: Final = 4096
"""Slots of which it is remembered whether they are of interest."""


class Skipped(NamedTuple):
    """The notices of an epoch after one number, up to another one, were of no interest."""

    shard: str
    epoch: int
    after: int
    number: int


class Interest:
    """Which slots somebody watches.  Used by one thread at a time.

    Args:
        wanted: The listing that shows them all.
    """

    __slots__ = ("_known", "wanted")

    def __init__(self, wanted: Survey) -> None:
        self.wanted = wanted
        self._known: dict[Slot, bool] = {}

    def covers(self, notice: Notice) -> bool:
        """Whether a notice tells of one of them."""
        return any(self._is_wanted(change[0]) for change in notice.changes)

    def _is_wanted(self, slot: Slot) -> bool:
        known = self._known.get(slot)
        if known is None:
            wanted = self.wanted
            known = (
                (not wanted.contexts or slot.context in wanted.contexts)
                and (not wanted.aspects or slot.aspect in wanted.aspects)
                and (
                    not wanted.patterns
                    or any(pattern_matches(pattern, slot.entity) for pattern in wanted.patterns)
                )
            )
            if len(self._known) >= KNOWN_MAX:
                self._known.clear()
            self._known[slot] = known
        return known


class NoticeQueue:
    """A feed filled from another thread.  `put` never blocks, `get` wakes at once.

    Args:
        interest: What is watched; None for everything.
        notices_max: How many notices it keeps.

    Attributes:
        late_s: How long the number of a notice of no interest may stay out.
        on_close: Called once by the first `close`; ends what fills the feed.
    """

    def __init__(self, interest: Survey | None = None, *, notices_max: int = NOTICES_MAX) -> None:
        self._interest = Interest(interest) if interest is not None else None
        self._notices: deque[Notice | Skipped] = deque()
        self._notices_max = notices_max
        self.late_s = 0.0
        self.on_close: Callable[[], None] | None = None
        self._newest: dict[str, tuple[int, int]] = {}
        self._changed = threading.Condition(threading.Lock())
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """How many notices were thrown away because nobody took them in time."""
        return self._dropped

    def put(self, notice: Notice) -> None:
        """Add a notice; one that came already (over a second connection) is ignored."""
        with self._changed:
            number = (notice.epoch, notice.number)
            if self._closed or number <= self._newest.get(notice.shard, (0, 0)):
                return
            self._newest[notice.shard] = number
            if self._interest is not None and not self._interest.covers(notice):
                self._skip(Skipped(notice.shard, notice.epoch, notice.number - 1, notice.number))
                return
            if len(self._notices) >= self._notices_max:
                self._notices.popleft()
                self._dropped += 1
            self._notices.append(notice)
            self._changed.notify()

    def skip(self, skipped: Skipped) -> None:
        """Add the numbers of notices that were of no interest; wakes nobody."""
        with self._changed:
            if not self._closed:
                self._skip(skipped)

    def _skip(self, skipped: Skipped) -> None:
        last = self._notices[-1] if self._notices else None
        if isinstance(last, Skipped) and (last.shard, last.epoch, last.number) == skipped[:3]:
            self._notices[-1] = last._replace(number=skipped.number)
        elif len(self._notices) < self._notices_max:
            self._notices.append(skipped)

    def get(self, timeout_s: float | None) -> Notice | Skipped | None:
        """Return the next notice or what was skipped before it.

        None after `timeout_s` without one, or once closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._notices or self._closed, timeout_s)
            return self._notices.popleft() if self._notices and not self._closed else None

    def close(self) -> None:
        """End the feed and wake whoever waits in `get`; twice is harmless."""
        with self._changed:
            if self._closed:
                return
            self._closed = True
            self._changed.notify_all()
        if self.on_close is not None:
            self.on_close()
