"""How often an act is repeated and timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

COUNT_MAX: Final = 20_000
COUNT_MIN: Final = 3
WARM_MAX: Final = 50
PAUSE_S: Final = 0.02
"""The pause between two acts where one is asked for: what a sleeping processor costs."""


def timed(
    act: Callable[[], object],
    seconds_s: float,
    *,
    pause_s: float = 0.0,
    before: Callable[[], object] | None = None,
) -> list[float]:
    """Repeat an act for so many seconds, at least three times; return its times in microseconds.

    Args:
        act: What is timed.
        seconds_s: How long to go on, all in all.
        pause_s: Waited before each act, not timed.
        before: Called before each act, not timed.
    """
    _warm(act, seconds_s, before)
    times_us: list[float] = []
    end_s = time.perf_counter() + seconds_s
    while len(times_us) < COUNT_MAX:
        if before is not None:
            before()
        if pause_s:
            time.sleep(pause_s)
        started_s = time.perf_counter()
        act()
        ended_s = time.perf_counter()
        times_us.append((ended_s - started_s) * 1e6)
        if ended_s >= end_s and len(times_us) >= COUNT_MIN:
            break
    return times_us


def repeating(
    act: Callable[[], object],
    *,
    pause_s: float = 0.0,
    before: Callable[[], object] | None = None,
) -> Callable[[float], list[float]]:
    """Return what times an act for so many seconds, see `timed`: the measure of a case."""
    return lambda seconds_s: timed(act, seconds_s, pause_s=pause_s, before=before)


def _warm(act: Callable[[], object], seconds_s: float, before: Callable[[], object] | None) -> None:
    end_s = time.perf_counter() + seconds_s / 10.0
    for _ in range(WARM_MAX):
        if before is not None:
            before()
        act()
        if time.perf_counter() >= end_s:
            break


def sleep_until(moment_ns: int) -> None:
    """Sleep until a moment of `time.perf_counter_ns`, which all processes of a host share."""
    time.sleep(max(0.0, (moment_ns - time.perf_counter_ns()) / 1e9))
