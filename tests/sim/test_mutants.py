"""The simulator bites: each small wrong edit of the core breaks a rule within a few seeds."""

from __future__ import annotations

import mutants
import pytest

from enact_dist.verify.simulation.scenario import Scenario

SEEDS = 600
"""A mutant that survives so many seeds counts as not caught."""


@pytest.mark.parametrize("mutant", mutants.ALL, ids=lambda mutant: mutant.__name__)
def test_mutant_is_caught(mutant, monkeypatch):
    """With the shard's own assertions off, the judge notices the edit."""
    mutant(monkeypatch.setattr)

    for seed in range(SEEDS):
        result = Scenario(seed, through_wire=False, asserts=False).run()
        if result.violation:
            print(f"{mutant.__name__}: seed {seed}: {result.violation.splitlines()[0]}")
            return

    pytest.fail(f"survived {SEEDS} seeds: {mutant.__doc__}", pytrace=False)
