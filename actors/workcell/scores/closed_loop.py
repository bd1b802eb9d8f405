"""Run the workcell in one process in simulated time: as fast as the processor can, reproducibly.

The product's actors run one after another on a core in memory, on a manual clock: cameras draw,
silhouettes are subtracted, hull, tracks, speed and path are made of them, and the robot's loop
obeys what comes `LATENCY_S` after the exposure.  Only the sources, the clock and the order are not
those of a cell of processes; so all that is scored on truth is the same for the same seed, on any
machine, whatever runs beside it.

`quality` runs the scenarios for several seeds and scores them.  `Sight` is what the robot goes by:
the cameras, or the truth in their place.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from actors.geometry.arms.kinematics import capsules_at
from actors.geometry.hull.silhouettes import BackgroundStatistics, Subtraction, packed
from actors.geometry.separation import Separation
from actors.workcell import vocabulary as words
from actors.workcell.background import checksum, one_thread
from actors.workcell.motion import CYCLE_S, NOMINAL_M_S, Motion
from actors.workcell.planning import PathPlanning
from actors.workcell.reconstruction import Reconstruction
from actors.workcell.scenarios import Fault, Scenario
from actors.workcell.scores.trace import ONLINE, TRUTH, Kept, Trace
from actors.workcell.scores.true_hull import TrueHull
from actors.workcell.setup import grid_of, task_of
from actors.workcell.simulation.arm import ARM, HOME_RAD
from actors.workcell.simulation.room import boxes_of, cameras
from actors.workcell.simulation.sources import LiveSource
from actors.workcell.speed import SpeedControl
from actors.workcell.tracking import HumanTracking
from actors.workcell.watch import CameraWatch, StandIn
from enact_dist import Lock, View, ViewEach, Write, testing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy.typing as npt

    from actors.geometry.hull.visibility import CameraTable
    from actors.geometry.hull.voxels import VoxelBlocks
    from enact_dist import Actor, Aspect, Cell, Entity

    F64 = npt.NDArray[np.float64]

LATENCY_S: Final = 0.08
"""From an exposure until the robot's loop has the command made of it."""
START_S: Final = 1_700_000_000.0
PERIOD_NS: Final = round(words.PERIOD_S * 1e9)
IMAGES: Final = 20
"""Images of the empty cell that make a background."""
RESTART_S: Final = 1.5
"""How long a killed process stays away."""
SEARCH_S: Final = 3600.0
"""A search ends by the number of its questions here, never by the clock: so it is reproducible."""
_OF_ONLINE: Final[tuple[tuple[Entity, Aspect[Any]], ...]] = (
    (words.WORKSPACE, words.HULL),
    (words.ROBOT, words.SPEED),
    (words.ROBOT, words.PATH),
    (words.SYSTEM, words.SAFETY),
)


class Sight(enum.Enum):
    """What the robot goes by."""

    CAMERAS = "cameras"
    ORACLE = "oracle"
    """The true distance and the true bodies, without delay but that of the robot's commands."""
    ZONE = "zone"
    """A fixed zone: full speed while it is empty, rest while a person is in it."""


class _Reconstruction(Reconstruction):
    clock: testing.ManualClock
    made: ClassVar[dict[bytes, list[CameraTable]]] = {}
    """Tables by what they were made of: runs in the same room share them."""

    def tables(
        self, blocks: VoxelBlocks, calibrations: list[words.Calibration], boxes: list[F64]
    ) -> list[CameraTable]:
        key = b"".join([np.array([blocks.voxel_m]).tobytes(), *(box.tobytes() for box in boxes)])
        if key not in self.made:
            self.made[key] = super().tables(blocks, calibrations, boxes)
        return self.made[key]

    def now_ns(self) -> int:
        return self.clock.wall_ns()


class _Later:
    clock: testing.ManualClock

    def now_ns(self) -> int:
        return self.clock.wall_ns() + round(LATENCY_S * 1e9)


class _SpeedControl(_Later, SpeedControl):
    pass


class _PathPlanning(_Later, PathPlanning):
    pass


@dataclass
class Eyes:
    """The eight cameras of the simulated room, with the backgrounds that they have learned."""

    sources: list[LiveSource]
    subtractions: dict[bool, list[Subtraction]] = field(default_factory=dict)

    @classmethod
    def opened(cls) -> Eyes:
        """Open the sources."""
        one_thread()
        sources = [LiveSource(str(number)) for number in range(words.CAMERA_COUNT)]
        for source, calibration in zip(sources, cameras(), strict=True):
            source.open(calibration)
        return cls(sources)

    def learned(self, playing: words.Playing, *, walk_in: bool) -> list[Subtraction]:
        """Return the subtractions of a room, learned once."""
        if walk_in not in self.subtractions:
            empty = words.Playing(playing.scenario, playing.seed, 1 << 62, playing.seconds, False)
            found = []
            for source in self.sources:
                source.look(empty, None)
                statistics = BackgroundStatistics()
                for image in range(IMAGES):
                    statistics.add(source.frame((image + 1) * PERIOD_NS))
                found.append(Subtraction(statistics.mean, statistics.spread))
            self.subtractions[walk_in] = found
        return self.subtractions[walk_in]


@lru_cache(maxsize=1)
def _eyes() -> Eyes:
    return Eyes.opened()


class ClosedLoop:
    """One run of a scenario.

    Args:
        scenario: What plays; cameras draw the one of its name, seed and seconds.
        sight: What the robot goes by.
        voxel_m: Edge of a voxel.

    Attributes:
        versions: What a recording of the run would hold.
        masks: Called with the stamp, the silhouettes and the arm of each set, if it is not None.
    """

    def __init__(
        self, scenario: Scenario, *, sight: Sight = Sight.CAMERAS, voxel_m: float = 0.025
    ) -> None:
        self.scenario, self.sight = scenario, sight
        self.versions: dict[tuple[str, str, str], list[Kept[Any]]] = {}
        self.masks: Callable[[int, list[Any], F64], None] | None = None
        self._clock = testing.ManualClock(start_s=START_S)
        self._start_ns = self._clock.wall_ns()
        self._grid = grid_of(voxel_m)
        self._motion = Motion(ARM, np.array(HOME_RAD), self._start_ns)
        self._taken_ns = 0
        self._known: dict[str, int] = {}
        self._playing = words.Playing(
            scenario.name, scenario.seed, self._start_ns, scenario.seconds, robot=True
        )
        self._actors: dict[str, Actor] = {}
        self._truth = TrueHull(scenario, self._grid, ARM)

    def run(self) -> Trace:
        """Play the scenario to its end and return what a recording would hold."""
        if self.sight is Sight.CAMERAS:
            eyes = _eyes()
            subtractions = eyes.learned(self._playing, walk_in=self.scenario.walk_in)
            for source in eyes.sources:
                source.look(self._playing, None)
        with testing.worlds(ONLINE, clock=self._clock) as cell:
            self._set_up(cell)
            for tick in range(math.ceil(self.scenario.seconds / words.PERIOD_S - 1e-9)):
                self._put(cell, words.ROBOT, words.JOINTS, self._motion.joints())
                if self.sight is Sight.CAMERAS:
                    self._look(cell, eyes, subtractions)
                else:
                    self._know(cell, tick)
                self._decide(cell)
                self._move(cell)
                self._clock.advance(words.PERIOD_S)
        return Trace(self.versions)

    # ------------------------------------------------------------ what is known beforehand

    def _set_up(self, cell: Cell) -> None:
        for number, calibration in enumerate(cameras()):
            self._put(cell, words.camera_entity(number), words.CALIBRATION, calibration)
        for number, box in enumerate(boxes_of(self.scenario)):
            self._put(cell, words.obstacle_entity(number), words.BOXES, box.row()[None])
        self._put(cell, words.WORKSPACE, words.GRID, self._grid)
        self._put(cell, words.ROBOT, words.MODEL, ARM)
        self._put(cell, words.ROBOT, words.TASK, task_of())
        self._keep(words.SCENARIO, words.PLAYING, self._playing, world=TRUTH)
        self._actors = {
            name: self._made(name)
            for name in ("watch", "stand-in", "reconstruction", "tracking", "speed", "planning")
        }

    def _made(self, name: str) -> Actor:
        """Return an actor as its process has it after a start."""
        if name == "watch":
            return CameraWatch()
        if name == "stand-in":
            return StandIn()
        if name == "tracking":
            return HumanTracking()
        if name == "reconstruction":
            seeing = _Reconstruction()
            seeing.clock = self._clock
            return seeing
        if name == "speed":
            speed = _SpeedControl()
            speed.clock = self._clock
            return speed
        planning = _PathPlanning()
        planning.clock, planning.limit_s = self._clock, SEARCH_S
        return planning

    # ------------------------------------------------------------ what is seen

    def _look(self, cell: Cell, eyes: Eyes, subtractions: list[Subtraction]) -> None:
        """Let the cameras see the tick, and make a hull of it."""
        joints, stamp_ns = self._motion.joints(), self._clock.wall_ns()
        testing.run_once(self._actors["watch"], cell)
        testing.run_once(self._actors["stand-in"], cell)
        silhouettes: list[npt.NDArray[np.uint8] | None] = []
        for number, (source, subtract) in enumerate(zip(eyes.sources, subtractions, strict=True)):
            faults = list(self._faults(f"camera-{number}"))
            if any(fault.kind != "stuck" for fault in faults):
                silhouettes.append(None)
                continue
            source.look(self._playing, joints, stuck=bool(faults))
            image = source.frame(stamp_ns)
            mask, shade = subtract.split(image)
            bits = packed(mask)
            silhouettes.append(bits)
            found = words.Silhouette(
                bits, int(np.count_nonzero(mask)), False, checksum(image), packed(shade)
            )
            self._put(cell, words.camera_entity(number), words.SILHOUETTE, found, stamp_ns)
        if self.masks is not None:
            self.masks(stamp_ns, silhouettes, capsules_at(ARM, self._motion.q_rad)[0])
        if self._runs("reconstruction"):
            testing.run_once(self._actors["reconstruction"], cell)

    def _know(self, cell: Cell, tick: int) -> None:
        """Let the robot know the truth in place of what cameras see."""
        self._put(cell, words.SYSTEM, words.CAMERA_STATES, {}, self._clock.wall_ns())
        at_s = tick * words.PERIOD_S
        if self.sight is Sight.ORACLE:
            hull = self._truth.hull_at(at_s, self._motion.q_rad)
        else:
            hull = self._truth.zone_at(at_s, Separation().protective_m(NOMINAL_M_S))
        self._put(cell, words.WORKSPACE, words.HULL, hull, self._clock.wall_ns())

    def _decide(self, cell: Cell) -> None:
        """Track, limit the speed, plan; keep what was written."""
        for name in ("tracking", "speed", "planning"):
            if name == "tracking" and self.sight is Sight.ZONE:
                continue
            if self._runs(name):
                testing.run_once(self._actors[name], cell)
        self._keep_newest(cell)

    def _move(self, cell: Cell) -> None:
        """Let the robot's loop run for one period; what was decided arrives on the way."""
        stamp_ns = self._clock.wall_ns()
        cycle_ns = round(CYCLE_S * 1e9)
        arrives_ns = stamp_ns + round(LATENCY_S * 1e9)
        for now_ns in range(stamp_ns, stamp_ns + PERIOD_NS, cycle_ns):
            if now_ns - cycle_ns < arrives_ns <= now_ns:
                self._command(cell, now_ns)
            self._motion.cycle(now_ns)
            self._motion.measured(self._motion.q_rad, self._motion.dq_rad_s, now_ns)

    def _command(self, cell: Cell, now_ns: int) -> None:
        """Give the robot the newest speed and path, and keep what it makes of them."""
        motion, refusal = self._motion, ""
        speeds = self.versions.get((ONLINE, words.ROBOT.name, words.SPEED.name))
        if speeds and speeds[-1].datum.captured_ns != self._taken_ns:
            refusal = motion.obey(speeds[-1].datum, now_ns)
            self._taken_ns = speeds[-1].datum.captured_ns
        paths = self.versions.get((ONLINE, words.ROBOT.name, words.PATH.name))
        if paths:
            motion.follow(paths[-1].datum, now_ns)
        done = motion.execution(self._clock.wall_ns(), now_ns, refusal)
        self._put(cell, words.ROBOT, words.EXECUTION, done)

    # ------------------------------------------------------------ data

    def _put(
        self, cell: Cell, entity: Entity, aspect: Aspect[Any], datum: object, stamp_ns: int = 0
    ) -> None:
        request = Write(cell.world(ONLINE), entity, aspect)
        with Lock(request) as lock:
            lock.put(request, datum, stamp_ns=stamp_ns)
        if aspect not in (words.SILHOUETTE, words.HULL):
            self._keep(entity, aspect, datum)

    def _keep(
        self,
        entity: Entity,
        aspect: Aspect[Any],
        datum: object,
        *,
        world: str = ONLINE,
        stamp_ns: int = 0,
    ) -> None:
        stamp_ns = stamp_ns or self._clock.wall_ns()
        kept = Kept(stamp_ns, stamp_ns + round(LATENCY_S * 1e9), datum)
        self.versions.setdefault((world, entity.name, aspect.name), []).append(kept)

    def _keep_newest(self, cell: Cell) -> None:
        """Keep what the actors have written since the last tick, with its stamps."""
        online = cell.world(ONLINE)
        single = [View(online, entity, aspect) for entity, aspect in _OF_ONLINE]
        people = [
            (aspect, ViewEach(online, words.HUMANS, aspect))
            for aspect in (words.TRACK, words.PREDICTION)
        ]
        with Lock(*single, *(view for _, view in people)) as lock:
            for view, (entity, aspect) in zip(single, _OF_ONLINE, strict=True):
                version = lock.version(view)
                if lock.is_null(view) or version == self._known.get(aspect.name):
                    continue
                self._known[aspect.name] = version
                self._keep(entity, aspect, lock[view], stamp_ns=lock.stamp_ns(view))
                if aspect is words.HULL:
                    for kind, those in people:
                        for human, datum in lock[those].items():
                            self._keep(human, kind, datum, stamp_ns=lock.stamp_ns(view))

    # ------------------------------------------------------------ what breaks

    def _faults(self, target: str) -> Iterator[Fault]:
        """Yield what is broken of a process now."""
        at_s = (self._clock.wall_ns() - self._start_ns) / 1e9
        for fault in self.scenario.faults:
            lasts_s = RESTART_S if fault.kind == "kill" else fault.seconds
            if fault.target == target and fault.at_s <= at_s < fault.at_s + lasts_s:
                yield fault

    def _runs(self, name: str) -> bool:
        """Say whether an actor runs now; one that was killed starts anew."""
        if any(self._faults(name)) or any(self._faults("cell")):
            self._actors[name] = self._made(name)
            return False
        return True
