"""Plant each wrong edit of the core in turn and show what catches it: the table of enact_dist/docs/proof.md.

`python tests/sim/run_mutants.py` runs all of them, `… no_fence barges` some.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import mutants

from enact_dist.verify.simulation.scenario import Scenario

if TYPE_CHECKING:
    from collections.abc import Iterable

SEEDS = 2000
"""A mutant that survives so many seeds counts as not caught."""
MISFITS = {"TypeError", "AttributeError", "NameError", "KeyError"}
"""What an edit raises whose place in the core has changed; that catches nothing."""
ROOT = Path(__file__).parents[2]
CORE_TESTS = ROOT / "tests" / "core"


class Caught(NamedTuple):
    """What caught a wrong edit: a rule after so many seeds, or a test (0 seeds).  "": nothing."""

    name: str
    by: str
    seeds: int


def simulate(mutant: mutants.Mutant, *, first: Iterable[int] = (), seeds: int = SEEDS) -> Caught:
    """Run some seeds first, then those from 0 on, with the edit and no assertions of the shard."""
    with mutants.planted(mutant):
        for count, seed in enumerate((*first, *range(seeds)), 1):
            rule = Scenario(seed, through_wire=False, asserts=False).run().rule
            if rule in MISFITS:
                raise RuntimeError(f"{mutant.__name__} does not fit the core any more: {rule}")
            if rule:
                return Caught(mutant.__name__, rule, count)
    return Caught(mutant.__name__, "", seeds)


def run_directed(mutant: mutants.Mutant) -> Caught:
    """Run the directed test in a process of its own, with the edit; it must fail."""
    name = mutants.DIRECTED[mutant]
    command = [sys.executable, __file__, "--under", mutant.__name__, name]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    failed = done.returncode == 1 and f"{name}" in done.stdout and " failed" in done.stdout
    return Caught(mutant.__name__, f"`{name}`" if failed else "", 0)


def catch(name: str) -> Caught:
    """Find out what catches a wrong edit."""
    mutant = BY_NAME[name]
    return run_directed(mutant) if mutant in mutants.DIRECTED else simulate(mutant)


def run_under(mutant: mutants.Mutant, test: str) -> int:
    """Run the tests of `tests/core` of this name with an edit; return their status."""
    import pytest

    holding = [
        str(path)
        for path in sorted(CORE_TESTS.glob("test_*.py"))
        if f"def {test.partition('[')[0]}" in path.read_text()
    ]
    with mutants.planted(mutant):
        return int(pytest.main(["-q", "-p", "no:cacheprovider", *holding, "-k", test]))


BY_NAME = {mutant.__name__: mutant for mutant in mutants.ALL}


def main() -> int:
    """Print the table; status 1 if one was not caught."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="wrong edits (default: all)")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--under", metavar="NAME", help="run a directed test with this edit")
    options = parser.parse_args()
    if options.under:
        return run_under(BY_NAME[options.under], options.names[0])
    wanted = options.names or list(BY_NAME)
    called = {mutant.__name__: [] for mutant in mutants.ALL}
    for name, mutant in mutants.NAMED.items():
        called[mutant.__name__].append(name)
    print("| wrong edit | seeds | caught by | known as |\n|---|---|---|---|")
    caught = 0
    with ProcessPoolExecutor(options.jobs) as pool:
        for name, by, seeds in pool.map(catch, wanted):
            caught += bool(by)
            text = " ".join(BY_NAME[name].__doc__.split())
            shown = seeds or "a test"
            known = ", ".join(called[name])
            print(f"| {text} | {shown} | {by or 'NOTHING'} | {known} |", flush=True)
    print(f"\n{caught} of {len(wanted)} caught")
    return 0 if caught == len(wanted) else 1


if __name__ == "__main__":
    sys.exit(main())
