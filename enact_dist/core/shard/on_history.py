"""History and lineage at the shard's door: known versions, their labels, causes and effects.

Causes and effects are looked up in what hangs on the known versions, so that lineage goes back as
far as the history does, and no further index is kept up to date by every commit.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import wrong_label, wrong_patterns
from enact_dist.core.protocol.messages import (
    NO_ROOM,
    START,
    VALUE,
    Cursor,
    EpochChanged,
    Explain,
    FindEffects,
    KeepVersions,
    Kept,
    ListHistory,
    Refused,
    VersionEntry,
    Versions,
)
from enact_dist.core.protocol.pages import VERSIONS_OF_A_LOOK, bytes_in_frame, over_slots, page_of
from enact_dist.core.protocol.records import KeptRecord, LogEvent, Persist, Reply
from enact_dist.core.state.slots import state_of
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Answer, SlotVersion
    from enact_dist.core.protocol.pages import Step
    from enact_dist.core.protocol.parts import Cause, VersionEntry
    from enact_dist.core.protocol.records import Content, Effect, MakeRoom, Record
    from enact_dist.core.shard.on_prepare import PrepareHandler
    from enact_dist.core.shard.on_session import SessionHandler
    from enact_dist.core.shard.state import ShardState
    from enact_dist.core.state.slots import SlotMap

_SLOT_BYTES: Final = 48
"""A slot with its version and stamp in an answer, names left out."""
_ENTRY_BYTES: Final = 256
"""The rest of a version in an answer, with its cause, names left out."""


def entries_of(
    slots: SlotMap, slot: Slot, found: Iterable[tuple[Content, int]]
) -> Iterator[VersionEntry]:
    """Yield entries of versions of a slot, each with the stamp until which it was current."""
    history = slots.history.of(slot)
    kept = history.kept if history is not None else {}
    for content, until_ns in found:
        labels = tuple(sorted(kept[content.version].labels)) if content.version in kept else ()
        shown = state_of(slot, content, with_datum=False)
        yield VersionEntry(shown, until_ns, labels, content.cause)


def versions(state: ShardState, steps: Iterable[Step[VersionEntry]]) -> Versions:
    """Return one page of a listing of versions."""
    return Versions(state.epoch, state.stamp(), *page_of(steps))


def version_of(entry: VersionEntry) -> int:
    """Return which version of its slot an entry is."""
    return entry.state.version


def bytes_of(entry: VersionEntry) -> int:
    """Return at least how many bytes an entry takes in an answer."""
    cause = entry.cause
    slots, names = [entry.state.slot], list(entry.kept)
    if cause is not None:
        names += (cause.actor, cause.host, cause.lock.session)
        slots += [read.slot for read in cause.reads]
        slots += [written.slot for written in cause.writes]
    text = "".join([name for slot in slots for name in slot] + names)
    return _ENTRY_BYTES + _SLOT_BYTES * len(slots) + 3 * len(names) + len(text.encode())


ASKED_MAX: Final = 4096
"""Versions or data that one question names."""


class LineageHandler:
    """Everything about why data are as they are."""

    def __init__(self, state: ShardState) -> None:
        self._state = state

    def on_explain(self, message: Explain, reply_to: int) -> Iterator[Effect]:
        """Return the asked versions with their causes; forgotten ones are left out."""
        wrong = _too_many(len(message.versions))
        yield Reply(reply_to, wrong or versions(self._state, self._explained(message)))

    def _explained(self, message: Explain) -> Iterator[Step[VersionEntry]]:
        begin, slots = max(0, message.after.number), self._state.slots
        for number, (slot, version) in enumerate(message.versions[begin:], begin + 1):
            after = Cursor(self._state.epoch, number=number)
            if self._state.hides(slot):
                yield None, 0, 1, after
                continue
            one = slots.versions(slot, version=version or slots[slot].version)
            found = entries_of(slots, slot, one)
            entry = next(found, None)
            yield entry, bytes_of(entry) if entry is not None else 0, 1, after

    def on_find_effects(self, message: FindEffects, reply_to: int) -> Iterator[Effect]:
        """Return every known version whose cause names one of these data."""
        wrong = _too_many(len(message.reads))
        yield Reply(reply_to, wrong or versions(self._state, self._effects(message)))

    def _effects(self, message: FindEffects) -> Iterator[Step[VersionEntry]]:
        wanted = {(read.slot, read.stamp_ns) for read in message.reads}
        since_ns = min((stamp_ns for _, stamp_ns in wanted), default=0)
        known: dict[int, bool] = {}
        slots, looked = self._state.slots, 0

        def is_effect(cause: Cause | None) -> bool:
            # All that a commit has written shares its cause.
            nonlocal looked
            looked += 1
            if cause is None:
                return False
            found = known.get(id(cause))
            if found is None:
                looked += len(cause.reads)
                found = any((slot, stamp_ns) in wanted for slot, _, stamp_ns in cause.reads)
                known[id(cause)] = found
            return found

        def listed(slot: Slot, newest: Content, above: int) -> tuple[Iterable[VersionEntry], int]:
            nonlocal looked
            looked = 0
            if newest.stamp_ns < since_ns or self._state.hides(slot):
                return (), 0
            found = [
                (content, until_ns)
                for content, until_ns in slots.versions(slot)
                if content.version > above and is_effect(content.cause)
            ]
            return entries_of(slots, slot, found), looked // VERSIONS_OF_A_LOOK

        return over_slots(
            slots,
            None,
            message.after,
            listed,
            epoch=self._state.epoch,
            version_of=version_of,
            bytes_of=bytes_of,
        )


def _too_many(count: int) -> Refused | None:
    if count <= ASKED_MAX:
        return None
    return Refused(VALUE, f"{count} were asked about at once; at most {ASKED_MAX}")


KEPT_MAX: Final = 10_000
"""Most versions that labels pin at one shard: only removing a label releases them."""
KEPT_BYTES_MAX: Final = 256 << 20
"""Bytes of kept data at most, payloads left out, which have a cap of their own."""


class HistoryHandler:
    """Everything about replaced versions, but views of them."""

    def __init__(
        self, state: ShardState, sessions: SessionHandler, prepares: PrepareHandler
    ) -> None:
        self._state = state
        self._sessions = sessions
        self._prepares = prepares

    # ---------------------------------------------------------------- listing

    def on_list_history(self, message: ListHistory, reply_to: int) -> Iterator[Effect]:
        """List the known versions of slots, oldest first, without their data."""
        slots = self._state.slots

        def listed(slot: Slot, _: Content, above: int) -> tuple[Iterable[VersionEntry], int]:
            if self._state.hides(slot):
                return (), 1
            history = slots.history.of(slot)
            kept = history.kept if history is not None else {}
            found = [
                (content, until_ns)
                for content, until_ns in slots.versions(slot)
                if not 0 < until_ns <= message.since_ns
                and (not message.kept or content.version in kept)
            ]
            begin = max(0, len(found) - message.count_max) if message.count_max else 0
            if above:
                begin = max(begin, bisect_right(found, above, key=lambda each: each[0].version))
            return entries_of(slots, slot, found[begin:]), len(found) // VERSIONS_OF_A_LOOK

        steps = over_slots(
            slots,
            message,
            message.after,
            listed,
            epoch=self._state.epoch,
            version_of=version_of,
            bytes_of=bytes_of,
        )
        yield Reply(reply_to, wrong_patterns(message.patterns) or versions(self._state, steps))

    # ---------------------------------------------------------------- labels

    def on_keep_versions(self, message: KeepVersions, reply_to: int) -> Iterator[Effect]:
        """Pin versions under a label, or unpin all that it pins."""
        if message.after != START:
            yield Reply(reply_to, self._page(message.label, (), message.after))
            return
        answer = self._state.answered_before(message)
        records: tuple[Record, ...] = ()
        if answer is None:
            answer, records = self._kept(message)
            self._state.remember_answer(message, answer)
        yield from self._sessions.answer_when_durable(reply_to, answer, records)

    def _kept(self, message: KeepVersions) -> tuple[Answer, tuple[Record, ...]]:
        """Execute the request; return the answer and the records to store before it."""
        label, history = message.label, self._state.slots.history
        if self._state.sessions.known(message.session) is None:
            return EpochChanged(self._state.epoch), ()
        refusal = wrong_label(label) or self._too_much(message)
        if refusal is not None:
            return refusal, ()
        before = tuple(history.labels.get(label, ()))
        if not message.versions:
            history.let_go(label)
        forgotten = self._keep_each(label, message.versions)
        kept = tuple(history.labels.get(label, ()))
        if kept == before:
            return self._page(label, forgotten), ()
        return self._page(label, forgotten), (self._record(label), *history.take_forgotten())

    def _page(self, label: str, forgotten: tuple[SlotVersion, ...], after: Cursor = START) -> Kept:
        """Return what a label keeps beyond a cursor, as much of it as one answer may have."""
        before = after.names, after.version
        epoch, kept = self._state.epoch, self._state.slots.history.labels.get(label, ())
        steps = (
            (each, bytes_in_frame(each), 1, Cursor(epoch, tuple(each.slot), 0, each.version))
            for each in sorted(kept)
            if (tuple(each.slot), each.version) > before
        )
        versions, more = page_of(steps)
        return Kept(versions, forgotten, more)

    def _keep_each(self, label: str, versions: tuple[SlotVersion, ...]) -> tuple[SlotVersion, ...]:
        """Keep versions; return those that are forgotten, or are about to be."""
        changing = {write.slot for _, writes in self._prepares.undecided() for write in writes}
        slots, forgotten = self._state.slots, []
        for version in versions:
            going = version.slot in changing and self._is_going(version)
            if going or not slots.history.keep(label, version, slots[version.slot]):
                forgotten.append(version)
        return tuple(forgotten)

    def _record(self, label: str) -> KeptRecord:
        """Return what a restart must know of a label: nothing of what it would not find."""
        history = self._state.slots.history
        versions = history.labels.get(label, ())
        return KeptRecord(label, tuple(v for v in versions if history.is_stored(v.slot)))

    def _too_much(self, message: KeepVersions) -> Refused | None:
        """Refuse to keep more than there is room for."""
        history = self._state.slots.history
        kept = sum(map(len, history.labels.values())) + len(message.versions)
        if not message.versions or (kept <= KEPT_MAX and history.kept_bytes <= KEPT_BYTES_MAX):
            return None
        return Refused(
            NO_ROOM,
            f"{len(message.versions)} versions were to be kept as {message.label!r}; with them"
            f" {kept} would be kept here, now of {history.kept_bytes} bytes; at most {KEPT_MAX} of"
            f" {KEPT_BYTES_MAX} bytes can be; release labels that are not needed",
        )

    def _is_going(self, version: SlotVersion) -> bool:
        """Whether a commit under way on its slot replaces it, and the store does not keep it."""
        newest = self._state.slots[version.slot]
        if newest.version != version.version:
            return False
        history = self._state.slots.history
        return history.is_stored(version.slot) and not history.will_hold(version.slot, newest)

    # ---------------------------------------------------------------- what goes

    def on_make_room(self, message: MakeRoom, _: int) -> Iterator[Effect]:
        """Remove the oldest history at the limit of shared memory."""
        gone, size = self._state.slots.make_room(message.bytes)
        if gone:
            self._state.count("history_dropped", gone)
            yield LogEvent(
                "history.dropped", f"{gone} replaced versions of {size} bytes at the cap"
            )

    def tidy(self) -> Iterator[Effect]:
        """Remove expired states, and tell the store unless a commit has done so."""
        history = self._state.slots.history
        history.grow_old(self._state.stamps.last_ns)
        forgotten = history.take_forgotten()
        if forgotten:
            yield Persist(0, forgotten, Durability.OS)
