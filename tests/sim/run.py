"""Run the simulator by hand.

`python tests/sim/run.py --seed 17` runs one seed again, `--first 0 --seconds 60` a series,
`--mutants` every wrong edit of the core until it is caught.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

import mutants

from enact_dist.verify.simulation.scenario import Result, Scenario


def main() -> int:
    """Run seeds until the time is over or one fails; say what happened."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="run this seed only, and tell all about it")
    parser.add_argument("--first", type=int, default=0, help="first seed of a series")
    parser.add_argument("--count", type=int, default=1 << 62, help="how many seeds at most")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to go on")
    parser.add_argument("--keep-going", action="store_true", help="do not stop at a violation")
    parser.add_argument("--no-wire", action="store_true", help="leave the wire format out")
    parser.add_argument("--mutants", action="store_true", help="show what catches wrong edits")
    options = parser.parse_args()
    if options.mutants:
        return _mutants()
    if options.seed is not None:
        options.first, options.count = options.seed, 1
    return _series(options)


def _series(options: argparse.Namespace) -> int:
    started_s, tally, bad = time.perf_counter(), Counter[str](), 0
    seeds, simulated_s = 0, 0.0
    for seed in range(options.first, options.first + options.count):
        result = Scenario(seed, through_wire=not options.no_wire).run()
        seeds, simulated_s = seeds + 1, simulated_s + result.simulated_s
        tally += result.tally
        if result.violation:
            bad += 1
            _tell(result)
            if not options.keep_going:
                break
        if time.perf_counter() - started_s > options.seconds:
            break
    took_s, cpu_s = time.perf_counter() - started_s, time.process_time()
    for name, count in sorted(tally.items()):
        print(f"{count:>10,}  {name}")
    print(
        f"{seeds} seeds, {simulated_s:.0f} s simulated in {took_s:.1f} s,"
        f" {tally['commits']} commits, {tally['commits'] / cpu_s:.0f} per second of one core,"
        f" {bad} with violations"
    )
    return 1 if bad else 0


def _mutants(seeds: int = 600) -> int:
    """Run each wrong edit until it is caught; print the table of the README."""
    survived = 0
    print("| wrong edit | seeds | caught by |\n|---|---|---|")
    for mutant in mutants.ALL:
        undo: list[tuple[object, str, object]] = []

        def patch(owner: object, name: str, value: object, undo: list = undo) -> None:
            undo.append((owner, name, vars(owner)[name]))
            setattr(owner, name, value)

        mutant(patch)
        rule, seed = "", 0
        while not rule and seed < seeds:
            violation = Scenario(seed, through_wire=False, asserts=False).run().violation
            rule, seed = violation.partition(" broken at ")[0].partition(" at ")[0], seed + 1
        for owner, name, value in reversed(undo):
            setattr(owner, name, value)
        survived += not rule
        print(f"| {mutant.__doc__} | {seed if rule else 'survived'} | {rule} |", flush=True)
    print(f"\n{len(mutants.ALL) - survived} of {len(mutants.ALL)} caught")
    return 1 if survived else 0


def _tell(result: Result) -> None:
    print(f"seed {result.seed}: {result.violation}")
    if result.trace:
        print(result.trace)
    print(f"again: python tests/sim/run.py --seed {result.seed}")


if __name__ == "__main__":
    sys.exit(main())
