"""A shard's history is that of a plain list of dicts, whatever is committed, forked, kept or lost.

`ENACT_MACHINE_EXAMPLES=500 python -m pytest -s tests/core/test_history_machine.py` runs the full
amount and prints how often each kind of step and of answer was met.
"""

from __future__ import annotations

from collections import Counter

import history_mutants
import pytest
from hypothesis import Phase, Verbosity
from hypothesis.stateful import run_state_machine_as_test
from machine_coverage import settings_of
from machine_history import ShardHistoryMachine
from time_runs import run_and_meet

from enact_dist.core.shard.shard import Shard

EXAMPLES, STEPS = 40, 80
EXAMPLES_OF_A_MUTANT = 3000
MET = (
    "commits",
    "commits over shards",
    "pauses",
    "forks",
    "forks of forks",
    "forks of the forgotten",
    "drops",
    "worlds made again",
    "keeps",
    "kept too late",
    "labels let go",
    "restarts",
    "died before the record",
    "died after the record",
    "travels",
    "travels by pattern",
    "travels to a null",
    "views that waited",
    "forgotten",
    "exact captures",
    "nearest captures",
    "explained too late",
    "effects",
)


def test_shard_agrees_with_a_list_of_dicts_about_the_past():
    """Listings, views as of any moment, captures, causes and effects, over crashes and restarts."""
    assert run_and_meet(ShardHistoryMachine, EXAMPLES, STEPS, MET) == []


@pytest.mark.sampled(6)
@pytest.mark.parametrize("mutant", history_mutants.ALL, ids=lambda mutant: mutant.__name__)
def test_machine_bites(mutant, monkeypatch):
    """With the shard's own assertions off, a small wrong edit is noticed within some examples."""
    tally = ShardHistoryMachine.tally = Counter()
    monkeypatch.setattr(Shard, "assert_invariants", lambda _shard: None)
    mutant(monkeypatch.setattr)
    quick = settings_of(
        EXAMPLES_OF_A_MUTANT, database=None, phases=[Phase.generate], verbosity=Verbosity.quiet
    )

    with pytest.raises(AssertionError):
        run_state_machine_as_test(ShardHistoryMachine, settings=quick)

    print(f"{mutant.__name__}: after {tally['commits']} commits")
