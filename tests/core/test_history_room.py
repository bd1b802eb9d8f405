"""At the cap of shared memory: which history goes, in what order, and when none does."""

import pytest
from shard_bench import slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.parts import NO_LIMIT
from enact_dist.core.protocol.records import Content, SlotRecord
from enact_dist.core.state.history import HELD_BYTES_MAX, Policy
from enact_dist.core.state.retention import Limits
from enact_dist.core.state.slots import SlotMap
from enact_dist.terms import NullReason

MB = 1_000_000


def content(version, *, size=MB, file=True):
    name = f"s-{version:x}" if file else ""
    return Content(version, version * 10, Datum(b"e", bytes(1), size, 0, name), NullReason.DELETED)


@pytest.fixture
def slots():
    """A slot whose versions 1 to 5 are payloads, all retained; 6 is the newest."""
    return filled(range(1, 7), retention=10)


def filled(versions, *, retention):
    """Return slots that retain so many versions, after these."""
    policy = Policy(Limits(retention, NO_LIMIT, NO_LIMIT), stored=False)
    found = SlotMap((), policies={"frame": policy})
    for version in versions:
        found.replace(slot("cam", "frame"), content(version))
    return found


def kept(slots, name="cam"):
    return [old.version for old, until_ns in slots.versions(slot(name, "frame")) if until_ns]


@pytest.mark.parametrize(("size", "left"), [(1, 4), (MB, 4), (MB + 1, 3), (5 * MB, 0)])
def test_oldest_history_goes_and_no_more_than_needed(slots, size, left):
    """The newest version is no history."""
    gone, freed = slots.make_room(size)

    assert kept(slots) == [2, 3, 4, 5][4 - left :]
    assert (gone, freed) == (5 - left, (5 - left) * MB)
    assert slots[slot("cam", "frame")].version == 6
    slots.assert_invariants()


def test_history_that_would_not_do_stays(slots):
    """A write that is refused costs nobody anything."""
    assert slots.make_room(5 * MB + 1) == (0, 0)
    assert kept(slots) == [1, 2, 3, 4, 5]


def test_history_that_is_not_retained_makes_room_too():
    """What is kept for a moment to answer as of a stamp holds its payload as well."""
    slots = filled((1, 2, 3), retention=1)

    assert slots.make_room(2 * MB) == (2, 2 * MB)


def test_history_outside_shared_memory_counts_for_nothing(slots):
    """It goes by its age with the rest, and frees no file."""
    for version in (7, 8):
        slots.replace(slot("arm", "frame"), content(version, file=False))

    assert slots.history.bytes == MB
    assert slots.make_room(5 * MB) == (5, 5 * MB)
    assert kept(slots, "arm") == [7]


def test_payloads_cost_the_history_of_other_aspects_nothing():
    """A camera at the cap asks for room with each picture; what has no payloads could give none."""
    policy = Policy(Limits(10, NO_LIMIT, NO_LIMIT), stored=False)
    slots = SlotMap((), policies={"verdict": policy, "frame": policy})
    for version in range(1, 5):
        slots.replace(slot("cam", "verdict"), content(version, size=1, file=False))
    for version in range(5, 8):
        slots.replace(slot("cam", "frame"), content(version))

    assert slots.make_room(2 * MB) == (2, 2 * MB)

    replaced = [old.version for old, until_ns in slots.versions(slot("cam", "verdict")) if until_ns]
    assert replaced == [1, 2, 3]
    assert kept(slots) == []
    slots.assert_invariants()


def test_restart_drops_no_history_because_it_lies_in_files_now():
    """Payloads in shared memory had a cap of their own; mapped files take no memory either."""
    limits = Limits(10, NO_LIMIT, NO_LIMIT)
    rows = [
        SlotRecord(slot("cam", "frame"), version, version * 10, datum, "")
        for version in range(1, 7)
        for datum in [Datum(b"e", bytes(1), HELD_BYTES_MAX // 2, 0, fault=lambda: "")]
    ]
    slots = SlotMap(rows[-1:], policies={"frame": Policy(limits, stored=True)})

    slots.recover_history(rows[:-1], ())

    assert kept(slots) == [1, 2, 3, 4, 5]
    assert (slots.history.dropped, slots.history.take_forgotten()) == (0, ())
