"""Commits over several shards of this process that a participant may not show yet.

The primary announces the decision; the other shards apply it a moment later.  A process must see
its own commits, so its views of such a slot are never older than them.

Rule a change must keep: an answer about some slots is no answer about the others.  A shard shows
one slot as of now while a commit on another one still waits for its decision.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import Slot
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.messages import Item, SlotState

SLOTS_MAX: Final = 512
"""Slots of one shard tracked singly; beyond that, the newest stamp counts for all its slots."""


class Unsettled:
    """The stamps of commits that some shard may not show yet.

    Attributes:
        by_slot: By shard and slot.
        by_shard: Of all slots of a shard together, where they are too many.
    """

    __slots__ = ("by_shard", "by_slot")

    def __init__(self) -> None:
        self.by_slot: dict[str, dict[Slot, int]] = {}
        self.by_shard: dict[str, int] = {}

    def __bool__(self) -> bool:
        return bool(self.by_slot or self.by_shard)

    def __len__(self) -> int:
        return len(self.by_shard) + sum(map(len, self.by_slot.values()))

    def committed(self, shard: str, slots: Iterable[Slot], stamp_ns: int) -> None:
        """Note a commit.  Threads learn of their commits in any order."""
        known = self.by_slot.setdefault(shard, {})
        for slot in slots:
            known[slot] = max(known.get(slot, 0), stamp_ns)
        if len(known) > SLOTS_MAX:
            self.by_shard[shard] = self.stamp_ns(shard)
            del self.by_slot[shard]

    def shown(self, shard: str, states: Iterable[SlotState], *, until_ns: int = 0) -> None:
        """Note what a shard has shown: as it was at `until_ns`, or as its own stamps say."""
        known = self.by_slot.get(shard)
        if known is None:
            return
        for state in states:
            stamp_ns = known.get(state.slot)
            if stamp_ns is not None and stamp_ns <= max(until_ns, state.stamp_ns):
                del known[state.slot]
        if not known:
            del self.by_slot[shard]

    def reached(self, shard: str, stamp_ns: int) -> None:
        """Note that a shard shows all commits up to a stamp, on whatever slot."""
        known = self.by_slot.pop(shard, {})
        left = {slot: ns for slot, ns in known.items() if ns > stamp_ns}
        if left:
            self.by_slot[shard] = left
        if self.by_shard.get(shard, stamp_ns + 1) <= stamp_ns:
            del self.by_shard[shard]

    def stamp_ns(self, shard: str, items: Iterable[Item] | None = None) -> int:
        """Return the largest stamp that a shard may not show on these slots (None: any), or 0."""
        known, newest_ns = self.by_slot.get(shard, {}), self.by_shard.get(shard, 0)
        if items is None:
            return max(newest_ns, *known.values(), 0)
        for item in items if known else ():
            if Access(item.access).each:
                found = (ns for slot, ns in known.items() if _covers(item, slot))
                newest_ns = max(newest_ns, *found, 0)
            else:
                slot = Slot(item.context, item.entity, item.aspect)
                newest_ns = max(newest_ns, known.get(slot, 0))
        return newest_ns


def _covers(item: Item, slot: Slot) -> bool:
    same = (item.context, item.aspect) == (slot.context, slot.aspect)
    return same and pattern_matches(item.entity, slot.entity)
