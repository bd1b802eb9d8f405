"""`enact verify --frames`."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Final

from enact_dist.cli.text.output import print_json
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.verify.frames.lives import BrokenLife, LifeTally, live
from enact_dist.verify.simulation.series import fresh_seed

SECONDS: Final = 60.0
"""Default duration."""
TOLD_S: Final = 5.0
"""How often it says how far it is."""


def run(arguments: argparse.Namespace) -> int:
    """Let shards live under hostile frames; status 1 if one broke a rule, 130 after Ctrl-C."""
    tally, begin_s = LifeTally(), time.monotonic()
    first = fresh_seed() if arguments.first is None else arguments.first
    seconds = SECONDS if arguments.seconds is None else arguments.seconds
    count = arguments.seeds
    if arguments.seed is not None:
        first, count = arguments.seed, 1
    problem, told_s, interrupted, seed = "", begin_s, False, first
    try:
        while (count is not None and seed < first + count) or (
            count is None and time.monotonic() - begin_s < seconds
        ):
            live(seed, tally)
            seed += 1
            if not arguments.json and time.monotonic() - told_s >= TOLD_S:
                told_s = time.monotonic()
                print(
                    f"{told_s - begin_s:.0f} s, {tally.frames} frames", file=sys.stderr, flush=True
                )
    except BrokenLife as broken:
        problem = str(broken)
    except KeyboardInterrupt:
        interrupted = True
    wall_s = time.monotonic() - begin_s
    if arguments.json:
        print_json(_as_json(tally, first, seed, problem, wall_s))
    else:
        _tell(tally, seed, problem, wall_s)
    if problem:
        return FAILED
    return 130 if interrupted else DONE


def _as_json(
    tally: LifeTally, first: int, seed: int, problem: str, wall_s: float
) -> dict[str, object]:
    return {
        "first": first,
        "lives": tally.lives,
        "with_store": tally.with_store,
        "restarts": tally.restarts,
        "frames": tally.frames,
        "illegal": tally.illegal,
        "asked": dict(sorted(tally.asked.items())),
        "answers": dict(sorted(tally.answers.items())),
        "wall_s": round(wall_s, 3),
        "failures": [{"seed": seed, "problem": problem}] if problem else [],
    }


def _tell(tally: LifeTally, seed: int, problem: str, wall_s: float) -> None:
    print(
        f"{tally.frames} legal frames of {len(tally.asked)} kinds in {wall_s:.0f} s, to"
        f" {tally.lives} shards ({tally.with_store} with a store), started again"
        f" {tally.restarts} times; {tally.illegal} messages could not travel"
    )
    kinds = ", ".join(f"{count} {name}" for name, count in tally.answers.most_common())
    print(f"answers: {kinds}")
    if problem:
        print(f"seed {seed} breaks a rule: {problem}")
        print(f"again: enact verify --frames --seed {seed}")
    else:
        print("no exception, every request answered once, every answer could be sent")
