"""Views and stamps at the shard's door: committed data without a lock, as of now or as of a stamp.

A view over several shards is one cut if all of them answer as of one stamp T: every commit stamped
up to T is shown, none after it.  The answer says from when to when its data were current; that
interval ends before the stamp of any commit that is prepared or under way on the viewed slots,
because such a commit may still become visible with a stamp from there on.  Asked *at* T, a shard
first moves its clock past T, so that whatever is prepared later gets a larger stamp, and then
waits for those that are undecided and stamped up to T.

A strict view as of T is about history: it is answered with the data as of T, or with what is
forgotten of them, and never with the present.  Where an undecided commit still stands in the way
after the wait, its interval ends before T, and it is to be asked again.

A question about a stamp asks when everything up to it has become visible.  The cost of a message
does not grow with the number of parked requests of either kind: the one that waits longest is found
at once, and so is the one with the smallest stamp.
"""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

from enact_dist.core.protocol.checks import unknown_world
from enact_dist.core.protocol.datum import Column, Slot
from enact_dist.core.protocol.messages import (
    CLOCK_SKEW,
    PROTOCOL,
    AwaitStamp,
    EpochChanged,
    Forgotten,
    Item,
    Reached,
    Refused,
    TakeView,
    Viewed,
)
from enact_dist.core.protocol.records import Effect, Reply
from enact_dist.core.state.grants import WAIT_SLICE_NS_MAX
from enact_dist.patterns import pattern_matches
from enact_dist.terms import ACCESSES

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from enact_dist.core.shard.on_lock import LockHandler
    from enact_dist.core.shard.on_prepare import PrepareHandler
    from enact_dist.core.shard.state import ShardState

VIEW_WAIT_NS: Final = 400_000_000
"""How long a view waits for undecided commits; then it is answered, and may be asked again."""
WAITING_MAX: Final = 2048
"""Views that wait at one shard; further ones are answered as if they had waited enough."""
OF_A_SESSION_MAX: Final = 64
"""Questions of one kind that a session may have parked; the oldest one is answered for the next."""
STALE_MAX: Final = 1024
"""Entries of questions that were answered early may stay in a heap up to as many as are parked
and these, then they are swept out."""

T = TypeVar("T")


class ParkedRequest(NamedTuple, Generic[T]):
    """One parked question: whose it is, and when its wait is over."""

    question: T
    session: str
    end_ns: int


class Order:
    """Parked questions by a number, the smallest first; those that are gone are passed over."""

    __slots__ = ("_heap", "_parked")

    def __init__(self, parked: dict[int, ParkedRequest[T]]) -> None:
        self._parked = parked
        self._heap: list[tuple[int, int]] = []

    def add(self, number: int, reply_to: int) -> None:
        """Put a parked question in its place."""
        if len(self._heap) > 2 * len(self._parked) + STALE_MAX:
            self._heap = [entry for entry in self._heap if entry[1] in self._parked]
            heapq.heapify(self._heap)
        heapq.heappush(self._heap, (number, reply_to))

    def first(self) -> tuple[int, int] | None:
        """Return the smallest number, and the question that has it; None if nothing is parked."""
        heap = self._heap
        while heap and heap[0][1] not in self._parked:
            heapq.heappop(heap)
        return heap[0] if heap else None


class Parked(Generic[T]):
    """All parked questions of one kind, by where their answers go."""

    __slots__ = ("_by_end", "_of_session", "by_reply")

    def __init__(self) -> None:
        self.by_reply: dict[int, ParkedRequest[T]] = {}
        self._by_end = Order(self.by_reply)
        self._of_session: dict[str, dict[int, None]] = {}

    def __len__(self) -> int:
        return len(self.by_reply)

    def add(self, reply_to: int, question: T, *, session: str, end_ns: int) -> int | None:
        """Park a request; return the oldest one of its session if that has too many."""
        self.by_reply[reply_to] = ParkedRequest(question, session, end_ns)
        self._by_end.add(end_ns, reply_to)
        of_session = self._of_session.setdefault(session, {})
        of_session[reply_to] = None
        return next(iter(of_session)) if len(of_session) > OF_A_SESSION_MAX else None

    def take(self, reply_to: int) -> T:
        """Let a question go that is answered now."""
        question, session, _ = self.by_reply.pop(reply_to)
        of_session = self._of_session[session]
        del of_session[reply_to]
        if not of_session:
            del self._of_session[session]
        return question

    def ended(self, now_ns: int) -> Iterator[tuple[int, T]]:
        """Remove and yield the requests whose wait is over."""
        while (first := self._by_end.first()) is not None and first[0] <= now_ns:
            yield first[1], self.take(first[1])

    def all(self) -> Iterator[tuple[int, T]]:
        """Remove and yield all requests, in order."""
        for reply_to in list(self.by_reply):
            yield reply_to, self.take(reply_to)

    def next_end_ns(self) -> int | None:
        """Return when the next wait is over."""
        first = self._by_end.first()
        return None if first is None else first[0]


class ViewHandler:
    """Everything about views without a lock.

    Attributes:
        waits: The views that wait for undecided commits.
    """

    def __init__(self, state: ShardState, locks: LockHandler, prepares: PrepareHandler) -> None:
        self._state = state
        self._locks = locks
        self._prepares = prepares
        self._parked = Parked[TakeView]()
        self.waits: Collection[int] = self._parked.by_reply
        self._behind: dict[int, dict[int, None]] = {}
        self._behind_of: dict[int, int] = {}

    def on_take_view(self, message: TakeView, reply_to: int) -> Iterator[Effect]:
        """Show committed data without a lock."""
        state, items = self._state, message.items
        session = state.session_in_epoch(message.lock.session, message.epoch)
        if session is None:
            yield Reply(reply_to, EpochChanged(state.epoch))
            return
        shape = state.tenures.shapes.get(items)
        refusal = self._locks.refused(message.map_version, items, shape)
        if refusal is not None:
            yield Reply(reply_to, refusal)
            return
        if message.at_ns < 0:
            yield Reply(
                reply_to, Refused(PROTOCOL, f"stamp {message.at_ns} was asked, which is none")
            )
            return
        if message.strict and state.stamps.too_far_ahead(message.at_ns, wall_ns=state.wall_ns):
            yield Reply(reply_to, self._in_the_future(message.at_ns))
            return
        # Whatever is counted renews: the client believes from the newest counter that was seen.
        session.renew(state.now_ns, message.count)
        state.stamp(max(message.seen_stamp_ns, message.at_ns))
        full = len(self._parked) >= WAITING_MAX
        if not full and message.at_ns and self._waits(reply_to, message):
            state.count("views_waited")
            end_ns = state.now_ns + VIEW_WAIT_NS
            oldest = self._parked.add(reply_to, message, session=session.session, end_ns=end_ns)
            if oldest is not None:
                yield self._answer(oldest, self._parked.take(oldest))
        else:
            yield Reply(reply_to, self._viewed(message))

    def _waits(self, reply_to: int, message: TakeView) -> bool:
        """Whether an undecided commit stands before a view; it waits for the first one then."""
        undecided_ns = self._undecided_ns(message.items)
        if undecided_ns > message.at_ns:
            return False
        # Here each commit has a stamp of its own.
        self._behind.setdefault(undecided_ns, {})[reply_to] = None
        self._behind_of[reply_to] = undecided_ns
        return True

    def _in_the_future(self, at_ns: int) -> Refused:
        ahead_s = (at_ns - self._state.wall_ns) / 1e9
        return Refused(
            CLOCK_SKEW,
            f"the data were asked as of a time {ahead_s:.1f} s ahead of the clock of shard"
            f" {self._state.settings.name}; at most 1 s is accepted; ask for a time that has come",
            (str(ahead_s),),
        )

    def _undecided_ns(self, items: tuple[Item, ...]) -> int:
        """Return the smallest stamp that an undecided commit on these items may get."""
        undecided = self._prepares.undecided()
        if not undecided:
            return _NEVER_NS
        slots = {Slot(i.context, i.entity, i.aspect) for i in items if not ACCESSES[i.access].each}
        each = [(Column(i.context, i.aspect), i.entity) for i in items if ACCESSES[i.access].each]
        return min(
            (
                stamp_ns
                for stamp_ns, writes in undecided
                if any(write.slot in slots or _in_any(write.slot, each) for write in writes)
            ),
            default=_NEVER_NS,
        )

    def _viewed(self, message: TakeView) -> Viewed | Forgotten:
        state = self._state
        if message.strict and message.at_ns:
            forgotten = state.slots.forgotten(message.items, message.at_ns)
            if forgotten is not None:
                state.count("views_forgotten")
                return forgotten
        states, pins, from_ns = state.slots.shown(message.items, message.at_ns)
        if pins and state.pins.add(message.lock, pins):
            state.count("views_displaced")
        stamp_ns = state.stamp()
        until_ns = min(stamp_ns, self._undecided_ns(message.items) - 1)
        if message.at_ns:
            # Some of it may be past already, and was current at that stamp for certain.
            until_ns = min(until_ns, message.at_ns)
        return Viewed(message.lock, state.epoch, stamp_ns, tuple(states), from_ns, until_ns)

    def answer_parked(self, *, decided: bool) -> Iterator[Effect]:
        """Answer the views that waited enough, or that nothing undecided stands before any more.

        Nothing was decided since the last time unless `decided`.
        """
        if self._state.draining:
            for reply_to, message in self._parked.all():
                yield self._answer(reply_to, message)
        for reply_to, message in self._parked.ended(self._state.now_ns):
            yield self._answer(reply_to, message)
        if decided:
            undecided = {stamp_ns for stamp_ns, _ in self._prepares.undecided()}
            for stamp_ns in sorted(self._behind.keys() - undecided):
                for reply_to in self._behind.pop(stamp_ns):
                    del self._behind_of[reply_to]
                    if not self._waits(reply_to, self._parked.by_reply[reply_to].question):
                        yield self._answer(reply_to, self._parked.take(reply_to))

    def _answer(self, reply_to: int, message: TakeView) -> Effect:
        stamp_ns = self._behind_of.pop(reply_to, None)
        if stamp_ns is not None:
            del self._behind[stamp_ns][reply_to]
            if not self._behind[stamp_ns]:
                del self._behind[stamp_ns]
        return Reply(reply_to, self._dropped(message) or self._viewed(message))

    def _dropped(self, message: TakeView) -> Refused | EpochChanged | None:
        """Refuse a view whose session, or one of whose contexts, ended while it waited.

        What it showed would stay pinned for a session that has ended.
        """
        if self._state.sessions.known(message.lock.session) is None:
            return EpochChanged(self._state.epoch)
        worlds = self._state.catalogue.worlds
        gone = next((item.context for item in message.items if item.context not in worlds), None)
        return None if gone is None else unknown_world(gone, worlds)

    def next_deadline_ns(self) -> int | None:
        """Return when a view has waited enough."""
        return self._parked.next_end_ns()


class StampHandler:
    """Everything about waiting for commits that are not decided yet.

    Attributes:
        waits: The questions that wait for their stamp.
    """

    def __init__(self, state: ShardState, prepares: PrepareHandler) -> None:
        self._state = state
        self._prepares = prepares
        self._parked = Parked[AwaitStamp]()
        self.waits: Collection[int] = self._parked.by_reply
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
        if not self.waits:
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
        undecided = self._prepares.undecided()
        return min([self._state.stamp(), *(stamp_ns - 1 for stamp_ns, _ in undecided)])

    def next_deadline_ns(self) -> int | None:
        """Return when the next wait is over."""
        return self._parked.next_end_ns()


_NEVER_NS: Final = 1 << 62


def _in_any(slot: Slot, each: list[tuple[Column, str]]) -> bool:
    column = Column(slot.context, slot.aspect)
    return any(column == one and pattern_matches(pattern, slot.entity) for one, pattern in each)
