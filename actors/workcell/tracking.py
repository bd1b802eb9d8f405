"""Human tracking (ENACT 4.1): recognises people in the hull and predicts where they walk."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
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
    PERIOD_NS,
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
    from collections.abc import Iterable, Mapping

    import numpy.typing as npt

    from actors.workcell.vocabulary import Grid, Hull
    from enact_dist import Entity, Lock

    F64 = npt.NDArray[np.float64]
    State = tuple[F64, F64]

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
LEVEL: Final = [0, 1, 3, 4]
"""Of position and velocity what lies in the floor's plane."""


class HumanTracking(Actor):
    """Keep an entity for each person, with track, limbs and prediction, at each hull.

    A person is a component of the tight hull of 20 litres or more; see `Person` for what becomes
    of one who is no longer seen.  What is low and still is marked as foreign, and counts as a
    person all the same.

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
        self._next = 0
        self._people: dict[Entity, Person] = {}

    def update(self, lock: Lock) -> None:
        """Find the people of the newest hull again."""
        if lock.is_null(self.grid):
            return
        hull, grid, now_ns = lock[self.hull], lock[self.grid], lock.stamp_ns(self.hull)
        tracks = dict(lock[self.tracks].items())
        seconds = since_last_s(tracks.values(), now_ns)
        if seconds <= 0.0:
            return
        known = known_people(tracks, self._people, now_ns)
        self._next = max(self._next, first_free(known))
        self._people, seen = followed(
            known, hull, grid,
            seconds=seconds, now_ns=now_ns, free=self._next, hidden_s_max=self.hidden_s_max,
        )  # fmt: skip
        finds_limbs = round(now_ns / PERIOD_NS) % self.limbs_every == 0
        for name in known.keys() - self._people.keys():
            lock[self.tracks].pop(name, None)
            lock[self.limbs].pop(name, None)
            lock[self.predictions].pop(name, None)
        for name, person in self._people.items():
            lock[self.tracks][name] = person.track
            lock[self.predictions][name] = person.prediction(seen.get(name), now_ns)
            if name not in seen:
                lock[self.limbs].pop(name, None)
            elif name not in known or known[name].track.hidden or finds_limbs:
                lock[self.limbs][name] = limbs(seen[name].points_m)


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """A person at a set: their track, and what it does not tell.

    A person no longer seen has left if last seen at a side of the workspace; otherwise they are
    hidden, and may reappear wherever they may have walked.  What was seen for less than
    `CONFIRMED_S` was not a person.

    Attributes:
        track: What is published of them.
        still_m: (2,), x and y where they have been since `still_ns`, if they are low; else None.
        still_ns: Nanoseconds since 1970.
    """

    track: Track
    still_m: F64 | None = None
    still_ns: int = 0

    @classmethod
    def new(cls, body: Body, now_ns: int) -> Person:
        """Return someone who is seen for the first time."""
        state = np.r_[body.centre_m, 0.0, 0.0], np.diag([SEEN_M**2] * 2 + [1.0] * 2)
        return cls(_track(state, body, body.top_m, now_ns, now_ns)).standing(body, now_ns)

    def hidden_s(self, now_ns: int) -> float:
        """Return for how long they have been hidden: since the set after they were last seen."""
        since_ns = now_ns - self.track.seen_ns - PERIOD_NS
        return max(0, since_ns) / 1e9 if self.track.hidden else 0.0

    def moved(self, seconds: float) -> State:
        """Return where they are some time later, as far as it is known."""
        return moved_on(*_state(self.track), 0.0 if self.track.hidden else seconds)

    def gate_m(self, covariance: F64, now_ns: int) -> float:
        """Return how far from where they are expected, with a covariance (4, 4), they can be."""
        if self.track.hidden:
            return GATE_M + WALK_M_S * self.hidden_s(now_ns)
        spread_m2 = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        return max(GATE_M, 3.0 * math.sqrt(spread_m2 + SEEN_M**2))

    def seen(self, expected: State, body: Body, now_ns: int) -> Person:
        """Return them where a body was seen that is theirs."""
        height_m = 0.8 * self.track.height_m + 0.2 * body.top_m
        first_ns = min(self.track.first_ns, now_ns)
        track = _track(corrected(*expected, body.centre_m), body, height_m, first_ns, now_ns)
        return replace(self, track=track).standing(body, now_ns)

    def standing(self, body: Body, now_ns: int) -> Person:
        """Return them where a body was seen, marked as foreign if that is low and still."""
        if body.top_m >= FOREIGN_M:
            return self
        place_m, since_ns = self.still_m, self.still_ns
        if place_m is None or np.hypot(*(body.centre_m - place_m)) > STILL_M:
            place_m, since_ns = body.centre_m, now_ns
        track = replace(self.track, foreign=now_ns - since_ns >= STILL_S * 1e9)
        return Person(track, place_m, since_ns)

    def lost(self, expected: State, grid: Grid, now_ns: int, hidden_s_max: float) -> Person | None:
        """Return them hidden, or None if they have left."""
        before, hidden_s = self.track, self.hidden_s(now_ns)
        low, high = grid.origin_m[:2], grid.origin_m[:2] + grid.voxel_m * np.array(grid.shape[:2])
        there = before.position_m[:2] if before.hidden else expected[0][:2]
        left = not before.hidden and np.minimum(there - low, high - there).min() < EDGE_M
        brief = before.seen_ns - before.first_ns < CONFIRMED_S * 1e9
        if brief or left or hidden_s > hidden_s_max:
            return None
        spread = np.diag([(SEEN_M + WALK_M_S * hidden_s) ** 2] * 2 + [WALK_M_S**2] * 2)
        still, covariance = np.zeros(3), _covariance(spread)
        return Person(
            replace(before, velocity_m_s=still, covariance=covariance, hidden=True, foreign=False)
        )

    def prediction(self, body: Body | None, now_ns: int) -> Prediction:
        """Return where they will be; a hidden one, who has no body, may be anywhere around."""
        if body is not None:
            radius_m = float(np.clip(body.radius_m, *RADIUS_M))
            return Prediction(np.array(AT_S), *predicted(*_state(self.track), AT_S, radius_m))
        radii = RADIUS_M[0] + WALK_M_S * (self.hidden_s(now_ns) + np.array(AT_S))
        return Prediction(
            np.array(AT_S),
            np.tile(self.track.position_m[:2], (len(AT_S), 1)),
            np.minimum(radii, HIDDEN_RADIUS_MAX_M),
        )


def since_last_s(tracks: Iterable[Track], now_ns: int) -> float:
    """Return how long before a set the one was that some tracks are of, seconds.

    It is one period where no track tells, and where the clock of the cameras was set back.
    """
    last_ns = max((track.seen_ns for track in tracks if not track.hidden), default=0)
    is_told = last_ns and now_ns >= last_ns - SET_BACK_NS
    return (now_ns - last_ns if is_told else PERIOD_NS) / 1e9


def known_people(
    tracks: Mapping[Entity, Track], before: Mapping[Entity, Person], now_ns: int
) -> dict[Entity, Person]:
    """Return the people of some tracks, with what was known of them before; sorted by entity.

    Where the clock of the cameras was set back, they were seen just now.
    """
    found = {}
    for name in sorted(tracks):
        track, person = tracks[name], before.get(name)
        if person is None or person.still_ns > now_ns:
            person = Person(track)
        found[name] = replace(person, track=replace(track, seen_ns=min(track.seen_ns, now_ns)))
    return found


def followed(
    known: Mapping[Entity, Person],
    hull: Hull,
    grid: Grid,
    *,
    seconds: float,
    now_ns: int,
    free: int,
    hidden_s_max: float,
) -> tuple[dict[Entity, Person], dict[Entity, Body]]:
    """Return the people at a set, and the bodies of those that are seen.

    Args:
        known: The people at the set before.
        hull: What the set shows.
        grid: Of the hull.
        seconds: Since the set before.
        now_ns: Stamp of the set, nanoseconds since 1970.
        free: Number of the first one who is new.
        hidden_s_max: Longest time that someone stays hidden.
    """
    expected = {name: person.moved(seconds) for name, person in known.items()}
    centres_m = np.array([state[:2] for state, _ in expected.values()]).reshape(-1, 2)
    visible = [not person.track.hidden for person in known.values()]
    points = grid.origin_m + (hull.voxels[hull.tight] + 0.5) * grid.voxel_m
    found = bodies(points, hull.component[hull.tight], grid.voxel_m, centres_m[visible])
    gates = [person.gate_m(expected[name][1], now_ns) for name, person in known.items()]
    there_m = np.array([body.centre_m for body in found]).reshape(-1, 2)
    pairs = associated(centres_m, np.array(gates), there_m)
    names = list(known)
    seen = {names[row]: found[column] for row, column in pairs}
    people: dict[Entity, Person] = {}
    for name, person in known.items():
        if name in seen:
            people[name] = person.seen(expected[name], seen[name], now_ns)
        elif lost := person.lost(expected[name], grid, now_ns, hidden_s_max):
            people[name] = lost
    taken = {column for _, column in pairs}
    others = [body for column, body in enumerate(found) if column not in taken]
    for number, body in enumerate(others, free):
        people[human_entity(number)] = Person.new(body, now_ns)
        seen[human_entity(number)] = body
    return people, seen


def first_free(names: Iterable[Entity]) -> int:
    """Return the number of the next person: above all that are there."""
    return 1 + max((int(name.name.rpartition("/")[2]) for name in names), default=-1)


def _state(track: Track) -> State:
    """Return state (4,) and covariance (4, 4) of a track."""
    state = np.r_[track.position_m[:2], track.velocity_m_s[:2]]
    return state, track.covariance[np.ix_(LEVEL, LEVEL)]


def _track(state: State, body: Body, height_m: float, first_ns: int, now_ns: int) -> Track:
    """Return the track of someone who is seen now."""
    return Track(
        position_m=np.r_[state[0][:2], body.top_m],
        velocity_m_s=np.r_[state[0][2:], 0.0],
        covariance=_covariance(state[1]),
        height_m=height_m,
        volume_m3=body.volume_m3,
        first_ns=first_ns,
        hidden=False,
        seen_ns=now_ns,
    )


def _covariance(level: F64) -> F64:
    """Return the covariance (6, 6) of position and velocity, by that in the floor's plane."""
    covariance = np.zeros((6, 6))
    covariance[np.ix_(LEVEL, LEVEL)] = level
    covariance[2, 2] = SEEN_M**2
    return covariance
