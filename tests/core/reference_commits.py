"""One shard from its definition, second half: commits, promises, decisions and who asks about them."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

from reference_parts import DURABILITY, RETENTION, Decision, Lane, Life
from reference_shard import MS
from reference_views import ReferenceViews

from enact_dist.core.protocol.messages import Finish, Resolve

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import LockId

ASK_NS_MAX = 1_000 * MS
TELL_NS_MAX = 2_000 * MS
STRICTER = ("volatile", "os", "durable")


FORCED_ASK_NS = 2_000 * MS


def text_of(datum: object) -> str | None:
    """Return a datum as text, None for null."""
    return None if datum is None else bytes(datum.body).decode()


class ReferenceShard(ReferenceViews):
    """Everything that a shard decides."""

    # ---------------------------------------------------------------- restart

    def recall(self, fact):
        """Take up what one record says."""
        super().recall(fact)
        kind, name = fact[:2]
        if kind == "slot":
            _, slot, version, text, volatile, history = fact
            if history:
                self.replaced.setdefault(slot, []).append(self.slots[slot])
            self.slots[slot] = (0, None) if volatile else (version, text)
        elif kind == "forgotten":
            for slot, version in name:
                self.replaced[slot] = [old for old in self.replaced[slot] if old[0] != version]
        elif kind == "outcome":
            lane = Lane(top=name.seq, outcome=(name, fact[2]))
            self.lanes.setdefault(name.session, {})[name.lane] = lane
        elif kind == "prepared":
            self.lives[name] = copy(self.prepared_as[name])
        elif kind == "prepared over":
            self.lives.pop(name)
            self.ended[name] = fact[2]
        elif kind == "forced":
            self.forced[name] = self.now_ns
        elif kind == "forced over":
            self.forced.pop(name)
        elif kind == "decision":
            self.decisions[name] = Decision(list(fact[2]), self.now_ns)
        elif kind == "decision done":
            del self.decisions[name]

    def restored(self):
        """What was prepared is held again before anything else is granted."""
        for slot in self.replaced:
            self.forget(slot)
        self.views = {}
        self.alarms: dict[LockId, list[int]] = {}
        for life in self.lives.values():
            self.number += 1
            life.number = self.number
            life.phase, life.hold_end_ns, life.replies, life.told = "prepared", 0, [], True
            life.versions = self.next_versions(life.writes)
            life.ask_ns = self.now_ns
            self.ended.pop(life.lock, None)
            self.table.enqueue(life.lock, life.lines)
            assert self.table.grant() == [life.lock]

    # ---------------------------------------------------------------- commit

    def next_versions(self, writes):
        """Return the versions that writes make."""
        return tuple((slot, self.slots.get(slot, (0, None))[0] + 1) for slot, _ in writes)

    def on_commit(self, m, handle):
        known = self.outcome_of(m.lock)
        if known is not None:
            self.answer(handle, "committed", m.lock, known, self.lives_still(m.lock, m.token))
            return
        flying = self.user(m.lock)
        if flying is not None and flying.phase in ("committing", "deciding"):
            flying.replies.append(handle)
            return
        life = self.lives.get(m.lock) or self.kept_under(m.lock.session, m.token)
        refusal = self.refusal(m, life)
        if refusal is not None:
            if refusal[0] == "refused" and not life.bound:
                self.end(life, "taken")
            self.answer(handle, *refusal)
            return
        moved = self.moved(m.expects, m.lock)
        if moved is not None:
            self.changed(m.lock, life, handle, moved)
            return
        if life.kept:
            self.lane_for(m.lock).top = m.lock.seq
        life.user, life.asks_to_keep = m.lock, m.keep
        life.writes = tuple((write.slot, text_of(write.datum)) for write in m.writes)
        life.versions, life.participants = self.next_versions(life.writes), m.participants
        life.replies = [handle]
        durabilities = [DURABILITY[slot.aspect] for slot, _ in life.writes]
        durability = max(durabilities, key=STRICTER.index, default="volatile")
        durability = "durable" if m.participants else durability
        facts = self.slot_facts(life)
        if durability == "volatile" and not facts:
            self.committed(life)
            return
        life.phase = "deciding" if m.participants else "committing"
        if durability == "volatile":
            durability = "os"
        else:
            facts += (("outcome", m.lock, life.versions),)
        if m.participants:
            facts += (("decision", m.lock, m.participants),)
        self.persist(durability, facts, ("commit", life))

    def kept_commit(self, life):
        """A commit is on disk."""
        self.committed(life)

    def slot_facts(self, life: Life) -> tuple:
        """Return what the disk keeps of writes; of volatile ones only that the slot exists."""
        texts, facts = dict(life.writes), []
        for slot, version in life.versions:
            volatile = DURABILITY[slot.aspect] == "volatile"
            if not (volatile and slot in self.slots):
                text = None if volatile else texts[slot]
                facts.append(("slot", slot, version, text, volatile, self.retains(slot)))
        return tuple(facts)

    def retains(self, slot) -> bool:
        """Whether the disk keeps the version of a slot that is replaced now."""
        stored = DURABILITY[slot.aspect] != "volatile"
        return stored and RETENTION[slot.aspect] > 1 and self.slots.get(slot, (0, None))[0] > 0

    def forget(self, slot) -> None:
        """Let go of what is outside retention."""
        kept = self.replaced[slot]
        gone = kept[: max(0, len(kept) - RETENTION[slot.aspect] + 1)]
        del kept[: len(gone)]
        if DURABILITY[slot.aspect] != "volatile":
            self.forgotten |= {(slot, version) for version, _ in gone if RETENTION[slot.aspect] > 1}

    def apply(self, life: Life) -> None:
        """Make the writes visible."""
        texts = dict(life.writes)
        for slot, version in life.versions:
            if slot in self.slots and self.slots[slot][0]:
                self.replaced.setdefault(slot, []).append(self.slots[slot])
                self.forget(slot)
            self.slots[slot] = (version, texts[slot])
            self.out.changes.append((slot, version, texts[slot]))

    def committed(self, life: Life) -> None:
        """A commit stands: apply, free, answer, tell."""
        self.apply(life)
        lock, lane = life.user, self.lane_of(life.user)
        if lane.outcome is None or lane.outcome[0].seq < lock.seq:
            lane.outcome = (lock, life.versions)
        life.phase = "granted"
        stays = self.stays(life)
        if not stays:
            self.end(life, "forgotten")
        self.ended[lock] = "forgotten"
        for handle in life.replies:
            self.answer(handle, "committed", lock, life.versions, stays)
        if life.participants:
            self.decisions[lock] = Decision(list(life.participants), self.now_ns)
            self.tell()

    def outcome_of(self, lock):
        """Return the versions of a commit that its lane still remembers."""
        lane = self.lane_of(lock)
        known = lane.outcome if lane else None
        return known[1] if known is not None and known[0] == lock else None

    def refusal(self, m, life: Life | None) -> tuple | None:
        """The fence first; then what no holder may ask."""
        if m.token.epoch != self.epoch or self.known(m.lock.session) is None:
            return "epoch", self.epoch
        if life is None or life.token != m.token:
            return self.fenced(m.lock)
        if self.behind(life, m.lock):
            return "fenced", m.lock
        slots = [write.slot for write in m.writes]
        allowed = all(any(line.allows(slot) for line in life.lines) for slot in slots)
        if life.bound or not allowed or len(set(slots)) < len(slots):
            return "refused", "protocol"
        return None

    def changed(self, lock, life, handle, moved):
        """End a lock whose expectation does not stand."""
        answer = self.lane_for(lock).changed = ("changed", lock, *moved)
        self.end(life, "given back")
        self.answer(handle, *answer)

    def fenced(self, lock):
        """What the holder of a lost lock is told: that something moved on, if that ended it."""
        lane = self.lane_of(lock)
        told = lane.changed if lane else None
        return told if told is not None and told[1] == lock else ("fenced", lock)

    def moved(self, expects, lock):
        """Return an expected slot that moved on or may be about to, and its version."""
        for slot, version in expects:
            newest = self.slots.get(slot, (0, None))[0]
            for life in self.lives.values():
                if life.phase in ("committing", "deciding"):
                    newest = dict(life.versions).get(slot, newest)
            others = [self.lives[other] for other in self.table.guards_of(slot) if other != lock]
            promised = ("prepared", "finishing", "aborting")
            if newest != version or any(o.phase in promised or not o.alone for o in others):
                return slot, newest
        return None

    def on_outcome(self, m, handle):
        known, lane = self.outcome_of(m.lock), self.lane_of(m.lock)
        life = self.user(m.lock)
        gone = m.lock.session not in self.people and not self.lanes.get(m.lock.session)
        at_disk = ("committing", "deciding", "preparing", "finishing", "aborting")
        newer = lane and max(lane.top, lane.outcome[0].seq if lane.outcome else 0) > m.lock.seq
        if known is not None:
            self.answer(handle, "outcome", m.lock, "committed", known)
        elif life is not None and life.phase in at_disk:
            self.answer(handle, "outcome", m.lock, "pending", ())
        else:
            kind = "expired" if gone or newer else "unseen"
            self.answer(handle, "outcome", m.lock, kind, ())

    def on_validate(self, m, handle):
        lane = self.lane_of(m.lock)
        life = self.lives.get(m.lock) or self.kept_under(m.lock.session, m.token)
        here = self.known(m.lock.session) is not None
        moved = self.moved(m.expects, m.lock)
        if here and m.token.number and lane and lane.validated == (m.lock, m.token):
            self.answer(handle, "valid", m.lock, self.lives_still(m.lock, m.token))
        elif m.token.epoch != self.epoch or not here:
            self.answer(handle, "epoch", self.epoch)
        elif not m.token.number:
            found = ("changed", m.lock, *moved) if moved else ("valid", m.lock, False)
            self.answer(handle, *found)
        elif life is None or life.token != m.token:
            self.answer(handle, *self.fenced(m.lock))
        elif life.bound or self.behind(life, m.lock):
            self.answer(handle, "fenced", m.lock)
        elif moved:
            self.changed(m.lock, life, handle, moved)
        else:
            lane = self.lane_for(m.lock)
            lane.validated = (m.lock, m.token)
            if life.kept:
                lane.top = m.lock.seq
            life.user, life.asks_to_keep = m.lock, m.keep
            stays = self.stays(life)
            if not stays:
                self.end(life, "validated")
            self.ended[m.lock] = "validated"
            self.answer(handle, "valid", m.lock, stays)

    # ---------------------------------------------------------------- promises

    def on_prepare(self, m, handle):
        life = self.lives.get(m.lock)
        if life is not None and life.phase in ("prepared", "finishing", "aborting"):
            self.answer(handle, "prepared", m.lock, life.versions)
            return
        if life is not None and life.phase == "preparing":
            life.replies.append(handle)
            return
        refusal, moved = self.refusal(m, life), self.moved(m.expects, m.lock)
        if refusal is not None:
            self.answer(handle, *refusal)
        elif moved:
            self.changed(m.lock, life, handle, moved)
        else:
            life.writes = tuple((write.slot, text_of(write.datum)) for write in m.writes)
            life.versions, life.phase = self.next_versions(life.writes), "preparing"
            life.primary, life.primary_token = m.primary, m.primary_token
            life.replies = [handle]
            self.prepared_as[m.lock] = copy(life)
            self.persist("durable", (("prepared", m.lock, life.versions),), ("prepare", life))

    def kept_prepare(self, life):
        """A promise is on disk."""
        life.phase, life.ask_ns = "prepared", self.now_ns + self.patience_ns(life)
        for handle in life.replies:
            self.answer(handle, "prepared", life.lock, life.versions)
        life.replies = []

    def patience_ns(self, life):
        """Return how long to wait for the primary's word before asking (again)."""
        person = self.people.get(life.lock.session)
        return min(ASK_NS_MAX, person.ttl_ns // 2 if person else ASK_NS_MAX)

    def on_finish(self, m, handle):
        life = self.lives.get(m.lock)
        if m.lock in self.forced:
            self.alarm(m.lock, [handle])
        elif life is None or life.phase not in ("prepared", "finishing", "aborting"):
            self.answer(handle, "finished", m.lock)
        else:
            life.replies.append(handle)
            self.finish(life, m.position)

    def finish(self, life, position):
        """The primary has committed: apply as soon as that is on disk."""
        if life.phase == "prepared":
            life.phase, life.position = "finishing", position
            facts = (*self.slot_facts(life), ("prepared over", life.lock, "finished"))
            self.persist("durable", facts, ("finish", life))
        elif life.phase == "aborting":
            life.position = position

    def kept_finish(self, life):
        """The end of a promise is on disk."""
        self.apply(life)
        self.end(life, "finished")
        for handle in life.replies:
            self.answer(handle, "finished", life.lock)

    def on_called(self, m, _):
        lock, life = m.request.lock, self.lives.get(m.request.lock)
        if isinstance(m.request, Finish) and lock in self.decisions:
            left = self.decisions[lock].left
            if m.shard in left:
                left.remove(m.shard)
            if not left:
                del self.decisions[lock]
                self.persist("os", (("decision done", lock),))
        elif isinstance(m.request, Resolve) and lock in self.forced:
            if m.answer.kind == "committed":
                self.alarm(lock, [])
            elif m.answer.kind == "aborted" and lock not in self.alarms:
                del self.forced[lock]
                self.persist("os", (("audit", ""), ("forced over", lock)))
        elif isinstance(m.request, Resolve) and life is not None:
            if m.answer.kind == "committed":
                self.finish(life, m.answer.position)
            elif m.answer.kind == "aborted" and life.phase == "prepared":
                self.persist("os", (("prepared over", lock, "aborted"),))
                self.end(life, "aborted")

    def on_resolve(self, m, handle):
        life = self.lives.get(m.lock)
        if m.lock in self.decisions or self.outcome_of(m.lock) is not None:
            kind = "committed"
        else:
            open_still = life is not None and life.token == m.primary_token
            kind = "open" if open_still else "aborted"
        self.answer(handle, "resolved", m.lock, kind)

    def ask_and_tell(self):
        """Ask primaries, tell participants."""
        for life in self.lives.values():
            if life.phase in ("prepared", "finishing", "aborting") and life.ask_ns <= self.now_ns:
                self.out.calls.append((life.primary, "resolve", life.lock))
                life.ask_ns = self.now_ns + self.patience_ns(life)
        for lock, due_ns in self.forced.items():
            if due_ns <= self.now_ns and lock not in self.alarms:
                self.out.calls.append(("far", "resolve", lock))
                self.forced[lock] = self.now_ns + FORCED_ASK_NS
        self.tell()

    def tell(self):
        """Tell participants, with growing pauses, until they have finished."""
        for lock, decision in self.decisions.items():
            if decision.due_ns <= self.now_ns:
                self.out.calls += [(shard, "finish", lock) for shard in decision.left]
                decision.due_ns = self.now_ns + decision.pause_ns
                decision.pause_ns = min(2 * decision.pause_ns, TELL_NS_MAX)

    # ---------------------------------------------------------------- people and readers

    def on_break(self, m, handle):
        found = [life for life in self.lives.values() if life.number == m.number]
        ends = bool(found) and not found[0].bound
        told = handle, "broken", ends or m == self.by_hand.get("break")
        if ends:
            self.end(found[0], "taken")
            self.by_hand["break"] = m
            self.persist("os", (("audit", ""),), ("told", [told]))
        else:
            self.answer_in_turn(told)

    def on_forceabort(self, m, handle):
        found = [life for life in self.lives.values() if life.number == m.number]
        if not found or found[0].phase != "prepared":
            again = [work for work in self.works if work[0] == "abort" and work[2] == m]
            if again:
                again[0][3].append(handle)
            else:
                self.answer(handle, "broken", m == self.by_hand.get("abort"))
            return
        life = found[0]
        life.phase, life.replies, life.position = "aborting", [], None
        facts = (("audit", ""), ("forced", life.lock), ("prepared over", life.lock, "aborted"))
        self.persist("durable", facts, ("abort", life, m, [handle]))

    def kept_abort(self, life, m, handles):
        """An operator's abort is on disk; the lost primary is asked on, for it may have committed."""
        self.end(life, "aborted")
        self.by_hand["abort"] = m
        for handle in handles:
            self.answer(handle, "broken", True)
        self.forced[life.lock] = self.now_ns + FORCED_ASK_NS
        if life.position is not None:
            self.alarm(life.lock, life.replies)

    def alarm(self, lock, replies):
        """What was aborted by hand has committed elsewhere: people must know, for good."""
        if lock in self.alarms:
            self.alarms[lock] += replies
            return
        self.alarms[lock] = replies
        self.persist("durable", (("audit", ""), ("forced over", lock)), ("alarm", lock))

    def kept_alarm(self, lock):
        """The alarm is on disk."""
        del self.forced[lock]
        for handle in self.alarms.pop(lock):
            self.answer(handle, "finished", lock)

    def deadlines_ns(self):
        """Return the times at which something is due."""
        due = super().deadlines_ns()
        promised = ("prepared", "finishing", "aborting")
        due += [life.ask_ns for life in self.lives.values() if life.phase in promised]
        due += [end_ns for _, end_ns in self.views.values()]
        due += [due_ns for lock, due_ns in self.forced.items() if lock not in self.alarms]
        return due + [decision.due_ns for decision in self.decisions.values()]

    # ---------------------------------------------------------------- names of states

    def state_of(self, lock) -> str:
        """Return a lock's row in the table of cells."""
        if lock in self.lives:
            return self.lives[lock].state
        if (life := self.user(lock)) is not None and life.bound:
            return life.state
        if lock in self.forced:
            return "alarm" if lock in self.alarms else "forced"
        if lock in self.decisions:
            return "decided"
        if self.outcome_of(lock) is not None:
            return "committed"
        return self.ended.get(lock, "unseen")
