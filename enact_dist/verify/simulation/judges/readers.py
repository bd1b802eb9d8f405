"""The rules of what readers are shown: I18, of now, as of a stamp, and by capture stamp.

A datum that is asked by its capture stamp is the newest version with that stamp that there was in
the moment of the answer and that its shard still retains; where there is none, null, and never
another one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Granted, Survey, Viewed
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access, NullReason
from enact_dist.verify.simulation.judges.picture import CommittedState

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Item, SlotState, Surveyed
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.judges.history import Observations
    from enact_dist.verify.simulation.judges.picture import ShardPicture

OUTSIDE: Final = CommittedState(0, 0, "no lock", 0, None)
"""What stands for a version that is not retained."""


class ReaderJudge:
    """Looks at grants, views and surveys.

    Args:
        observed: What is known of the run.
        retentions: How many versions of a slot stay readable, by aspect.
    """

    def __init__(self, observed: Observations, retentions: dict[str, int]) -> None:
        self._observed = observed
        self._fail = observed.fail
        self._retentions = retentions

    def check(self, host: ShardNode, answer: Granted | Viewed, picture: ShardPicture) -> None:
        """I18: an answer shows one committed moment, and all of it."""
        entry = self._observed.entry(answer.lock)
        items = entry.items if entry is not None else ()
        asked = {i[1:4]: i.captured_ns for i in items if i.captured_ns}
        for state in answer.states:
            captured_ns = asked.get(state.slot, 0)
            if captured_ns:
                self._check_captured(answer, state, captured_ns, picture)
            else:
                self._check_current(answer, state, picture)
            if isinstance(answer, Viewed) and answer.from_ns <= answer.until_ns:
                self._check_interval(answer, state.slot, picture)
        if isinstance(answer, Viewed):
            self._check_patterns_of_view(host, answer, items, picture)
        else:
            self._check_patterns_of_grant(host, answer, picture)

    # ---------------------------------------------------------------- the newest version

    def _check_current(
        self, answer: Granted | Viewed, state: SlotState, picture: ShardPicture
    ) -> None:
        now = picture.now(state.slot)
        name = (state.version, state.stamp_ns)
        if name != now.name and isinstance(answer, Viewed):
            now = picture.at(state.slot, max(answer.from_ns, answer.until_ns))
            self._observed.count("data shown as of the past", 1)
            if name != now.name and answer.from_ns > answer.until_ns:
                # Of no one moment, and it says so: some of the past was forgotten.
                now = picture.at(state.slot, answer.until_ns)
                self._observed.count("views of no moment", 1)
        if name != now.name:
            self._fail("I18 readers see what is committed", state.slot, state, now)
        if (state.null_reason == "") != (now.datum is not None):
            self._fail("null is null", state, now)
        if state.captured_ns != stamp_of(now.datum):
            self._fail("a datum keeps its capture stamp", state, now)

    def _check_interval(self, answer: Viewed, slot: Slot, picture: ShardPicture) -> None:
        """What a view says was current from one stamp to another was so all the time."""
        first, last = picture.at(slot, answer.from_ns), picture.at(slot, answer.until_ns)
        if first is not last:
            self._fail("a view is current from its begin to its end", slot, answer, first, last)

    # ---------------------------------------------------------------- by capture stamp

    def _check_captured(
        self, answer: Granted | Viewed, state: SlotState, captured_ns: int, picture: ShardPicture
    ) -> None:
        slot = state.slot
        moments = [picture.now(slot)]
        if isinstance(answer, Viewed):
            at_end = picture.at(slot, answer.until_ns)
            at_begin = picture.at(slot, answer.from_ns)
            # Where the answer is of no one moment and says so, each datum is of some.
            no_moment = answer.from_ns > answer.until_ns
            moments = [*moments, at_begin, at_end] if no_moment else [at_end]
        right = [self._captured(picture, slot, newest, captured_ns) for newest in moments]
        right += [OUTSIDE] * self._observed.clocks_were_set  # it may have grown old in one leap
        if not any(_is_shown(state, one) for one in right):
            self._fail("a capture stamp shows its own version", state, captured_ns, right)
        newest = picture.now(slot)
        if state.null_reason == NullReason.OUTSIDE_RETENTION.name:
            self._observed.count("stamps outside retention", 1)
        elif not state.null_reason and (state.version, state.stamp_ns) != newest.name:
            self._observed.count("replaced versions shown by stamp", 1)
        if moments[-1] is not newest:
            self._observed.count("stamped views of the past", 1)

    def _captured(
        self, picture: ShardPicture, slot: Slot, newest: CommittedState, captured_ns: int
    ) -> CommittedState:
        """Return what a slot that is at `newest` has to show for a capture stamp."""
        if stamp_of(newest.datum) == captured_ns:
            return newest
        for old in reversed(self._retained(picture, slot)):
            if old.version <= newest.version and stamp_of(old.datum) == captured_ns:
                return old
        return newest if newest.datum is None else OUTSIDE

    def _retained(self, picture: ShardPicture, slot: Slot) -> list[CommittedState]:
        """Return the replaced versions that a shard still has, oldest first.

        A restart leaves what is on the disk, and of volatile slots nothing.
        """
        line = picture.line(slot, volatile=self._observed.is_volatile(slot))
        return line[-self._retentions[slot.aspect] : -1]

    def check_survey(self, message: Survey, answer: Surveyed, picture: ShardPicture) -> None:
        """A survey names every version that is retained, oldest first, and then the newest."""
        told: dict[Slot, list[SlotState]] = {}
        for state in answer.states:
            told.setdefault(state.slot, []).append(state)
        for slot in picture.chains:
            if not _is_surveyed(message, slot):
                continue
            retained = self._retained(picture, slot) if message.retained else []
            right = [(*s.name, stamp_of(s.datum)) for s in (*retained, picture.now(slot))]
            found = [(s.version, s.stamp_ns, s.captured_ns) for s in told.pop(slot, ())]
            if not found and right == [(0, 0, 0)]:
                continue  # the only write that it had is gone, as declared
            grew_old = self._observed.clocks_were_set and found and found == right[-len(found) :]
            if found != right and not grew_old:
                self._fail("a survey names what is retained", slot, found, right)
            self._observed.count("replaced versions surveyed", len(retained))
        for slot, states in told.items():
            # A slot of class `volatile` whose first write came to nothing is known to exist.
            if any((s.version, s.stamp_ns, s.captured_ns) != (0, 0, 0) for s in states):
                self._fail("a survey names what was committed", slot, states)

    # ---------------------------------------------------------------- patterns

    def _check_patterns_of_view(
        self, host: ShardNode, answer: Viewed, items: tuple[Item, ...], picture: ShardPicture
    ) -> None:
        if answer.from_ns > answer.until_ns:
            return  # of no one moment, and it says so
        shown = {state.slot for state in answer.states}
        for item in items:
            if Access(item.access) is Access.VIEW_EACH:
                for slot in _not_shown(item, shown, picture):
                    if picture.at(slot, answer.until_ns).datum is not None:
                        self._fail("I18 a viewed pattern shows all that match", item, slot)
                    self._check_interval(answer, slot, picture)

    def _check_patterns_of_grant(
        self, host: ShardNode, answer: Granted, picture: ShardPicture
    ) -> None:
        shown = {state.slot for state in answer.states}
        absent = self._observed.absent.setdefault(answer.lock, {})
        for known in [known for known in absent if known[0] == host.name]:
            del absent[known]  # of an earlier grant, before a restart
        tenure = host.shard.state.tenures.by_lock.get(answer.lock)
        for item in tenure.items if tenure else ():
            if Access(item.access).each:
                for slot in _not_shown(item, shown, picture):
                    now = picture.now(slot)
                    if now.datum is not None:
                        self._fail("I18 a pattern shows all that match", item, slot)
                    absent[host.name, slot] = (picture.epoch, now.name)


def stamp_of(datum: Datum | None) -> int:
    """Return when a datum was captured, 0 if it has no stamp or there is none."""
    return datum.stamp_ns if datum is not None else 0


def _is_shown(state: SlotState, right: CommittedState) -> bool:
    if right is OUTSIDE and state.null_reason != NullReason.OUTSIDE_RETENTION.name:
        return False
    null = right.datum is None
    return (
        (state.version, state.stamp_ns) == right.name
        and bool(state.null_reason) == null
        and state.captured_ns == stamp_of(right.datum)
    )


def _is_surveyed(message: Survey, slot: Slot) -> bool:
    return (
        (not message.contexts or slot.context in message.contexts)
        and (not message.aspects or slot.aspect in message.aspects)
        and (
            not message.patterns
            or any(pattern_matches(pattern, slot.entity) for pattern in message.patterns)
        )
    )


def _not_shown(item: Item, shown: set[Slot], picture: ShardPicture) -> list[Slot]:
    column = picture.columns.get((item.context, item.aspect), {})
    return [s for s in column if s not in shown and pattern_matches(item.entity, s.entity)]
