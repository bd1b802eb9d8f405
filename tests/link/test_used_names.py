"""Names of payloads that are over: of each session, in a few bytes."""

import gc
import sys

from hypothesis import given
from hypothesis import strategies as st

from enact_dist.link.memory.names import NUMBERS_MAX, SERIES_MAX, UsedNames

NAMES = st.builds("{}-{:x}".format, st.sampled_from(["ann", "bob"]), st.integers(0, 2**64 - 1))


@given(st.lists(NAMES, max_size=50), st.lists(NAMES, max_size=50))
def test_exactly_what_was_added_is_known_while_there_is_room(added, others):
    """In whichever order they come, and twice."""
    names = UsedNames()
    for name in [*added, *added[::-1]]:
        names.add(name)

    assert all(name in names for name in added)
    assert [name for name in others if name in names] == [n for n in others if n in added]


def test_busy_session_forgets_its_own_oldest_names_alone():
    """The newest half at least is known, and all that others have used."""
    names = UsedNames()
    names.add("bob-1")
    names.add("ann-1000000000000000")  # the first that it staged
    for number in range(3 * NUMBERS_MAX):
        names.add(f"ann-{number:x}")

    known = [number for number in range(3 * NUMBERS_MAX) if f"ann-{number:x}" in names]
    assert NUMBERS_MAX // 2 <= len(known) <= NUMBERS_MAX
    assert known == list(range(3 * NUMBERS_MAX))[-len(known) :]
    assert "bob-1" in names
    assert "ann-1000000000000000" in names


def test_rows_of_numbers_are_forgotten_by_their_age():
    """A client numbers each length in a row of its own: those of one lie far below the other's."""
    names = UsedNames()
    for number in range(NUMBERS_MAX):
        names.add(f"ann-{(1 << 20) + number:x}")
        names.add(f"ann-{(2 << 20) + number:x}")

    for row in (1 << 20, 2 << 20):
        latest = range(NUMBERS_MAX - NUMBERS_MAX // 4, NUMBERS_MAX)
        assert all(f"ann-{row + number:x}" in names for number in latest)


def test_session_that_has_used_no_name_for_longest_is_forgotten():
    """Clients come and go for as long as a shard runs."""
    names = UsedNames()
    for number in range(SERIES_MAX):
        names.add(f"s{number}-1")
    names.add("s0-2")
    names.add("new-1")

    assert "s1-1" not in names
    assert all(name in names for name in ("s0-1", "s0-2", "s2-1", "new-1"))


def test_name_takes_eight_bytes():
    """A shard under camera traffic uses a thousand names in a few seconds."""
    names = UsedNames()
    names.add("ann-0")
    gc.collect()
    before = sys.getallocatedblocks()
    for number in range(1, NUMBERS_MAX):
        names.add(f"ann-{number:x}")

    assert sys.getallocatedblocks() - before < 100
    assert sum(map(sys.getsizeof, names._numbers["ann", 0])) < 10 * NUMBERS_MAX
