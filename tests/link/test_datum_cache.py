"""What a client keeps of the data that it has seen, up to a cap in bytes."""

import pytest

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.link.client.fetch import CACHED_BYTES_MIN, DatumCache

CUP, PLATE, TRAY = (Slot("online", entity, "image") for entity in ("cup", "plate", "tray"))
KNOWN = ("s0", 1)
BYTES_MAX = 4 * CACHED_BYTES_MIN


def datum(kilobytes):
    return Datum(b"b", bytes(kilobytes * CACHED_BYTES_MIN), kilobytes * CACHED_BYTES_MIN)


@pytest.fixture
def cache():
    """A cache of 4 KiB."""
    return DatumCache(BYTES_MAX)


def test_least_recently_used_goes_first(cache):
    """To ask for a datum is a use of it; what is asked of its version alone is none."""
    for slot in (CUP, PLATE, TRAY):
        cache.put(slot, *KNOWN, 1, datum(1))
    assert cache.get(CUP, *KNOWN, 1) is not None
    assert cache.version(PLATE, *KNOWN) == 1

    cache.put(Slot("online", "spoon", "image"), *KNOWN, 1, datum(2))

    assert [slot in cache for slot in (CUP, PLATE, TRAY)] == [True, False, True]


def test_as_many_go_as_have_to(cache):
    """One datum as large as the cap leaves no other; up to the cap all of them stay."""
    for slot in (CUP, PLATE):
        cache.put(slot, *KNOWN, 1, datum(2))
    assert CUP in cache

    cache.put(TRAY, *KNOWN, 1, datum(4))

    assert [slot in cache for slot in (CUP, PLATE, TRAY)] == [False, False, True]


def test_datum_larger_than_the_cap_is_not_kept_and_costs_no_other_its_place(cache):
    """Nor does one that is smaller than what is worth keeping."""
    cache.put(CUP, *KNOWN, 1, datum(4))
    for size in (BYTES_MAX + 1, CACHED_BYTES_MIN - 1):
        cache.put(PLATE, *KNOWN, 1, Datum(b"b", bytes(size), size))

    assert PLATE not in cache
    assert cache.get(CUP, *KNOWN, 1) is not None


def test_a_newer_version_counts_in_place_of_the_one_before(cache):
    """A slot that is read again and again takes no more room than its newest datum."""
    cache.put(CUP, *KNOWN, 1, datum(1))
    for version in range(1, 20):
        cache.put(PLATE, *KNOWN, version, datum(3))
    assert cache.get(CUP, *KNOWN, 1) is not None
    assert cache.version(PLATE, *KNOWN) == 19

    cache.put(PLATE, *KNOWN, 20, datum(1))  # and gives back what it needs no more
    cache.put(TRAY, *KNOWN, 1, datum(2))

    assert all(slot in cache for slot in (CUP, PLATE, TRAY))


def test_late_datum_of_an_older_version_changes_nothing(cache):
    """Neither what is known nor what it counts."""
    cache.put(PLATE, *KNOWN, 1, datum(1))
    cache.put(CUP, *KNOWN, 5, datum(1))
    cache.put(CUP, *KNOWN, 4, datum(4))

    assert cache.version(CUP, *KNOWN) == 5
    assert PLATE in cache


def test_datum_of_another_start_of_its_shard_is_another_one(cache):
    """Volatile versions begin anew there: an equal number says nothing."""
    cache.put(CUP, "s0", 1, 7, datum(3))

    assert cache.version(CUP, "s0", 2) == 0
    assert cache.get(CUP, "s0", 2, 7) is None
    cache.put(CUP, "s0", 2, 1, datum(2))  # takes the place of the one before
    cache.put(PLATE, "s0", 2, 1, datum(2))
    assert cache.version(CUP, "s0", 2) == 1
    assert PLATE in cache
