"""Benches `stopped` and `recovery`: what others lose when a client stands still, or something dies.

`recovery` kills holders and daemons of cells of its own; it is `enact verify --recovery`, shorter.
"""

from __future__ import annotations

import math
import signal
import statistics
import time
from typing import TYPE_CHECKING, Final

from enact_dist.bench.cases.payloads import WAIT_S, entity, store
from enact_dist.bench.cases.updates import slots, update
from enact_dist.bench.rows import Row, sample_of
from enact_dist.bench.timing import timed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.bench.run import Run

FLOOD: Final = "50 MB"
FLOOD_BYTES: Final = 50_000_000
ADDED_P99_US: Final = 50_000.0
ADDED_MAX_US: Final = 150_000.0
FIRST_S: Final = 0.01
STOPS: Final = 5
"""How often the reader is stopped: each time it is caught at another place."""
KILLS_PER_S: Final = 2
"""Deaths per second of measuring time; a death costs others about a TTL of 2 s."""


def run_stopped(run: Run) -> None:
    """Whole updates of one client, alone and while another that was fetching 50 MB is stopped."""
    import numpy as np

    place = run.place
    world = place.world(place.carrier)
    writes = slots(world, 1, entity="stopped")
    store(world, entity(FLOOD), np.zeros(FLOOD_BYTES, np.uint8))
    run.told("stopped: alone")
    alone = timed(lambda: update(writes), run.seconds_s / 2)
    with place.far_worker("fetcher", entity=entity(FLOOD).name) as fetcher:
        beside: list[float] = []
        for number in range(STOPS):
            run.told(f"stopped: stop {number + 1} of {STOPS}")
            fetcher.expect("fetching:", timeout_s=WAIT_S)
            time.sleep(FIRST_S * number)
            fetcher.signal(signal.SIGSTOP)
            try:
                beside += timed(lambda: update(writes), run.seconds_s / STOPS)
            finally:
                fetcher.signal(signal.SIGCONT)
            fetcher.expect("fetched:", timeout_s=WAIT_S)
    run.add_row(_stopped_row(alone, beside))


def _stopped_row(alone: Sequence[float], beside: Sequence[float]) -> Row:
    base_us, found = statistics.median(alone), sample_of(beside)
    longest_us = max(beside)
    met = found.p99_us - base_us < ADDED_P99_US and longest_us - base_us < ADDED_MAX_US
    return Row(
        "stopped",
        f"update beside a stopped reader of {FLOOD}",
        round(found.median_us, 2),
        round(found.p99_us, 2),
        found.n,
        round(found.median_us / base_us, 3),
        "adds p99 < 50 ms, max < 150 ms",
        met,
        note=f"longest {longest_us / 1e3:.1f} ms; alone median {base_us / 1e3:.2f} ms,"
        f" longest {max(alone) / 1e3:.1f} ms",
    )


def run_recovery(run: Run) -> None:
    """How soon locks are back after a death."""
    from enact_dist.verify.recovery import KILLED_FAR, KILLED_NEAR, RESTARTED, measure

    rounds = max(1, math.ceil(run.seconds_s * KILLS_PER_S))
    names = (KILLED_FAR, KILLED_NEAR, RESTARTED)
    for figure in measure(rounds, only=names, say=lambda text: run.told(f"recovery: {text}")):
        times_us = [time_s * 1e6 for time_s in figure.times_s]
        found = sample_of(times_us)
        run.add_row(
            Row(
                "recovery",
                figure.name,
                round(found.median_us, 2),
                round(found.p99_us, 2),
                found.n,
                None,
                f"p99 ≤ {figure.goal_s:g} s",
                figure.met,
            )
        )
