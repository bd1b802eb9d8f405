"""A cell whose messages pass the wire one by one, so that any one of them can come again.

A `Tape` numbers every delivery of a run: requests at a shard, answers at a client, answers between
shards.  `Again` names one of them and when its copy comes.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from client_bench import ANSWER, REQUEST, CellBench, ClientBench
from shard_bench import ASPECTS, MS, Answer, Register

from enact_dist.core.protocol.messages import Goodbye, Item
from enact_dist.core.protocol.records import Called, Tick
from enact_dist.terms import Access
from enact_dist.wire.frames import decode_frame, encode_frame

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.messages import Message, Request


class When(enum.Enum):
    """When a copy of a message comes."""

    AT_ONCE = "right behind it"
    AT_THE_END = "when all is over"
    AFTER_A_RESTART = "after a restart of the shard that took or sent it"


class Again(NamedTuple):
    """Which delivery is repeated, and when."""

    index: int
    when: When


@dataclass(slots=True)
class Delivery:
    """One message that has arrived.

    Attributes:
        shard: Who took or sent it.
        message: What came.
        repeat: Lets a copy come; returns its answer where it is a request.
        answer: What the first one was answered at once.
        second: What the copy was answered at once.
    """

    shard: str
    message: Message
    repeat: Callable[[], Answer | None]
    answer: Answer | None = None
    second: Answer | None = None


def through_wire(message):
    """Return what the other side reads of a message."""
    header, payload = encode_frame(message)
    return decode_frame(header, payload or b"")


class RepeatingCell(CellBench):
    """Two shards or more, their clients, and the tape of all that they say."""

    def __init__(self, *shards: str, again: Again | None = None) -> None:
        super().__init__(*shards)
        self.again = again
        self.tape: list[Delivery] = []
        self.clients: list[RepeatingClient] = []
        self.locks: list[MultiLock] = []
        self.loses_calls: Callable[[str, Request], bool] = lambda _shard, _request: False

    def client(self, session: str, *, observer: bool = False) -> RepeatingClient:
        """Open a session at every shard."""
        bench = RepeatingClient(self, session)
        bench.core.observer = observer
        self.clients.append(bench)
        for shard in self.shards:
            bench.call(shard, bench.core.hello(shard))
            bench.call(shard, Register(session, ("online",), ASPECTS))
        return bench

    def _taped(self, delivery: Delivery) -> None:
        """Deliver for the first time, and once more if its turn is now."""
        index = len(self.tape)
        self.tape.append(delivery)
        delivery.answer = delivery.repeat()
        if self.again == (index, When.AT_ONCE):
            delivery.second = delivery.repeat()

    def request(self, shard: str, request: Request) -> Delivery:
        """Carry a request to a shard."""
        bench = self.shards[shard]
        delivery = Delivery(shard, request, lambda: bench.ask(through_wire(request)))
        self._taped(delivery)
        return delivery

    def answer(self, shard: str, answer: Answer, take: Callable[[Answer], object]) -> None:
        """Carry an answer to whoever waits for it."""

        def repeat() -> None:
            take(through_wire(answer))

        self._taped(Delivery(shard, answer, repeat))

    def carry_calls(self) -> None:
        """Let the shards talk with each other until they have nothing to say."""
        while any(bench.calls for bench in self.shards.values()):
            for name, bench in self.shards.items():
                calls, bench.calls[:] = list(bench.calls), []
                for other, request in calls:
                    if not self.loses_calls(other, request):
                        self._carry_call(name, other, request)

    def _carry_call(self, name: str, other: str, request: Request) -> None:
        delivery = self.request(other, request)
        bench = self.shards[name]
        for came in (delivery.answer, delivery.second):
            if came is not None:
                self.answer(other, came, lambda came: bench.event(Called(other, request, came)))

    def tick(self) -> None:
        """Let each shard look at the time, then let them talk."""
        for bench in self.shards.values():
            bench.event(Tick())
        self.carry_calls()

    def wait_alive(self, ns: int) -> None:
        """Let time pass while every client keeps itself alive."""
        for _ in range(max(1, ns // (500 * MS))):
            self.wait(500 * MS)
            self.keep_alive()
            self.carry_calls()

    def keep_alive(self) -> None:
        """Let every client say that it lives, and hello where a shard has restarted."""
        for client in self.clients:
            if not client.gone:
                client.keep_alive()
                client.keep_alive()

    def restart(self, shard: str) -> None:
        """Let a shard die and come back; every client says hello, a new one locks."""
        self.shards[shard].restart()
        self.keep_alive()
        zoe = self.client("zoe")
        for lane, name in enumerate(self.shards):
            new = Item(Access.WRITE, "online", self.entity_on(name, "new"), "count")
            zoe.locked(new, lane=lane)

    def repeat(self) -> None:
        """Let the late copy come, if one is due."""
        if self.again is not None and self.again.when is not When.AT_ONCE:
            delivery = self.tape[self.again.index]
            delivery.second = delivery.repeat()
            self.carry_calls()


class RepeatingClient(ClientBench):
    """One client process whose messages are on the tape."""

    cell: RepeatingCell

    def __init__(self, cell: RepeatingCell, session: str) -> None:
        super().__init__(cell, session)
        self.gone = self.said_goodbye = False

    def call(self, shard: str, request: Request) -> Answer | None:
        """Make one call outside of any lock."""

        def take(answer: Answer) -> None:
            self.core.answered(shard, request, answer, self.cell.now_ns)

        return self._called(shard, request, take)

    def _called(self, shard, request, take):
        self.sent.append((shard, request))
        lost = self.lose(shard, request)
        if lost == REQUEST:
            return None
        delivery = self.cell.request(shard, request)
        if lost == ANSWER:
            return None
        for came in (delivery.answer, delivery.second):
            if came is not None:
                self.cell.answer(shard, came, take)
        return delivery.answer

    def begin(self, *items, **options):
        """Start a lock without making its calls."""
        lock = super().begin(*items, **options)
        self.cell.locks.append(lock)
        return lock

    def step(self, lock: MultiLock) -> None:
        """Make the calls that the lock wants now, or let time pass until it wants some."""
        calls, until_ns = lock.next_calls(self.cell.now_ns)
        self.core.assert_invariants()
        if not calls and lock.phase.busy:
            self.cell.wait(max(MS, until_ns - self.cell.now_ns))
        for shard, request in calls:

            def take(answer, shard=shard, request=request):
                lock.answered(shard, request, answer, self.cell.now_ns)

            if self._called(shard, request, take) is None:
                lock.answered(shard, request, None, self.cell.now_ns)
        self.cell.carry_calls()

    def _answer(self, shard: str, request: Request) -> Answer | None:
        return self.call(shard, request)

    def say_goodbye(self) -> None:
        """End the session at every shard."""
        for shard in self.core.shards_in_use():
            self.call(shard, Goodbye(self.core.session))
        self.gone = self.said_goodbye = True
