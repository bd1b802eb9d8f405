"""Versions as a shard lists them, for history and lineage: without data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import VersionEntry, Versions
from enact_dist.core.pages import page_of
from enact_dist.core.slots import state_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.pages import Step
    from enact_dist.core.shard_state import ShardState
    from enact_dist.core.slots import Content, SlotMap

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
