"""Runs a state machine until every kind of step and of answer was met, or for long enough."""

from __future__ import annotations

import os
from collections import Counter
from typing import TYPE_CHECKING

from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hypothesis.stateful import RuleBasedStateMachine

ROUNDS_MAX = 40
"""So often the examples are run while something was not met: chance is given time, not less to do."""


def run_and_meet(
    machine: type[RuleBasedStateMachine], examples: int, steps: int, kinds: Sequence[str]
) -> list[str]:
    """Run examples with fresh seeds and print what was met; return the kinds that never were.

    Args:
        machine: Has a class attribute `tally`, which counts.
        examples: How many in a round, where `ENACT_MACHINE_EXAMPLES` does not say.
        steps: The most steps of an example.
        kinds: What `tally` has to count.
    """
    tally: Counter[str] = Counter()
    machine.tally = tally  # type: ignore[attr-defined]
    options = settings(
        max_examples=int(os.environ.get("ENACT_MACHINE_EXAMPLES", "0")) or examples,
        stateful_step_count=steps,
        deadline=None,
        derandomize=False,
        print_blob=True,
        suppress_health_check=list(HealthCheck),
    )
    for _ in range(ROUNDS_MAX):
        run_state_machine_as_test(machine, settings=options)
        if all(tally[kind] for kind in kinds):
            break
    print(f"\n{dict(tally)}")
    return [kind for kind in kinds if not tally[kind]]
