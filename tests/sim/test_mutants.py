"""The simulator bites: each small wrong edit of the core breaks a rule within a few seeds."""

from __future__ import annotations

import mutants
import pytest
from run_mutants import run_directed, simulate
from test_seeds import KNOWN_BAD


@pytest.mark.parametrize("mutant", mutants.ALL, ids=lambda mutant: mutant.__name__)
def test_mutant_fits_the_core(mutant):
    """What a run does not draw stands for what is there all the same."""
    with mutants.planted(mutant):
        pass


@pytest.mark.sampled(35)
@pytest.mark.parametrize("mutant", mutants.SIMULATED, ids=lambda mutant: mutant.__name__)
def test_mutant_is_caught(mutant):
    """With the shard's own assertions off, the judge notices the edit."""
    known = KNOWN_BAD.get(mutant.__name__)

    caught = simulate(mutant, first=() if known is None else (known,))

    print(f"{caught.name}: {caught.seeds} seeds: {caught.by}")
    assert caught.by, f"survived {caught.seeds} seeds: {mutant.__doc__}"


@pytest.mark.parametrize("mutant", mutants.DIRECTED, ids=lambda mutant: mutant.__name__)
def test_directed_test_catches_its_mutant(mutant):
    """Where the simulator does not get, a test of `tests/core` fails under the edit."""
    assert run_directed(mutant).by, f"{mutants.DIRECTED[mutant]} passes with: {mutant.__doc__}"


def test_every_mutant_of_the_design_is_in_the_list():
    """The names of the design's models and of the review's planted bugs all stand for one."""
    assert len(mutants.NAMED) == 26
    assert set(mutants.NAMED.values()) <= set(mutants.ALL)
    assert len(mutants.ALL) >= 24
    assert set(KNOWN_BAD) <= {mutant.__name__ for mutant in mutants.SIMULATED}
