"""Run the simulator by hand: `python tests/sim/run.py --seed 17`, or `--first 0 --seconds 60`."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter

from simulated.scenario import Result, Scenario


def main() -> int:
    """Run seeds until the time is over or one fails; say what happened."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="run this seed only, and tell all about it")
    parser.add_argument("--first", type=int, default=0, help="first seed of a series")
    parser.add_argument("--count", type=int, default=1 << 62, help="how many seeds at most")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to go on")
    parser.add_argument("--keep-going", action="store_true", help="do not stop at a violation")
    parser.add_argument("--no-wire", action="store_true", help="leave the wire format out")
    options = parser.parse_args()
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
    took_s = time.perf_counter() - started_s
    for name, count in sorted(tally.items()):
        print(f"{count:>10,}  {name}")
    print(
        f"{seeds} seeds, {simulated_s:.0f} s simulated in {took_s:.1f} s,"
        f" {tally['commits'] / took_s:.0f} commits/s, {bad} with violations"
    )
    return 1 if bad else 0


def _tell(result: Result) -> None:
    print(f"seed {result.seed}: {result.violation}")
    if result.trace:
        print(result.trace)
    print(f"again: python tests/sim/run.py --seed {result.seed}")


if __name__ == "__main__":
    sys.exit(main())
