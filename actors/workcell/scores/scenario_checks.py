"""What each scenario must hold, on the truth of its run; the table is in `scenarios`."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from actors.geometry.capsules import distance_to_points
from actors.geometry.separation import LATEST_S
from actors.workcell import vocabulary as words
from actors.workcell.motion import BRAKING_M_S2, NOMINAL_M_S, ROBOT_S
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.trace import TRUTH
from actors.workcell.scores.truth_of_run import truth_of
from actors.workcell.vocabulary import PERIOD_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario
    from actors.workcell.scores.trace import Kept, Trace
    from actors.workcell.scores.truth_of_run import Truth

REST_SCALE = 0.02
"""Below this share of the nominal speed the arm counts as at rest."""
NEEDED = frozenset(
    ("sets_missed", "sets_incomplete", "robot_p99_ms", "lost_near_voxels", "phantom_p99_l")
) | {"moments"}
"""What every run must have measured; without it a goal would count as met by a run that did
nothing."""
MOMENTS_S = 50.0
"""Least samples of the arm per second; a shard that restarts loses some of the 100."""
PLACE_M = 0.6
"""So near to the middle of a person something must be occupied, or a track be theirs."""
REST_S = LATEST_S + NOMINAL_M_S / BRAKING_M_S2 + ROBOT_S + 0.025
"""So long after the last exposure that a command rests on the arm is at rest."""
HAND_M = 0.42
"""Nearest true distance that a reaching hand may come to a moving arm."""


def checks_of(
    trace: Trace, scores: Mapping[str, float], played_s: float | None = None
) -> dict[str, bool]:
    """Return what the scenario of a run must hold, in words, and whether it did.

    Args:
        trace: The run.
        scores: Its scores.
        played_s: How much of the scenario was to be played; None: all of it.
    """
    truth = truth_of(trace)
    name = _playing(trace).name
    found = {
        "no moment faster than ISO/TS 15066 allows": scores.get("violations", 1.0) == 0.0,
        "every figure was measured": scores.keys() >= NEEDED
        and scores["moments"] >= MOMENTS_S * (truth.seconds if played_s is None else played_s),
    }
    found |= _CHECKS.get(name, _nothing)(trace, truth, scores)
    return {text: bool(held) for text, held in found.items()}  # numpy's are no JSON


def _playing(trace: Trace) -> Scenario:
    """Return what was played."""
    playing = trace.newest(words.SCENARIO.name, words.PLAYING, TRUTH)
    return scenario_of(playing.scenario, playing.seed, playing.seconds)


def _nothing(_: Trace, __: Truth, ___: Mapping[str, float]) -> dict[str, bool]:
    return {}


def _speeds(trace: Trace, truth: Truth) -> list[Kept[words.Speed]]:
    return [kept for kept in trace.of(words.ROBOT.name, words.SPEED) if truth.covers(kept.stamp_ns)]


def _hulls(trace: Trace, truth: Truth) -> list[Kept[words.Hull]]:
    those = trace.of(words.WORKSPACE.name, words.HULL)
    return [kept for kept in those if truth.covers(kept.stamp_ns)]


def _empty(trace: Trace, truth: Truth, scores: Mapping[str, float]) -> dict[str, bool]:
    """S1: no person is present."""
    speeds = _speeds(trace, truth)
    return {
        "full speed in every set": bool(speeds) and all(one.datum.scale == 1.0 for one in speeds),
        "no voxel is occupied": not any(len(one.datum.voxels) for one in _hulls(trace, truth)),
        "no set is incomplete": scores.get("sets_incomplete", 1.0) == 0.0,
    }


def _past(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S2: full speed again a second after everybody has left the workspace."""
    speeds, after = _speeds(trace, truth), []
    empty_since = -math.inf  # no person has been there yet
    for kept in speeds:
        inside = any(bool(truth.over(body[:, :2]).any()) for body in truth.bodies_at(kept.stamp_ns))
        empty_since = 0 if inside else empty_since + 1
        if empty_since > round(1.0 / words.PERIOD_S):
            after.append(kept.datum.scale)
    slowed = any(kept.datum.scale < 1.0 for kept in speeds)
    return {
        "the robot slows down for who walks past": slowed,
        "full speed a second after they have left": bool(after) and min(after) == 1.0,
    }


def _reach(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S3, S12: at rest before the hand is near, and no restart while it is there."""
    motion = trace.joints()
    stopped = restarted = False
    nearest_moving = math.inf
    for kept in trace.of(words.ROBOT.name, words.EXECUTION):
        stamp = kept.datum.captured_ns
        if not truth.covers(stamp):
            continue
        true_m = truth.distance_m(stamp, motion.at(stamp))
        if kept.datum.scale > REST_SCALE:
            nearest_moving = min(nearest_moving, true_m)
            restarted |= stopped and true_m < HAND_M
        stopped |= kept.datum.scale <= REST_SCALE and true_m < 2.0
    return {
        "the robot stops": stopped,
        f"it moves only while the hand is farther than {HAND_M} m": nearest_moving >= HAND_M,
        "no restart while the hand is there": not restarted,
    }


def _hidden(trace: Trace, truth: Truth, scores: Mapping[str, float]) -> dict[str, bool]:
    """S4: who hides stays known, and keeps their place occupied."""
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    held = []
    for kept in _hulls(trace, truth):
        middles = [middle for middle, *_ in truth.centres_at(kept.stamp_ns)]
        if middles and truth.over(middles[0], -0.3).all():
            places = grid.origin_m[:2] + (kept.datum.voxels[:, :2] + 0.5) * grid.voxel_m
            off_m = np.linalg.norm(places - middles[0], axis=1)
            held.append(bool(off_m.min(initial=math.inf) < PLACE_M))
    return {
        "the place of who hides stays occupied": bool(held) and all(held),
        "no voxel is lost near the robot": scores.get("lost_near_voxels", 1.0) == 0.0,
    }


def _still(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S5: who stands still does not fade into the background."""
    hulls = [kept for kept in _hulls(trace, truth) if truth.bodies_at(kept.stamp_ns)]
    inside = [
        kept for kept in hulls if all(truth.inside(body) for body in truth.bodies_at(kept.stamp_ns))
    ]
    sizes = [len(kept.datum.voxels) for kept in inside]
    third = max(1, len(sizes) // 3)
    first, last = (
        float(np.median(part)) if part else 0.0 for part in (sizes[:third], sizes[-third:])
    )
    return {"who stands still does not fade": first > 0.0 and last > 0.8 * first}


def _left(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S6: an object left in the cell stays an obstacle, and is reported."""
    thing = truth.things[0]
    after = [
        kept
        for kept in _hulls(trace, truth)
        if truth.at_s(kept.stamp_ns) > thing.from_s + 1.0 and not truth.bodies_at(kept.stamp_ns)
    ]
    grid = trace.newest(words.WORKSPACE.name, words.GRID)
    point = np.array([[*thing.centre_m, *thing.centre_m, 0.05]])
    kept_there = [
        len(kept.datum.voxels) > 0
        and float(
            distance_to_points(
                point, grid.origin_m + (kept.datum.voxels + 0.5) * grid.voxel_m
            ).min()
        )
        < 0.1
        for kept in after
    ]
    reported = [
        kept.datum.foreign
        for name in trace.entities(words.TRACK)
        for kept in trace.of(name, words.TRACK)
        if math.dist(kept.datum.position_m[:2], thing.centre_m[:2]) < PLACE_M
    ]
    return {
        "what is left stays an obstacle": bool(kept_there) and all(kept_there),
        "what is left is reported as foreign": any(reported),
    }


def _cameras(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S7: the cell goes on with fewer cameras, and takes each back."""
    hulls = _hulls(trace, truth)
    replaced = taken_back = True
    for fault in _playing(trace).faults:
        name = fault.target.replace("-", "/")
        after = [kept for kept in hulls if truth.at_s(kept.stamp_ns) > fault.at_s]
        there = [name in kept.datum.cameras for kept in after]
        replaced &= False in there
        taken_back &= False in there and True in there[there.index(False) :]
    longest = max(
        ((other.stamp_ns - one.stamp_ns) / PERIOD_NS for one, other in itertools.pairwise(hulls)),
        default=math.inf,
    )
    return {
        "a stand-in replaces each camera that fails": replaced,
        "every camera is taken back": taken_back,
        "the cell goes on within 2 s": longest <= 20.0,
    }


def _restarts(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S8: the robot rests while an actor is away, and goes on by itself."""
    motion = trace.joints()
    stamps = np.array([kept.stamp_ns for kept in _speeds(trace, truth)], np.int64)
    if not len(stamps):
        return {"the robot goes on by itself": False}
    late = 0
    for stamp, dq in zip(motion.stamp_ns, motion.dq, strict=True):
        if not truth.covers(int(stamp)):
            continue
        newest = stamps[stamps <= stamp].max(initial=truth.start_ns)
        late += (stamp - newest) / 1e9 > REST_S and bool(np.abs(dq).max() > 0.02)
    gaps = int((np.diff(stamps) > 5 * PERIOD_NS).sum())
    last_s = truth.at_s(int(stamps[-1]))
    return {
        "the commands stop while an actor is away": gaps >= 1,
        "at rest within 250 ms and the braking time": late == 0,
        "the robot goes on by itself": last_s > truth.seconds - 1.0,
    }


def _dark(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S10: the light drops: a fault that stops the robot, not a crash."""
    states = [kept.datum for kept in trace.of(words.SYSTEM.name, words.SAFETY)]
    faults = [one for one in states if one.state == "fault" and truth.covers(one.since_ns)]
    after = [
        one.datum for one in _speeds(trace, truth) if truth.at_s(one.stamp_ns) > 0.6 * truth.seconds
    ]
    return {
        "a fault names the background": any("background" in one.reason for one in faults),
        "the robot stands": bool(after) and all(one.scale == 0.0 for one in after),
    }


def _two(trace: Trace, truth: Truth, _: Mapping[str, float]) -> dict[str, bool]:
    """S11: two people are two tracks."""
    tracks: dict[int, list[npt.NDArray[np.float64]]] = {}
    for human in trace.entities(words.TRACK):
        for kept in trace.of(human, words.TRACK):
            tracks.setdefault(kept.stamp_ns, []).append(kept.datum.position_m[:2])
    both = []
    for hull in _hulls(trace, truth):
        middles = [middle for middle, *_ in truth.centres_at(hull.stamp_ns)]
        if len(middles) > 1 and truth.over(np.array(middles), -0.3).all():
            there = tracks.get(hull.stamp_ns, [])
            near = [[float(np.linalg.norm(m - one)) < PLACE_M for one in there] for m in middles]
            own = {row.index(True) for row in near if any(row)}
            both.append(len(own) == len(middles))
    return {"two tracks, each at its person": bool(both) and sum(both) > 0.8 * len(both)}


_CHECKS: Mapping[str, Callable[[Trace, Truth, Mapping[str, float]], dict[str, bool]]] = {
    "S1": _empty,
    "S2": _past,
    "S3": _reach,
    "S4": _hidden,
    "S5": _still,
    "S6": _left,
    "S7": _cameras,
    "S8": _restarts,
    "S10": _dark,
    "S11": _two,
    "S12": _reach,
}
