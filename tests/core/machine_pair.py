"""A real shard and its reference, given the same messages and compared after each of them.

`Pair` is also the host of the shard: its clock, and its disk, which reports when told and keeps
any prefix of what was not reported when the shard dies.
"""

from __future__ import annotations

from collections import Counter
from itertools import count
from typing import TYPE_CHECKING

from kept_parts import FakeMarks
from machine_answers import fact_of, plain
from reference_commits import ReferenceShard
from reference_parts import DURABILITY, RETENTION
from shard_bench import ShardBench

from enact_dist.core.offline.ledger import Ledger
from enact_dist.core.protocol.datum import Slot, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    AwaitStamp,
    Commit,
    EpochChanged,
    Reached,
    TakeView,
    Viewed,
    Waiting,
)
from enact_dist.core.protocol.records import Call, Persist, Persisted, Publish, Recovered, Reply

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId
    from enact_dist.core.protocol.messages import SlotState

ENTITIES = ("a", "tray/1", "tray/2")
ASPECTS = ("count", "note", "frame")
SLOTS = [Slot("online", entity, aspect) for entity in ENTITIES for aspect in ASPECTS]
STORY_LINES = 40


class Pair:
    """The shard, the reference, their one clock and their one disk.

    Attributes:
        kept: Everything the shard has asked its disk to keep, oldest first.
        reported: How many of these were reported (or need no report): a kill keeps them.
        synced: How many of these a power cut keeps, too.
        floor_ns: Largest stamp that the shard has told in this epoch.
        history: All states of each slot with their stamps, but of what restarts have lost.
    """

    def __init__(self) -> None:
        bench = ShardBench()
        for name, durability in DURABILITY.items():
            entry = AspectEntry(name, "int", durability, RETENTION[name])
            bench.register(entry)
        self._base, self._settings = bench, bench.settings
        self.shard, self.marks = bench.shard, FakeMarks()
        self.shard.state.tenures.kept.marks = self.marks
        self.now_ns, self.wall_ns = bench.now_ns, bench.wall_ns
        self.born_ns = self.now_ns
        self.reference = ReferenceShard(1, self.now_ns, None, 0)
        self.kept: list[Persist] = []
        self.reported = self.synced = 0
        self.floor_ns = 0
        self.last_token = Token(0, 0)
        self.tokens: dict[LockId, Token] = {}
        self.history: dict[Slot, list[tuple]] = {slot: [(0, 0, None)] for slot in SLOTS}
        self.promised_ns: dict[Slot, int] = {}
        self.awaited: dict[int, tuple[int, str]] = {}
        self.asked: dict[int, dict[Slot, int]] = {}
        self.tally: Counter[str] = Counter()
        self.reached_ns = 0
        self.story: list[tuple[int, object]] = []
        self._handles = count(1)

    # ---------------------------------------------------------------- steps

    def give(self, message: object) -> None:
        """Give both one message and compare."""
        handle = next(self._handles)
        self._tell(message)
        if isinstance(message, AwaitStamp):
            self.awaited[handle] = message.stamp_ns, message.session
        if isinstance(message, TakeView):
            stamps = {Slot(*item[1:4]): item.captured_ns for item in message.items}
            self.asked[handle] = {slot: ns for slot, ns in stamps.items() if ns}
        expected = self.reference.handle(message, handle, self.now_ns)
        effects = self.shard.handle(
            message, reply_to=handle, now_ns=self.now_ns, wall_ns=self.wall_ns
        )
        self.shard.assert_invariants()
        self._adopt_tokens(expected)
        persists = [effect for effect in effects if isinstance(effect, Persist)]
        asked = [
            (p.durability.value, bool(p.ticket), tuple(fact_of(r) for r in p.records))
            for p in persists
        ]
        wanted = [(d, t, tuple(_told(f) for f in facts)) for d, t, facts in expected.persists]
        self.same("what the disk is asked to keep", asked, wanted)
        self._judge_stamps(message, persists)
        self.kept += persists
        calls = [
            (e.shard, type(e.request).__name__.lower(), e.request.lock)
            for e in effects
            if isinstance(e, Call)
        ]
        self.same("calls", sorted(calls), sorted(expected.calls))
        self._judge_changes(effects, expected)
        self._judge_answers(expected, effects)
        self._compare_state()

    def mark(self, lock: LockId, *, on: bool) -> None:
        """Take, or give back, the mark of a lock's grant."""
        token = self.tokens.get(lock)
        if token is not None and token.epoch == self.shard.epoch:
            self._tell(f"{'used' if on else 'unused'}: {lock} {token}")
            for marks in (self.marks.in_use, self.reference.used):
                (marks.add if on else marks.discard)((lock.session, token.number))

    def report(self, number: int = 1) -> None:
        """Let the disk finish its oldest writes."""
        for persist in self.kept[self.reported : self.reported + number]:
            self.reported += 1
            if persist.durability.value == "durable":
                self.synced = self.reported
            if persist.ticket:
                self.give(Persisted(persist.ticket))

    def crash(self, keep: int, *, down_ns: int) -> None:
        """Die with so many writes kept, and start again."""
        self._tell(f"crash: {keep} of {len(self.kept)} writes kept")
        del self.kept[keep:]
        self.reported = self.synced = keep
        self.now_ns += down_ns
        self.wall_ns += down_ns
        epoch = self.shard.epoch + 1
        recovered = self._recovered(epoch)
        self.shard = type(self.shard)(
            self._settings, recovered, now_ns=self.now_ns, wall_ns=self.wall_ns
        )
        self.marks = self.shard.state.tenures.kept.marks = FakeMarks()
        self.reference = ReferenceShard(epoch, self.now_ns, self.reference, keep)
        for slot in SLOTS:
            content = self.shard.state.slots[slot]
            version, text = self.reference.slots.get(slot, (0, None))
            known = [entry for entry in self.history[slot] if entry[1] < version]
            self.history[slot] = [*known, (content.stamp_ns, version, text)]
        self.floor_ns = self.reached_ns = 0
        self.promised_ns.clear()
        self.awaited.clear()
        self._compare_state()

    def _recovered(self, epoch: int) -> Recovered:
        """Return what a store gives back of all that it has kept."""
        records = (record for persist in self.kept for record in persist.records)
        return Ledger((*self._base.log, *records)).recovered(epoch)

    # ---------------------------------------------------------------- comparisons

    def same(self, what: str, found: object, wanted: object) -> None:
        """Fail with the story where the two differ."""
        if found != wanted:
            lines = "\n".join(
                f"{(now_ns - self.born_ns) / 1e6:10.3f} ms  {event}"
                for now_ns, event in self.story[-STORY_LINES:]
            )
            raise AssertionError(f"{what}:\n  shard     {found}\n  reference {wanted}\n{lines}")

    def _tell(self, what: object) -> None:
        self.story.append((self.now_ns, what))

    def _adopt_tokens(self, expected) -> None:
        """Only the shard can choose tokens: they grow, and name its epoch."""
        for lock in expected.grants:
            tenure = self.shard.state.tenures.by_lock.get(lock)
            self.same(f"{lock} is granted", tenure is not None and tenure.token is not None, True)
            token = tenure.token
            self.same(
                "a token grows", (token > self.last_token, token.epoch), (True, self.shard.epoch)
            )
            self.last_token = self.tokens[lock] = token
            life = self.reference.lives.get(lock)
            if life is not None:
                life.token = token

    def _judge_answers(self, expected, effects) -> None:
        answers = {}
        for effect in effects:
            if isinstance(effect, Reply):
                self.same("one answer for each request", effect.reply_to in answers, False)
                if isinstance(effect.answer, Reached):
                    self._judge_reached(effect)
                    continue
                if effect.reply_to in self.awaited:
                    session = self.awaited.pop(effect.reply_to)[1]
                    person = self.reference.people.get(session)
                    self.same(
                        "the session may not wait", person is None or not person.present, True
                    )
                    self.same("is told the epoch", type(effect.answer), EpochChanged)
                    continue
                answers[effect.reply_to] = effect.answer
                self.floor_ns = max(self.floor_ns, getattr(effect.answer, "stamp_ns", 0))
        found = {to: plain(answer) for to, answer in answers.items()}
        for to, answer in answers.items():
            wanted = expected.answers.get(to)
            if isinstance(answer, Waiting) and wanted is not None:
                gone = answer.lock not in self.reference.lives
                many = len(wanted[3]) > 8
                if gone or many:  # told in the moment of its end, or to nobody in full
                    found[to], expected.answers[to] = found[to][:2], wanted[:2]
            elif isinstance(answer, Viewed) and wanted is not None:
                self._judge_view(answer, self.asked[to])
                if wanted[2] is None:
                    found[to], expected.answers[to] = found[to][:2], wanted[:2]
        self.same("answers", found, expected.answers)
        for answer in answers.values():
            if plain(answer)[0] == "granted":
                life = self.reference.lives[answer.lock]
                self.same("the token of a grant", answer.token, life.token)

    def _judge_view(self, answer: Viewed, asked: dict[Slot, int]) -> None:
        """What is shown was current at every stamp of the interval, and stays so."""
        for state in answer.states:
            if state.slot in asked:
                self._judge_stamped(answer, state, asked[state.slot])
                continue
            text = None if state.datum is None else bytes(state.datum.body).decode()
            states = self.history[state.slot]
            entry = next((e for e in states if e[1:] == (state.version, text)), None)
            self.same(f"{state.slot} was committed", entry is not None, True)
            index = states.index(entry)
            self.same("the begin of a view", entry[0] <= answer.from_ns, True)
            if index + 1 < len(states):
                self.same("the end of a view", states[index + 1][0] > answer.until_ns, True)
            elif answer.from_ns <= answer.until_ns:
                before = self.promised_ns.get(state.slot, 0)
                self.promised_ns[state.slot] = max(before, answer.until_ns)

    def _judge_stamped(self, answer: Viewed, state: SlotState, captured_ns: int) -> None:
        """The newest version with a stamp that there was, and still is, at the end of a view."""
        text = None if state.datum is None else bytes(state.datum.body).decode()
        states = self.history[state.slot]
        ends = [entry for entry in states if entry[0] <= answer.until_ns]
        moments = ends[-1:] if answer.from_ns <= answer.until_ns else [*ends[-1:], states[-1]]
        right = [self.reference.by_stamp(state.slot, m[1:], captured_ns) for m in moments]
        self.same(
            f"{state.slot} by stamp {captured_ns}",
            (state.version, text) if (state.version, text) not in right else right,
            right,
        )
        past = moments[0] is not states[-1]
        newest = state.version == states[-1][1]
        self.tally["by stamp: newest" if text and newest else "by stamp: replaced"] += bool(text)
        self.tally["by stamp: outside retention"] += not (text or state.version)
        self.tally["by stamp: as of the past"] += past

    def _judge_reached(self, effect: Reply) -> None:
        stamp_ns, _ = self.awaited.pop(effect.reply_to)
        if effect.answer.reached:
            self.reached_ns = max(self.reached_ns, stamp_ns)

    def _judge_stamps(self, message, persists) -> None:
        """A commit is stamped after all that was told before, here and to its client."""
        for persist in persists:
            for record in persist.records:
                position = getattr(record, "position", None)
                stamp_ns = position.stamp_ns if position else getattr(record, "stamp_ns", 0)
                fact = fact_of(record)
                if fact[0] in ("outcome", "prepared"):
                    seen_ns = max(self.floor_ns, message.seen_stamp_ns)
                    self.same("a stamp comes after what was seen", stamp_ns > seen_ns, True)
                    self.reference.user(fact[1]).stamp_ns = stamp_ns
                    if fact[0] == "prepared":
                        self.reference.prepared_as[fact[1]].stamp_ns = stamp_ns
                elif fact[0] == "slot" and isinstance(message, Commit):
                    # The first commit of a volatile slot leaves no outcome behind.
                    self.reference.user(message.lock).stamp_ns = stamp_ns

    def _judge_changes(self, effects, expected) -> None:
        changes = [c for e in effects if isinstance(e, Publish) for c in e.notice.changes]
        found = [(c.slot, c.version, c.null) for c in changes]
        wanted = [(slot, version, text is None) for slot, version, text in expected.changes]
        self.same("what becomes visible", found, wanted)
        for change, (slot, version, text) in zip(changes, expected.changes, strict=True):
            before_ns = self.history[slot][-1][0]
            promised_ns = max(self.promised_ns.get(slot, 0), self.reached_ns)
            self.same("stamps of a slot grow", change.stamp_ns > before_ns, True)
            self.same(
                f"{slot} changes after every stamp at which it was shown",
                max(change.stamp_ns, promised_ns + 1),
                change.stamp_ns,
            )
            self.history[slot].append((change.stamp_ns, version, text))

    def _compare_state(self) -> None:
        state, reference = self.shard.state, self.reference
        tenures = state.tenures.by_lock
        self.same("locks", set(tenures), set(reference.lives))
        phases = {
            lock: (
                (t.claim.granted, t.bound, t.token, t.prepared is not None),
                (bool(t.kept), t.recalled),
            )
            for lock, t in tenures.items()
        }
        promised = ("prepared", "finishing", "aborting")
        wanted = {
            lock: (
                (life.held, life.bound, life.token, life.phase in promised),
                (life.kept, life.recalled),
            )
            for lock, life in reference.lives.items()
        }
        self.same("phases (held, bound, token, prepared), (kept, recalled)", phases, wanted)
        cells = {number for page in self.marks.cells.values() for number in page}
        near = [life for life in reference.lives.values() if life.kept and not life.far]
        numbers = {life.token.number for life in near if not life.recalled}
        self.same("cells", cells, numbers)
        far = [life for life in reference.lives.values() if life.far]
        self.tally["far grants recalled"] += any(life.recalled for life in far)
        waiting = sorted(
            (t.claim.ticket, lock) for lock, t in tenures.items() if not t.claim.granted
        )
        self.same(
            "queue", [lock for _, lock in waiting], [lock for lock, _ in reference.table.queue]
        )
        for lock, life in reference.lives.items():
            if life.phase == "granted":
                self.same(f"hold limit of {lock}", tenures[lock].hold_end_ns, life.hold_end_ns)
        for slot in SLOTS:
            content = state.slots[slot]
            text = None if content.datum is None else bytes(content.datum.body).decode()
            self.same(f"{slot}", (content.version, text), reference.slots.get(slot, (0, None)))
        self._compare_sessions()
        self.same(
            "decisions",
            {k: set(d.left) for k, d in state.decisions.by_lock.items()},
            {k: set(d.left) for k, d in reference.decisions.items()},
        )
        due_ns = min(reference.deadlines_ns(), default=1 << 62)
        self.same("wakes in time", self.shard.next_deadline_ns() <= max(due_ns, self.now_ns), True)
        self.same("nobody is overtaken", self.shard.counters.get("locks_bypassed", 0), 0)

    def _compare_sessions(self) -> None:
        sessions, reference, now_ns = self.shard.state.sessions, self.reference, self.now_ns
        found = {
            name: (s.lease_end_ns(now_ns), s.present, s.acknowledged, s.durable, s.token_present)
            for name, s in sessions.by_id.items()
        }
        wanted = {
            name: (p.lease_end_ns(now_ns), p.present, p.acknowledged, p.durable, p.token)
            for name, p in reference.people.items()
        }
        self.same("sessions", found, wanted)
        self.same("grace", sessions.in_grace(now_ns), reference.in_grace)
        for session in ("ann", "bob", "cyd"):
            lanes = {
                number: (lane.top, lane.outcome and lane.outcome.lock)
                for number, lane in (sessions.lanes_of(session) or {}).items()
            }
            wanted = {
                number: (lane.top, lane.outcome and lane.outcome[0])
                for number, lane in reference.lanes.get(session, {}).items()
            }
            self.same(f"lanes of {session}", lanes, wanted)


def _told(fact: tuple) -> tuple:
    """Leave out of a fact what only the reference needs."""
    return fact[:2] if fact[0] == "prepared over" else fact
