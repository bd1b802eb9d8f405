"""What went into a commit: the data that its lock read, for their lineage (`Cell.why`).

===================  ==========================================================================
request              counts as read
===================  ==========================================================================
`Read`, `View`       always, null too: the lock was asked for because of it
`ReadEach`,          the data that the block looked at; all that were there, where it looked at
`ViewEach`           the mapping alone, as `keys()` and `len` do
`Write`,             the replaced data that the block looked at; one that is null, or that it
`WriteEach`          overwrites unseen, has no part in the new one
===================  ==========================================================================
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.message_parts import READS_MAX
from enact_dist.reading import slot_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.core.datum import Slot
    from enact_dist.core.messages import DatumRead
    from enact_dist.reading import EachData, Readings
    from enact_dist.terms import LockRequest


def reads_of(
    readings: Readings,
    requests: Iterable[LockRequest[Any]],
    each: Mapping[LockRequest[Any], EachData[Any]],
) -> tuple[tuple[DatumRead, ...], int]:
    """Return what a lock has read, and how many further data a commit does not name.

    Where there are too many, those that were named one by one go first, then what was looked at.

    Args:
        readings: What it was shown, and what of it was looked at.
        requests: What it asked for.
        each: The mappings of its patterns that were used.
    """
    looked_at = readings.looked_at
    slots: dict[Slot, None] = {}
    for request in requests:
        access = request.access
        if not (access.writes or access.each):
            slots[slot_of(request)] = None
    slots.update(dict.fromkeys(looked_at))
    for request, data in each.items():
        if not request.access.writes:
            shown = data.slots()
            if looked_at.keys().isdisjoint(shown):
                slots.update(dict.fromkeys(shown))
    reads = readings.versions(slots)
    return reads[:READS_MAX], max(0, len(reads) - READS_MAX)
