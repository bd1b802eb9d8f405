"""Each scenario holds what it must, on its truth: the whole cell, tick by tick on a manual clock.

``ENACT_SCENARIO_SEED=7`` plays another seed.  What only processes can show (a killed shard, Ctrl-C)
is in `test_demo_faults`.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, NamedTuple

import pytest

from actors.workcell.evaluation import score
from actors.workcell.scenario_checks import checks_of

from .stepped import stepped

if TYPE_CHECKING:

    from .stepped import Stepped

SEED = int(os.environ.get("ENACT_SCENARIO_SEED", "1"))
RESTART_S = 0.8
"""So long an actor that was killed is away."""


class Part(NamedTuple):
    """Which part of a scenario is played: all that decides, and little more.

    Attributes:
        seconds: How long the scenario lasts.
        begin_s: Where the part begins; nobody is in the workspace.
        end_s: Where it ends.
    """

    seconds: float
    begin_s: float
    end_s: float


PARTS = {
    "S1": Part(3.0, 0.0, 3.0),
    "S2": Part(16.0, 1.4, 7.4),
    "S3": Part(20.0, 1.2, 6.0),
    "S4": Part(8.0, 1.2, 6.4),
    "S5": Part(30.0, 1.2, 6.6),
    "S6": Part(20.0, 4.5, 11.5),
    "S7": Part(6.0, 0.0, 6.0),
    "S8": Part(6.0, 0.0, 6.0),
    "S10": Part(6.0, 1.4, 6.0),
    "S11": Part(20.0, 1.4, 5.0),
}


def played(monkeypatch: pytest.MonkeyPatch, name: str) -> tuple[Stepped, dict[str, bool]]:
    """Play the part of a scenario and return the cell and what held."""
    part = PARTS[name]
    with stepped(monkeypatch, name, seed=SEED, seconds=part.seconds, begin_s=part.begin_s) as cell:
        cell.until(part.end_s, before=lambda: cell.break_as_planned(RESTART_S))
        trace = cell.trace()
        return cell, checks_of(trace, score(trace, every=5))


@pytest.mark.parametrize("name", PARTS)
def test_a_scenario_holds_what_it_must(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    _, held = played(monkeypatch, name)

    assert len(held) > 1
    assert [what for what, right in held.items() if not right] == []
