"""What became of each tick of a pipeline: when its set was read, or where it was late or lost."""

from __future__ import annotations

import collections
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

STAGES: Final = ("camera's wake-up", "image's commit", "worker", "reader")
"""Where a tick's time goes, in this order; each ends with the slowest of the eight."""
IN_TIME_NS: Final = 100_000_000
"""A set that is read later than one period after its tick counts as missed."""


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
