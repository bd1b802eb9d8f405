"""How soon the cell reacts to a true distance that has become too small: the command, and rest.

The times are those of the paper's "highly responsive execution".  They are negative where the cell
reacts before it must: it takes everything to be nearer than it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.separation import Separation
from actors.workcell import vocabulary as words
from actors.workcell.motion import CYCLE_S, NOMINAL_M_S
from actors.workcell.scores.truth_of_run import RESTING_M_S, course_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scores.trace import Trace
    from actors.workcell.scores.truth_of_run import Truth

    Flags = npt.NDArray[np.bool_]
    Stamps = npt.NDArray[np.int64]

GAP_NS: Final = 15_000_000
"""Samples of the joints that are farther apart tell no jerk."""


def reaction_of(trace: Trace, truth: Truth) -> dict[str, float]:
    """Return how soon the cell reacts, and how smoothly the arm moves.

    The first time runs from the moment in which the true distance falls below the protective
    distance of the full speed, to the commit of the first command that is lower than the full
    speed; the second one from the protective distance at rest, to the arm at rest.
    """
    course, law = course_of(trace, truth), Separation()
    stamps, distance_m = course.stamp_ns, course.distance_m
    if len(stamps) < 3:
        return {}
    speeds = trace.of(words.ROBOT.name, words.SPEED)
    commands = np.array([kept.committed_ns for kept in speeds], np.int64)
    lower = np.array([kept.datum.limit_m_s < NOMINAL_M_S for kept in speeds], np.bool_)
    found = {}
    full = after_ms(stamps, distance_m < law.protective_m(NOMINAL_M_S), commands, lower)
    if full:
        found = {"reaction_p50_ms": float(np.median(full)), "reaction_max_ms": max(full)}
    rest = after_ms(
        stamps, distance_m < law.protective_m(0.0), stamps, course.fastest_m_s < RESTING_M_S
    )
    if rest:
        found["rest_max_ms"] = max(rest)
    return found | _jerk(stamps, course.dq)


def after_ms(stamps: Stamps, cause: Flags, told: Stamps, effect: Flags) -> list[float]:
    """Return how long after each begin of a cause its effect began, ms.

    An effect that lasts already when the cause begins counts with its own begin: the time is
    negative.  A cause that ends before any effect begins gives no time.

    Args:
        stamps: (n,) int64, increasing.
        cause: (n,), whether the cause is there.
        told: (m,) int64, increasing.
        effect: (m,), whether the effect is there.
    """
    begins = np.flatnonzero(cause[1:] & ~cause[:-1]) + 1
    ends = np.flatnonzero(~cause[1:] & cause[:-1]) + 1
    onsets = np.flatnonzero(effect & ~np.concatenate([[False], effect[:-1]]))
    found = []
    for begin in begins.tolist():
        begin_ns = int(stamps[begin])
        later = ends[ends > begin]
        end_ns = int(stamps[later[0]]) if len(later) else int(stamps[-1])
        now = int(np.searchsorted(told, begin_ns, side="right")) - 1
        if now >= 0 and effect[now]:
            onset_ns = int(told[onsets[onsets <= now][-1]])
        else:
            following = [int(told[one]) for one in onsets if begin_ns < told[one] <= end_ns]
            if not following:
                continue
            onset_ns = following[0]
        found.append((onset_ns - begin_ns) / 1e6)
    return found


def _jerk(stamps: Stamps, dq_rad_s: npt.NDArray[np.float64]) -> dict[str, float]:
    """Return the greatest jerk of any joint, of samples that follow each other cycle by cycle."""
    steps_ns = np.diff(stamps)
    whole = (steps_ns[1:] < GAP_NS) & (steps_ns[:-1] < GAP_NS)
    if not whole.any():
        return {}
    jerk = np.abs(np.diff(dq_rad_s, n=2, axis=0))[whole] / CYCLE_S**2
    return {"jerk_max_rad_s3": float(jerk.max())}
