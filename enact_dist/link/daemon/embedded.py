"""The carrier of `local()`: the shard runs in this process, a call is a function call.

Nothing is encoded or copied: data are immutable, so both sides share them.  The session's token
exists as long as the process, as it does over a network.
"""

from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.records import SessionSeen
from enact_dist.errors import MisuseError, ShardUnreachableError
from enact_dist.link.carrier import LOOK_S
from enact_dist.link.notices import NoticeQueue

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Answer, Request, ShardEntry, Survey
    from enact_dist.link.host import ShardHost


FETCH_BYTES: Final = 1 << 40
"""Larger than any datum."""


class _Call:
    """One pending answer; most have arrived before a thread waits."""

    __slots__ = ("answer", "done", "timeout_s")

    def __init__(self, timeout_s: float) -> None:
        self.answer: Answer | None = None
        self.timeout_s = timeout_s
        self.done = threading.Lock()  # a bare lock wakes twice as fast as an Event
        self.done.acquire()

    def __call__(self, answer: Answer) -> None:
        self.answer = answer
        self.done.release()

    def wait(self, into: memoryview | None = None) -> Answer | None:
        """Return the answer; its data are the shard's own objects."""
        self.done.acquire(timeout=max(0.0, self.timeout_s))
        return self.answer

    def abandon(self) -> None:
        """Do nothing: an abandoned call needs no cleanup."""


class EmbeddedCarrier:
    """Calls the one shard of this process.  See `Carrier` for the methods.

    Args:
        host: The shard; the carrier does not close it.
        session: The session whose token counts as present until `close`.

    Attributes:
        inside: True: the only shard runs in this process.
        fetch_bytes: The largest slice that one call requests: a whole datum, since nothing is
            copied.
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

    def request(
        self,
        shard: str,
        message: Request,
        *,
        timeout_s: float,
        interrupt: threading.Event | None = None,
    ) -> Answer | None:
        """Call the shard; return None if it parks the call beyond `timeout_s`, or fails.

        Raises:
            ShardUnreachableError: `shard` is not the shard of this process.
            MisuseError: The carrier is closed or was opened before a fork.
        """
        call = self.begin(shard, message, timeout_s=timeout_s)
        if call.answer is not None or interrupt is None:
            return call.answer if call.answer is not None else call.wait()
        end_s = time.monotonic() + timeout_s
        while not call.done.acquire(timeout=LOOK_S):
            if interrupt.is_set() or time.monotonic() >= end_s:
                break
        return call.answer

    def request_all(
        self, requests: Sequence[tuple[str, Request]], *, timeout_s: float
    ) -> list[Answer | None]:
        """Make all calls, then wait for the parked ones."""
        calls = [self.begin(shard, message, timeout_s=timeout_s) for shard, message in requests]
        deadline_s = time.monotonic() + timeout_s
        for call in calls:
            call.done.acquire(timeout=max(0.0, deadline_s - time.monotonic()))
        return [call.answer for call in calls]

    def begin(self, shard: str, message: Request, *, timeout_s: float) -> _Call:
        """Make a call whose answer the caller awaits later."""
        self._check_usable()
        if shard != self._host.name:
            raise ShardUnreachableError(
                f"shard {shard} is not in this process; the only one here is {self._host.name}",
                shard=shard,
                endpoint="this process",
            )
        call = _Call(timeout_s)
        if self._host.ended:
            call.done.release()
        else:
            self._host.submit(message, call)  # a lent thread would see no end of its time
        return call

    def _check_usable(self) -> None:
        if self._pid != os.getpid():
            raise MisuseError(
                f"this cell runs inside process {self._pid} and cannot be used in process"
                f" {os.getpid()}, which was forked from it; open one there, or use a shard daemon"
            )
        if self._closed:
            raise MisuseError("the connection to this cell is closed; open a new one")

    def subscribe(self, interest: Survey | None = None) -> NoticeQueue:
        """Open a feed of the shard's notices."""
        self._check_usable()
        feed = NoticeQueue(interest)
        put = feed.put
        if interest is not None and interest.data:
            put = lambda notice: feed.put(self._host.with_data(notice))  # noqa: E731
        unwatch = self._host.watch(put)

        def end() -> None:
            unwatch()
            self._feeds.discard(feed)

        feed.on_close = end
        self._feeds.add(feed)
        return feed

    def add_endpoints(self, entries: Sequence[ShardEntry]) -> None:
        """Do nothing: there is no other shard."""

    def transport_of(self, shard: str) -> str:
        """Return the transport, for people: calls stay inside this process."""
        return "call"

    def away(self, shard: str) -> bool:
        """Return False: the shard is in this process."""
        return False

    def on_reconnect(self, returned: Callable[[str], None]) -> None:
        """Do nothing: the shard is within reach while this process lives."""

    def endpoint_of(self, shard: str) -> str:
        """Return where the shard is and, once it has failed, why."""
        failure = self._host.failure
        if failure is not None:
            return (
                f"this process, where it has stopped ({failure}; close the cell and open a new one)"
            )
        return "this process"

    def reason_away(self, shard: str) -> str:
        """Return nothing: no certificate lies between the shard and its clients."""
        return ""

    def close(self) -> None:
        """End the session's token and all feeds; idempotent."""
        if self._closed or self._pid != os.getpid():
            return
        self._closed = True
        for feed in list(self._feeds):
            feed.close()
        self._host.event(SessionSeen(self._session, present=False))
