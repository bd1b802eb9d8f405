"""Which data travel with a notice: small or named ones, of the newest version, up to a limit."""

from __future__ import annotations

import pytest
from shard_bench import slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Notice, SlotChange
from enact_dist.core.protocol.records import Content
from enact_dist.core.shard.inspection import (
    NOTICE_BYTES_MAX,
    NOTICE_DATUM_BYTES_MAX,
    with_data,
)
from enact_dist.core.state.slots import SlotMap
from enact_dist.terms import NullReason

FULL = Datum(b"t", bytes(NOTICE_DATUM_BYTES_MAX - 1), NOTICE_DATUM_BYTES_MAX - 1)


def told(*data):
    """Return the slots after a commit, and its notice."""
    slots, changes = SlotMap(()), []
    for number, datum in enumerate(data):
        slots.set(slot(f"e{number}"), Content(3, 7, datum, NullReason.DELETED))
        changes.append(SlotChange(slot(f"e{number}"), 3, 7, datum is None))
    return slots, Notice("s0", 1, 1, tuple(changes))


@pytest.mark.parametrize(
    ("datum", "carried"),
    [
        (FULL, FULL),
        (Datum(b"tt", FULL.body, FULL.size), None),
        (Datum(b"t", b"mapped", 1 << 20, 5, "s-1"), Datum(b"t", b"", 1 << 20, 5, "s-1")),
        (Datum(b"t", b"", 1, fault=lambda: "damaged"), None),
        (None, None),
    ],
)
def test_small_and_named_data_travel(datum, carried):
    """One byte more than may travel, bytes of unknown state and nulls do not."""
    slots, notice = told(datum)
    (change,) = with_data(slots, notice).changes
    assert change == notice.changes[0]._replace(datum=carried)


def test_a_notice_carries_only_the_newest_version_and_so_many_bytes():
    """A slot that has moved on already is told of without its datum."""
    slots, notice = told(*[FULL] * 20)
    slots.set(slot("e0"), Content(4, 8, FULL, NullReason.DELETED))
    carried = [change.datum is not None for change in with_data(slots, notice).changes]
    count = NOTICE_BYTES_MAX // NOTICE_DATUM_BYTES_MAX
    assert carried == [False, *[True] * count, *[False] * (19 - count)]
