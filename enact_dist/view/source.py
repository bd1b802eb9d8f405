"""Where the data come from: the cell, read by an observer, which takes no lock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from enact_dist.access.asking import answers_to, explained, in_parts
from enact_dist.access.snapshot import HeldView
from enact_dist.core.protocol.messages import Item, ListHistory, SlotVersion, Versions
from enact_dist.errors import ForgottenError, LeaseLostError
from enact_dist.recording.exact import Recorded
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.world.cell import Cell

TOGETHER_MAX: Final = 512
"""Most slots of one view."""

Histories = dict["Slot", list[tuple[int, int]]]
"""Version and stamp of every known version, oldest first, by slot."""


class FoundData(NamedTuple):
    """The data of one moment.

    Attributes:
        data: By slot; a datum that was null then has none.
        forgotten: Slots whose state of that moment has left its retention.
    """

    data: dict[Slot, Recorded]
    forgotten: tuple[Slot, ...]


class DataSource(Protocol):
    """A cell, or a recording of one."""

    def data_at(self, slots: Sequence[Slot], at_ns: int) -> FoundData:
        """Return data as of a moment."""

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return which versions of these slots are known."""


class CellSource:
    """A running cell.  Its session reads only; every view is one of the past, which waits for none.

    Args:
        cell: An observer's connection.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.session = cell.world(cell.worlds()[0]).session

    def data_at(self, slots: Sequence[Slot], at_ns: int) -> FoundData:
        """Return data as of a moment, over all shards.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        data: dict[Slot, Recorded] = {}
        forgotten: list[Slot] = []
        left = [*in_parts(slots, TOGETHER_MAX)]
        while left:
            some = left.pop()
            try:
                data |= self._viewed(some, at_ns)
            except ForgottenError:
                if len(some) == 1:
                    forgotten += some
                else:
                    left += in_parts(some, -(-len(some) // 2))
        return FoundData(data, tuple(sorted(forgotten)))

    def _viewed(self, slots: Sequence[Slot], at_ns: int) -> dict[Slot, Recorded]:
        items = [Item(int(Access.VIEW), *slot) for slot in slots]
        with HeldView(self.session, items, past_ns=at_ns) as view:
            data = view.fetch([one for one in view.states if not one.state.null_reason])
            return {
                state.slot: Recorded(
                    state.slot,
                    state.version,
                    state.stamp_ns,
                    shard,
                    0,
                    data.get(state.slot),
                    state.null_reason,
                )
                for shard, _, state in view.states
            }

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return which versions of these slots the shards still know.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        client = self.session.client
        wanted = set(slots)
        groups: dict[tuple[str, str, str], list[str]] = {}
        for slot in slots:
            place = (client.shard_of(slot.entity), slot.context, slot.aspect)
            groups.setdefault(place, []).append(slot.entity)
        calls = [
            (shard, ListHistory((context,), entities, (aspect,)))
            for (shard, context, aspect), each in groups.items()
            for entities in in_parts(each)
        ]
        found: Histories = {}
        for _, answer in answers_to(client, Versions, calls):
            for entry in answer.entries:
                state = entry.state
                if state.slot in wanted and state.version:
                    found.setdefault(state.slot, []).append((state.version, state.stamp_ns))
        return {slot: sorted(each, key=lambda one: one[1]) for slot, each in found.items()}

    def explained(self, versions: Iterable[tuple[Slot, int]]) -> dict[Slot, VersionEntry]:
        """Return size and writer of versions.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        asked = [SlotVersion(slot, version) for slot, version in versions]
        answers = explained(self.session.client, asked)
        return {entry.state.slot: entry for answer in answers for entry in answer.entries}


RETRIED: Final = (LeaseLostError,)
"""Errors of a view whose data were removed before they were fetched: view again."""
