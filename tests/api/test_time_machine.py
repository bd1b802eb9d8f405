"""World contexts in time are what a plain list of dicts says, whatever is done to a durable cell.

`ENACT_MACHINE_EXAMPLES=500 python -m pytest -s tests/api/test_time_machine.py` runs the full amount
and prints how often each kind of step and of answer was met.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from machine_cell import CellMachine
from time_runs import run_and_meet

EXAMPLES, STEPS = 25, 60
MET = (
    "commits",
    "pauses",
    "forks",
    "forks of the past",
    "forks of forks",
    "forks of the forgotten",
    "drops",
    "worlds made again",
    "keeps",
    "kept too late",
    "labels let go",
    "restarts",
    "travels",
    "travels by pattern",
    "nulls",
    "forgotten",
    "exact captures",
    "nearest captures",
    "lists of some",
    "data of versions",
    "versions fetched too late",
    "diffs",
    "diffs with the past",
    "differences",
)


def test_cell_agrees_with_a_list_of_dicts_about_its_past():
    """Histories, travels, forks, diffs, kept versions and causes, over restarts."""
    assert run_and_meet(CellMachine, EXAMPLES, STEPS, MET) == []
