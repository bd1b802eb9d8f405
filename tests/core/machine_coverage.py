"""How often each cell (state, event) was met: counted, asserted and printed.

A state machine that never gets anywhere finds nothing, and says so to nobody.  So each cell has to
be hit a number of times, and each cell that cannot be hit is listed with its reason and must not be.
"""

from __future__ import annotations

import os
from collections import Counter
from typing import TYPE_CHECKING

from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hypothesis.stateful import RuleBasedStateMachine

FULL_EXAMPLES = 500
"""Examples of the full amount, each of up to `STEPS` steps: `ENACT_MACHINE_EXAMPLES=500`."""
STEPS = 100
FULL_HITS = 50
"""Hits of each cell that the full amount must bring."""

ROUNDS_MORE = 60
ROUND_SHARE = 4
"""How often a cell that is rare gets another chance, with so many examples as this part."""


def examples(usual: int) -> int:
    """Return how many examples to run: what fits into CI, or what the environment asks for."""
    return int(os.environ.get("ENACT_MACHINE_EXAMPLES", "0")) or usual


def hits_wanted(count: int) -> int:
    """Return the hits that so many examples owe each cell: half their share, short of the full."""
    return FULL_HITS if count >= FULL_EXAMPLES else max(1, FULL_HITS * count // FULL_EXAMPLES // 2)


def settings_of(max_examples: int, **options: object) -> settings:
    """Return settings with fresh seeds, whatever the environment is."""
    return settings(
        max_examples=max_examples,
        stateful_step_count=STEPS,
        deadline=None,
        derandomize=False,
        print_blob=True,
        suppress_health_check=list(HealthCheck),
        **options,
    )


def run_and_cover(machine: type[RuleBasedStateMachine], count: int, *tables: Coverage) -> list[str]:
    """Run so many examples, and many times as many again while a cell is owed hits.

    Returns:
        What is wrong with the cells in the end: chance is given more time, never less to show.
    """
    wanted = hits_wanted(count)
    run_state_machine_as_test(machine, settings=settings_of(count))
    for _ in range(ROUNDS_MORE):
        if all(table.rarest >= wanted for table in tables):
            break
        if hasattr(machine, "owed"):
            machine.owed = [cell for table in tables for cell in table.owed(wanted)]
        run_state_machine_as_test(machine, settings=settings_of(count // ROUND_SHARE))
    return [problem for table in tables for problem in table.problems(wanted)]


class Coverage:
    """Counts of cells over all examples of one run.

    Args:
        states: The rows.
        events: The columns.
        unreachable: Cells that no run can meet, with the reason.
    """

    def __init__(
        self,
        states: Sequence[str],
        events: Sequence[str],
        unreachable: Mapping[tuple[str, str], str],
    ) -> None:
        self.states, self.events, self.unreachable = states, events, unreachable
        self.hits: Counter[tuple[str, str]] = Counter()
        self.tally: Counter[str] = Counter()

    def hit(self, state: str, event: str) -> None:
        """Note that an event has met a state."""
        self.hits[state, event] += 1

    def count_run(self, steps: int) -> None:
        """Note how long an example was: Hypothesis is free to stop early, and mostly does not."""
        self.tally["examples"] += 1
        self.tally["steps"] += steps
        self.tally["examples of all steps"] += steps >= STEPS - 2  # less the initial ones

    def problems(self, wanted: int) -> list[str]:
        """Return the cells that were met too seldom, and those that were met against reason."""
        unknown = self.hits.keys() - {(s, e) for s in self.states for e in self.events}
        found = [f"unknown cell {cell}" for cell in unknown]
        for state in self.states:
            for event in self.events:
                cell, hits = (state, event), self.hits[state, event]
                if cell in self.unreachable and hits:
                    found.append(f"{cell} was met {hits} times: {self.unreachable[cell]}")
                elif cell not in self.unreachable and hits < wanted:
                    found.append(f"{cell} was met {hits} times of {wanted}")
        return found

    def owed(self, wanted: int) -> list[tuple[str, str]]:
        """Return the cells that can be met and were met too seldom."""
        cells = [(state, event) for state in self.states for event in self.events]
        return [c for c in cells if c not in self.unreachable and self.hits[c] < wanted]

    @property
    def rarest(self) -> int:
        """The hits of the least met cell that can be met."""
        return min(
            self.hits[state, event]
            for state in self.states
            for event in self.events
            if (state, event) not in self.unreachable
        )

    def table(self) -> str:
        """Return the counts as text: one row per event, one column per state, `-` unreachable."""
        names = [state.replace(" ", "_") for state in self.states]
        first = max(map(len, self.events))
        widths = [max(6, len(name)) for name in names]
        head = " ".join(name.rjust(w) for name, w in zip(names, widths, strict=True))
        lines = [f"{'':{first}} {head}"]
        for event in self.events:
            cells = [
                "-" if (state, event) in self.unreachable else str(self.hits[state, event])
                for state in self.states
            ]
            row = " ".join(cell.rjust(w) for cell, w in zip(cells, widths, strict=True))
            lines.append(f"{event:{first}} {row}")
        tally = ", ".join(f"{name} {count}" for name, count in sorted(self.tally.items()))
        reachable = len(self.states) * len(self.events) - len(self.unreachable)
        lines.append(f"{tally}; {reachable} cells, rarest {self.rarest}")
        return "\n".join(lines)
