"""The lock table does what its definition says, whatever is asked of it in whatever order."""

from __future__ import annotations

import machine_table
import pytest
from hypothesis import Phase, Verbosity
from hypothesis.stateful import run_state_machine_as_test
from machine_coverage import Coverage, examples, run_and_cover, settings_of
from machine_table import ACTS, CLAIMS, NEWCOMERS, THERE, UNREACHABLE, TableMachine

from enact_dist.core.state import lock_table, tenure
from enact_dist.core.state.lock_table import CONFLICTS, Mode

EXAMPLES = 150


def fresh_coverage() -> tuple[Coverage, Coverage]:
    """Count anew."""
    TableMachine.meetings = Coverage(NEWCOMERS, THERE, {})
    TableMachine.claims = Coverage(CLAIMS, ACTS, UNREACHABLE)
    return TableMachine.meetings, TableMachine.claims


def test_table_agrees_with_the_definition_step_by_step():
    """The same holders, queue and blockers as sets and one list; every cell is met."""
    meetings, claims = fresh_coverage()

    problems = run_and_cover(TableMachine, examples(EXAMPLES), meetings, claims)

    print(f"\n{meetings.table()}\n\n{claims.table()}")
    assert not problems


def barges(patch):
    """A newcomer passes waiters that conflict with it."""
    wrong = lambda q, mode: not any(q.held_modes[other] for other in CONFLICTS[mode])  # noqa: E731
    patch(lock_table._Queue, "admits", wrong)


def wakes_out_of_order(patch):
    """A release wakes whoever agrees with the holders, earlier waiters or not."""
    patch(lock_table._Queue, "_first_conflicting_ticket", lambda _q, _mode: 1 << 62)


def forgets_to_wake(patch):
    """A release does not look for who may go on."""
    patch(lock_table._Queue, "newly_eligible", lambda _queue: [])


def intentions_do_not_conflict(patch):
    """A pattern that reads a column stands beside writers of its slots."""
    wrong = list(CONFLICTS)
    wrong[Mode.IX] = (Mode.SIX, Mode.X)
    patch(lock_table, "CONFLICTS", tuple(wrong))


def mixed_mode_is_forgotten(patch):
    """Reading a column and writing one slot of it counts as reading."""
    join = lock_table.join
    wrong = lambda one, other: Mode.S if join(one, other) is Mode.SIX else join(one, other)  # noqa: E731
    patch(tenure, "join", wrong)


def readers_wait_for_readers(patch):
    """Readers of one slot go one after the other."""
    wrong = list(CONFLICTS)
    wrong[Mode.S] = (*CONFLICTS[Mode.S], Mode.S)
    patch(lock_table, "CONFLICTS", tuple(wrong))


def limit_is_one_too_far(patch):
    """Of two waiters the later one goes first, once."""
    limit = lock_table._Queue._first_conflicting_ticket
    patch(lock_table._Queue, "_first_conflicting_ticket", lambda q, mode: limit(q, mode) + 1)


def first_of_a_mode_only(patch):
    """A release wakes one waiter of each mode, not all who may go on."""
    newly_eligible = lock_table._Queue.newly_eligible

    def wrong(queue):
        found = newly_eligible(queue)
        for claim in found[1:]:
            mode = next(m for m in Mode if claim.lock in queue.waiting[m])
            queue.pending[mode][claim.lock] = claim
        return found[:1]

    patch(lock_table._Queue, "newly_eligible", wrong)


MUTANTS = (
    barges,
    wakes_out_of_order,
    forgets_to_wake,
    intentions_do_not_conflict,
    mixed_mode_is_forgotten,
    readers_wait_for_readers,
    limit_is_one_too_far,
    first_of_a_mode_only,
)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_machine_bites(mutant, monkeypatch):
    """With the table's own assertions off, a small wrong edit is noticed within some examples."""
    fresh_coverage()
    monkeypatch.setattr(machine_table.TableMachine, "own_assertions", False)
    mutant(monkeypatch.setattr)
    quick = settings_of(1500, database=None, phases=[Phase.generate], verbosity=Verbosity.quiet)

    with pytest.raises((AssertionError, KeyError)):
        run_state_machine_as_test(TableMachine, settings=quick)
