"""A bounded queue of notices between their receiver and a watcher.

The newest notices win: if the watcher is slow, the oldest are dropped and counted.  The watcher
sees the gap in their numbers and asks for the present state, so it never silently misses a change.

A watcher names its `Interest`.  Other notices do not wake it; it gets only their numbers
(`Skipped`), so that real gaps remain visible.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final, NamedTuple, Protocol

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import Notice, Survey
from enact_dist.errors import EnactError
from enact_dist.patterns import Patterns

NOTICES_MAX: Final = 65_536
"""Notices queued for a slow watcher: 11 minutes at 100 per second."""


DATA_MAX: Final = 256
"""Notices that wait with their data; a slow watcher reads those of further ones."""
KNOWN_MAX: Final = 4096
"""Slots whose relevance is cached."""


class Skipped(NamedTuple):
    """A run of notices without interest: their epoch, the number before the first, the last."""

    shard: str
    epoch: int
    after: int
    number: int


def without_data(notice: Notice) -> Notice:
    """Return a notice that only tells of its changes."""
    if all(change.datum is None for change in notice.changes):
        return notice
    changes = [change._replace(datum=None) for change in notice.changes]
    return replace(notice, changes=tuple(changes))


class Interest:
    """The slots that a watcher wants.  Used by one thread at a time."""

    __slots__ = ("_aspects", "_contexts", "_entities", "_known", "wanted")

    def __init__(self, wanted: Survey) -> None:
        self.wanted = wanted
        self._contexts, self._aspects = frozenset(wanted.contexts), frozenset(wanted.aspects)
        self._entities = Patterns(wanted.patterns)
        self._known: dict[Slot, bool] = {}

    def covers(self, notice: Notice) -> bool:
        """Whether a notice is about one of them."""
        return any(self.wants(change[0]) for change in notice.changes)

    def wants(self, slot: Slot) -> bool:
        """Whether a slot is one of them."""
        known = self._known.get(slot)
        if known is None:
            known = (
                (not self._contexts or slot.context in self._contexts)
                and (not self._aspects or slot.aspect in self._aspects)
                and self._entities.cover(slot.entity)
            )
            if len(self._known) >= KNOWN_MAX:
                self._known.clear()
            self._known[slot] = known
        return known


class Source(Protocol):
    """A source from which a waiting thread can read notices."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when data have arrived."""

    def take_notices(self) -> list[Notice | Skipped]:
        """Return the complete notices that have arrived; never waits.

        Raises:
            EnactError: The data are invalid.
            EOFError: The source has ended.
            OSError: The source is broken.
        """


class _Ear:
    """Waits for a source, or for a bell that other threads ring; the bell rings until heard."""

    __slots__ = ("_bell", "_poll", "on_end", "source")

    def __init__(self, source: Source, on_end: Callable[[Exception], None]) -> None:
        self.source, self.on_end = source, on_end
        self._bell = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._poll = select.poll()
        self._poll.register(self._bell, select.POLLIN)
        self._poll.register(source, select.POLLIN)

    def wait(self, wait_s: float | None) -> list[int]:
        """Return the readable descriptors, that of the bell included."""
        return [one for one, _ in self._poll.poll(None if wait_s is None else wait_s * 1e3)]

    def ring(self) -> None:
        os.eventfd_write(self._bell, 1)

    def heard_bell(self, ready: list[int]) -> bool:
        """Whether the bell is in `ready`; silences it.  The ringing thread's mutex is held."""
        rang = self._bell in ready
        if rang:
            ready.remove(self._bell)
            os.eventfd_read(self._bell)
        return rang

    def __del__(self) -> None:
        os.close(self._bell)


class NoticeQueue:
    """A feed filled from another thread.  `put` never blocks, `get` wakes at once.

    `get` itself may read one source, so that no thread has to wake another.

    Args:
        interest: The slots to watch; None: all.
        notices_max: Capacity of the queue.

    Attributes:
        late_s: How late the numbers of notices without interest may be, in seconds.
        on_close: Called once by the first `close`; stops the sources of the feed.
    """

    def __init__(self, interest: Survey | None = None, *, notices_max: int = NOTICES_MAX) -> None:
        self._interest = Interest(interest) if interest is not None else None
        self._notices: deque[Notice | Skipped] = deque()
        self._notices_max = notices_max
        self.late_s = 0.0
        self.on_close: Callable[[], None] | None = None
        self._newest: dict[str, tuple[int, int]] = {}
        self._mutex = threading.Lock()
        self._changed = threading.Condition(self._mutex)
        self._came = threading.Condition(self._mutex)
        self._closed = False
        self._dropped = 0
        self._ear: _Ear | None = None
        self._polling = False
        self._pid = os.getpid()

    @property
    def dropped(self) -> int:
        """How many notices were dropped because the watcher was too slow."""
        return self._dropped

    def put(self, notice: Notice) -> None:
        """Add a notice; a duplicate (from a second connection) is ignored."""
        with self._mutex:
            wanted = self._interest is None or self._interest.covers(notice)
            self._put(notice, wanted=wanted)

    def _put(self, notice: Notice, *, wanted: bool) -> None:
        number = (notice.epoch, notice.number)
        if self._closed or number <= self._newest.get(notice.shard, (0, 0)):
            return
        self._newest[notice.shard] = number
        self._came.notify_all()
        if not wanted:
            self._skip(Skipped(notice.shard, notice.epoch, notice.number - 1, notice.number))
            return
        if len(self._notices) >= self._notices_max:
            self._notices.popleft()
            self._dropped += 1
        if len(self._notices) >= DATA_MAX:
            notice = without_data(notice)
        self._notices.append(notice)
        self._wake()

    def not_beyond(self, shard: str, epoch: int, number: int) -> None:
        """Accept notices after this number: the shard itself reports it as the last one sent.

        A notice with a later number was not the shard's and must not hide the ones that follow.
        """
        with self._mutex:
            if self._newest.get(shard, (0, 0)) > (epoch, number):
                self._newest[shard] = (epoch, number)

    def _wake(self) -> None:
        """Wake the thread that waits in `get`.  The mutex is held."""
        self._changed.notify_all()
        if self._ear is not None and self._polling:
            self._ear.ring()

    def wait_for_earlier(self, first: Notice | Skipped, wait_s: float) -> None:
        """Wait until a shard's notices before `first` have arrived by another route.

        Waits at most `wait_s`: a notice may be lost, or older than this feed.
        """
        after = first.after if isinstance(first, Skipped) else first.number - 1
        with self._mutex:
            self._came.wait_for(
                lambda: (
                    self._closed
                    or not after
                    or self._newest.get(first.shard, (0, 0)) >= (first.epoch, after)
                ),
                wait_s,
            )

    def read_from(self, source: Source, on_end: Callable[[Exception], None]) -> bool:
        """Let `get` read this source too; False if it already has one, or the feed is closed.

        Args:
            source: Read while a thread waits in `get`; at other times its data wait there.
            on_end: Called once by `get`, with the reason, when the source has ended.
        """
        with self._mutex:
            if self._closed or self._ear is not None:
                return False
            self._ear = _Ear(source, on_end)
            self._wake()
            return True

    def take(self, found: Iterable[Notice | Skipped]) -> None:
        """Add notices from a shard that already skips those without interest."""
        with self._mutex:
            for one in found:
                if not isinstance(one, Skipped):
                    self._put(one, wanted=True)
                elif not self._closed:
                    self._skip(one)

    def _skip(self, skipped: Skipped) -> None:
        """Add the numbers of notices without interest; wakes no thread."""
        last = self._notices[-1] if self._notices else None
        if isinstance(last, Skipped) and (last.shard, last.epoch, last.number) == skipped[:3]:
            self._notices[-1] = Skipped(last.shard, last.epoch, last.after, skipped.number)
        elif len(self._notices) < self._notices_max:
            self._notices.append(skipped)

    def get(self, timeout_s: float | None) -> Notice | Skipped | None:
        """Return the next notice, or the skipped run before it.

        Returns None after `timeout_s`, once closed, and in a forked child.
        """
        if self._is_inherited():
            return None
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        late = False
        while True:
            with self._mutex:
                if self._ear is None:
                    self._changed.wait_for(self._has_news, _left_s(deadline_s))
                if self._closed:
                    return None
                if self._notices:
                    return self._notices.popleft()
                ear = self._ear
                if ear is None or late:
                    return None
                self._polling = True
            if not self._read(ear, _left_s(deadline_s)):
                return None
            # The data may be a part of a notice, or the end of the source.
            late = deadline_s is not None and time.monotonic() >= deadline_s

    def get_here(self) -> Notice | Skipped | None:
        """Return the next notice that has arrived already, or None."""
        if self._is_inherited():
            return None
        with self._mutex:
            return self._notices.popleft() if self._notices and not self._closed else None

    def _is_inherited(self) -> bool:
        """Whether this is a forked child: a thread of the parent may have held the mutex."""
        return self._pid != os.getpid()

    def _has_news(self) -> bool:
        return bool(self._notices) or self._closed or self._ear is not None

    def _read(self, ear: _Ear, wait_s: float | None) -> bool:
        """Wait for the source or the bell, and take what has arrived; False if nothing has."""
        try:
            ready = ear.wait(wait_s)
            with self._mutex:
                self._polling = False
                rang = ear.heard_bell(ready)
            if self._closed or not ready:
                return rang
            found = ear.source.take_notices()
        except (EnactError, EOFError, OSError, ValueError) as error:
            self._ended(ear, error)
            return True
        self.take(found)
        return True

    def _ended(self, ear: _Ear, error: Exception) -> None:
        with self._mutex:
            if self._ear is not ear:
                return
            self._ear = None
        ear.on_end(error)

    def close(self) -> None:
        """End the feed and wake a thread that waits in `get`; idempotent."""
        if self._is_inherited():
            return
        with self._mutex:
            if self._closed:
                return
            self._closed = True
            self._wake()
            self._came.notify_all()
        if self.on_close is not None:
            self.on_close()


def _left_s(deadline_s: float | None) -> float | None:
    return None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
