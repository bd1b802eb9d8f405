"""`enact verify --takeover`."""

from __future__ import annotations

import argparse
import os
from typing import Final

from enact_dist.cli.text.output import print_json
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.verify.simulation.command import INTERRUPTED, SEEDS, as_json, told_progress
from enact_dist.verify.simulation.scenario import Result
from enact_dist.verify.simulation.schedule import WHOLE
from enact_dist.verify.simulation.series import Totals, fresh_seed, run_series
from enact_dist.verify.simulation.shrink import Shrunk
from enact_dist.verify.takeover.run import TakeoverRun, run_takeover
from enact_dist.world.trees import shown_s

_SHOWN: Final = (
    ("takeovers", "takeovers"),
    ("failovers of the database", "failovers of the database"),
    ("changes that a failover lost", "unconfirmed changes lost"),
    ("batches that stood", "batches that stood after a lost answer"),
    ("daemons fenced", "daemons fenced"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run seeds of shards in a replicated database; status 1 if one broke a rule, 130 after Ctrl-C.

    With `--seed` the events of one run are printed.
    """
    if arguments.seed is not None:
        totals = _run_one(arguments.seed, tells=not arguments.json)
    else:
        count = arguments.seeds
        if count is None and arguments.seconds is None:
            count = SEEDS
        with told_progress(arguments, count, arguments.seconds) as on_progress:
            totals = run_series(
                fresh_seed() if arguments.first is None else arguments.first,
                count=count,
                seconds=arguments.seconds,
                jobs=arguments.jobs or os.cpu_count() or 1,
                keep_going=arguments.keep_going,
                on_progress=on_progress,
                run=run_takeover,
            )
    if arguments.json:
        print_json(as_json(totals, [Shrunk(WHOLE, one, one, 1) for one in totals.failures]))
    else:
        _tell(totals)
    if totals.failures:
        return FAILED
    return INTERRUPTED if totals.interrupted else DONE


def _run_one(seed: int, *, tells: bool) -> Totals:
    one = TakeoverRun(seed, story=tells)
    result, totals = one.run(), Totals(seed)
    totals.add(result, 0.0)
    for at_ns, line in one.world.story or ():
        print(f"{at_ns / 1e9:10.6f} s  {line}")
    return totals


def _tell(totals: Totals) -> None:
    for failure in totals.failures:
        _tell_failure(failure)
    print(
        f"{totals.seeds:,} seeds from {totals.first} on, {shown_s(totals.simulated_s)} simulated"
        + (f" in {shown_s(totals.wall_s)}" if totals.wall_s else "")
        + (" (interrupted)" if totals.interrupted else "")
    )
    tally = totals.tally
    print(f"{tally['writes judged']:,} writes judged, {len(totals.failures)} violations")
    print(", ".join(f"{tally[name]:,} {text}" for name, text in _SHOWN))


def _tell_failure(failure: Result) -> None:
    print(f"seed {failure.seed}: {failure.violation}")
    if failure.trace:
        print(failure.trace.rstrip())
    for fault in failure.faults:
        print(f"  {fault}")
    print(f"again: enact verify --takeover --seed {failure.seed}\n")
