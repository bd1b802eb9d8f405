"""Lineage at the shard's door: which data a version came from, and what came of a datum.

Both are looked up in the causes that hang on the known versions, so that lineage goes back as far
as the history does, and no further index is kept up to date by every commit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import Explain, FindEffects, Refused
from enact_dist.core.records import Reply
from enact_dist.core.version_list import bounded, entries_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.message_parts import Cause, VersionEntry
    from enact_dist.core.records import Effect
    from enact_dist.core.shard_state import ShardState

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
        yield Reply(reply_to, bounded(self._state, self._explained(message)))

    def _explained(self, message: Explain) -> Iterator[VersionEntry]:
        for slot, version in message.versions:
            slots = self._state.slots
            yield from entries_of(slots, slot, version=version or slots[slot].version)

    def on_find_effects(self, message: FindEffects, reply_to: int) -> Iterator[Effect]:
        """Return every known version whose cause names one of these data."""
        if len(message.reads) > ASKED_MAX:
            yield Reply(reply_to, _too_many(len(message.reads)))
            return
        yield Reply(reply_to, bounded(self._state, self._effects(message)))

    def _effects(self, message: FindEffects) -> Iterator[VersionEntry]:
        wanted = {(read.slot, read.stamp_ns) for read in message.reads}
        since_ns = min((stamp_ns for _, stamp_ns in wanted), default=0)
        known: dict[int, bool] = {}

        def is_effect(cause: Cause | None) -> bool:
            # All that a commit has written shares its cause.
            if cause is None:
                return False
            found = known.get(id(cause))
            if found is None:
                found = any((slot, stamp_ns) in wanted for slot, _, stamp_ns in cause.reads)
                known[id(cause)] = found
            return found

        slots = self._state.slots
        for slot in slots.all():
            if slots[slot].stamp_ns >= since_ns and any(
                is_effect(content.cause) for content, _ in slots.versions(slot)
            ):
                yield from (entry for entry in entries_of(slots, slot) if is_effect(entry.cause))


def _too_many(count: int) -> Refused:
    return Refused("value", f"{count} were asked about at once; at most {ASKED_MAX}")
