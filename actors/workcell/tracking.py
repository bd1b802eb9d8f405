"""Human tracking (ENACT 4.1): recognises people in the hull and predicts where they walk."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.people import (
    SEEN_M,
    WALK_M_S,
    Body,
    associated,
    bodies,
    corrected,
    limbs,
    moved_on,
    predicted,
)
from actors.workcell.vocabulary import (
    GRID,
    HULL,
    HUMANS,
    LIMBS,
    PERIOD_S,
    PREDICTION,
    SET_BACK_NS,
    TRACK,
    WORKSPACE,
    Prediction,
    Track,
    human_entity,
)
from enact_dist import Actor, View, World, WriteEach

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.vocabulary import Grid
    from enact_dist import Entity, Lock

    F64 = npt.NDArray[np.float64]

CONFIRMED_S: Final = 0.25
"""For how long a person must have been seen to count as hidden when they are seen no longer.

What was seen for less was not a person: the arm as it comes into view, a bad image.  Trackers of
many targets call this the confirmation of a track.
"""
AT_S: Final = tuple(k / 10.0 for k in range(1, 11))
"""For when a person is predicted, seconds after the stamp."""
EDGE_M: Final = 0.4
"""A person last seen this near to a side of the workspace has left."""
FOREIGN_M: Final = 0.6
"""What is lower than this, and still, is no standing person."""
STILL_M: Final = 0.05
STILL_S: Final = 3.0
"""What has moved by less than `STILL_M` for this long is still."""
GATE_M: Final = 0.35
"""Distance from where a person is expected at which they are recognised, whatever the spread."""
HIDDEN_RADIUS_MAX_M: Final = 1.5
"""Greatest radius of the prediction of a hidden person."""
RADIUS_M: Final = (0.25, 0.6)
"""Least and greatest radius of a body."""


class HumanTracking(Actor):
    """Keep an entity for each person, with track, limbs and prediction, at each hull.

    A person is a component of the tight hull of 20 litres or more.  A person no longer seen
    has left if last seen at a side of the workspace; otherwise they are hidden, and may reappear
    wherever they may have walked.  A component seen for less than :data:`CONFIRMED_S` was not a
    person.  What is low and still is marked as foreign, and counts as a person all the same.

    Attributes:
        hidden_s_max: How long someone stays hidden before the track ends.
        limbs_every: Of so many sets, limbs are found in one: they take longer than all else.
    """

    online = World("online")
    hull = View(online, WORKSPACE, HULL)
    grid = View(online, WORKSPACE, GRID)
    tracks = WriteEach(online, HUMANS, TRACK)
    limbs = WriteEach(online, HUMANS, LIMBS)
    predictions = WriteEach(online, HUMANS, PREDICTION)
    triggers = (hull,)

    hidden_s_max: float = 300.0
    limbs_every: int = 3

    def __init__(self) -> None:
        self._last_ns = self._next = self._sets = 0
        self._hidden_since_ns: dict[Entity, int] = {}
        self._still_since: dict[Entity, tuple[F64, int]] = {}

    def update(self, lock: Lock) -> None:
        """Find the people of the newest hull again."""
        if lock.is_null(self.grid):
            return
        hull, grid, now_ns = lock[self.hull], lock[self.grid], lock.stamp_ns(self.hull)
        if now_ns < self._last_ns - SET_BACK_NS:
            self._last_ns = 0
            self._hidden_since_ns, self._still_since = {}, {}
        seconds = (now_ns - self._last_ns) / 1e9 if self._last_ns else PERIOD_S
        if seconds <= 0.0:
            return
        self._last_ns, self._sets = now_ns, self._sets + 1
        known = dict(lock[self.tracks].items())
        names = sorted(known)
        expected = {name: _moved(known[name], seconds) for name in names}
        visible = [name for name in names if not known[name].hidden]
        points = grid.origin_m + (hull.voxels[hull.tight] + 0.5) * grid.voxel_m
        found = bodies(
            points,
            hull.component[hull.tight],
            grid.voxel_m,
            np.array([expected[name][0][:2] for name in visible]).reshape(-1, 2),
        )
        pairs = associated(
            np.array([expected[name][0][:2] for name in names]).reshape(-1, 2),
            np.array(
                [self._gate_m(name, known[name], expected[name][1], now_ns) for name in names]
            ),
            np.array([body.centre_m for body in found]).reshape(-1, 2),
        )
        seen = {names[row]: found[column] for row, column in pairs}
        for name in names:
            if name in seen:
                self._hidden_since_ns.pop(name, None)
                state = corrected(*expected[name], seen[name].centre_m)
                self._write(lock, name, state, seen[name], known[name], now_ns)
            else:
                self._lose(lock, name, expected[name], known[name], grid, now_ns)
        taken = {column for _, column in pairs}
        self._next = max(self._next, _first_free(names))
        for column, body in enumerate(found):
            if column not in taken:
                state = np.r_[body.centre_m, 0.0, 0.0], np.diag([SEEN_M**2] * 2 + [1.0] * 2)
                self._write(lock, human_entity(self._next), state, body, None, now_ns)
                self._next += 1

    def _gate_m(self, name: Entity, track: Track, covariance: F64, now_ns: int) -> float:
        """Return how far from where they are expected a person can be."""
        spread_m = 3.0 * float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1] + SEEN_M**2))
        if not track.hidden:
            return max(GATE_M, spread_m)
        return GATE_M + WALK_M_S * self._hidden_s(name, now_ns)

    def _hidden_s(self, name: Entity, now_ns: int) -> float:
        return (now_ns - self._hidden_since_ns.setdefault(name, now_ns)) / 1e9

    def _write(
        self,
        lock: Lock,
        name: Entity,
        state: tuple[F64, F64],
        body: Body,
        before: Track | None,
        now_ns: int,
    ) -> None:
        """Write what is known of a person who is seen."""
        height_m = body.top_m if before is None else 0.8 * before.height_m + 0.2 * body.top_m
        first_ns = now_ns if before is None else min(before.first_ns, now_ns)
        lock[self.tracks][name] = _track(
            state,
            body.top_m,
            height_m,
            body.volume_m3,
            first_ns,
            now_ns,
            foreign=body.top_m < FOREIGN_M and self._is_still(name, body.centre_m, now_ns),
        )
        if before is None or before.hidden or self._sets % self.limbs_every == 0:
            lock[self.limbs][name] = limbs(body.points_m)
        radius_m = float(np.clip(body.radius_m, *RADIUS_M))
        lock[self.predictions][name] = Prediction(
            np.array(AT_S), *predicted(*state, AT_S, radius_m)
        )

    def _is_still(self, name: Entity, centre_m: F64, now_ns: int) -> bool:
        place_m, since_ns = self._still_since.get(name, (centre_m, now_ns))
        if np.hypot(*(centre_m - place_m)) > STILL_M:
            place_m, since_ns = centre_m, now_ns
        self._still_since[name] = place_m, since_ns
        return now_ns - since_ns >= STILL_S * 1e9

    def _lose(
        self,
        lock: Lock,
        name: Entity,
        state: tuple[F64, F64],
        before: Track,
        grid: Grid,
        now_ns: int,
    ) -> None:
        """Write that a person is hidden, or that they have left."""
        self._still_since.pop(name, None)
        low, high = grid.origin_m[:2], grid.origin_m[:2] + grid.voxel_m * np.array(grid.shape[:2])
        there = before.position_m[:2] if before.hidden else state[0][:2]
        inside_m = float(np.minimum(there - low, high - there).min())
        hidden_s = self._hidden_s(name, now_ns)
        brief = before.seen_ns - before.first_ns < CONFIRMED_S * 1e9
        left = not before.hidden and inside_m < EDGE_M
        if brief or left or hidden_s > self.hidden_s_max:
            self._hidden_since_ns.pop(name, None)
            lock[self.tracks].pop(name, None)
            lock[self.limbs].pop(name, None)
            lock[self.predictions].pop(name, None)
            return
        still = np.r_[before.position_m[:2], 0.0, 0.0]
        spread = np.diag([(SEEN_M + WALK_M_S * hidden_s) ** 2] * 2 + [WALK_M_S**2] * 2)
        lock[self.tracks][name] = _track(
            (still, spread),
            float(before.position_m[2]),
            before.height_m,
            before.volume_m3,
            before.first_ns,
            before.seen_ns,
            hidden=True,
        )
        lock[self.limbs].pop(name, None)
        radii = RADIUS_M[0] + WALK_M_S * (hidden_s + np.array(AT_S))
        lock[self.predictions][name] = Prediction(
            np.array(AT_S),
            np.tile(before.position_m[:2], (len(AT_S), 1)),
            np.minimum(radii, HIDDEN_RADIUS_MAX_M),
        )


def _moved(track: Track, seconds: float) -> tuple[F64, F64]:
    """Return state (4,) and covariance (4, 4) of a track some time later."""
    if track.hidden:
        seconds = 0.0
    kept = [0, 1, 3, 4]
    state = np.r_[track.position_m[:2], track.velocity_m_s[:2]]
    return moved_on(state, track.covariance[np.ix_(kept, kept)], seconds)


def _track(
    state: tuple[F64, F64],
    top_m: float,
    height_m: float,
    volume_m3: float,
    first_ns: int,
    seen_ns: int,
    *,
    hidden: bool = False,
    foreign: bool = False,
) -> Track:
    covariance = np.zeros((6, 6))
    kept = [0, 1, 3, 4]
    covariance[np.ix_(kept, kept)] = state[1]
    covariance[2, 2] = SEEN_M**2
    return Track(
        position_m=np.r_[state[0][:2], top_m],
        velocity_m_s=np.r_[state[0][2:], 0.0],
        covariance=covariance,
        height_m=height_m,
        volume_m3=volume_m3,
        first_ns=first_ns,
        hidden=hidden,
        seen_ns=seen_ns,
        foreign=foreign,
    )


def _first_free(names: list[Entity]) -> int:
    """Return the number of the next person: above all that are there."""
    return 1 + max((int(name.name.rpartition("/")[2]) for name in names), default=-1)
