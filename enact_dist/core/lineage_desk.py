"""Lineage at the shard's door: which data a version came from, and what came of a datum.

Both are looked up in the causes that hang on the known versions, so that lineage goes back as far
as the history does, and no further index is kept up to date by every commit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import Cursor, Explain, FindEffects, Refused
from enact_dist.core.pages import VERSIONS_OF_A_LOOK, over_slots
from enact_dist.core.records import Reply
from enact_dist.core.version_list import bytes_of, entries_of, version_of, versions

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.message_parts import Cause, VersionEntry
    from enact_dist.core.pages import Step
    from enact_dist.core.records import Effect
    from enact_dist.core.shard_state import ShardState
    from enact_dist.core.slots import Content

ASKED_MAX: Final = 4096
"""Versions or data that one question names."""


class LineageDesk:
    """Everything about why data are as they are."""

    def __init__(self, state: ShardState) -> None:
        self._state = state

    def on_explain(self, message: Explain, reply_to: int) -> Iterator[Effect]:
        """Return the asked versions with their causes; forgotten ones are left out."""
        if len(message.versions) > ASKED_MAX:
            yield Reply(reply_to, _too_many(len(message.versions)))
            return
        yield Reply(reply_to, versions(self._state, self._explained(message)))

    def _explained(self, message: Explain) -> Iterator[Step[VersionEntry]]:
        begin, slots = max(0, message.after.number), self._state.slots
        for number, (slot, version) in enumerate(message.versions[begin:], begin + 1):
            after = Cursor(self._state.epoch, number=number)
            one = slots.versions(slot, version=version or slots[slot].version)
            found = entries_of(slots, slot, one)
            entry = next(found, None)
            yield entry, bytes_of(entry) if entry is not None else 0, 1, after

    def on_find_effects(self, message: FindEffects, reply_to: int) -> Iterator[Effect]:
        """Return every known version whose cause names one of these data."""
        if len(message.reads) > ASKED_MAX:
            yield Reply(reply_to, _too_many(len(message.reads)))
            return
        yield Reply(reply_to, versions(self._state, self._effects(message)))

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
            if newest.stamp_ns < since_ns:
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


def _too_many(count: int) -> Refused:
    return Refused("value", f"{count} were asked about at once; at most {ASKED_MAX}")
