"""Score a run of the workcell on the truth: rate, latency, hull, distance, tracks, safety, speed.

    python -m actors.workcell.scores.evaluation out/run.mcap

reads the recording of `enact demo workcell` and prints the table.  The truth is what the scenario
and its seed say of the people (`simulation.human`), and what the arm's joints say of the arm; no
actor of the cell has seen it.

What each score is stands with its function, its goal in `GOALS`.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import distance_to_points
from actors.workcell import vocabulary as words
from actors.workcell.scores.reaction import reaction_of
from actors.workcell.scores.trace import T, trace_of
from actors.workcell.scores.track_scores import track_samples
from actors.workcell.scores.true_hull import TrueVoxels
from actors.workcell.scores.truth_of_run import Truth, share_of, too_fast_of, truth_of
from actors.workcell.vocabulary import PERIOD_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario
    from actors.workcell.scores.trace import Kept, Trace

    F64 = npt.NDArray[np.float64]
    Samples = dict[str, npt.NDArray[np.float64]]

NEAR_M: Final = 0.5
"""Within this distance of the robot no voxel of a person may be lost."""
PHANTOM_M: Final = 0.15
"""What is farther than this from everything real is a phantom."""
CLOSE_M: Final = 2.0
"""Distances are scored below this true distance."""


@dataclass(frozen=True, slots=True)
class Goal:
    """What a score should be.

    Attributes:
        what: In words, with the unit.
        low: Least value that meets it.
        high: Greatest value that meets it.
    """

    what: str
    low: float = -math.inf
    high: float = math.inf

    def met(self, value: float) -> bool:
        """Say whether a value meets it."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        """Return the goal as the table shows it."""
        if self.low == self.high:
            return f"{self.low:g}"
        if self.low == -math.inf:
            return "" if self.high == math.inf else f"≤ {self.high:g}"
        return f"≥ {self.low:g}" if self.high == math.inf else f"{self.low:g} to {self.high:g}"


GOALS: Final[Mapping[str, Goal]] = {
    "sets": Goal("sets of masks"),
    "sets_missed": Goal("ticks without a set", 0, 0),
    "sets_incomplete": Goal("sets with a stand-in", 0, 0),
    "masks_p50_ms": Goal("capture → last mask, p50, ms"),
    "masks_p99_ms": Goal("capture → last mask, p99, ms"),
    "hull_p50_ms": Goal("capture → hull, p50, ms"),
    "hull_p99_ms": Goal("capture → hull, p99, ms"),
    "speed_p50_ms": Goal("capture → speed, p50, ms"),
    "speed_p99_ms": Goal("capture → speed, p99, ms"),
    "robot_p50_ms": Goal("capture → robot has the command, p50, ms", high=60),
    "robot_p99_ms": Goal("capture → robot has the command, p99, ms", high=100),
    "lost_near_voxels": Goal("true voxels lost within 0.5 m of the robot", 0, 0),
    "lost_share": Goal("true voxels lost elsewhere, share", high=0.0002),
    "true_voxels": Goal("true voxels looked at"),
    "iou_p50": Goal("tight set against truth, IoU, p50", low=0.8),
    "phantom_p99_l": Goal("phantom volume, p99, litres", high=2.0),
    "distance_p50_m": Goal("distance, estimated - true, p50, m"),
    "distance_p1_m": Goal("distance, estimated - true, p1, m", low=-0.12),
    "distance_max_m": Goal("distance, estimated - true, greatest, m", high=0.0),
    "nearest_true_m": Goal("nearest true distance, m"),
    "track_position_p50_m": Goal("track, position, p50, m", high=0.04),
    "track_velocity_p50_m_s": Goal("track, velocity, p50, m/s", high=0.1),
    "track_ahead_p50_m": Goal("track, 0.5 s ahead, p50, m", high=0.12),
    "untracked_share": Goal("people inside without a track, share of moments", high=0.01),
    "violations": Goal("moments faster than ISO/TS 15066 allows", 0, 0),
    "moments": Goal("moments looked at, 100 Hz"),
    "speed_kept": Goal("mean share of the nominal speed"),
    "productivity_oracle": Goal("the same, of an oracle's", low=0.9),
    "productivity_zone": Goal("the same, of a fixed stop zone's", low=2.0),
    "reaction_p50_ms": Goal("true S(full speed) → lower command, p50, ms"),
    "reaction_max_ms": Goal("true S(full speed) → lower command, greatest, ms"),
    "rest_max_ms": Goal("true S(0) → arm at rest, greatest, ms"),
    "jerk_max_rad_s3": Goal("jerk of a joint, greatest, rad/s³"),
    "paths": Goal("paths planned"),
    "replan_p99_ms": Goal("planning, p99, ms", high=100),
    "paths_touching": Goal("planned paths that touch the hull", 0, 0),
}
"""Every score with its goal, in the order of the table."""


def score(
    trace: Trace, *, every: int = 1, tell: Callable[[str], None] = lambda _: None
) -> dict[str, float]:
    """Return all scores of a run that can be made of what it has, by their names in `GOALS`.

    Args:
        trace: The versions of the run, with what was played.
        every: Only each so-many-th hull is compared voxel by voxel.
        tell: Called with what is being done: ten minutes of a run take minutes.

    Raises:
        ConfigError: The run has no truth, no arm or no grid.
    """
    truth = truth_of(trace)
    tell("comparing the run with its truth")
    samples = samples_of(trace, every=every)
    if len(samples["share"]):
        tell(f"playing {truth.seconds:.0f} s with an oracle and with a fixed stop zone")
        samples |= beside(truth.scenario)
    of_run = _rates(trace, truth) | _latencies(trace, truth) | reaction_of(trace, truth)
    return in_order(of_run | scores_of([samples]))


def in_order(scores: Mapping[str, float]) -> dict[str, float]:
    """Return scores in the order of the table."""
    return {name: scores[name] for name in GOALS if name in scores}


def samples_of(trace: Trace, *, every: int = 1) -> Samples:
    """Return all single figures of a run that its scores are made of, but rates and latencies.

    Args:
        trace: The versions of the run, with what was played.
        every: Only each so-many-th hull is compared voxel by voxel.

    Raises:
        ConfigError: The run has no truth, no arm or no grid.
    """
    truth = truth_of(trace)
    found = {
        **_voxels(trace, truth, every=every),
        **_distances(trace, truth),
        **track_samples(trace, truth),
        **_planning(trace, truth),
        "too_fast": too_fast_of(trace, truth),
        "share": share_of(trace, truth),
    }
    return {name: np.asarray(values, np.float64) for name, values in found.items()}


@lru_cache(maxsize=4)
def beside(scenario: Scenario) -> Samples:
    """Return how fast an oracle and a fixed zone let the robot be in a scenario."""
    from actors.workcell.scores.closed_loop import ClosedLoop, Sight

    found = {}
    for name, sight in (("oracle_share", Sight.ORACLE), ("zone_share", Sight.ZONE)):
        trace = ClosedLoop(scenario, sight=sight).run()
        found[name] = share_of(trace, truth_of(trace))
    return found


def scores_of(runs: Sequence[Samples]) -> dict[str, float]:
    """Return the scores of one run or of several together.

    Productivity is the mean share of the nominal speed while the arm is not at a goal, beside that
    of two other robots in the same scenario, with the same arm, task, planner, reaction time and
    formula: one goes by the true distance and the true bodies (the oracle), one runs at full speed
    while no person is nearer to any place of its task than the protective distance of the full
    speed, and rests else (the fixed zone).

    Args:
        runs: Of `samples_of`, at least one.
    """
    every = {
        name: np.concatenate([run[name] for run in runs if name in run])
        for name in dict.fromkeys(name for run in runs for name in run)
    }
    found: dict[str, float] = {}

    def told(name: str, of: str, figure: Callable[[F64], float]) -> None:
        if len(every.get(of, ())):
            found[name] = float(figure(every[of]))

    def percentile(share: float) -> Callable[[F64], float]:
        return lambda values: float(np.percentile(values, share))

    told("lost_near_voxels", "lost_near", np.sum)
    told("lost_share", "lost", lambda lost: lost.sum() / max(every["real"].sum(), 1.0))
    told("true_voxels", "real", np.sum)
    told("iou_p50", "iou", np.median)
    told("phantom_p99_l", "phantom_l", percentile(99))
    told("distance_p50_m", "distance_error_m", np.median)
    told("distance_p1_m", "distance_error_m", percentile(1))
    told("distance_max_m", "distance_error_m", np.max)
    told("nearest_true_m", "distance_m", np.min)
    if math.isinf(found.get("nearest_true_m", 0.0)):
        del found["nearest_true_m"]
    told("track_position_p50_m", "track_position_m", np.median)
    told("track_velocity_p50_m_s", "track_velocity_m_s", np.median)
    told("track_ahead_p50_m", "track_ahead_m", np.median)
    told("untracked_share", "untracked", np.mean)
    told("violations", "too_fast", np.sum)
    told("moments", "too_fast", len)
    told("speed_kept", "share", np.mean)
    for name in ("oracle", "zone"):
        share = every.get(f"{name}_share")
        if share is not None and len(share) and share.mean() > 0.0 and "speed_kept" in found:
            found[f"productivity_{name}"] = found["speed_kept"] / float(share.mean())
    found["paths"] = float(len(every.get("touching", ())))
    if len(every.get("planned_ms", ())) > 1:
        told("replan_p99_ms", "planned_ms", percentile(99))
    told("paths_touching", "touching", np.sum)
    return found


def missed(scores: Mapping[str, float]) -> list[str]:
    """Return the names of the scores that do not meet their goals."""
    return [name for name, value in scores.items() if not GOALS[name].met(value)]


def _during(kept: Iterable[Kept[T]], truth: Truth) -> list[Kept[T]]:
    """Return the versions whose exposure lies in the scenario, each stamp once."""
    by_stamp = {one.stamp_ns: one for one in kept if truth.covers(one.stamp_ns)}
    return [by_stamp[stamp] for stamp in sorted(by_stamp)]


def _quantiles(name: str, values: Sequence[float] | F64, unit: str) -> dict[str, float]:
    if not len(values):
        return {}
    low, high = np.percentile(values, [50, 99])
    return {f"{name}_p50_{unit}": float(low), f"{name}_p99_{unit}": float(high)}


def _rates(trace: Trace, truth: Truth) -> dict[str, float]:
    """Count sets: one hull per tick of the scenario, each of images of all cameras."""
    hulls = _during(trace.of(words.WORKSPACE.name, words.HULL), truth)
    if not hulls:
        return {"sets": 0.0, "sets_missed": float(truth.ticks)}
    cameras = len(trace.entities(words.CALIBRATION))
    incomplete = sum(len(kept.datum.cameras) < cameras for kept in hulls)
    return {
        "sets": float(len(hulls)),
        "sets_missed": float(truth.ticks - len(hulls)),
        "sets_incomplete": float(incomplete),
    }


def _latencies(trace: Trace, truth: Truth) -> dict[str, float]:
    """Return the times from the exposure to the commits of each stage, and to the robot's loop.

    A set of which no command was made counts until the robot had the next one, or the run ended.
    """
    last: dict[int, int] = {}
    for camera in trace.entities(words.SILHOUETTE):
        for mask in _during(trace.of(camera, words.SILHOUETTE), truth):
            last[mask.stamp_ns] = max(last.get(mask.stamp_ns, 0), mask.committed_ns)
    sets = set(last)
    found = _quantiles("masks", [(done - stamp) / 1e6 for stamp, done in last.items()], "ms")
    for name, entity, aspect in (
        ("hull", words.WORKSPACE, words.HULL),
        ("speed", words.ROBOT, words.SPEED),
    ):
        those = _during(trace.of(entity.name, aspect), truth)
        sets |= {one.stamp_ns for one in those}
        ages = [(one.committed_ns - one.stamp_ns) / 1e6 for one in those]
        found |= _quantiles(name, ages, "ms")
    arrived: dict[int, int] = {}
    for done in trace.of(words.ROBOT.name, words.EXECUTION):
        command = done.datum
        if truth.covers(command.captured_ns):
            arrived.setdefault(command.captured_ns, command.received_ns)
    received_ns = truth.start_ns + truth.ticks * PERIOD_NS
    ages = []
    for captured_ns in sorted(sets | arrived.keys(), reverse=True) if arrived else ():
        received_ns = arrived.get(captured_ns, received_ns)
        ages.append((received_ns - captured_ns) / 1e6)
    return found | _quantiles("robot", ages, "ms")


def voxels_of(trace: Trace) -> TrueVoxels:
    """Return the voxels of the grid of a run."""
    boxes = [trace.newest(name, words.BOXES) for name in trace.entities(words.BOXES)]
    return TrueVoxels(trace.newest(words.WORKSPACE.name, words.GRID), boxes)


def _voxels(trace: Trace, truth: Truth, *, every: int) -> dict[str, list[float]]:
    """Compare hulls with bodies, voxel by voxel.

    Lost is a voxel whose centre lies in a body, outside of static obstacles and of the robot, that
    the safe set does not have.  The robot is grown as the refinement grows it.
    """
    voxels, motion = voxels_of(trace), trace.joints()
    near: list[float] = []
    far: list[float] = []
    count: list[float] = []
    ious: list[float] = []
    phantoms: list[float] = []
    for kept in _during(trace.of(words.WORKSPACE.name, words.HULL), truth)[::every]:
        bodies, hull = truth.bodies_at(kept.stamp_ns), kept.datum
        safe = voxels.number(hull.voxels)
        parts = [voxels.of(body) for body in bodies]
        index = np.unique(np.concatenate([np.empty((0, 3), int), *parts]), axis=0)
        arm = capsules_at(truth.arm, motion.at(kept.stamp_ns))[0]
        clearance_m = distance_to_points(arm, voxels.centres(index))
        outside = clearance_m > 0.87 * voxels.voxel_m + 0.01
        index, clearance_m = index[outside], clearance_m[outside]
        real = voxels.number(index)
        gone = ~np.isin(real, safe)
        near.append(float((gone & (clearance_m < NEAR_M)).sum()))
        far.append(float((gone & (clearance_m >= NEAR_M)).sum()))
        count.append(float(len(real)))
        if len(real) and all(truth.inside(body) for body in bodies):
            tight = safe[hull.tight]
            common = int(np.isin(tight, real).sum())
            ious.append(common / (len(tight) + len(real) - common))
        phantoms.append(_phantom_l(voxels, hull, bodies, truth, kept.stamp_ns))
    return {"lost_near": near, "lost": far, "real": count, "iou": ious, "phantom_l": phantoms}


def _phantom_l(
    voxels: TrueVoxels, hull: words.Hull, bodies: Sequence[F64], truth: Truth, stamp_ns: int
) -> float:
    """Return the volume of the safe set that is far from everything real, litres."""
    if not len(hull.voxels):
        return 0.0
    points = voxels.centres(hull.voxels)
    far_m = distance_to_points(np.concatenate([np.empty((0, 7)), *bodies]), points)
    far_m = np.minimum(far_m, truth.distance_to_things(points, stamp_ns))
    return float((far_m > PHANTOM_M).sum()) * voxels.voxel_m**3 * 1000.0


def _distances(trace: Trace, truth: Truth) -> dict[str, list[float]]:
    """Compare the nearest clearance with the true distance of body and arm at the exposure."""
    motion = trace.joints()
    errors: list[float] = []
    nearest: list[float] = []
    for kept in _during(trace.of(words.WORKSPACE.name, words.HULL), truth):
        true_m = truth.distance_m(kept.stamp_ns, motion.at(kept.stamp_ns), over_workspace=True)
        nearest.append(true_m)
        if true_m < CLOSE_M:
            errors.append(kept.datum.nearest_m - true_m)
    return {"distance_error_m": errors, "distance_m": nearest}


def _planning(trace: Trace, truth: Truth) -> dict[str, list[float]]:
    """Tell of each path whether it touches what was occupied in the set it was planned on."""
    paths = [
        kept
        for kept in trace.of(words.ROBOT.name, words.PATH)
        if truth.covers(kept.stamp_ns) and len(kept.datum.waypoints)
    ]
    hulls = {kept.stamp_ns: kept for kept in trace.of(words.WORKSPACE.name, words.HULL)}
    voxels = voxels_of(trace)
    touching: list[float] = []
    for kept in paths:
        planned_on = hulls.get(kept.stamp_ns)
        hull = planned_on.datum if planned_on is not None else None
        if hull is None or not len(hull.voxels):
            touching.append(0.0)
            continue
        points = voxels.centres(hull.voxels)
        states = capsules_at(truth.arm, along(kept.datum.waypoints))
        touching.append(
            float(any(float(distance_to_points(arm, points).min()) < 0.0 for arm in states))
        )
    planned = [kept.datum.took_ms for kept in paths if kept.datum.took_ms > 0.0]
    return {"touching": touching, "planned_ms": planned}


def along(waypoints: F64, step_rad: float = 0.1) -> F64:
    """Return states (n, 7) on a path, no two of them farther apart than `step_rad` in any joint."""
    pieces = [waypoints[:1]]
    for one, other in itertools.pairwise(waypoints):
        count = max(1, math.ceil(float(np.abs(other - one).max()) / step_rad))
        pieces.append(one + (other - one) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(pieces)


def main(argv: Sequence[str] | None = None) -> int:
    """Score a recording and print it as JSON; return 0, or 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--every", type=int, default=1, help="compare each N-th hull by voxels")
    options = parser.parse_args(argv)
    scores = score(trace_of(options.recording), every=options.every)
    print(json.dumps({"scores": scores, "missed": missed(scores)}, indent=2))
    return int(bool(missed(scores)))


if __name__ == "__main__":
    sys.exit(main())
