"""The process around one real `Client`: its calls, its keep-alives and its threads.

A thread is a generator that yields what it waits for: `Sleep`, or `ParallelCalls` whose answers it
is then sent, None for each that no shard answered in time.  It drives `MultiLock` as `link.client`
does.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from enact_dist.core.client.client import Client, RecallListener
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    Acquire,
    Answer,
    AspectEntry,
    Hello,
    KeepAlive,
    Refused,
    Register,
    Registered,
    Request,
    Welcome,
)
from enact_dist.link.client.catalogue import CATALOGUES, KnownCatalogue
from enact_dist.link.client.kept import QUIET_S
from enact_dist.verify.simulation.hosts.folders import ClientFiles, Folders
from enact_dist.verify.simulation.hosts.keeping import KeptLocks, Sight, Stop
from enact_dist.verify.simulation.hosts.world import MS, Host, S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.hosts.network import Network
    from enact_dist.verify.simulation.hosts.shard_host import ShardPlace
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld

QUIET_NS = int(QUIET_S * S)
CALL_NS = S
"""How long a call may stay unanswered before its thread takes that for an answer."""


@dataclass(frozen=True, slots=True)
class Sleep:
    """Wait for a duration of the host's clock."""

    duration_ns: int


@dataclass(frozen=True, slots=True)
class ParallelCalls:
    """Make these calls at once and wait for all answers."""

    calls: Sequence[tuple[str, Request]]
    lock: MultiLock | None = None


T = TypeVar("T")
Steps: TypeAlias = Generator[Sleep | Stop | ParallelCalls, list[Answer | None], T]
"""A part of what a thread does, with what comes of it."""
Thread: TypeAlias = Steps[None]


@dataclass(slots=True)
class _Call:
    shard: str
    request: Request
    take: Callable[[Answer | None], None] | None
    lock: MultiLock | None


class ClientNode(Host):
    """A client process with one session and several threads."""

    def __init__(
        self,
        world: SimulatedWorld,
        name: str,
        *,
        network: Network,
        shards: Mapping[str, ShardPlace],
        check_beliefs: Callable[[ClientNode], None],
        faults: Faults,
        ttl_ns: int,
        sight: Sight = Sight.AWAY,
        folders: Folders | None = None,
    ) -> None:
        super().__init__(world, name, drift_ppm=faults.drift_ppm, wall_offset_ns=0)
        session = f"{world.schedule.stream(f'session of {name}').getrandbits(64):016x}"
        self.client = Client(session, ttl_ns=ttl_ns, actor=name)
        self.catalogue = KnownCatalogue()
        self.generation = 0
        self.starves_until_ns = 0
        self.files = ClientFiles(
            self,
            session,
            lambda shard, message: self.call(shard, message, lambda _answer: None),
            folders or Folders(world),
        )
        self.cache: dict[Slot, tuple[str, int, int, Datum]] = {}
        self.own: dict[Slot, tuple[str, int, int]] = {}
        """Where and in which epoch it last committed a slot, and with which stamp."""
        self.threads_left = 0
        self._network, self._shards, self._check_beliefs = network, shards, check_beliefs
        self._faults = faults
        self._calls: dict[int, _Call] = {}
        self._calls_made = 0
        self._late_answers = world.schedule.place(f"{name}-late")
        self._stopped: dict[int, Thread] = {}
        self._stops = 0
        self._listeners: dict[str, RecallListener] = {}
        self.kept = KeptLocks(
            self.client,
            sight,
            world.schedule.stream(f"steps of {name}"),
            marks_of=lambda shard: shards[shard].marks if shards[shard].up else None,
            now=lambda: self.local_ns,
            say=lambda shard, message: self.call(shard, message, lambda _answer: None),
        )
        self.kept.listens = self.listen

    # ---------------------------------------------------------------- threads

    def start(self, thread: Thread) -> None:
        """Run a thread; what breaks it breaks the run."""
        self.threads_left += 1
        self._resume(thread, [])

    def _resume(self, thread: Thread, answers: list[Answer | None] | None) -> None:
        try:
            wish = thread.send(answers) if answers else next(thread)
        except StopIteration:
            self.threads_left -= 1
            return
        if isinstance(wish, Sleep):
            self.later(wish.duration_ns, lambda: self._resume(thread, None))
        elif isinstance(wish, Stop):
            self._stops += 1
            self._stopped[self._stops] = thread
            self.later(wish.duration_ns, partial(self._goes_on, self._stops))
        else:
            self._call_all(thread, wish)

    def _goes_on(self, number: int) -> None:
        """Let a thread go on that stands between two steps, unless it did so before."""
        thread = self._stopped.pop(number, None)
        if thread is not None:
            self._resume(thread, None)

    def acts(self) -> bool:
        """Let one thread that stands between two steps take the next one now, if there is one."""
        if not self.up or self.paused or not self._stopped:
            return False
        self.world.tally["steps while a shard looks at marks"] += 1
        self._goes_on(next(iter(self._stopped)))
        return True

    def _call_all(self, thread: Thread, wish: ParallelCalls) -> None:
        answers: list[Answer | None] = [None] * len(wish.calls)
        left = [len(wish.calls)]

        def take(index: int, answer: Answer | None) -> None:
            answers[index] = answer
            left[0] -= 1
            if not left[0]:
                self._resume(thread, answers)

        for index, (shard, request) in enumerate(wish.calls):
            self.call(shard, request, partial(take, index), lock=wish.lock)

    # ---------------------------------------------------------------- calls

    def call(
        self,
        shard: str,
        request: Request,
        take: Callable[[Answer | None], None] | None,
        *,
        lock: MultiLock | None = None,
    ) -> None:
        """Send a request; `take` gets its answer, or None when time is up."""
        self._calls_made += 1
        number = self._calls_made
        self._calls[number] = _Call(shard, request, take, lock)
        host = self._shards[shard]

        def reply(answer: Answer) -> None:
            self._network.send(host, self, answer, lambda came: self._answered(number, came))

        self._network.send(self, host, request, lambda came: host.request(came, reply))
        patience_ns = CALL_NS
        if isinstance(request, Acquire) or (isinstance(request, KeepAlive) and request.wait_ns):
            patience_ns += request.wait_ns
        elif isinstance(request, Hello | KeepAlive):
            patience_ns = CALL_NS // 2
        self.later(patience_ns, lambda: self._time_is_up(number))

    def _answered(self, number: int, answer: Answer) -> None:
        call = self._calls.get(number)
        if call is None:
            return
        if call.take is None:
            self._late(number, call, answer)
            return
        del self._calls[number]
        call.take(answer)
        self._check_beliefs(self)

    def _time_is_up(self, number: int) -> None:
        call = self._calls.get(number)
        if call is None or call.take is None:
            return
        self.world.tally["calls without an answer"] += 1
        take, call.take = call.take, None
        take(None)

    def notices_end_of(self, shard: str) -> None:
        """The link to a shard broke: waiting threads learn that no answer will come."""
        for number, call in list(self._calls.items()):
            if call.shard == shard:
                self._time_is_up(number)

    def _late(self, number: int, call: _Call, answer: Answer) -> None:
        """Deliver an answer that no thread waits for any more, if the faults demand it."""
        del self._calls[number]
        coming = (self._late_answers.next() & 0xFFFF) < self._faults.late_answers * 0x10000
        if coming and self.world.schedule.allows(self._late_answers.fault):
            self.world.tally["late answers"] += 1
            text = f"{type(answer).__name__} comes after its caller gave up"
            self.world.befell(self._late_answers.fault, text)
            self.learn(call.shard, answer)
            if call.lock is not None and call.lock.phase.busy:
                call.lock.answered(call.shard, call.request, answer, self.local_ns)
            else:
                self.client.answered(call.shard, call.request, answer, self.local_ns)
            self._check_beliefs(self)

    # ---------------------------------------------------------------- the session

    def open(self, aspects: tuple[AspectEntry, ...], then: Callable[[], None]) -> Thread:
        """Greet every shard and register the aspects, as often as it takes."""
        for shard in self._shards:
            registered = False
            while not registered:
                request: Request = self.client.hello(shard)
                if not self.client.needs_hello(shard):
                    request = Register(self.client.session, (), aspects)
                epoch = self.client.epoch(shard)
                (answer,) = yield ParallelCalls([(shard, request)])
                if answer is None:
                    yield Sleep(50 * MS)
                    continue
                self.learn(shard, answer, sent_in=epoch)
                registered = isinstance(answer, Registered)
                if isinstance(answer, Refused):
                    self.world.violation("nothing is refused", answer)
                else:
                    self.client.answered(shard, request, answer, self.local_ns)
        then()

    def keep_alive(self) -> None:
        """Renew the session at every shard, four times per TTL, until the process ends."""
        if self.world.now_ns >= self.starves_until_ns:
            self._renew()
        else:
            self.world.tally["keep-alives starved"] += 1
        self.later(self.client.ttl_ns // 4, self.keep_alive)

    def _renew(self) -> None:
        now_ns = self.local_ns
        for shard in self.client.shards_in_use():
            request = self.client.keep_alive(shard, now_ns)
            self.call(shard, request, partial(self._renewed, shard, request))

    def _renewed(self, shard: str, request: Request, answer: Answer | None) -> None:
        if answer is not None:
            self.learn(shard, answer)
            self.client.answered(shard, request, answer, self.local_ns)
        self.kept.give_back()

    def listen(self, shard: str) -> None:
        """Listen for recalls of a shard, unless this client does so already."""
        if shard not in self._listeners:
            self._listeners[shard] = RecallListener(self.client, shard)
            self._ask_for_recalls(shard)

    def _ask_for_recalls(self, shard: str) -> None:
        starves = self.world.now_ns < self.starves_until_ns
        if starves or self.client.needs_hello(shard):
            self.later(QUIET_NS, lambda: self._ask_for_recalls(shard))
            return
        listener = self._listeners.get(shard)
        if listener is not None:
            question = listener.ask(self.local_ns)
            self.call(shard, question, partial(self._hears, listener, question))

    def _hears(self, listener: RecallListener, question: Request, answer: Answer | None) -> None:
        """Take word of recalls, or none, as the thread of `link.client.kept` does."""
        shard = listener.shard
        if shard not in self._listeners:
            return  # its session has ended
        pauses_first = listener.hear(question, answer, self.local_ns)
        self.world.tally["words of a recall"] += listener.word
        self.kept.give_back()
        if listener.over:
            del self._listeners[shard]
        elif pauses_first:
            self.later(QUIET_NS, lambda: self._ask_for_recalls(shard))
        else:
            self._ask_for_recalls(shard)

    def learn(self, shard: str, answer: Answer, *, sent_in: int = 0) -> None:
        """Take the catalogue that an answer carries, as `link.client.session` does."""
        if isinstance(answer, Welcome):
            self.kept.learn(shard, answer.epoch)
            self.files.payloads.learn(answer)
        if isinstance(answer, CATALOGUES):
            self.catalogue.learn(shard, answer, sent_in=sent_in)
            self.client.knows_types(shard, self.catalogue.successions(shard))

    def drive(self, lock: MultiLock, gives_up: Callable[[], bool] | None = None) -> Thread:
        """Make the lock's calls until it rests, then send what it says on leaving."""
        while True:
            if gives_up is not None and gives_up():
                lock.release()
            calls, wait_until_ns = lock.next_calls(self.local_ns)
            self.client.assert_invariants()
            if not calls and not lock.phase.busy:
                break
            if not calls:
                yield Sleep(max(MS, wait_until_ns - self.local_ns))
                continue
            answers = yield ParallelCalls(calls, lock)
            for (shard, request), answer in zip(calls, answers, strict=True):
                if answer is not None:
                    self.learn(shard, answer)
                lock.answered(shard, request, answer, self.local_ns)
            self._check_beliefs(self)
        if lock.phase is not Phase.HELD:
            yield from self.kept.leave(lock)
        for shard, release in lock.take_releases():
            self.call(shard, release, lambda _answer: None)

    def dies(self) -> None:
        """End silently: nothing is sent any more."""
        self.end_life()
        self._calls.clear()
        self._stopped.clear()
        self._listeners.clear()
        self.kept.vanish()
        self.files.vanish()
        self.threads_left = 0
