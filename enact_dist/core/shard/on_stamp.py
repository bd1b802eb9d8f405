"""Stamps at the shard's door: has everything up to a stamp become visible, and tell me when."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.messages import AwaitStamp, EpochChanged, Reached
from enact_dist.core.protocol.records import Reply
from enact_dist.core.shard.parked import Order, Parked
from enact_dist.core.state.grants import WAIT_SLICE_NS_MAX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.shard.on_prepare import PrepareDesk
    from enact_dist.core.shard.state import ShardState


class StampDesk:
    """Everything about waiting for commits that are not decided yet."""

    def __init__(self, state: ShardState, prepares: PrepareDesk) -> None:
        self._state = state
        self._prepares = prepares
        self._parked = Parked[AwaitStamp]()
        self._by_stamp = Order(self._parked.by_reply)

    def on_await_stamp(self, message: AwaitStamp, reply_to: int) -> Iterator[Effect]:
        """Answer at once, or park the question of a session until the stamp is reached."""
        state = self._state
        stamp_ns, shown_ns = state.stamp(), self._shown_ns()
        reached = message.stamp_ns <= shown_ns
        wait_ns = min(message.wait_ns, WAIT_SLICE_NS_MAX)
        if reached or wait_ns <= 0 or not message.session or state.draining:
            yield Reply(reply_to, Reached(reached, stamp_ns))
            return
        if message.epoch != state.epoch or state.sessions.known(message.session) is None:
            yield Reply(reply_to, EpochChanged(state.epoch))
            return
        oldest = self._parked.add(
            reply_to, message, session=message.session, end_ns=state.now_ns + wait_ns
        )
        self._by_stamp.add(message.stamp_ns, reply_to)
        if oldest is not None:
            self._parked.take(oldest)
            yield Reply(oldest, Reached(False, stamp_ns))

    def answer_reached(self) -> Iterator[Effect]:
        """Answer those whose stamp is reached, and those whose wait is over."""
        if not self._parked:
            return
        stamp_ns, shown_ns = self._state.stamp(), self._shown_ns()
        while (first := self._by_stamp.first()) is not None and first[0] <= shown_ns:
            self._parked.take(first[1])
            yield Reply(first[1], Reached(True, stamp_ns))
        for reply_to, _ in self._parked.ended(self._state.now_ns):
            yield Reply(reply_to, Reached(False, stamp_ns))

    def answer_all(self) -> Iterator[Effect]:
        """Answer everybody: this shard ends."""
        yield from self.answer_reached()
        for reply_to, _ in self._parked.all():
            yield Reply(reply_to, Reached(False, self._state.stamp()))

    def _shown_ns(self) -> int:
        """Return the stamp up to which every commit is visible."""
        undecided = [stamp_ns for stamp_ns, _ in self._state.commits.undecided()]
        undecided += [record.stamp_ns for record in self._prepares.undecided()]
        return min([self._state.stamp(), *(stamp_ns - 1 for stamp_ns in undecided)])

    def next_deadline_ns(self) -> int | None:
        """Return when the next wait is over."""
        return self._parked.next_end_ns()
