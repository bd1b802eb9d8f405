"""The lock table: who must wait for whom, and in which order."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from enact_dist.core.protocol.datum import Column, LockId, Slot
from enact_dist.core.protocol.messages import Item
from enact_dist.core.state.lock_table import CONFLICTS, LockTable, Mode, join
from enact_dist.core.state.tenure import wants_of
from enact_dist.terms import Access

R, W, RE, WE = Access.READ, Access.WRITE, Access.READ_EACH, Access.WRITE_EACH


def lock(number: int) -> LockId:
    return LockId("s", number, 1)


def wants(*lines: tuple[Access, str]) -> dict:
    return wants_of([Item(access, "online", entity, "count") for access, entity in lines])


def taken(table: LockTable) -> list[int]:
    table.assert_invariants()
    return [claim.lock.lane for claim in table.take_ready()]


class TestReadersAndWriters:
    def test_readers_share_when_nobody_writes(self):
        """Adjacent readers are granted together."""
        table = LockTable()
        for number in (1, 2, 3):
            table.enqueue(lock(number), wants((R, "a")))

        assert taken(table) == [1, 2, 3]

    def test_writer_waits_until_the_last_reader_left(self):
        """A writer is granted when the last reader is gone, not before."""
        table = LockTable()
        for number in (1, 2):
            table.enqueue(lock(number), wants((R, "a")))
        assert taken(table) == [1, 2]
        table.enqueue(lock(3), wants((W, "a")))

        table.remove(lock(1))
        assert taken(table) == []
        table.remove(lock(2))
        assert taken(table) == [3]

    def test_reader_waits_behind_a_waiting_writer(self):
        """Nobody overtakes a conflicting earlier waiter, so writers do not starve."""
        table = LockTable()
        table.enqueue(lock(1), wants((R, "a")))
        assert taken(table) == [1]
        table.enqueue(lock(2), wants((W, "a")))
        table.enqueue(lock(3), wants((R, "a")))

        assert taken(table) == []
        table.remove(lock(1))
        assert taken(table) == [2]
        table.remove(lock(2))
        assert taken(table) == [3]

    def test_waiters_go_on_when_a_waiter_gives_up(self):
        """Readers that only a waiting writer kept out go when it leaves the queue."""
        table = LockTable()
        table.enqueue(lock(1), wants((R, "a")))
        assert taken(table) == [1]
        table.enqueue(lock(2), wants((W, "a")))
        table.enqueue(lock(3), wants((R, "a")))

        table.remove(lock(2))
        assert taken(table) == [3]

    def test_set_is_granted_at_once_or_not_at_all(self):
        """A wide claim holds nothing while it waits, and later narrow ones wait behind it."""
        table = LockTable()
        table.enqueue(lock(1), wants((W, "a")))
        assert taken(table) == [1]
        table.enqueue(lock(2), wants((W, "a"), (W, "b")))
        table.enqueue(lock(3), wants((W, "b")))

        assert taken(table) == []
        table.remove(lock(1))
        assert taken(table) == [2]

    def test_disjoint_claims_do_not_wait(self):
        """Locks on different slots pass each other."""
        table = LockTable()
        table.enqueue(lock(1), wants((W, "a")))
        table.enqueue(lock(2), wants((W, "b")))

        assert taken(table) == [1, 2]

    def test_opposite_order_does_not_deadlock(self):
        """Two claims on the same slots in opposite order go one after the other."""
        table = LockTable()
        table.enqueue(lock(1), wants((W, "a"), (W, "b")))
        table.enqueue(lock(2), wants((W, "b"), (W, "a")))

        assert taken(table) == [1]
        table.remove(lock(1))
        assert taken(table) == [2]


class TestPatterns:
    @pytest.mark.parametrize(
        ("first", "second", "together"),
        [
            ((RE, "tray/*"), (R, "a"), True),
            ((RE, "tray/*"), (RE, "tray/*"), True),
            ((RE, "tray/*"), (W, "tray/new"), False),
            ((WE, "tray/*"), (R, "tray/1"), False),
            ((WE, "tray/*"), (RE, "tray/*"), False),
            ((W, "tray/1"), (W, "tray/2"), True),
        ],
    )
    def test_pattern_and_slot_wait_for_each_other_when_they_conflict(self, first, second, together):
        """A pattern locks its column against newcomers; slots of one column stay independent."""
        for one, other in ((first, second), (second, first)):
            table = LockTable()
            table.enqueue(lock(1), wants(one))
            table.enqueue(lock(2), wants(other))

            assert taken(table) == ([1, 2] if together else [1])

    def test_reading_all_and_writing_some_is_one_mode(self):
        """A pattern read with a write in the same column lets nobody else write there."""
        both = wants((RE, "tray/*"), (W, "tray/1"))
        assert both[Column("online", "count")] is Mode.SIX
        table = LockTable()
        table.enqueue(lock(1), both)
        table.enqueue(lock(2), wants((R, "tray/2")))
        table.enqueue(lock(3), wants((W, "tray/3")))

        assert taken(table) == [1, 2]

    def test_views_lock_nothing(self):
        """A view takes no part in the table."""
        assert wants((Access.VIEW, "a"), (Access.VIEW_EACH, "**")) == {}

    def test_conflicts_are_mutual(self):
        """If one mode cannot stand beside another, neither can the other beside the one."""
        for one in Mode:
            for other in Mode:
                assert (one in CONFLICTS[other]) == (other in CONFLICTS[one])

    @given(st.lists(st.sampled_from(list(Mode)), min_size=1, max_size=4))
    def test_joined_mode_conflicts_with_all_that_its_parts_do(self, modes):
        """The mode of several uses of one resource protects each of them."""
        joined = None
        for mode in modes:
            joined = join(joined, mode)

        for mode in modes:
            assert set(CONFLICTS[mode]) <= set(CONFLICTS[joined])


class _Plain:
    """The laws as a scan: slow and obvious."""

    def __init__(self):
        self.queue = []
        self.held = {}

    def grant(self):
        granted, waiting = [], []
        for number, needs in self.queue:
            before = [*self.held.values(), *(w for _, w in waiting)]
            if any(_clash(needs, other) for other in before):
                waiting.append((number, needs))
            else:
                self.held[number] = needs
                granted.append(number)
        self.queue = waiting
        return granted


def _clash(some, others):
    return any(
        others.get(resource) in CONFLICTS[mode]
        for resource, mode in some.items()
        if resource in others
    )


LINE = st.tuples(st.sampled_from([R, W, RE, WE]), st.sampled_from(["a", "b", "c"]))
STEP = st.one_of(st.lists(LINE, min_size=1, max_size=3), st.integers(min_value=0, max_value=30))


@settings(max_examples=300, deadline=None)
@given(st.lists(STEP, max_size=40))
def test_table_grants_what_a_plain_scan_grants(steps):
    """Counters per claim and queues per mode decide exactly as a scan of one queue would."""
    table, plain = LockTable(), _Plain()
    for number, step in enumerate(steps):
        if isinstance(step, list):
            needs = wants(*step)
            table.enqueue(lock(number), needs)
            plain.queue.append((number, needs))
        else:
            table.remove(lock(step))
            plain.held.pop(step, None)
            plain.queue = [entry for entry in plain.queue if entry[0] != step]

        assert taken(table) == plain.grant()


def test_blockers_are_the_holder_and_earlier_conflicting_waiters():
    """People are told who is in the way: holders first, then those who came before."""
    table = LockTable()
    claims = [table.enqueue(lock(number), wants((W, "a"))) for number in range(4)]
    table.take_ready()

    found = table.blockers(claims[3], count_max=8)

    assert [claim.lock.lane for claim in found] == [0, 1, 2]
    assert table.place(claims[3]) == 3
    assert table.blockers(claims[0], count_max=8) == []


def test_table_is_empty_when_all_have_left():
    """Nothing is kept about resources that nobody uses."""
    table = LockTable()
    for number in range(10):
        table.enqueue(lock(number), wants((W, f"e{number % 3}"), (R, "shared")))
    for number in range(10):
        table.take_ready()
        table.remove(lock(number))

    assert not table.claims
    assert not table._queues
    assert Slot("online", "a", "count") not in table._queues
