"""One shard from its definition: sessions, grace, leases, queue and time; commits in a subclass.

Written from the protocol, not from the code: dictionaries and scans, nothing kept twice, nothing
clever.  What only the shard can choose (numbers of tokens, stamps) is taken over from it and
judged by the machine.  `handle` returns what the step must bring.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from reference_kept import LOOK_AGAIN_NS, ReferenceKeeping
from reference_parts import RETENTION, Decision, Expected, Lane, Life, Person, captured_of
from reference_table import ReferenceTable

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.records import Persisted
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId

EACH = (Access.READ_EACH, Access.WRITE_EACH, Access.VIEW_EACH)
GRACE_PER_CENT = 102
IDLE_TTLS = 4
MS = 1_000_000
TELLS = ("commit", "prepare", "finish", "abort")
"""What is persisted with a word about history that has gone."""


class ReferenceSessions(ReferenceKeeping):
    """Who is alive, what waits, what is held; no data yet.

    Args:
        epoch: The epoch that begins.
        now_ns: This host's monotonic clock.
        before: The life before, or None; of it only `disk[:keep]` and names for the table remain.
        keep: How many writes of the life before have survived.
    """

    def __init__(self, epoch: int, now_ns: int, before: ReferenceSessions | None, keep: int):
        self.epoch, self.now_ns = epoch, now_ns
        self.people: dict[str, Person] = {}
        self.lanes: dict[str, dict[int, Lane]] = {}
        self.lives: dict[LockId, Life] = {}
        self.table = ReferenceTable()
        self.slots: dict[Slot, tuple[int, str | None]] = {}
        self.replaced: dict[Slot, list[tuple[int, str | None]]] = {}
        self.forgotten: set[tuple[Slot, int]] = set()
        self.decisions: dict[LockId, Decision] = {}
        self.forced: dict[LockId, int] = {}
        self.tokens_elsewhere: set[str] = set()
        self.by_hand: dict[str, object] = {}
        self.number = 0
        self.rows, self.used = {}, set()
        self.listening, self.untold = {}, set()
        self.draining = False
        self.disk: list[tuple] = before.disk[:keep] if before else []
        self.ended: dict[LockId, str] = dict(before.ended) if before else {}
        self.ttls = before.ttls if before else {}
        self.prepared_as: dict[LockId, Life] = before.prepared_as if before else {}
        self.works: list[tuple] = []
        self.recording: dict[str, object] = {}
        self.out = Expected()
        for life in before.lives.values() if before else ():
            self.ended[life.lock] = "lost"
        for facts in self.disk:
            for fact in facts:
                self.recall(fact)
        ttls = [person.ttl_ns for person in self.people.values()]
        self.grace_end_ns = now_ns + max(ttls, default=0) * GRACE_PER_CENT // 100
        self.restored()

    def recall(self, fact: tuple) -> None:
        """Take up what one record says."""
        kind, name = fact[:2]
        if kind == "session":
            self.people[name] = Person(self.ttls[name], self.now_ns, False, durable=True)
        elif kind == "session over":
            self.people.pop(name, None)

    @property
    def shortest_ttl_ns(self) -> int:
        """Of the people that there are."""
        return min((person.ttl_ns for person in self.people.values()), default=60_000 * MS)

    def restored(self) -> None:
        """All records are read."""

    # ---------------------------------------------------------------- one step

    def handle(self, message: object, handle: int, now_ns: int) -> Expected:
        """Take one message and say what must come of it."""
        gap_ns = now_ns - self.now_ns
        if gap_ns > self.shortest_ttl_ns // 4:
            self.stalled(gap_ns)
        self.now_ns = now_ns
        self.out = Expected()
        getattr(self, f"on_{type(message).__name__.lower()}")(message, handle)
        self.answer_views()
        self.tell_untold()
        self.grant()
        return self.out

    def answer_views(self) -> None:
        """Answer the views that wait for nothing any more."""

    def stalled(self, gap_ns: int) -> None:
        """The shard stood still: every deadline waits as long."""
        self.grace_end_ns += gap_ns
        for person in self.people.values():
            person.renewed_ns += gap_ns
            if person.seen_ns is not None:
                person.seen_ns += gap_ns
        for life in self.lives.values():
            life.hold_end_ns += gap_ns

    @property
    def in_grace(self) -> bool:
        """Whether somebody may still believe in an older grant."""
        return self.now_ns < self.grace_end_ns

    def answer(self, handle: int, *what: object) -> None:
        """Answer a request, once."""
        assert handle not in self.out.answers
        self.out.answers[handle] = what

    def persist(self, durability: str, facts: tuple, work: tuple | None = None) -> None:
        """Ask the disk to keep facts; `work` is what is to be done then."""
        if work is not None and work[0] in TELLS:
            facts += self.forgotten_facts()
        self.disk.append(facts)
        self.out.persists.append((durability, work is not None, facts))
        if work is not None:
            self.works.append(work)

    def forgotten_facts(self) -> tuple:
        """Return what the disk need not keep any more, once."""
        facts = (("forgotten", tuple(sorted(self.forgotten))),) if self.forgotten else ()
        self.forgotten.clear()
        return facts

    def on_persisted(self, _: Persisted, __: int) -> None:
        """The oldest write that was to be reported is kept."""
        act, *arguments = self.works.pop(0)
        getattr(self, f"kept_{act}")(*arguments)

    def known(self, session: str, epoch: int | None = None) -> Person | None:
        """Return who said hello in this epoch, where the client means this epoch."""
        person = self.people.get(session)
        here = person is not None and person.present
        return person if here and epoch in (None, self.epoch) else None

    def lane_of(self, lock: LockId) -> Lane | None:
        """Return what a thread did, if it did anything."""
        return self.lanes.get(lock.session, {}).get(lock.lane)

    # ---------------------------------------------------------------- sessions

    def on_hello(self, m, handle):
        person = self.people.get(m.session)
        if person is None:
            person = Person(m.ttl_ns, self.now_ns, acknowledged=True)
            self.people[m.session] = person
            self.ttls[m.session] = m.ttl_ns
            if m.session in self.tokens_elsewhere:
                self.tokens_elsewhere.remove(m.session)
                person.token, person.seen_ns = True, self.now_ns
        person.renewed_ns = max(person.renewed_ns, self.now_ns)
        person.acknowledged |= m.known_epoch == self.epoch
        self.end_grace_early()
        welcome = (handle, "welcome", self.epoch, not self.in_grace)
        if not person.durable and m.session not in self.recording:
            self.recording[m.session] = person
            work = ("welcome", m.session, person, [welcome])
            self.persist("durable", (("session", m.session),), work)
            return
        person.present |= person.durable
        self.answer_in_turn(welcome)

    def answer_in_turn(self, answer: tuple) -> None:
        """Answer after what was to be told when the disk has it."""
        waiting = [work for work in self.works if work[0] in ("welcome", "told")]
        if waiting:
            waiting[-1][-1].append(answer)
        else:
            self.answer(*answer)

    def kept_told(self, answers):
        """What people did is on the disk."""
        for answer in answers:
            self.answer(*answer)

    def kept_welcome(self, session, person, answers):
        """The record of a session is durable."""
        if self.recording.get(session) is person:
            del self.recording[session]
            person.durable = person.present = True
        for answer in answers:
            self.answer(*answer)

    def end_grace_early(self) -> None:
        """Nobody can believe in an older grant once all have said so."""
        if self.in_grace and all(p.acknowledged for p in self.people.values() if p.durable):
            self.grace_end_ns = self.now_ns

    def on_keepalive(self, m, handle):
        person = self.known(m.session, m.epoch)
        if person is None:
            self.answer(handle, "epoch", self.epoch)
            return
        self.renew(person, m.count)
        lowest = {view.lane: view.seq for view in m.view}
        for life in self.of(m.session):
            if life.lock.seq < lowest.get(life.lock.lane, 0) and not (life.bound or life.kept):
                self.end(life, "given back")
        if m.wait_ns:
            self.listen(m, handle)
        else:
            self.answer(handle, *self.alive_of(m.session))

    def renew(self, person: Person, count: int) -> None:
        """Whatever is counted renews."""
        person.renewed_ns = max(person.renewed_ns, self.now_ns)
        person.count = max(person.count, count)

    def on_goodbye(self, m, handle):
        self.leave(m.session)
        self.answer(handle, "released")

    def leave(self, session: str) -> None:
        """A session ends: what is not bound is free, its outcomes stay known."""
        if session not in self.people:
            return
        for life in self.of(session):
            if not life.bound:
                self.end(life, "taken")
        self.session_over(session)
        person = self.people.pop(session)
        self.answer_listener(session)
        if person.token:
            self.tokens_elsewhere.add(session)
        self.end_grace_early()
        if person.durable or self.recording.pop(session, None):
            self.persist("os", (("session over", session),))

    def on_sessionseen(self, m, _):
        person = self.people.get(m.session)
        if person is None:
            self.tokens_elsewhere.discard(m.session)
            if m.present:
                self.tokens_elsewhere.add(m.session)
        else:
            if m.present or person.token:
                person.seen_ns = self.now_ns
            person.token = m.present
        if not m.present:
            for life in self.of(m.session):
                if not life.held:
                    self.drop(life)

    # ---------------------------------------------------------------- locks

    def of(self, session: str) -> list[Life]:
        """Return the locks of a session."""
        return [life for life in self.lives.values() if life.lock.session == session]

    def on_acquire(self, m, handle):
        person = self.known(m.lock.session, m.epoch)
        if person is None:
            self.answer(handle, "epoch", self.epoch)
            return
        self.renew(person, m.count)
        life = self.lives.get(m.lock)
        if life is None:
            lanes = self.lanes.setdefault(m.lock.session, {})
            lane = lanes.setdefault(m.lock.lane, Lane())
            if m.lock.seq <= lane.top:
                self.answer(handle, "stale", m.lock)
                return
            for older in self.of(m.lock.session):
                if older.lock.lane == m.lock.lane and not (older.bound or older.kept):
                    self.end(older, "taken")
            lane.top = m.lock.seq
            self.number += 1
            life = self.lives[m.lock] = Life.of(m, self.number)
            self.ended.pop(m.lock, None)
            self.table.enqueue(m.lock, life.lines)
            self.grant()
            if not life.held:
                for holder in self.table.in_the_way(m.lock)[0]:
                    self.take_back(self.lives[holder])
                self.grant()
        if life.held:
            self.answer(handle, *self.granted(life))
            return
        self.unpark(life)
        if m.wait_ns:
            life.parked, life.slice_end_ns = handle, self.now_ns + m.wait_ns
        else:
            self.answer(handle, *self.waiting(life))

    def granted(self, life: Life) -> tuple:
        """Return what a grant shows: every slot named, and what there is of a pattern."""
        life.told = True
        left_ns = max(0, life.hold_end_ns - self.now_ns)
        count = self.people[life.lock.session].count
        return "granted", life.lock, frozenset(self.shown(life.items)), count, left_ns

    def shown(self, items) -> set[tuple]:
        """Return slot, version and text of what items show."""
        found = set()
        for item in items:
            if item.access not in EACH:
                slot = Slot(item.context, item.entity, item.aspect)
                newest = self.slots.get(slot, (0, None))
                found.add((slot, *self.by_stamp(slot, newest, item.captured_ns)))
                continue
            for slot, (version, text) in self.slots.items():
                same = (slot.context, slot.aspect) == (item.context, item.aspect)
                if same and text is not None and pattern_matches(item.entity, slot.entity):
                    found.add((slot, version, text))
        return found

    def by_stamp(self, slot, newest, captured_ns) -> tuple[int, str | None]:
        """Return the newest version up to `newest` of a capture stamp, if there is one still."""
        if not captured_ns:
            return newest
        kept = self.replaced.get(slot, [])[::-1] if RETENTION[slot.aspect] > 1 else []
        for version, text in (newest, *kept[: RETENTION[slot.aspect] - 1]):
            if version <= newest[0] and captured_of(text) == captured_ns:
                return version, text
        return newest if newest[1] is None else (0, None)

    def on_survey(self, m, handle):
        found = set()
        for slot, newest in self.slots.items():
            kept = RETENTION[slot.aspect] - 1
            versions = [*self.replaced.get(slot, [])[-kept:], newest] if kept else [newest]
            told = tuple((version, captured_of(text)) for version, text in versions if version)
            if told:
                found.add((slot, told))
        self.answer(handle, "surveyed", frozenset(found))

    def waiting(self, life: Life) -> tuple:
        """Return the answer to whom waits: place and who is in the way."""
        holders, earlier = self.table.in_the_way(life.lock)
        return "waiting", life.lock, len(earlier) + 1, frozenset(holders + earlier)

    def unpark(self, life: Life) -> None:
        """Answer whoever waits for this lock's grant: not yet."""
        if life.parked is not None:
            self.answer(life.parked, *self.waiting(life))
            life.parked = None

    def grant(self) -> None:
        """Outside the grace and before the end, grant whatever may be granted."""
        if self.in_grace or self.draining:
            return
        for lock in self.table.grant():
            life = self.lives[lock]
            life.phase, life.hold_end_ns = "granted", self.now_ns + life.hold_ns
            self.out.grants.append(lock)
            if life.parked is not None:
                handle, life.parked = life.parked, None
                self.answer(handle, *self.granted(life))

    def end(self, life: Life, how: str) -> None:
        """A lock ends; who waits for it goes on at the end of the step."""
        if not life.held:
            self.unpark(life)
        self.table.remove(life.lock)
        del self.lives[life.lock]
        self.ended[life.lock] = how
        if life.far and how == "taken":
            self.untold.add(life.lock.session)

    def drop(self, life: Life) -> None:
        """A waiter loses its place and may ask again."""
        self.end(life, "dropped")
        lane = self.lane_of(life.lock)
        if life.lock.session in self.people and lane and lane.top == life.lock.seq:
            lane.top -= 1

    def on_release(self, m, handle):
        life = self.lives.get(m.lock)
        if life is not None and not life.bound:
            self.end(life, "given back")
        elif life is not None and life.phase in ("prepared", "finishing", "aborting"):
            life.ask_ns = min(life.ask_ns, self.now_ns + 50 * MS)
        elif life is None and any(other.kept for other in self.of(m.lock.session)):
            lane = self.lane_for(m.lock)  # a view may be the first of its lane
            if lane.top < m.lock.seq:
                lane.top = m.lock.seq
                self.ended[m.lock] = "given back"
        self.answer(handle, "released")

    # ---------------------------------------------------------------- time

    def on_tick(self, _, __):
        for session in dict.fromkeys(life.lock.session for life in self.lives.values()):
            person = self.people.get(session)
            if person is None or person.lease_end_ns(self.now_ns) <= self.now_ns:
                for life in self.of(session):
                    if not life.held:
                        self.drop(life)
                    elif not life.bound:
                        self.end(life, "taken")
        self.end_unused()
        for life in list(self.lives.values()):
            over = life.phase == "granted" and life.hold_end_ns <= self.now_ns
            if over and (life.recalled or not life.kept):
                self.end(life, "taken")
        for session, person in sorted(self.people.items(), key=self._silent_for_longest):
            away_ns = self.now_ns - person.lease_end_ns(self.now_ns)
            if not self.in_grace and away_ns > IDLE_TTLS * person.ttl_ns:
                self.leave(session)
        self.grant()
        for life in list(self.lives.values()):
            if life.parked is not None and life.slice_end_ns <= self.now_ns:
                self.unpark(life)
        for session, (_, end_ns) in list(self.listening.items()):
            if end_ns <= self.now_ns:
                self.answer_listener(session)
        self.ask_and_tell()
        facts = self.forgotten_facts()
        if facts:
            self.persist("os", facts)

    def _silent_for_longest(self, entry):
        session, person = entry
        return person.lease_end_ns(self.now_ns) + IDLE_TTLS * person.ttl_ns, session

    def ask_and_tell(self) -> None:
        """Ask primaries, tell participants."""

    def on_drain(self, _, __):
        self.draining = True
        for life in list(self.lives.values()):
            self.take_back(life)
        for life in self.lives.values():
            self.unpark(life)
        for session in list(self.listening):
            self.answer_listener(session)

    def on_listlocks(self, _, handle):
        found = [(i.number, i.lock, i.held, self.use_of(i)) for i in self.lives.values()]
        self.answer(handle, "locks", tuple(sorted(found)))

    def on_awaitstamp(self, _, __):
        """Answered when it is so; the machine judges the promise."""

    def deadlines_ns(self) -> list[int]:
        """Return the times at which something is due."""
        due = [self.grace_end_ns] if self.in_grace else []
        due += [end_ns for _, end_ns in self.listening.values()]
        for life in self.lives.values():
            person = self.people.get(life.lock.session)
            if person is not None and not life.bound:
                due.append(person.lease_end_ns(self.now_ns))
            if life.recalled:
                due.append(self.now_ns + LOOK_AGAIN_NS)
            if life.phase == "granted" and (life.recalled or not life.kept):
                due.append(life.hold_end_ns)
            if life.parked is not None:
                due.append(life.slice_end_ns)
        return due
