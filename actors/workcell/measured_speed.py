"""Speed control that goes by how fast people are, where that is known (ISO/TS 15066 5.5.4, v_h)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.workcell.speed import SpeedControl
from actors.workcell.vocabulary import HUMANS, TRACK
from enact_dist import ViewEach

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    from actors.workcell.vocabulary import Grid, Hull, Track
    from enact_dist import Lock

    F64 = npt.NDArray[np.float64]

LEAST_M_S: Final = 0.5
"""The least speed of a person: a hand is quicker than the body, and a person may start to walk."""
SIGMAS: Final = 2.0
"""Of the speed's standard deviation, on top of the speed."""
SETTLED_NS: Final = 1_000_000_000
"""A younger track has not settled yet."""
FRESH_NS: Final = 250_000_000
"""A track counts only if its person was seen within this time before the exposure."""
WITHIN_M: Final = 0.2
"""A component is a person's if it comes so near to the middle of their body, in x and y."""
REACH_M: Final = 0.9
"""So far from the middle of their body a person reaches; what is farther is not theirs alone."""


def people_m_s(
    hull: Hull, grid: Grid, tracks: Iterable[Track], captured_ns: int, assumed_m_s: float
) -> tuple[float, str]:
    """Return how fast people count, and why.

    It is the greatest speed of a track plus twice its standard deviation, if all that is occupied
    belongs to people with settled tracks, and no track is hidden, young or old; else what is
    assumed of people in general.  Someone without a settled track can stand beside another person
    and be one component with them.

    Args:
        hull: What is occupied.
        grid: Its voxels.
        tracks: Of the people.
        captured_ns: Exposure of the hull.
        assumed_m_s: Of a person who is not measured.
    """
    if not len(hull.voxels):
        return assumed_m_s, ""
    known = []
    for one in tracks:
        if not _settled(one, captured_ns):
            return _assumed(assumed_m_s, one.position_m, "has no settled track")
        known.append(one)
    middles = np.array([_middle(one, captured_ns) for one in known]).reshape(-1, 2)
    places = grid.origin_m[:2] + (hull.voxels[:, :2] + 0.5) * grid.voxel_m
    fastest_m_s = LEAST_M_S
    for number in np.unique(hull.component):
        part = places[hull.component == number]
        off_m = np.linalg.norm(part[:, None] - middles[None], axis=2)
        theirs = off_m.min(0) <= WITHIN_M
        own_m = off_m[:, theirs].min(1, initial=np.inf)
        if own_m.max() > REACH_M:
            what = "has no settled track" if not theirs.any() else "is beyond reach of their track"
            return _assumed(assumed_m_s, part[np.argmax(own_m)], what)
        quick = [_fast_m_s(one) for one, own in zip(known, theirs, strict=True) if own]
        fastest_m_s = max(fastest_m_s, *quick)
    return fastest_m_s, f"people at {fastest_m_s:.2f} m/s, measured"


def _assumed(assumed_m_s: float, at_m: F64, what: str) -> tuple[float, str]:
    x, y = at_m[:2]
    return assumed_m_s, f"{assumed_m_s:g} m/s assumed: what is at ({x:.1f}, {y:.1f}) {what}"


def _settled(track: Track, captured_ns: int) -> bool:
    fresh = 0 <= captured_ns - track.seen_ns <= FRESH_NS
    return fresh and not track.hidden and captured_ns - track.first_ns >= SETTLED_NS


def _middle(track: Track, captured_ns: int) -> F64:
    """Return x and y of a person at an exposure."""
    seconds = (captured_ns - track.seen_ns) / 1e9
    return np.asarray(track.position_m[:2] + seconds * track.velocity_m_s[:2])


def _fast_m_s(track: Track) -> float:
    """Return the speed of a track with what is uncertain about it."""
    sigma = np.sqrt(np.linalg.eigvalsh(track.covariance[3:5, 3:5])[-1])
    return float(np.linalg.norm(track.velocity_m_s[:2]) + SIGMAS * sigma)


class MeasuredSpeedControl(SpeedControl):
    """Speed control in which people are as fast as their tracks say, plus two deviations.

    The standard allows it where the speed of people is monitored.  The least is 0.5 m/s.
    `human_m_s` counts as soon as anything occupied belongs to no settled track, or while any track
    is not settled.  The reason of each speed says which of the two it was.

    A track knows the body's middle, not a hand.  This is why it is not the default.
    """

    tracks = ViewEach(SpeedControl.online, HUMANS, TRACK)

    def people_m_s(self, lock: Lock) -> tuple[float, str]:
        """Return how fast people count, and why."""
        grid = lock.get(self.grid)
        if grid is None:
            return super().people_m_s(lock)
        tracks, captured_ns = lock[self.tracks].values(), lock.stamp_ns(self.hull)
        return people_m_s(lock[self.hull], grid, tracks, captured_ns, self.human_m_s)
