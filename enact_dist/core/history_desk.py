"""History at the shard's door: which versions are known, and which of them labels keep."""

from __future__ import annotations

from bisect import bisect_right
from typing import TYPE_CHECKING, Final

from enact_dist.core.admission import wrong_label, wrong_patterns
from enact_dist.core.messages import (
    START,
    Cursor,
    EpochChanged,
    KeepVersions,
    Kept,
    ListHistory,
    Refused,
)
from enact_dist.core.pages import VERSIONS_OF_A_LOOK, bytes_in_frame, over_slots, page_of
from enact_dist.core.records import KeptRecord, Persist, Reply, Story
from enact_dist.core.version_list import bytes_of, entries_of, version_of, versions
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.messages import Answer, SlotVersion, VersionEntry
    from enact_dist.core.prepares import PrepareDesk
    from enact_dist.core.records import Effect, MakeRoom, Record
    from enact_dist.core.session_desk import SessionDesk
    from enact_dist.core.shard_state import ShardState
    from enact_dist.core.slots import Content

KEPT_MAX: Final = 10_000
"""Most versions that labels pin at one shard: only removing a label releases them."""
KEPT_BYTES_MAX: Final = 256 << 20
"""Bytes of kept data at most, payloads left out, which have a cap of their own."""


class HistoryDesk:
    """Everything about replaced versions, but views of them."""

    def __init__(self, state: ShardState, sessions: SessionDesk, prepares: PrepareDesk) -> None:
        self._state = state
        self._sessions = sessions
        self._prepares = prepares

    # ---------------------------------------------------------------- listing

    def on_list_history(self, message: ListHistory, reply_to: int) -> Iterator[Effect]:
        """List the known versions of slots, oldest first, without their data."""
        slots = self._state.slots

        def listed(slot: Slot, _: Content, above: int) -> tuple[Iterable[VersionEntry], int]:
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
        undecided = [writes for _, writes in self._state.commits.undecided()]
        undecided += [record.writes for record in self._prepares.undecided()]
        changing = {write.slot for writes in undecided for write in writes}
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
            "no_room",
            f"{len(message.versions)} versions were to be kept as {message.label!r}; with them"
            f" {kept} would be kept here, now of {history.kept_bytes} bytes; at most {KEPT_MAX} of"
            f" {KEPT_BYTES_MAX} bytes can be; let go of labels that are not needed",
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
            yield Story("history.dropped", f"{gone} replaced versions of {size} bytes at the cap")

    def tidy(self) -> Iterator[Effect]:
        """Remove expired states, and tell the store unless a commit has done so."""
        history = self._state.slots.history
        history.grow_old(self._state.stamps.last_ns)
        forgotten = history.take_forgotten()
        if forgotten:
            yield Persist(0, forgotten, Durability.OS)
