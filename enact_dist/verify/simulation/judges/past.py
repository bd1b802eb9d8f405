"""The rules of history: what was is shown as it was, or said to be forgotten; what must stay does.

The judge's own picture has every committed state of every slot, and never forgets one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import (
    START,
    KeepVersions,
    Kept,
    ListHistory,
    SlotVersion,
    TakeView,
    Viewed,
)
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access, NullReason
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.judges.picture import NEVER_SET, CommittedState
from enact_dist.verify.simulation.judges.readers import stamp_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.protocol.messages import Forgotten, Item, SlotState, VersionEntry, Versions
    from enact_dist.core.protocol.records import Recovered
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.judges.history import Observations
    from enact_dist.verify.simulation.judges.picture import ShardPicture


class PastJudge:
    """Looks at strict views, at lists of versions and at what labels keep."""

    def __init__(self, observed: Observations, retentions: dict[str, int]) -> None:
        self._observed = observed
        self._fail = observed.fail
        self._retentions = retentions

    # ---------------------------------------------------------------- as of a stamp

    def check_view(
        self, answer: Viewed, at_ns: int, items: Iterable[Item], picture: ShardPicture
    ) -> None:
        """A strict view shows every slot as it was then, those that were deleted since, too."""
        if answer.until_ns < at_ns:
            self._observed.count("strict views to be asked again", 1)
            return
        if answer.from_ns > at_ns:
            self._fail("a view of the past is of its moment", answer, at_ns)
        shown = {state.slot: state for state in answer.states}
        for slot, each in self._asked(items, picture):
            picture.promised[slot] = max(at_ns, picture.promised.get(slot, 0))
            state, right = shown.get(slot), picture.at(slot, at_ns)
            if state is None and (not each or right.datum is not None):
                self._fail("a view of the past shows all that was", slot, at_ns, right)
            if state is not None:
                self._check_state(state, right, at_ns, picture)
            self._observed.count("data shown as of long ago", right.name != picture.now(slot).name)

    def _check_state(
        self, state: SlotState, right: CommittedState, at_ns: int, picture: ShardPicture
    ) -> None:
        found = state.version, state.stamp_ns, state.captured_ns
        if found != (*right.name, stamp_of(right.datum)):
            self._fail("a view of the past shows what was", state, at_ns, right)
        if state.null_reason not in self._reasons(state.slot, right, picture):
            self._fail("a view of the past says why there was nothing", state, at_ns, right)
        if state.null_reason == NullReason.LOST.name and at_ns < picture.started_ns:
            self._fail("what was before a restart is forgotten, not null", state, at_ns)

    def _reasons(self, slot: Slot, right: CommittedState, picture: ShardPicture) -> tuple[str, ...]:
        if right.datum is not None:
            return ("",)
        if right.version:
            return (NullReason.DELETED.name,)
        if self._observed.is_volatile(slot) and picture.epoch > 1:
            # A restart may know that a slot exists whose only write came to nothing; a power cut
            # may take the record of a slot that was written.
            unknown = right is NEVER_SET or slot in picture.vanished
            return (NullReason.LOST.name, *([NullReason.NEVER_SET.name] if unknown else []))
        return (NullReason.NEVER_SET.name,)

    def check_forgotten(self, answer: Forgotten, asked: TakeView, picture: ShardPicture) -> None:
        """Only data that may be forgotten are, and data reported as known are known.

        A restart may know a slot from a prepared commit alone, whose data a power cut took: this
        picture lacks it, so the slot that the answer names counts as asked for.
        """
        slots = [slot for slot, _ in self._asked(asked.items, picture)]
        if answer.slot not in slots and any(_names(item, answer.slot) for item in asked.items):
            slots.append(answer.slot)
        latest_ns = max((self._since_ns(slot, picture) for slot in slots), default=0)
        leapt = self._observed.clocks_were_set  # what is retained may have grown old in one leap
        if not leapt and all(self._must_know(slot, asked.at_ns, picture) for slot in slots):
            self._fail("what is retained is not forgotten", answer, asked, latest_ns)
        if not (asked.at_ns < answer.oldest_ns and (leapt or answer.oldest_ns <= latest_ns)):
            self._fail("it is said since when all is known", answer, asked, latest_ns)
        self._observed.count("views of what is forgotten", 1)

    def _must_know(self, slot: Slot, at_ns: int, picture: ShardPicture) -> bool:
        kept = picture.labels_of(slot)
        return self._since_ns(slot, picture) <= at_ns or any(s.stamp_ns == at_ns for s in kept)

    def _since_ns(self, slot: Slot, picture: ShardPicture) -> int:
        """Return the stamp from which on a slot must be known."""
        volatile = self._observed.is_volatile(slot)
        line = picture.line(slot, volatile=volatile)
        held = line[-self._retentions[slot.aspect] :]
        if held and held[0].version > 1:
            return held[0].stamp_ns
        return picture.started_ns if volatile and picture.epoch > 1 else 0

    def _asked(self, items: Iterable[Item], picture: ShardPicture) -> Iterator[tuple[Slot, bool]]:
        """Yield the slots that items name or match, as far as the judge knows them."""
        for item in items:
            if item.context not in CONTEXTS:
                continue
            if not Access(item.access).each:
                yield Slot(*item[1:4]), False
                continue
            for slot in picture.columns.get((item.context, item.aspect), {}):
                if pattern_matches(item.entity, slot.entity):
                    yield slot, True

    # ---------------------------------------------------------------- lists

    def check_list(self, message: ListHistory, answer: Versions, picture: ShardPicture) -> None:
        """A list names every version that is retained or kept, oldest first, with its time."""
        told: dict[Slot, list[VersionEntry]] = {}
        for entry in answer.entries:
            told.setdefault(entry.state.slot, []).append(entry)
        for slot in picture.chains:
            if slot.context in message.contexts and slot.aspect in message.aspects:
                self._check_entries(slot, told.get(slot, []), picture)

    def _check_entries(self, slot: Slot, found: list[VersionEntry], picture: ShardPicture) -> None:
        line = picture.line(slot, volatile=self._observed.is_volatile(slot))
        held = line[-self._retentions[slot.aspect] :]
        kept = {state.version: state for state in picture.labels_of(slot)}
        names = [(e.state.version, e.state.stamp_ns) for e in found if e.state.version]
        first = held[0].version if held else 0
        early = [kept[version] for version in sorted(kept) if version < first]
        right = [state.name for state in (*early, *held)]
        if names != right:
            self._fail("a list names what is retained", slot, names, right)
        if {e.state.version for e in found if e.kept} != set(kept):
            self._fail("a list says what is kept", slot, found, kept)
        for entry, after in zip(found, [*found[1:], None], strict=False):
            last = after is None or after.state.version != entry.state.version + 1
            until_ns = 0 if after is None else after.state.stamp_ns
            if entry.until_ns != until_ns and not (last and after is not None):
                self._fail("a list says until when each was current", entry, until_ns)
        self._observed.count("replaced versions listed", max(0, len(names) - 1))

    # ---------------------------------------------------------------- labels

    def take_keep(self, host: ShardNode, message: KeepVersions, picture: ShardPicture) -> None:
        """A label keeps what it kept, and what was added, or nothing any more."""
        before = picture.labels.get(message.label, {})
        history = host.shard.state.slots.history
        now = set(history.labels.get(message.label, ()))
        if now == set(before):
            return
        if not message.versions:
            wrong = bool(now)
        else:
            wrong = now - set(before) - set(message.versions) != set() or not set(before) <= now
        if wrong:
            self._fail("a label keeps what was asked", message, before, now)
        picture.labels.pop(message.label, None)
        if now:
            picture.labels[message.label] = {key: self._state(key, picture) for key in now}
        picture.confirmed_labels.pop(message.label, None)
        self._observed.count("labels changed", 1)

    def _state(self, key: SlotVersion, picture: ShardPicture) -> CommittedState:
        line = picture.line(key.slot, volatile=self._observed.is_volatile(key.slot))
        for state in (*reversed(line), *picture.labels_of(key.slot)):
            if state.version == key.version:
                return state
        self._fail("only what was committed is kept", key)
        raise AssertionError(key)

    def check_kept(self, asked: KeepVersions, answer: Kept, picture: ShardPicture) -> None:
        """Versions that a shard keeps under a label survive; a further page promises none."""
        kept = picture.labels.get(asked.label)
        if asked.after == START and kept is not None and set(kept) == set(answer.versions):
            picture.confirmed_labels[asked.label] = None

    def booted(self, host: ShardNode, recovered: Recovered, picture: ShardPicture) -> None:
        """What a label keeps, and the disk has, is kept after a restart."""
        slots = host.shard.state.slots
        stamps = [record.stamp_ns for record in recovered.slots]
        stamps += [record.position.stamp_ns for record in recovered.outcomes]
        stamps += [record.position.stamp_ns for record in recovered.decisions]
        stamps += [record.stamp_ns for record in recovered.prepared]
        stamps += [record.at_ns for record in recovered.worlds]
        picture.started_ns = max(host.wall_ns, *stamps, 0)
        picture.promised.clear()
        found = {label: set(kept) for label, kept in slots.history.labels.items()}
        for label in picture.confirmed_labels:
            stored = {k for k in picture.labels[label] if not self._observed.is_volatile(k.slot)}
            if not stored <= found.get(label, set()):
                self._fail("what is kept survives", label, stored, found.get(label))
            self._observed.count("kept versions found after a restart", len(stored))
        for label in [label for label in picture.confirmed_labels if label not in found]:
            del picture.confirmed_labels[label]
        picture.labels = {
            label: {key: self._state(key, picture) for key in kept} for label, kept in found.items()
        }


def _names(item: Item, slot: Slot) -> bool:
    """Whether an item asks for a slot, by its name or by a pattern."""
    return (item.context, item.aspect) == (slot.context, slot.aspect) and (
        pattern_matches(item.entity, slot.entity)
    )
