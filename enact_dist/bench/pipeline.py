"""Bench `pipeline`: 8 cameras at 10 Hz, 8 workers that make masks, one consumer of whole sets.

Each of the 17 is a process.  The cameras are triggered at the same moments; a worker is woken by
its camera's image and writes a mask under the lock that reads the image; the consumer is woken by
masks and takes all eight under one lock.  A tick counts as missed if no set of its eight masks was
taken.  The latency is that from the earliest camera's store (before its lock) to the consumer's
set, all of one tick.

What the framework costs is the processor time of all processes, daemons included where they are
the bench's own, less that of the same 17 doing the same work on arrays of their own.
"""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.bench.floors import written
from enact_dist.bench.pipeline_worker import CAMERAS, PERIOD_NS
from enact_dist.bench.place import PIPELINE_WORKER
from enact_dist.bench.rows import Case, Row, at_most
from enact_dist.bench.timing import sleep_until
from enact_dist.link.shared_folder import shared_root

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.bench.run import Run

TIMES: Final = 20
"""A pipeline runs this many times as long as a line of another bench: 60 s by default."""
WARM_TICKS: Final = 15
HEAD_START_NS: Final = 1_500_000_000
END_S: Final = 60.0
CORES_MAX: Final = 0.25
MEGA: Final = 1e6


def run_pipeline(run: Run) -> None:
    """Measure the work with sharing, and the same work without."""
    ticks = max(10, math.ceil(TIMES * run.seconds_s * 1e9 / PERIOD_NS))
    bare_ticks = max(10, ticks // 3)
    run.told(f"pipeline: {bare_ticks / 10:g} s without sharing")
    bare = _Measured(run, bare_ticks, sharing=False)
    run.told(f"pipeline: {ticks / 10:g} s")
    shared = _Measured(run, ticks, sharing=True)
    floor = written("0.9 MB")
    run.measure([run.floors.case(floor[1])])
    goal = at_most(12_000.0, "p50 ≤ 12 ms, p99 ≤ 20 ms", p99_us=20_000.0)
    latency = "image stored to 8 masks read"
    if shared.latencies_us:
        case = Case("pipeline", latency, lambda _seconds_s: (), floor, goal)
        run.add(case, shared.latencies_us)
    else:
        run.add_row(Row("pipeline", latency, None, None, 0, goal=goal.text, met=False))
    missed = ticks - len(shared.latencies_us)
    run.add_row(_row("missed ticks", missed, "ticks", ticks, "0", met=missed == 0))
    run.add_row(_row("sets of one tick looked for in vain", shared.uneven, "reads", ticks))
    cores = shared.cores - bare.cores
    over = "" if run.place.own else ", clients alone"
    run.add_row(
        _row(
            f"processor time of the framework{over}",
            round(cores, 3),
            "cores",
            ticks,
            f"≤ {CORES_MAX} core",
            met=cores <= CORES_MAX,
        )
    )
    run.add_row(_row("the same work without sharing", round(bare.cores, 3), "cores", bare_ticks))
    run.add_row(_row("memory growth", round(shared.grown_bytes / MEGA, 2) + 0.0, "MB", ticks))
    run.add_row(_row("shared files growth", round(shared.files_bytes / MEGA, 2) + 0.0, "MB", ticks))


def _row(
    variant: str,
    value: float,
    unit: str,
    n: int,
    goal: str | None = None,
    *,
    met: bool | None = None,
) -> Row:
    return Row("pipeline", variant, None, None, n, None, goal, met, value, unit)


class _Measured:
    """One run of all processes.

    Attributes:
        latencies_us: Of the sets that were taken, one per tick.
        uneven: How often the consumer held masks of different ticks, and waited for more.
        cores: Processor time per time.
        grown_bytes: By how much the private memory of all processes grew after the warm-up.
        files_bytes: By how much what lies in the shared folder grew meanwhile.
    """

    def __init__(self, run: Run, ticks: int, *, sharing: bool) -> None:
        place = run.place
        total = WARM_TICKS + ticks
        roles: list[tuple[str, dict[str, Any]]] = [
            ("consumer", {}),
            *(("segmenter", {"camera": number}) for number in range(CAMERAS)),
            *(("camera", {"camera": number}) for number in range(CAMERAS)),
        ]
        options = {"ticks": total, "sharing": sharing}
        with place.workers(
            [(role, {**own, **options}) for role, own in roles],
            carrier=place.carrier,
            module=PIPELINE_WORKER,
        ) as workers:
            start_ns = time.perf_counter_ns() + HEAD_START_NS
            for worker in workers:
                worker.tell(str(start_ns))
            pids = [worker.pid for worker in workers] + (place.daemon_pids() if sharing else [])
            self._measure(pids, start_ns, total)
            consumer = workers[0]
            said = json.loads(consumer.expect("sets:", timeout_s=END_S))
            for worker in workers[1:]:
                worker.expect("done:", timeout_s=END_S)
        self.latencies_us = [ns / 1e3 for tick, ns in said["sets"] if tick >= WARM_TICKS]
        self.uneven: int = said["uneven"]

    def _measure(self, pids: list[int], start_ns: int, total: int) -> None:
        sleep_until(start_ns + WARM_TICKS * PERIOD_NS)
        cpu_s, memory, files = _cpu_s(pids), _private_bytes(pids), _files_bytes()
        began_ns = time.perf_counter_ns()
        sleep_until(start_ns + total * PERIOD_NS)
        self.cores = (_cpu_s(pids) - cpu_s) / ((time.perf_counter_ns() - began_ns) / 1e9)
        self.grown_bytes = _private_bytes(pids) - memory
        self.files_bytes = _files_bytes() - files


def _cpu_s(pids: Sequence[int]) -> float:
    """Return the processor time of processes, exact: the kernel has a clock for each."""
    return sum(time.clock_gettime((~pid << 3) | 2) for pid in pids)


def _private_bytes(pids: Sequence[int]) -> int:
    """Return the memory that processes have for themselves."""
    total = 0
    for pid in pids:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                total += int(line.split()[1]) * 1024
    return total


def _files_bytes() -> int:
    """Return the memory under all files of the shared folder."""
    root = shared_root()
    total = 0
    for path in root.rglob("*") if root.is_dir() else ():
        try:
            total += path.lstat().st_blocks * 512
        except FileNotFoundError:
            continue
    return total
