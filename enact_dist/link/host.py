"""Runs one pure shard among threads: the only place that holds a `Shard` and may call it.

::

    transport ── submit(request, reply) ─┐
    who writes ──── persisted ───────────┤ mutex │── Shard.handle ── effects ──┐
    timer thread ── Tick ────────────────┘                                     │
              reply(answer)  ◄── Reply │ StoreThread ◄── Persist │ watchers ◄── Publish
                                       │ other shards ◄── Call, Compare

A transport needs `submit` and nothing else; the shard cannot tell the transports apart.
Rules that a change must keep:

- The thread that brings an event handles it under the mutex and performs its effects before it
  releases the mutex: no further thread delays the answer, and notices leave in order.
- A reply callback must not block and must not call back into the host.
- Before a `Tick` the inboxes are drained: a renewal that has arrived counts before the expiry.
- If the store or the core fails, the host answers nothing more: unacknowledged changes may be lost,
  acknowledged ones are on disk.
"""

from __future__ import annotations

import logging
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Final, cast

from enact_dist.core.protocol.messages import (
    OVERLOAD,
    Acquire,
    AwaitStamp,
    Commit,
    EpochChanged,
    Hello,
    ListSessions,
    Prepare,
    Refused,
    Stage,
    Staged,
)
from enact_dist.core.protocol.records import (
    Compare,
    Drain,
    LogEvent,
    MakeRoom,
    Persist,
    Persisted,
    Publish,
    Reply,
    Tick,
)
from enact_dist.core.shard import owners
from enact_dist.core.shard.inspection import with_data
from enact_dist.core.shard.shard import Shard
from enact_dist.core.state.clock import state_of
from enact_dist.errors import StoreError
from enact_dist.link.clock import Clock, SystemClock
from enact_dist.link.host_figures import Stalls, figures_of, latencies_of
from enact_dist.link.lease import AnswerGate
from enact_dist.link.memory.drafts import half_of, names_payloads
from enact_dist.link.memory.payload_handler import PayloadHandler
from enact_dist.link.memory.use_marks import mark_uses
from enact_dist.link.signals import Uninterrupted

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.messages import Answer, Notice, Request
    from enact_dist.core.protocol.records import Call, Event
    from enact_dist.core.rights.rules import Rights
    from enact_dist.core.state.clock import Latencies
    from enact_dist.link.memory.shared_folder import SharedFolder
    from enact_dist.link.store.store import Store
    from enact_dist.link.store.thread import StoreThread

TICK_S_MAX: Final = 0.1
"""Longest pause between two timer wake-ups: bounds how late an expiry may be."""
TICK_S_MIN: Final = 0.001
"""Shortest pause of the timer; deadlines of many locks then share one tick."""
_SOON_NS: Final = TICK_S_MAX * 1e9
_TOLD_LATER: Final = (Publish, LogEvent)  # a union would be rebuilt for each message
PARKED_MAX: Final = 100_000
"""Requests that may be parked at one time."""
JOIN_S: Final = 0.5
"""How long a closing host waits for its timer; a drain has to be over within 2 s."""

_log = logging.getLogger("enact.shard")


class ShardHost:
    """One shard with its mutex, store thread, timer and `payloads`.  Thread-safe.

    Args:
        shard: The shard; only the host calls it from now on.
        store: Where its records go; None: they last only as long as this process.
        clock: Read under the mutex, so the shard's time never goes back.
        on_failure: Called once, from any thread, when store or core failed; the host is dead then.
        shared: Folder of large data that clients of this host map; None: they stay in memory.
        payload_bytes_max: Byte limit of that folder; None: half of the file system, memory beyond.
    """

    def __init__(
        self,
        shard: Shard,
        *,
        store: Store | None = None,
        clock: Clock | None = None,
        on_failure: Callable[[Exception], None] | None = None,
        shared: SharedFolder | None = None,
        payload_bytes_max: int | None = None,
    ) -> None:
        self._shard = shard
        self.with_data = partial(with_data, shard.state.slots)  # of a notice, while it is published
        mark_uses(shard.state.tenures.kept, shared)
        self._clock: Clock = clock or SystemClock()
        self._on_failure = on_failure
        self.payloads = PayloadHandler(
            shared,
            half_of(shared) if shared is None or payload_bytes_max is None else payload_bytes_max,
            firm=payload_bytes_max is not None,
            make_room=lambda size: self.event(MakeRoom(size)),
            biggest=self._biggest,
            clock=self._clock,
        )
        self._mutex = threading.RLock()  # reentrant for `count` in reply callbacks, and in here
        self._uninterrupted = Uninterrupted()
        self._replies: dict[int, Callable[[Answer], None]] = {}
        self._handles = 0
        self._watchers: tuple[Callable[[Notice], None], ...] = ()
        self._call: Callable[[str, Request], None] | None = None
        self._compare: Callable[[Compare], None] = lambda _: None
        self._inboxes: dict[Callable[[], None], Callable[[], object]] = {}  # and what removes it
        self._each_tick: tuple[Callable[[], None], ...] = ()
        self._failure: Exception | None = None
        self._ended = self._draining = self._stops_now = self._lent = self._queued = False
        self._rests = threading.Event()
        self._wake = threading.Condition(threading.Lock())
        self._look_again = False
        self._store = store
        self._store_thread: StoreThread | None = None
        if store is None:
            shard.keep_nothing()
        self.silence = AnswerGate.of(store, self.count, self._fail)
        self._stalls = Stalls(self.name, self.count)
        if store is not None:
            from enact_dist.link.store.thread import StoreThread

            self._store_thread = StoreThread(store, self._persisted, self._fail)
        self._timer = threading.Thread(target=self._keep_time, name="enact-timer", daemon=True)
        self._timer.start()

    # ---------------------------------------------------------------- for transports

    @property
    def name(self) -> str:
        """The shard's name."""
        return self._shard.settings.name

    @property
    def epoch(self) -> int:
        """The shard's epoch, which changes with every start."""
        return self._shard.epoch

    @property
    def state(self) -> str:
        """Whether locks are granted, and the reason if not; read without the mutex."""
        state = self._shard.state
        return state_of(grants=state.grants, draining=state.draining)

    def figures(self) -> dict[str, float]:
        """Return counters and current values, by name; see `link.host_figures`."""
        parts = self._shard.state, self.payloads, self.silence
        now_ns = self._clock.monotonic_ns()
        return figures_of(*parts, parked=len(self._replies), now_ns=now_ns)

    def latencies(self) -> dict[str, Latencies]:
        """Return latencies, by name; see `link.host_figures`."""
        return latencies_of(self._shard.state, self._store_thread)

    @property
    def ended(self) -> bool:
        """Whether the host has ended and answers no request."""
        return self._ended

    @property
    def failure(self) -> Exception | None:
        """Why the host failed, or None while it lives."""
        return self._failure

    def submit(
        self,
        message: Request,
        reply: Callable[[Answer], None],
        identity: str = "",
        subject: str | None = None,
        lends: bool = False,
    ) -> bool:
        """Pass a request to the shard; `reply` is called once, now or later, from any thread.

        If the host ends first, `reply` is never called: no answer means *unknown*.  `identity` is
        the sender ("": this process), `subject` whose rights it uses (None: no name is proven).
        Who `lends` its thread and gets True calls `write_here` next, which the answer awaits.
        """
        kind = type(message)
        if kind is Commit or kind is Prepare:
            commit: Commit = message  # type: ignore[assignment]  # as just found
            if self.silence and (too_large := self.silence.too_large(commit, self._shard.state)):
                reply(too_large)
                return False
            if names_payloads(commit) and self._refusal(commit, identity) is None:
                message = self.payloads.with_bodies(commit)  # otherwise staged data stay
        elif kind is Stage:
            self._stage(cast("Stage", message), reply, identity, subject)
            return False
        elif kind is ListSessions:
            more = self.silence.rounded() if self.silence else {}
            self._shard.counters.update(self.payloads.figures() | more)
        with self._mutex:
            if self._ended:
                return False
            if len(self._replies) >= PARKED_MAX:
                self.count("overloads")
                reply(Refused(OVERLOAD, f"{PARKED_MAX} requests are parked at shard {self.name}"))
                return False
            self._handles += 1
            self._replies[self._handles] = reply
            self._lent, self._queued = lends, False
            self._handle(message, self._handles, identity, subject)
            self._lent = False
            if (parked := self._handles in self._replies) or kind is Hello:
                self._look_at_clock_for(message)
            return lends and parked and self._queued

    def write_here(self) -> None:
        """Write what the last `submit` has left to this thread; see `StoreThread`."""
        if self._store_thread is not None:
            self._store_thread.write_here()

    def _stage(
        self, message: Stage, reply: Callable[[Answer], None], identity: str, subject: str | None
    ) -> None:
        if self._ended:
            return
        file = message.file
        answer: Answer | None = self._refusal(message, identity)
        if answer is None and message.session not in self._shard.state.sessions.by_id:
            # Drafts end with their session; the name of an unknown one takes no place.
            answer = EpochChanged(self.epoch) if message.total else Staged(file, 0, shared=False)
        if answer is None and self.rights is not None:
            with self._mutex:
                answer = self._shard.denied(message, identity, subject)
        reply(answer or self.payloads.stage(message, identity))

    def _refusal(self, message: Request, identity: str) -> Refused | EpochChanged | None:
        """Return why the shard will refuse a message because of its sender, else None."""
        state = self._shard.state
        return owners.refusal(message, identity, state.sessions, self.epoch) if identity else None

    @property
    def rights(self) -> Rights | None:
        """The rights of the cell; None: every client may do everything."""
        guard = self._shard.state.guard
        return guard.rights if guard is not None else None

    def take_rights(self, rights: Rights) -> None:
        """Replace the rights from the next message on; see `Shard.take_rights`."""
        with self._mutex:
            self._shard.take_rights(rights)

    def owner_of(self, session: str) -> str:
        """Return the identity of a session; "" if unknown.  Takes no mutex."""
        return self._shard.state.sessions.owner(session) or ""

    def owners(self) -> dict[str, str]:
        """Return the identity of each session."""
        with self._mutex:
            return {one.session: one.identity for one in self._shard.state.sessions}

    def knows(self, identity: str) -> bool:
        """Whether an identity has a session here.  Takes no mutex."""
        return bool(self._shard.state.sessions.of(identity))

    def event(self, event: Event) -> None:
        """Pass an event to the shard (for example: a session's token appeared)."""
        with self._mutex:
            if not self._ended:
                self._handle(event, 0)

    def count(self, name: str, amount: int = 1) -> None:
        """Add to a counter of the shard; also allowed in reply callbacks."""
        with self._mutex:
            self._shard.state.count(name, amount)

    def _biggest(self) -> str:
        """Return the slots with the largest data, for people."""
        with self._mutex:
            names = ", ".join([f"{name} {size}" for name, size in self._shard.biggest(3)])
        return f"; the largest: {names}" if names else ""

    def call_with(
        self, call: Callable[[str, Request], None], compare: Callable[[Compare], None] | None = None
    ) -> None:
        """Set the functions that ask other shards; they must not block."""
        self._call, self._compare = call, compare or self._compare

    def watch(self, watcher: Callable[[Notice], None]) -> Callable[[], None]:
        """Call `watcher` with each notice, in order; return a function that ends this."""

        def unwatch() -> None:
            with self._mutex:
                self._watchers = tuple(other for other in self._watchers if other is not watcher)

        with self._mutex:
            self._watchers = (*self._watchers, watcher)
        return unwatch

    def add_inbox(self, drain: Callable[[], None]) -> Callable[[], object]:
        """Call `drain` before each tick to submit requests that are here; return what ends this."""
        return self._inboxes.setdefault(drain, lambda: self._inboxes.pop(drain, None))

    def each_tick(self, act: Callable[[], None]) -> None:
        """Call `act` after each tick, so at least every `TICK_S_MAX` while the shard works.

        The timer's thread calls it after the shard has returned, so a hung shard stops the calls.
        `act` must not block.
        """
        self._each_tick = (*self._each_tick, act)

    # ---------------------------------------------------------------- messages in, effects out

    def _handle(
        self, message: Request | Event, handle: int, identity: str = "", subject: str | None = None
    ) -> None:
        """Let the shard decide, and perform its effects.  The mutex is held."""
        if threading.get_ident() == self._uninterrupted.main:
            with self._uninterrupted:
                self._handle_now(message, handle, identity, subject)
        else:
            self._handle_now(message, handle, identity, subject)

    def _handle_now(
        self, message: Request | Event, handle: int, identity: str, subject: str | None
    ) -> None:
        later: list[Publish | LogEvent] = []
        try:
            effects = self._shard.handle(
                message,
                reply_to=handle,
                identity=identity,
                subject=subject,
                now_ns=self._clock.monotonic_ns(),
                wall_ns=self._clock.wall_ns(),
            )
            for effect in self.silence.passing(effects) if self.silence else effects:
                if isinstance(effect, Reply):  # answers first, since clients wait for them
                    reply = self._replies.pop(effect.reply_to, None)
                    if reply is not None:
                        reply(effect.answer)  # type: ignore[arg-type]  # of the core: an `Answer`
                elif isinstance(effect, _TOLD_LATER):
                    later.append(effect)
                else:
                    self._perform(effect)
            store = self._store_thread
            if store is not None and store.queue and not (self._lent and handle in self._replies):
                store.wake()
            for told in later:
                self._tell(told)
            if self._draining and self._shard.idle:
                self._rests.set()
        except BaseException as failure:
            # A half-made decision must not be used.
            _log.exception("the shard failed on %s", type(message).__name__)
            self._fail(failure)
            if not isinstance(failure, Exception):
                raise

    def _perform(self, effect: Persist | Compare | Call) -> None:
        """Perform an effect that concerns the store or another shard."""
        if isinstance(effect, Persist):
            if self._store_thread is not None:
                self._store_thread.submit(effect, wake=False)
                self._queued = True
        elif isinstance(effect, Compare):
            self._compare(effect)
        elif self._call is not None:
            self._call(effect.shard, cast("Request", effect.request))

    def _tell(self, effect: Publish | LogEvent) -> None:
        """Tell watchers of a commit, or the log of an event."""
        if isinstance(effect, Publish):
            for watcher in self._watchers:
                watcher(cast("Notice", effect.notice))
        else:
            level = logging.CRITICAL if effect.grave else logging.INFO
            _log.log(level, "%s: %s", effect.event, effect.text, extra={"event": effect.event})

    def _persisted(self, tickets: list[int]) -> None:
        """Report to the shard that these tickets are stored."""
        with self._mutex:
            for ticket in tickets:
                self.event(Persisted(ticket))

    def _fail(self, reason: BaseException) -> None:
        with self._mutex:
            if self._failure is not None:
                return
            failure = reason if isinstance(reason, Exception) else RuntimeError(repr(reason))
            self._failure, self._ended = failure, True
            self._replies.clear()
            self._rests.set()
            _log.critical("shard %s stops: %s", self.name, failure)
            if self._on_failure is not None:
                self._on_failure(failure)

    # ---------------------------------------------------------------- time

    def tick(self) -> int:
        """Submit arrived requests, then advance time; return when the next tick is due, in ns."""
        for drain in tuple(self._inboxes):
            drain()
        if drafts := self.payloads.drafts():
            with self._mutex:
                working = set(filter(self._shard.state.tenures.works, drafts.values()))
            sessions = self._shard.state.sessions.by_id
            self.payloads.sweep(sessions.__contains__, working.__contains__)
        writing = self._store_thread.writing_since_s if self._store_thread is not None else None
        self._stalls.look(writing, time.monotonic())
        with self._mutex:
            if not self._ended:
                self._handle(Tick(), 0)
            return self._shard.next_deadline_ns()

    def _keep_time(self) -> None:
        try:
            self._tick_on()
        except Exception as failure:  # noqa: BLE001 - without it no lease ends
            _log.exception("the timer of shard %s failed", self.name)
            self._fail(failure)

    def _tick_on(self) -> None:
        while not self._ended:
            wait_s = (self.tick() - self._clock.monotonic_ns()) / 1e9
            for act in self._each_tick:
                act()
            with self._wake:
                if not self._look_again:
                    self._wake.wait(min(max(wait_s, TICK_S_MIN), TICK_S_MAX))
                self._look_again = False

    def _look_at_clock_for(self, message: Request) -> None:
        """Wake the timer if this parked request, or this hello, asks for an earlier tick."""
        parked = isinstance(message, Acquire | AwaitStamp) and message.wait_ns < _SOON_NS
        if parked or (isinstance(message, Hello) and message.ttl_ns // 8 < _SOON_NS):
            self._wake_timer()

    def _wake_timer(self) -> None:
        with self._wake:
            self._look_again = True
            self._wake.notify()

    # ---------------------------------------------------------------- end

    def drain(self) -> None:
        """Grant nothing new and answer all parked requests; may be called repeatedly."""
        self._draining = True
        self.event(Drain())

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until a drained shard may stop without costing a client its lock or commit.

        Returns:
            True once it may stop or has failed; False after `timeout_s` and after `stop_now`.
        """
        return self._rests.wait(timeout_s) and not self._stops_now

    def stop_now(self) -> None:
        """End `wait_idle`."""
        self._stops_now = True
        self._rests.set()

    def close(self) -> None:
        """Store all pending records, then end; idempotent."""
        if self.silence is not None:
            self.silence.end_soon()
        if self._store_thread is not None:
            self._store_thread.close()
        with self._mutex:
            self._ended = True
            self._replies.clear()
            self._rests.set()
        self._wake_timer()
        if threading.current_thread() is not self._timer:
            self._timer.join(JOIN_S)
        if self._store is not None:
            try:
                self._store.close()
            except StoreError as failure:
                self._fail(failure)
