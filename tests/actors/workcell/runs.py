"""Runs made by hand: a trace of a scenario, with an arm at rest and hulls made of the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.capsules import distance_to_points
from actors.workcell import vocabulary as words
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.trace import ONLINE, TRUTH, Kept, Trace
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.simulation.human import Person

if TYPE_CHECKING:
    from enact_dist import Aspect

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
GRID = words.Grid(np.array([-2.0, -2.0, 0.0]), 0.05, (80, 80, 44))


def near(body: np.ndarray) -> np.ndarray:
    """Return the voxels (n, 3) of the box around a body."""
    if not len(body):
        return np.empty((0, 3), int)
    ends = body[:, :6].reshape(-1, 3)
    low, high = (
        np.clip(np.floor((end - GRID.origin_m) / GRID.voxel_m).astype(int), 0, GRID.shape)
        for end in (ends.min(0) - 0.2, ends.max(0) + 0.2)
    )
    axes = [np.arange(one, other) for one, other in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


class Run:
    """Collects versions; `trace` gives them as a recording would.

    Args:
        scenario: Name of the scenario, of seed 1.
        seconds: How long it lasts.
    """

    def __init__(self, scenario: str, seconds: float) -> None:
        self.scenario = scenario_of(scenario, 1, seconds)
        self.people = [Person(walk) for walk in self.scenario.walks]
        self.versions: dict[tuple[str, str, str], list[Kept[Any]]] = {}
        self.q = np.array(HOME_RAD)
        playing = words.Playing(scenario, 1, START_NS, seconds, robot=True)
        self.add(words.SCENARIO.name, words.PLAYING, playing, 0, world=TRUTH)
        self.add(words.WORKSPACE.name, words.GRID, GRID, 0)
        self.add(words.ROBOT.name, words.MODEL, ARM, 0)
        eye = words.Calibration(np.eye(3), np.zeros(5), np.eye(4), 640, 480)
        self.add("camera/0", words.CALIBRATION, eye, 0)

    @property
    def ticks(self) -> range:
        """The ticks of the scenario."""
        return range(round(self.scenario.seconds * 10))

    def add(
        self,
        entity: str,
        aspect: Aspect[Any],
        datum: object,
        tick: int,
        *,
        late_ms: float = 0.0,
        world: str = ONLINE,
    ) -> None:
        """Add a version with the stamp of a tick, committed so much later."""
        stamp = START_NS + tick * PERIOD_NS
        kept = Kept(stamp, stamp + round(late_ms * 1e6), datum)
        self.versions.setdefault((world, entity, aspect.name), []).append(kept)

    def rest(self, dq: float = 0.0) -> None:
        """Let the arm stand where it is, with a turning of the first joint that it claims."""
        for tick in self.ticks[9::10]:
            stamps = START_NS + (tick - 9) * PERIOD_NS + np.arange(100) * 10_000_000
            turning = np.zeros((100, 7))
            turning[:, 0] = dq
            joints = words.Joints(np.tile(self.q, (100, 1)), turning, stamps)
            self.add(words.ROBOT.name, words.JOINTS, joints, tick)

    def hull(self, tick: int, *, without: int = 0, late_ms: float = 40.0) -> None:
        """Add the hull that is the truth, without its first voxels."""
        bodies = [
            body for person in self.people if (body := person.capsules_at(tick / 10)) is not None
        ]
        body = np.concatenate([np.empty((0, 7)), *bodies])
        index = near(body)
        centres = GRID.origin_m + (index + 0.5) * GRID.voxel_m
        index = index[distance_to_points(body, centres) <= 0.0][without:] if len(index) else index
        centres = GRID.origin_m + (index + 0.5) * GRID.voxel_m
        arm = capsules_at(ARM, self.q)[0]
        clearance = distance_to_points(arm, centres) if len(index) else np.empty(0, np.float32)
        hull = words.Hull(
            voxels=index.astype(np.int16),
            clearance_m=clearance,
            tight=np.ones(len(index), np.bool_),
            component=np.zeros(len(index), np.int16),
            counts={},
            cameras=("camera/0",),
            nearest_m=float(clearance.min(initial=np.inf)),
            nearest_voxel=int(clearance.argmin()) if len(index) else -1,
        )
        self.add(words.WORKSPACE.name, words.HULL, hull, tick, late_ms=late_ms)

    def trace(self) -> Trace:
        """Return what a recording of it would give."""
        return Trace(self.versions)
