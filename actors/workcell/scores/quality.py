"""The quality figures of the workcell: scenarios of several seeds, each in simulated time, scored.

    python -m actors.workcell.scores.quality --seeds 10 --processes 2

plays each scenario with each seed, with an oracle and a fixed zone beside it, and scores all runs
together.  The same arguments give the same figures (but planning times), on any machine.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TYPE_CHECKING, Final

from actors.workcell.scenarios import SCENARIOS, scenario_of
from actors.workcell.scores.closed_loop import ClosedLoop
from actors.workcell.scores.evaluation import beside, in_order, missed, samples_of, scores_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from actors.workcell.scores.evaluation import Samples

SECONDS: Final = 12.0
"""How long each run is: long enough for a person to come in, reach over the table, and go."""
SEEDS: Final = 10
PROCESSES: Final = 2


@dataclass(frozen=True, slots=True)
class Case:
    """One run: scenario, seed, seconds."""

    scenario: str
    seed: int
    seconds: float


def samples_of_case(case: Case) -> Samples:
    """Play a case and return what its scores are made of."""
    scenario = scenario_of(case.scenario, case.seed, case.seconds)
    return samples_of(ClosedLoop(scenario).run()) | beside(scenario)


def played(cases: Sequence[Case], processes: int) -> Iterator[tuple[Case, Samples]]:
    """Yield the samples of cases as they are done, in this process or in several."""
    if processes < 2:
        for case in cases:
            yield case, samples_of_case(case)
        return
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(samples_of_case, case): case for case in cases}
        for done in as_completed(waiting):
            yield waiting[done], done.result()


def quality(
    scenarios: Sequence[str],
    seeds: Sequence[int],
    *,
    seconds: float = SECONDS,
    processes: int = PROCESSES,
    told: Callable[[str], None] = lambda _: None,
) -> dict[str, dict[str, float]]:
    """Return the scores of each scenario over all seeds, and of all together as `all`.

    Raises:
        ConfigError: There is no scenario of a name.
    """
    cases = [Case(name, seed, seconds) for seed, name in itertools.product(seeds, scenarios)]
    for case in cases:
        scenario_of(case.scenario, case.seed, case.seconds)  # refuses what does not exist
    found: dict[Case, Samples] = {}
    for case, samples in played(cases, processes):
        found[case] = samples
        told(f"{case.scenario}, seed {case.seed}: {len(found)} of {len(cases)}")
    ordered = [found[case] for case in cases]
    of_each = {
        name: in_order(scores_of([found[case] for case in cases if case.scenario == name]))
        for name in scenarios
    }
    return {"all": in_order(scores_of(ordered)), **of_each}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the scores as JSON; return 0, or 1 where a goal of all runs together is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenarios", nargs="+", default=SCENARIOS[1:], metavar="NAME")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="seeds 1 to N of each")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each run")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    options = parser.parse_args(argv)
    scores = quality(
        options.scenarios,
        range(1, options.seeds + 1),
        seconds=options.seconds,
        processes=options.processes,
        told=lambda text: print(text, file=sys.stderr),
    )
    print(json.dumps({"scores": scores, "missed": missed(scores["all"])}, indent=2))
    return int(bool(missed(scores["all"])))


if __name__ == "__main__":
    sys.exit(main())
