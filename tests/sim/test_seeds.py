"""The real core survives every seed: those that once broke it, and as many others as time allows.

`ENACT_SIM_SECONDS` (default 20) is how long to go on.  When it is set, the seeds are fresh ones,
never the same twice; otherwise they start at 0, so that a plain run of the suite repeats itself.
`ENACT_SIM_FIRST` names the first seed.
"""

from __future__ import annotations

import os
import time
from collections import Counter

import pytest

from enact_dist.verify.simulation.scenario import Scenario

KNOWN_BAD = (7, 58, 77, 148, 151, 196, 199, 3303, 100584, 200939, 402476)
"""Seeds that found something in the core or in the simulator; see README.md beside this file."""

SECONDS = float(os.environ.get("ENACT_SIM_SECONDS", "20"))
SEEDS_MIN = 60
"""Even on a slow machine so many seeds run; fewer would prove nothing about rare events."""

HAPPENED = (
    # What went wrong outside the core.
    "lost",
    "duplicated",
    "delayed",
    "cut",
    "crashes",
    "power cuts",
    "torn logs",
    "clients killed",
    "deaths proven",
    "pauses",
    "pauses with token",
    "late answers",
    "faults set off",
    "calls without an answer",
    "epoch changes",
    # What the core did about it.
    "shard: fenced",
    "shard: epoch_refusals",
    "shard: orphans_freed",
    "shard: leases_expired",
    "shard: held_too_long",
    "shard: superseded",
    "shard: stale",
    "shard: stalls",
    "shard: waiters_dropped",
    "shard: grants_without_listener",
    "shard: commits_repeated",
    "shard: commits_changed",
    "shard: lock_waits",
    # What it did about commits over shards.
    "decisions",
    "commits finished by participants",
    "shard: resolves_asked",
    "shard: finishes_repeated",
    "views over several slots checked",
    # What the clients were told, and did.
    "told: committed",
    "told: lost",
    "told: timed out",
    "told: unreachable",
    "told: unknown",
    "told: changed",
    "labels found",
    "data reused",
    "data fetched",
)


def checked(seed: int) -> Counter[str]:
    """Run one seed; fail with the line that runs it again."""
    result = Scenario(seed).run()
    if result.violation:
        pytest.fail(
            f"seed {seed}: {result.violation}\n{result.trace}\n"
            f"again: python tests/sim/run.py --seed {seed}",
            pytrace=False,
        )
    return result.tally


def first_seed() -> int:
    """Return where the series of seeds begins."""
    if "ENACT_SIM_FIRST" in os.environ:
        return int(os.environ["ENACT_SIM_FIRST"])
    return int(time.time()) * 1000 if "ENACT_SIM_SECONDS" in os.environ else 0


@pytest.mark.parametrize("seed", KNOWN_BAD)
def test_seed_that_once_failed_passes(seed):
    """What was fixed stays fixed."""
    checked(seed)


def test_seeds_break_no_rule_and_meet_every_fault(record_property):
    """No rule is broken in any seed, and nothing that the rules are about failed to happen."""
    first, tally = first_seed(), Counter[str]()
    started_s, cpu_s = time.perf_counter(), time.process_time()
    seed = first
    while time.perf_counter() - started_s < SECONDS or seed < first + SEEDS_MIN:
        tally += checked(seed)
        seed += 1

    cpu_s = time.process_time() - cpu_s
    record_property("seeds", seed - first)
    record_property("commits", tally["commits"])
    print(
        f"\nseeds {first} to {seed - 1}: {tally['commits']} checked commits,"
        f" {tally['commits'] / cpu_s:.0f} per second of one core,"
        f" {tally['crashes'] + tally['power cuts']} crashes, 0 violations"
    )
    missing = [name for name in HAPPENED if not tally[name]]
    assert not missing, f"never happened in {seed - first} seeds: {missing}"
