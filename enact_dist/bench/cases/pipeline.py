"""Bench `pipeline`: 8 cameras at 10 Hz, 8 workers that make masks, one reader of whole sets.

Each of the 17 is a process.  The cameras are triggered at the same moments; a worker is an actor
that its camera's image triggers; the reader is an actor that sets of eight masks with one capture
stamp trigger.  That all eight are of one frame is found in their pixels, not by the stamp.  The
latency is that from the earliest camera's store (before its lock) to the reader's set.  A tick
counts as missed if its set was not read within 0.1 s, and the reason is said.

What the framework costs is the processor time of all processes, daemons included where they are
the bench's own, less that of the same 17 doing the same work on arrays of their own.
"""

from __future__ import annotations

import collections
import json
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from enact_dist.bench.cases.pipeline_worker import CAMERAS, PERIOD_NS
from enact_dist.bench.floors import written
from enact_dist.bench.place import PIPELINE_WORKER
from enact_dist.bench.rows import Case, Row, at_most, value_row
from enact_dist.bench.timing import sleep_until
from enact_dist.bench.usage import Sampled, Usage, growth_row
from enact_dist.link.memory.shared_folder import shared_root

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from enact_dist.bench.run import Run
    from enact_dist.verify.daemons import LineProcess

NAME: Final = "pipeline"
TIMES: Final = 20
"""A pipeline runs this many times as long as a line of another bench: 60 s by default."""
WARM_TICKS: Final = 15
HEAD_START_NS: Final = 1_500_000_000
END_S: Final = 60.0
CORES_MAX: Final = 0.25
KINDS: Final = {"camera": "cameras", "segmenter": "workers", "consumer": "reader"}
SHARD: Final = "shards"
STAGES: Final = ("camera's wake-up", "image's commit", "worker", "reader")
"""Where a tick's time goes, in this order; each ends with the slowest of the eight."""
IN_TIME_NS: Final = 100_000_000
"""A set that is read later than one period after its tick counts as missed."""


def run_pipeline(run: Run) -> None:
    """Measure the work with sharing, and the same work without."""
    ticks = max(10, math.ceil(TIMES * run.seconds_s * 1e9 / PERIOD_NS))
    bare_ticks = max(10, ticks // 3)
    run.told(f"pipeline: {bare_ticks / 10:g} s without sharing")
    bare = _Measured(run, bare_ticks, sharing=False)
    run.told(f"pipeline: {ticks / 10:g} s")
    shared = _Measured(run, ticks, sharing=True)
    _add_times(run, shared.ticks(), ticks)
    _add_processors(run, shared.usage, bare.usage, ticks, bare_ticks)
    _add_memory(run, shared.usage)


def _add_times(run: Run, found: Ticks, ticks: int) -> None:
    floor = written("0.9 MB")
    run.measure([run.floors.case(floor[1])])
    goal = at_most(12_000.0, "p50 ≤ 12 ms, p99 ≤ 20 ms", p99_us=20_000.0)
    latency = "image stored to 8 masks read"
    if not found.latencies_us:
        run.add_row(Row(NAME, latency, None, None, 0, goal=goal.text, met=False))
    else:
        run.add(_case(latency, floor, goal), found.latencies_us)
        for stage in STAGES:
            run.add(_case(f"of it: {stage}", floor), found.stages_us[stage])
    reasons = "; ".join(f"{count}: {reason}" for reason, count in sorted(found.reasons.items()))
    for variant, value, note in (
        ("missed ticks", found.missed, reasons),
        ("sets of more than one frame", found.torn, ""),
    ):
        unit = "ticks" if variant.startswith("missed") else "sets"
        run.add_row(value_row(NAME, variant, value, unit, ticks, "0", met=not value, note=note))


def _case(variant: str, floor: tuple[str, str], goal: Any = None) -> Case:
    return Case(NAME, variant, lambda _seconds_s: (), floor, goal)


def _add_processors(run: Run, usage: Usage, bare: Usage, ticks: int, bare_ticks: int) -> None:
    by_kind = {kind: usage.cores(kind) for kind in usage.kinds}
    alone = {kind: bare.cores(kind) for kind in bare.kinds}
    cores = sum(by_kind.values()) - sum(alone.values())
    note = ", ".join(
        f"{kind} {cores_ - alone.get(kind, 0.0):.3f}" for kind, cores_ in by_kind.items()
    )
    over = "" if run.place.own else ", clients alone"
    run.add_row(
        value_row(
            NAME,
            f"processor time of the framework{over}",
            round(cores, 3),
            "cores",
            ticks,
            f"≤ {CORES_MAX} core",
            met=cores <= CORES_MAX,
            note=note,
        )
    )
    total = round(sum(alone.values()), 3)
    run.add_row(value_row(NAME, "the same work without sharing", total, "cores", bare_ticks))


def _add_memory(run: Run, usage: Usage) -> None:
    last = usage.last()
    for kind, count in usage.kinds.items():
        note = f"and {last.kinds[kind].shared / 1e6:.1f} MB shared"
        private = round(last.kinds[kind].private / 1e6, 1)
        run.add_row(value_row(NAME, f"memory of the {kind}", private, "MB", count, note=note))
    figures: dict[str, Callable[[Sampled], float]] = {
        "growth of memory of their own": lambda one: sum(k.private for k in one.kinds.values()),
        "growth of shared memory": lambda one: sum(k.shared for k in one.kinds.values()),
        "growth of the shared folder": lambda one: one.files_bytes,
    }
    for variant, figure in figures.items():
        note = "after 10 s"
        if variant.endswith("of their own"):
            grown = {kind: usage.growth(_private_of(kind)) or 0.0 for kind in usage.kinds}
            note += ": " + ", ".join(f"{kind} {one / 1e3:.1f}" for kind, one in grown.items())
        if variant.endswith("folder"):
            note += f"; {last.files} files, {last.files_bytes / 1e6:.1f} MB at the end"
        run.add_row(growth_row(usage, NAME, variant, figure, note))


def _private_of(kind: str) -> Callable[[Sampled], float]:
    return lambda one: one.kinds[kind].private


class _Measured:
    """One run of all processes.

    Attributes:
        usage: What they used after the warm-up.
    """

    def __init__(self, run: Run, ticks: int, *, sharing: bool) -> None:
        place = run.place
        self._total = WARM_TICKS + ticks
        roles: list[tuple[str, dict[str, Any]]] = [
            ("consumer", {}),
            *(("segmenter", {"camera": number}) for number in range(CAMERAS)),
            *(("camera", {"camera": number}) for number in range(CAMERAS)),
        ]
        options = {"ticks": self._total, "sharing": sharing}
        with place.workers(
            [(role, {**own, **options}) for role, own in roles],
            carrier=place.carrier,
            module=PIPELINE_WORKER,
        ) as workers:
            self._start_ns = time.perf_counter_ns() + HEAD_START_NS
            for worker in workers:
                worker.tell(str(self._start_ns))
            pids: dict[str, list[int]] = {}
            for (role, _), worker in zip(roles, workers, strict=True):
                pids.setdefault(KINDS[role], []).append(worker.pid)
            if sharing:
                pids[SHARD] = place.daemon_pids()
            self.usage = Usage(pids, shared_root())
            sleep_until(self._start_ns + WARM_TICKS * PERIOD_NS)
            self.usage.watch(ticks * PERIOD_NS / 1e9)
            self._said = self._heard(roles, workers)

    @staticmethod
    def _heard(
        roles: list[tuple[str, dict[str, Any]]], workers: list[LineProcess]
    ) -> dict[str, list[Mapping[str, Any]]]:
        said: dict[str, list[Mapping[str, Any]]] = {}
        for (role, _), worker in zip(roles, workers, strict=True):
            said.setdefault(role, []).append(json.loads(worker.expect("did:", timeout_s=END_S)))
        return said

    def ticks(self) -> Ticks:
        """Return what became of each tick after the warm-up."""
        (consumer,) = self._said["consumer"]
        return ticks_of(
            self._said["camera"],
            self._said["segmenter"],
            consumer,
            ticks=range(WARM_TICKS, self._total),
            start_ns=self._start_ns,
            period_ns=PERIOD_NS,
        )


# ---------------------------------------------------------------- what became of each tick


@dataclass(frozen=True, slots=True)
class Ticks:
    """The ticks of one run.

    Attributes:
        latencies_us: Of the sets that were read: from the earliest image's store to the set.
        stages_us: The time of each stage, of the sets that were read.
        reasons: How many ticks were missed, by reason.
        torn: Sets whose masks were not of one frame.
    """

    latencies_us: list[float]
    stages_us: dict[str, list[float]]
    reasons: dict[str, int]
    torn: int

    @property
    def missed(self) -> int:
        """How many ticks were missed."""
        return sum(self.reasons.values())


def ticks_of(
    cameras: Sequence[Mapping[str, Any]],
    segmenters: Sequence[Mapping[str, Any]],
    consumer: Mapping[str, Any],
    *,
    ticks: range,
    start_ns: int,
    period_ns: int,
) -> Ticks:
    """Join what all processes say about the ticks that count.

    Args:
        cameras: "ticks": (tick, begin of the store, its end) of each image.
        segmenters: "ticks": (tick, when its mask was made).
        consumer: "sets": (tick, when it was read, latency); "torn": ticks of torn sets.
        ticks: The ticks that count.
        start_ns: When tick 0 was due.
        period_ns: Between two ticks.
    """
    stored = [{tick: (begun, ended) for tick, begun, ended in one["ticks"]} for one in cameras]
    made = [dict(one["ticks"]) for one in segmenters]
    read = {tick: (had, latency) for tick, had, latency in consumer["sets"]}
    torn = set(consumer["torn"]) & set(ticks)
    found = Ticks([], {stage: [] for stage in STAGES}, {}, len(torn))
    reasons: collections.Counter[str] = collections.Counter()
    for tick in ticks:
        if tick in torn:
            reasons["masks of different frames"] += 1
        elif any(tick not in one for one in stored):
            reasons["no image was stored"] += 1
        elif any(tick not in one for one in made):
            reasons["a worker passed over its image"] += 1
        elif tick not in read:
            reasons["the reader passed over its set"] += 1
        else:
            had_ns, latency_ns = read[tick]
            due_ns = start_ns + tick * period_ns
            ends_ns = (
                max(one[tick][0] for one in stored),
                max(one[tick][1] for one in stored),
                max(one[tick] for one in made),
                had_ns,
            )
            times_us = _between_us(due_ns, ends_ns)
            for stage, time_us in zip(STAGES, times_us, strict=True):
                found.stages_us[stage].append(time_us)
            found.latencies_us.append(latency_ns / 1e3)
            if had_ns - due_ns > IN_TIME_NS:
                slowest = STAGES[times_us.index(max(times_us))]
                reasons[f"late, mostly by the {slowest}"] += 1
    found.reasons.update(reasons)
    return found


def _between_us(begin_ns: int, ends_ns: Sequence[int]) -> list[float]:
    times_us = []
    for end_ns in ends_ns:
        times_us.append(max(0, end_ns - begin_ns) / 1e3)
        begin_ns = max(begin_ns, end_ns)
    return times_us
