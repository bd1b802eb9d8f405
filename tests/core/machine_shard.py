"""The shard beside its reference: every message to a lock in every state, timers, crashes.

A step chooses a state that some lock is in, then a lock, then an event, each evenly: so rare states
meet rare events as often as common ones.  Messages are also sent again, any number of steps later,
and held back to be delivered late.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from machine_cells import (
    ABOUT_NO_LOCK,
    BY_GRANT,
    BY_HOST,
    BY_LOCK,
    BY_SESSION,
    BY_TIME,
    EVENTS,
    LIVE,
    OVER,
    PAST,
    STATES,
    UNREACHABLE,
)
from machine_coverage import Coverage
from machine_messages import HOLDS, MS, TTLS, Pick, Plans
from machine_pair import Pair
from machine_staging import Staging

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import AwaitStamp, Finish, ListLocks, Survey
from enact_dist.core.protocol.records import Called, Drain, SessionSeen, Tick
from enact_dist.core.state.clock import wrong_decision

PICK = st.integers(0, (1 << 62) - 1)
PICKS = st.lists(PICK, min_size=2, max_size=5)


def some_of(events):
    """Return a strategy for some events, each with a number for what is open in it."""
    return st.lists(st.tuples(st.sampled_from(events), PICK), min_size=5, max_size=12)


LANES = 2
REMEMBERED = 2
"""So many of a lane's newest locks are counted and spoken to."""


def _owed(pick: int) -> tuple[str, str]:
    return Pick(pick).one(ShardMachine.owed)


class ShardMachine(Staging, RuleBasedStateMachine):
    """One shard under everything that its clients, its host and other shards can do to it."""

    coverage: ClassVar[Coverage]
    owed: ClassVar[list[tuple[str, str]]] = []
    """The cells that the rounds before have met too seldom."""

    def __init__(self) -> None:
        super().__init__()
        self.pair = Pair()
        self.plans = Plans(self.pair)
        self.tops = {(session, lane): 0 for session in TTLS for lane in range(LANES)}
        self.sent: list[tuple[str, LockId, object]] = []
        self.late: list[tuple[str, LockId, object]] = []
        self.lapsed: set[str] = set()
        self.steps = -1

    @property
    def reference(self):
        """The reference shard of this epoch."""
        return self.pair.reference

    # ---------------------------------------------------------------- rules

    @initialize(pick=PICK)
    def begin(self, pick):
        """All sessions say hello, and some locks are asked for."""
        self._hello_all()
        choice = Pick(pick)
        for lane in self.tops:
            if choice.below(2):
                self._event("acquire", self._next(lane), choice)

    @rule(state=st.sampled_from(STATES), events=some_of(EVENTS))
    def meet(self, state, events):
        """Anything happens to a lock in any state."""
        self._meet(state, events)

    @rule(state=st.sampled_from(LIVE), events=some_of(BY_LOCK[:9]))
    def ask(self, state, events):
        """Its client speaks about a lock that is alive."""
        self._meet(state, events)

    @rule(state=st.sampled_from(LIVE), events=some_of(BY_LOCK[9:]))
    def tell(self, state, events):
        """Others speak about a lock that is alive."""
        self._meet(state, events)

    @rule(state=st.sampled_from(PAST), events=some_of(BY_LOCK[:9]))
    def ask_of_the_past(self, state, events):
        """Its client speaks about a lock that ended, or was not asked for yet."""
        self._meet(state, events)

    @rule(state=st.sampled_from(PAST), events=some_of(BY_LOCK[9:]))
    def tell_of_the_past(self, state, events):
        """Others speak about a lock that ended, or was not asked for yet."""
        self._meet(state, events)

    @rule(state=st.sampled_from((*LIVE, *PAST, "kept", "recalled")), events=some_of(BY_GRANT))
    def go_on(self, state, events):
        """Blocks begin and end under grants that stay, or do not."""
        self._meet(state, events)

    @rule(state=st.sampled_from(LIVE + OVER), events=some_of(BY_SESSION))
    def come_and_go(self, state, events):
        """Sessions come, go and are heard of or not, with a lock in some state."""
        self._meet(state, events)

    @rule(state=st.sampled_from(LIVE + OVER), events=some_of((*BY_TIME, *BY_HOST)))
    def disturb(self, state, events):
        """Time and the host do something to a lock in some state."""
        self._meet(state, events)

    @precondition(lambda self: self.owed)
    @rule(cells=st.lists(PICK.map(lambda pick: (_owed(pick), pick)), min_size=3, max_size=6))
    def make_up(self, cells):
        """What was met too seldom so far is met."""
        for (state, event), pick in cells:
            self._meet(state, [(event, pick)])

    @rule(picks=PICKS)
    def work(self, picks):
        """Clients go on as honest ones do."""
        for pick in picks:
            self._work(Pick(pick))

    @rule(pick=PICK)
    def disk(self, pick):
        """The disk finishes some of its writes."""
        waiting = len(self.pair.kept) - self.pair.reported
        self._report(1 + Pick(pick).below(waiting or 1))

    @rule(pick=PICK)
    def time(self, pick):
        """Some time passes; the wall clock may be set."""
        choice = Pick(pick)
        if choice.below(6) == 0:
            self.pair.wall_ns += choice.one((1, -1)) * 3600 * 1000 * MS
        self._tick(choice.one((0, 1, 10 * MS, 40 * MS)))

    @rule(pick=PICK)
    def keep_up(self, pick):
        """Every session says hello or keeps itself alive."""
        self._hello_all()
        for session in TTLS:
            lock = LockId(session, 0, 0)
            self._event("keep alive", lock, Pick(pick))

    @precondition(lambda self: self.sent)
    @rule(picks=st.lists(PICK, min_size=1, max_size=3))
    def again(self, picks):
        """Some earlier message arrives once more."""
        for pick in picks:
            choice = Pick(pick)
            recent = self.sent[-30:] if choice.below(2) else self.sent
            self._deliver(*choice.one(recent), "again")

    @precondition(lambda self: len(self.late) < 8)
    @rule(picks=st.lists(PICK, min_size=1, max_size=2))
    def hold_back(self, picks):
        """A message is made now and comes later."""
        for pick in picks:
            choice = Pick(pick)
            live = list(self.reference.lives)
            event = choice.one((*BY_LOCK[:9], *BY_GRANT[:3]))
            if live:
                lock = choice.one(live)
                self.late.append((event, lock, self._compose(event, lock, choice)))

    @precondition(lambda self: self.late)
    @rule(pick=PICK)
    def deliver_late(self, pick):
        """A message that was held back arrives."""
        self._deliver(*self.late.pop(Pick(pick).below(len(self.late))), "late")

    @rule(pick=PICK)
    def look(self, pick):
        """Somebody lists the locks and what is retained, and somebody waits for a stamp."""
        self.pair.give(ListLocks())
        self.pair.give(Survey((), (), (), retained=True))
        pick = Pick(pick)
        session, epoch = pick.one(("", *TTLS)), self.pair.shard.epoch
        stamp_ns = self.pair.floor_ns + pick.below(3) - 1
        self.pair.give(AwaitStamp(stamp_ns, 90 * MS, session, epoch))

    @precondition(lambda self: self.reference.draining)
    @rule(pick=PICK)
    def start_again(self, pick):
        """A shard that drains stops, with everything on disk, and starts again."""
        self._report(len(self.pair.kept))
        self._crash(Pick(pick), "kill")

    @invariant()
    def count_the_step(self):
        """Called after each step, and once before the first."""
        self.steps += 1

    def teardown(self):
        """The example is over."""
        self.coverage.count_run(self.steps)
        self.coverage.tally.update(self.pair.tally)

    # ---------------------------------------------------------------- choosing

    def _next(self, lane) -> LockId:
        """Return the lock that a lane would ask for next."""
        return LockId(*lane, self.tops[lane] + 1)

    def _locks(self) -> dict[LockId, str]:
        """Return the locks of interest with their states."""
        locks = dict.fromkeys(self.reference.lives)
        for lane, top in self.tops.items():
            for seq in range(max(1, top - REMEMBERED + 1), top + 2):
                locks[LockId(*lane, seq)] = None
        return {lock: self.reference.state_of(lock) for lock in locks}

    def _meet(self, state: str, events) -> None:
        """Bring a lock into a state and let events happen to it, again after each way out of it."""
        lock = None
        for event, pick in events:
            choice = Pick(pick)
            if (state, event) in UNREACHABLE:
                continue
            if lock is None or self.reference.state_of(lock) != state:
                lock = self.bring(state, choice)
            if lock is not None:
                self._event(event, lock, choice)

    def _work(self, choice: Pick) -> None:
        """Do what an honest client would do next in one lane."""
        lane = choice.one(list(self.tops))
        lock = LockId(*lane, self.tops[lane])
        state = self.reference.state_of(lock) if lock.seq else "unseen"
        if lane[0] not in self.reference.people:
            self._event("hello", lock, choice)
        if state not in LIVE:
            self._event("acquire", self._next(lane), choice)
        elif state in ("waiting", "parked", "untold"):
            self._event("acquire", lock, choice)
        elif state == "granted":
            alone = self.plans.alone.get(lock)
            ways = (
                ("keep", "keep", "commit", "expect")
                if alone
                else ("prepare", "prepare", "decide", "validate")
            )
            self._event(choice.one(ways), lock, choice)
        elif state in ("kept", "recalled"):
            self._event(choice.one(("use", "use", "look", "used", "unused")), lock, choice)
        elif state == "prepared" and choice.below(2):
            self._event(choice.one(("finish", "told aborted", "force abort")), lock, choice)

    # ---------------------------------------------------------------- events

    def _event(self, event: str, lock: LockId, choice: Pick) -> None:
        """Let one event happen to a lock, as far as it can happen."""
        if event in BY_TIME:
            self._pass_time(event, lock, choice)
        elif event in ("kill", "power cut"):
            self._crash(choice, event)
        elif event == "persisted":
            self._report_of(lock)
        elif event == "drain":
            self._hit_all("drain")
            self.pair.give(Drain())
        elif event in ("token seen", "token gone"):
            self._hit_all(event, session=lock.session)
            self.pair.give(SessionSeen(lock.session, event == "token seen"))
        elif event in ("used", "unused"):
            self.coverage.hit(self.reference.state_of(lock), event)
            self.pair.mark(lock, on=event == "used")
        elif event == "newer":
            self._event("acquire", self._next(lock[:2]), choice)
        elif self._possible(event, lock):
            self._say(event, lock, self._compose(event, lock, choice))

    def _say(self, event: str, lock: LockId, message: object) -> None:
        """Deliver a message for the first time, and remember it."""
        self.sent.append((event, lock, message))
        self._deliver(event, lock, message, "first")

    def _possible(self, event: str, lock: LockId) -> bool:
        """Whether the far primary, which decides once, can say this."""
        state = self.reference.state_of(lock)
        if event in ("finish", "told committed"):
            return lock not in self.plans.far or self.plans.far[lock] is not None
        if event == "told aborted":
            return self.plans.far.get(lock) is None and (state, event) not in UNREACHABLE
        return True

    def _compose(self, event: str, lock: LockId, choice: Pick) -> object:
        if event in ("use", "look"):
            lane = (lock.session, choice.below(LANES))
            return getattr(self.plans, event)(lock, self._next(lane), choice)
        return getattr(self.plans, event.replace(" ", "_"))(lock, choice)

    def _deliver(self, event: str, lock: LockId, message: object, how: str) -> None:
        state = self.reference.state_of(lock)
        if not self._consistent(event, lock, message):
            return
        self.coverage.tally[f"messages {how}"] += 1
        if event in ("hello", "goodbye"):
            self._hit_all(event, session=lock.session)
        elif event in ("keep alive", "unwanted"):
            self._hit_view(message)
        else:
            self.coverage.hit(state, event)
            if event == "acquire" and lock.seq > self.tops[lock[:2]]:
                self._hit_all("newer", lane=lock[:2])
                self.tops[lock[:2]] = lock.seq
            elif event in ("use", "look"):
                later = message.lock
                self.tops[later[:2]] = max(self.tops[later[:2]], later.seq)
        self.pair.give(message)

    def _consistent(self, event: str, lock: LockId, message: object) -> bool:
        """Whether a repeated word of the far primary is still its word, by a clock that agrees."""
        if event == "finish":
            assert isinstance(message, Finish)
            return self._agrees(message) and self.plans.far.get(lock) == message.position
        if isinstance(message, Called) and event.startswith("told"):
            state, kind = self.reference.state_of(lock), message.answer.kind
            if kind == "committed":
                told = self.plans.far.get(lock) == message.answer.position
                return told and self._agrees(message.answer)
            if kind == "aborted":
                return self.plans.far.get(lock) is None and (state, event) not in UNREACHABLE
        return True

    def _agrees(self, told) -> bool:
        """Whether the shard can take this stamp: a clock set back before a restart forbids it.

        `test_far_stamps.py` shows what the shard answers where it cannot.
        """
        pair, lock = self.pair, LockId("", 0, 0)
        stamps = pair.shard.state.stamps
        refused = wrong_decision(lock, told.position, stamps, wall_ns=pair.wall_ns)
        self.coverage.tally["stamps from far ahead"] += refused is not None
        return refused is None

    def _hit_view(self, message) -> None:
        lowest = {view.lane: view.seq for view in message.view}
        for lock, state in self._locks().items():
            if lock.session == message.session:
                wanted = lock.seq >= lowest.get(lock.lane, 0)
                self.coverage.hit(state, "keep alive" if wanted else "unwanted")

    def _hit_all(self, event: str, *, session: str | None = None, lane=None) -> None:
        for lock, state in self._locks().items():
            if session in (None, lock.session) and lane in (None, lock[:2]):
                self.coverage.hit(state, event)

    # ---------------------------------------------------------------- time and disk

    def _tick(self, ns: int) -> None:
        """Let less time pass than a stall, and look at the clock."""
        pair, before_ns = self.pair, self.pair.now_ns
        pair.now_ns += ns
        pair.wall_ns += ns
        now_ns = pair.now_ns
        over = {
            name
            for name, person in self.reference.people.items()
            if person.lease_end_ns(now_ns) <= now_ns
        }
        for lock, state in self._locks().items():
            self.coverage.hit(state, "tick")
            life = self.reference.lives.get(lock)
            if lock.session in over - self.lapsed:
                self.coverage.hit(state, "lease end")
            if life is not None and life.held and before_ns < life.hold_end_ns <= now_ns:
                self.coverage.hit(state, "hold end")
            if state == "parked" and before_ns < life.slice_end_ns <= now_ns:
                self.coverage.hit(state, "slice end")
        self.lapsed = over
        pair.give(Tick())

    def _pass_time(self, event: str, lock: LockId, choice: Pick) -> None:
        if event == "tick":
            self._tick(choice.one((0, 1, 10 * MS, 40 * MS)))
            return
        if event == "stall":
            self._hit_all("stall")
            self.pair.now_ns += choice.one((101 * MS, 500 * MS, 5000 * MS))
            self.pair.give(Tick())
            return
        life = self.reference.lives.get(lock)
        person = self.reference.people.get(lock.session)
        if event == "lease end" and person is not None:
            if life is not None and life.parked is not None:
                # Parked for as long as may be, so that its slice does not end first.
                message = replace(self.plans.acquire(lock, choice), wait_ns=1000 * MS)
                self._say("acquire", lock, message)
                if not person.token:
                    self._until(person.lease_end_ns(self.pair.now_ns), choice, None)
                return
            if person.token:
                self._event("token gone", lock, choice)
            idle = 5 * person.ttl_ns if choice.below(8) == 0 else 0
            self._until(person.lease_end_ns(self.pair.now_ns) + idle, choice, None)
        elif event == "hold end" and life is not None and life.hold_ns < HOLDS[-1]:
            self._until(life.hold_end_ns, choice, lock.session)
        elif event == "slice end" and life is not None and life.parked is not None:
            self._until(life.slice_end_ns, choice, lock.session)

    def _until(self, end_ns: int, choice: Pick, alive: str | None) -> None:
        """Go to the last nanosecond before a deadline, then to it."""
        step_ns = self.reference.shortest_ttl_ns // 4
        while self.pair.now_ns < end_ns - 1:
            self._tick(min(step_ns, end_ns - 1 - self.pair.now_ns))
            if alive is not None:
                self._event("keep alive", LockId(alive, 0, 0), Pick(1))
        self._tick(max(0, end_ns - self.pair.now_ns))

    def _report(self, number: int) -> None:
        """Let the disk finish so many writes, one after the other."""
        for _ in range(number):
            works = self.reference.works
            index = self.pair.reported
            if index >= len(self.pair.kept):
                return
            if self.pair.kept[index].ticket and works[0][0] not in ABOUT_NO_LOCK:
                what, about = works[0][:2]
                state = "alarm" if what == "alarm" else about.state
                self.coverage.hit(state, "persisted")
            self.pair.report()

    def _report_of(self, lock: LockId) -> None:
        def about(what) -> tuple:
            return what, getattr(what, "lock", None), getattr(what, "user", None)

        while any(lock in about(work[1]) for work in self.reference.works):
            self._report(1)

    def _crash(self, choice: Pick, event: str) -> None:
        """Die with any prefix of what was not reported, or not synced, and start again."""
        self._hit_all(event)
        first = self.pair.synced if event == "power cut" else self.pair.reported
        keep = first + choice.below(len(self.pair.kept) - first + 1)
        self.coverage.tally["writes lost"] += len(self.pair.kept) - keep
        self.pair.crash(keep, down_ns=choice.one((1, 50 * MS, 3000 * MS)))
        self.lapsed.clear()
        if choice.below(2):
            self._hello_all()

    def _hello_all(self) -> None:
        """Every session comes (back) and its record becomes durable."""
        for session in TTLS:
            person = self.reference.people.get(session)
            if person is None or not person.present or not person.acknowledged:
                self._greet(session)
        self._report(len(self.pair.kept))
