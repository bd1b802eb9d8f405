"""Tracks and predictions of a run beside the people who were there.

A track is compared with the person who is nearest to it, its prediction with where that person
really was half a second later.  A person without a track has no error of position, so they count by
themselves: the share of moments in which a person well inside the workspace had none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.workcell import vocabulary as words
from actors.workcell.scores.truth_of_run import AHEAD_S

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scores.trace import Trace
    from actors.workcell.scores.truth_of_run import Truth

    F64 = npt.NDArray[np.float64]

INSIDE_M: Final = 1.7
"""People count while their middle is so near to the robot's axis along x and y."""
TRACKED_M: Final = 0.5
"""A track at most so far from a person's middle can be theirs."""
HIDDEN_M: Final = 1.5
"""As `TRACKED_M` of a track that says "hidden": so far its prediction reaches."""


def track_samples(trace: Trace, truth: Truth) -> dict[str, list[float]]:
    """Return errors of tracks, one per track and moment, and who had none.

    `track_position_m`, `track_velocity_m_s` and `track_ahead_m` are of tracks that are not hidden.
    The last is that of the prediction which the tracker published with the track; a track without
    one counts as predicted to stay.  `untracked` is, per person and moment with a hull, 1 where no
    track of its own is near, else 0.  Excused are moments in which `system/safety` says that the
    cell cannot see (a fault): the robot stands then, and nothing is planned.  A person whom no
    camera sees is not excused: their track has to say "hidden".
    """
    found: dict[str, list[float]] = {
        name: [] for name in ("track_position_m", "track_velocity_m_s", "track_ahead_m")
    }
    tracks = _by_stamp(trace, truth)
    for stamp_ns, those in tracks.items():
        people = _inside(truth, stamp_ns)
        for track, prediction in those if people else ():
            if track.hidden:
                continue
            at_m = track.position_m[:2]
            off = [float(np.linalg.norm(one[0] - at_m)) for one in people]
            here, speed, ahead = people[off.index(min(off))]
            found["track_position_m"].append(float(np.linalg.norm(at_m - here)))
            found["track_velocity_m_s"].append(
                float(np.linalg.norm(track.velocity_m_s[:2] - speed))
            )
            found["track_ahead_m"].append(float(np.linalg.norm(_ahead(track, prediction) - ahead)))
    found["untracked"] = _untracked(trace, truth, tracks)
    return found


Tracks = dict[int, list[tuple[words.Track, "words.Prediction | None"]]]


def _by_stamp(trace: Trace, truth: Truth) -> Tracks:
    """Return the tracks of each moment with the predictions of the same moment."""
    result: Tracks = {}
    for human in trace.entities(words.TRACK):
        ahead = {one.stamp_ns: one.datum for one in trace.of(human, words.PREDICTION)}
        of_human = {one.stamp_ns: one.datum for one in trace.of(human, words.TRACK)}
        for stamp_ns, track in of_human.items():
            if truth.covers(stamp_ns):
                result.setdefault(stamp_ns, []).append((track, ahead.get(stamp_ns)))
    return result


def _inside(truth: Truth, stamp_ns: int) -> list[tuple[F64, F64, F64]]:
    """Return middle, velocity and middle half a second later of who is well inside."""
    return [one for one in truth.centres_at(stamp_ns) if np.abs(one[0]).max() < INSIDE_M]


def _ahead(track: words.Track, prediction: words.Prediction | None) -> F64:
    """Return where the tracker said that a person would be, (2,)."""
    if prediction is None:
        return np.asarray(track.position_m[:2])
    return np.array([np.interp(AHEAD_S, prediction.at_s, along) for along in prediction.centre_m.T])


def _untracked(trace: Trace, truth: Truth, tracks: Tracks) -> list[float]:
    """Return 1 per person and moment without a track of their own, 0 per one with it."""
    from scipy.optimize import linear_sum_assignment

    faults = [
        (one.stamp_ns, one.datum.state == "fault")
        for one in trace.of(words.SYSTEM.name, words.SAFETY)
    ]
    changes = np.array([stamp_ns for stamp_ns, _ in faults], np.int64)
    result: list[float] = []
    stamps = {one.stamp_ns for one in trace.of(words.WORKSPACE.name, words.HULL)}
    for stamp_ns in sorted(filter(truth.covers, stamps)):
        state = int(np.searchsorted(changes, stamp_ns, side="right")) - 1
        people = _inside(truth, stamp_ns)
        if not people or (state >= 0 and faults[state][1]):
            continue
        those = [track for track, _ in tracks.get(stamp_ns, ())]
        near = np.zeros((len(people), len(those)), bool)
        for column, track in enumerate(those):
            reach_m = HIDDEN_M if track.hidden else TRACKED_M
            off = [float(np.linalg.norm(track.position_m[:2] - here)) for here, _, _ in people]
            near[:, column] = np.array(off) <= reach_m
        rows, columns = linear_sum_assignment(near, maximize=True)
        with_one = float(near[rows, columns].sum())
        result += [0.0] * int(with_one) + [1.0] * int(len(people) - with_one)
    return result
