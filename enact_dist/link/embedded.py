"""The carrier of `local()`: the shard lives in this process, a call is a function call.

Nothing is encoded and nothing copied; data are immutable, so both sides may hold them.  The
session's token is present as long as the process is, exactly as over a network.
"""

from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.records import SessionSeen
from enact_dist.errors import MisuseError, ShardUnreachableError
from enact_dist.link.notices import NoticeQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.messages import Answer, Request, ShardEntry, Survey
    from enact_dist.link.host import ShardHost


FETCH_BYTES: Final = 1 << 40
"""More than any datum has."""


class _Call:
    """One answer on its way; most are there before anybody waits."""

    __slots__ = ("answer", "done", "timeout_s")

    def __init__(self) -> None:
        self.answer: Answer | None = None
        self.timeout_s = 0.0
        self.done = threading.Lock()  # a bare lock wakes in half the time of an Event
        self.done.acquire()

    def __call__(self, answer: Answer) -> None:
        self.answer = answer
        self.done.release()

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer; its data are those that the shard has."""
        self.done.acquire(timeout=max(0.0, self.timeout_s))
        return self.answer

    def abandon(self) -> None:
        """Do nothing: nothing is left to do."""


class EmbeddedCarrier:
    """Calls the one shard of this process.  See `Carrier` for the methods.

    Args:
        host: The shard; it is not closed with the carrier.
        session: The session whose token is shown as present until `close`.

    Attributes:
        inside: The only shard is in this process.
        fetch_bytes: How large a slice of a datum is asked for in one call: all, nothing is copied.
    """

    def __init__(self, host: ShardHost, session: str) -> None:
        self.inside = True
        self.fetch_bytes = FETCH_BYTES
        self._host = host
        self._session = session
        self._pid = os.getpid()
        self._closed = False
        self._feeds: set[NoticeQueue] = set()
        host.event(SessionSeen(session, present=True))

    def request(self, shard: str, message: Request, *, timeout_s: float) -> Answer | None:
        """Call the shard; None if it is parked for longer than `timeout_s` or fails meanwhile.

        Raises:
            ShardUnreachableError: `shard` is not the shard of this process.
            MisuseError: The carrier is closed or was opened before a fork.
        """
        call = self._begin(shard, message)
        if call.answer is None:
            call.done.acquire(timeout=max(0.0, timeout_s))
        return call.answer

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Make all calls, then wait for those that are parked.

        Raises:
            ShardUnreachableError: As `request`.
            MisuseError: As `request`.
        """
        calls = [self._begin(shard, message) for shard, message in requests]
        deadline_s = time.monotonic() + timeout_s
        for call in calls:
            call.done.acquire(timeout=max(0.0, deadline_s - time.monotonic()))
        return [call.answer for call in calls]

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> _Call:
        """Make a call whose answer is waited for later.

        Raises:
            ShardUnreachableError: As `request`.
            MisuseError: As `request`.
        """
        call = self._begin(shard, message)
        call.timeout_s = timeout_s
        return call

    def _begin(self, shard: str, message: Request) -> _Call:
        self._check_usable()
        if shard != self._host.name:
            raise ShardUnreachableError(
                f"shard {shard} is not in this process; the only one here is {self._host.name}",
                shard=shard,
                endpoint="this process",
            )
        call = _Call()
        if self._host.ended:
            call.done.release()
        else:
            self._host.submit(message, call)
        return call

    def _check_usable(self) -> None:
        if self._pid != os.getpid():
            raise MisuseError(
                f"this cell runs inside process {self._pid} and cannot be used in process"
                f" {os.getpid()}, which was forked from it; open one there, or use a shard daemon"
            )
        if self._closed:
            raise MisuseError("the connection to this cell is closed; open it again")

    def subscribe(self, interest: Survey | None = None) -> NoticeQueue:
        """Open a feed of the shard's notices."""
        self._check_usable()
        feed = NoticeQueue(interest)
        unwatch = self._host.watch(feed.put)

        def end() -> None:
            unwatch()
            self._feeds.discard(feed)

        feed.on_close = end
        self._feeds.add(feed)
        return feed

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Do nothing: there is no other shard."""

    def way_to(self, shard: str) -> str:
        """Return how calls travel: not at all."""
        return "call"

    def away(self, shard: str) -> bool:
        """Say no: the shard is in this process."""
        return False

    def tell_returns(self, returned: Callable[[str], None]) -> None:
        """Do nothing: the shard is in reach as long as this process lives."""

    def endpoint_of(self, shard: str) -> str:
        """Return where the shard is, and why it answers no more."""
        failure = self._host.failure
        if failure is not None:
            return (
                f"this process, where it has stopped ({failure}; close the cell and open it anew)"
            )
        return "this process"

    def close(self) -> None:
        """End the session's token and all feeds; twice is harmless."""
        if self._closed or self._pid != os.getpid():
            return
        self._closed = True
        for feed in list(self._feeds):
            feed.close()
        self._host.event(SessionSeen(self._session, present=False))
