"""Which outcomes a store forgets: those of sessions that ended a day ago, whatever else ended."""

import tracemalloc

from enact_dist.core.protocol.datum import LockId
from enact_dist.link.store.rows import RowKind, key_of
from enact_dist.link.store.states import OUTCOMES_KEPT_NS, Outcomes

DAY_NS = OUTCOMES_KEPT_NS


def test_outcomes_of_sessions_that_ended_a_day_ago_are_forgotten_once():
    """The oldest first, with the rows of all their lanes; those of others stay."""
    outcomes = Outcomes([LockId("a", 3, 1), LockId("b", 0, 1)], {"b": 20, "a": 10, "c": 30})
    outcomes.came_back("c")
    outcomes.ended("c", DAY_NS)

    gone = list(outcomes.expired(DAY_NS + 20))

    a, b = (key_of(RowKind.ENDED, session) for session in "ab")
    lanes = [key_of(RowKind.OUTCOME, *lane) for lane in (("a", 3), ("b", 0))]
    assert gone == [a, lanes[0], b, lanes[1]]
    assert list(outcomes.expired(DAY_NS + 20)) == []
    assert list(outcomes.expired(2 * DAY_NS)) == [key_of(RowKind.ENDED, "c")]


def test_end_of_a_session_costs_the_same_however_many_ended_today():
    """A copy of all of them for each one kept every thread waiting for a millisecond."""
    outcomes = Outcomes((), {f"session {index}": index for index in range(20_000)})

    tracemalloc.start()
    try:
        gone = [key for _ in range(3) for key in outcomes.expired(DAY_NS - 1)]
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert gone == []
    assert peak_bytes < 20_000
