"""Naming the largest slots: right, and at the same cost beside any number of them."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from shard_bench import slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.records import Content
from enact_dist.core.state.slots import LARGE_BYTES, LOOKED_MAX, LargeSlots, SlotMap
from enact_dist.terms import NullReason

SIZES = st.integers(0, 8 * LARGE_BYTES) | st.sampled_from([0, LARGE_BYTES - 1, LARGE_BYTES])


@given(st.lists(st.tuples(st.sampled_from("abcdefgh"), SIZES), max_size=40))
def test_largest_are_those_of_all_slots(writes):
    """As they are now, whatever they were: grown, shrunk, deleted, dropped with their context."""
    slots, sizes = SlotMap(()), {}
    for version, (entity, size) in enumerate(writes, 1):
        datum = Datum(b"t", b"", size) if size else None
        slots.set(slot(entity), Content(version, version, datum, NullReason.DELETED))
        sizes[str(slot(entity))] = size
    large = sorted((size for size in sizes.values() if size >= LARGE_BYTES), reverse=True)

    named = slots.large.largest(3)

    assert [size for _, size in named] == large[:3]
    assert all(sizes[name] == size for name, size in named)
    slots.drop("online")
    assert slots.large.largest(3) == []


class Looked(dict):
    """Counts how many of its items are looked at."""

    count = 0

    def items(self):
        for item in super().items():
            Looked.count += 1
            yield item


def test_among_many_of_about_one_size_some_are_looked_at():
    """Ten thousand slots of 1 MB: three of them are named, and a thousand were looked at."""
    slots = LargeSlots()
    for number in range(10_000):
        slots.change(slot(f"e{number}"), before=0, after=(1 << 20) + number)
    slots._groups = {exponent: Looked(group) for exponent, group in slots._groups.items()}

    named = slots.largest(3)

    assert [size for _, size in named] == sorted((s for _, s in named), reverse=True)
    assert min(size for _, size in named) >= 1 << 20
    assert Looked.count == LOOKED_MAX
