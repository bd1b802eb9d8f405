"""The shard does what its definition says, whatever comes in whatever order, whenever it dies.

`ENACT_MACHINE_EXAMPLES=500 python -m pytest -s tests/core/test_shard_machine.py` runs the full amount
and prints how often each event has met each state.  A failure prints its shortest example; the
decorator that it names, put above `ShardMachine`, runs that example again.
"""

from __future__ import annotations

import machine_mutants
import pytest
from hypothesis import Phase, Verbosity
from hypothesis.stateful import run_state_machine_as_test
from machine_cells import EVENTS, STATES, UNREACHABLE
from machine_coverage import Coverage, examples, run_and_cover, settings_of
from machine_shard import ShardMachine

from enact_dist.core.shard.shard import Shard

EXAMPLES = 100
EXAMPLES_OF_A_MUTANT = 3000
"""Most bite within 20; an acknowledgement of nothing took 81 once.  The first bite is the last."""
COUNTED = (
    "messages again",
    "messages late",
    "writes lost",
    "by stamp: newest",
    "by stamp: replaced",
    "by stamp: outside retention",
    "by stamp: as of the past",
    "far grants recalled",
)


def test_shard_agrees_with_the_definition_step_by_step():
    """Answers, locks, versions, outcomes, leases and records; every reachable cell is met."""
    coverage = ShardMachine.coverage = Coverage(STATES, EVENTS, UNREACHABLE)
    ShardMachine.owed = []

    problems = run_and_cover(ShardMachine, examples(EXAMPLES), coverage)

    print(f"\n{coverage.table()}")
    assert not problems
    for kind in COUNTED:
        assert coverage.tally[kind] > 0


@pytest.mark.sampled(10)
@pytest.mark.parametrize("mutant", machine_mutants.ALL, ids=lambda mutant: mutant.__name__)
def test_machine_bites(mutant, monkeypatch):
    """With the shard's own assertions off, a small wrong edit is noticed within some examples."""
    coverage = ShardMachine.coverage = Coverage(STATES, EVENTS, UNREACHABLE)
    ShardMachine.owed = []
    monkeypatch.setattr(Shard, "assert_invariants", lambda _shard: None)
    mutant(monkeypatch.setattr)
    quick = settings_of(
        EXAMPLES_OF_A_MUTANT, database=None, phases=[Phase.generate], verbosity=Verbosity.quiet
    )

    with pytest.raises(AssertionError) as caught:
        run_state_machine_as_test(ShardMachine, settings=quick)

    how = str(caught.value).splitlines()[0]
    print(f"{mutant.__name__}: {coverage.tally['examples']} examples: {how}")
