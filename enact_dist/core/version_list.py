"""Versions as a shard lists them, for history and lineage: without data, and in bounded answers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import VersionEntry, Versions
from enact_dist.core.slots import state_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.shard_state import ShardState
    from enact_dist.core.slots import SlotMap

NAMED_MAX: Final = 50_000
"""Versions, and data that their causes name, in one answer; further ones are only counted."""


def entries_of(slots: SlotMap, slot: Slot) -> Iterator[VersionEntry]:
    """Yield all known versions of a slot, oldest first."""
    history = slots.history.of(slot)
    kept = history.kept if history is not None else {}
    for content, until_ns in slots.versions(slot):
        labels = tuple(sorted(kept[content.version].labels)) if content.version in kept else ()
        shown = state_of(slot, content, with_datum=False)
        yield VersionEntry(shown, until_ns, labels, content.cause)


def bounded(state: ShardState, found: Iterable[VersionEntry]) -> Versions:
    """Return an answer with these entries, as far as there is room for them."""
    entries: list[VersionEntry] = []
    named = left_out = 0
    for entry in found:
        cause = entry.cause
        named += 1 + (len(cause.reads) + len(cause.writes) if cause is not None else 0)
        if named <= NAMED_MAX:
            entries.append(entry)
        else:
            left_out += 1
    return Versions(state.epoch, state.stamp(), tuple(entries), left_out)
