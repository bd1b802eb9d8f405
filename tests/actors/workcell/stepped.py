"""The cell of `cell.toml` in one process, one tick after the other on a manual clock.

No second passes by itself, so a slow machine changes nothing: each tick has the times that it has on
a machine that is quick enough.  Images are of half size and nothing else is, which makes a tick
cheap; all actors, locks and commits are those of the cell.
"""

from __future__ import annotations

import contextlib
import time
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from lost_commits import lose_commit

from actors.geometry.hull.visibility import camera_table
from actors.workcell import reconstruction, robot, setup
from actors.workcell import vocabulary as words
from actors.workcell.demo.cell import SETUP, TEMPLATE
from actors.workcell.motion import CYCLE_S, Motion
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.trace import ASPECTS, ONLINE, RECORDED, TRUTH, Kept, Trace
from actors.workcell.simulation.camera import SimulatedCamera
from actors.workcell.simulation.drawing.render import View as Room
from actors.workcell.simulation.room import cameras
from actors.workcell.simulation.sources import LiveSource
from enact_dist import Lock, View, Write, testing
from enact_dist.access.reads import slot_of
from enact_dist.actor.running.load import configured_actor
from enact_dist.config.read import load_config

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import pytest

    from actors.geometry.hull.voxels import VoxelBlocks
    from actors.workcell.cameras.sources import CameraSource
    from actors.workcell.vocabulary import ArmModel, Calibration
    from enact_dist import Actor, Cell
    from enact_dist.config.types import ActorConfig

TICK_S: Final = words.PERIOD_S
SCALE: Final = 0.5
"""Of the images: 320 x 240 pixels."""
VOXEL_M: Final = 0.025
MASKS_S: Final = 0.05
"""From the exposure to the last mask."""
SIBLINGS: Final = ("background", "silhouette")
"""Actors in the process of a camera."""
LEARNED: Final = 4
"""Images of a background: enough for the noise of the simulation."""


@cache
def drawn_room(number: int, seed: int) -> Room:
    """Return the renderer of a camera; what it has drawn serves all scenarios."""
    return Room(cameras(SCALE)[number], seed=seed)


_tables: dict[bytes, Any] = {}


def table_of(blocks: VoxelBlocks, calibration: Calibration, boxes: Any) -> Any:
    """Return what `camera_table` does, worked out once for all scenarios."""
    pose = calibration.camera_from_cell.tobytes()
    key = b"".join([pose, *(np.asarray(box, float).tobytes() for box in boxes)])
    if key not in _tables:
        _tables[key] = camera_table(blocks, calibration, boxes)
    return _tables[key]


class Source(LiveSource):
    """A live source whose room is drawn once for all tests."""

    def open(self, calibration: Calibration) -> None:
        """Take the room that is drawn already."""
        self._view = drawn_room(self._number, self._number)
        self._follow()


class Inline:
    """What `Camera` asks for images, without a thread, and without getting ready in good time."""

    def __init__(self, source: CameraSource) -> None:
        self._source, self._open = source, False

    def image(self, calibration: Calibration, stamp_ns: int) -> tuple[Any, int]:
        """Return the image of a tick, exposed at it."""
        if not self._open:
            self._source.open(calibration)
        self._open = True
        return self._source.frame(stamp_ns), stamp_ns

    def prepare(self, stamp_ns: int) -> None:
        """Do nothing: time stands still."""

    def close(self) -> None:
        """Nothing is open."""


class Arm:
    """`RunningArm` without its thread: `Stepped` calls its loop."""

    def __init__(self, driver: Any, model: ArmModel, last_rad: Any) -> None:
        self.driver = driver
        self.motion = Motion(model, driver.open(last_rad), time.time_ns())

    def check(self) -> None:
        """Nothing ends the loop."""

    def close(self) -> None:
        """Nothing runs."""


class Stepped:
    """A cell that plays a scenario tick by tick.

    Args:
        cell: World contexts on a manual clock.
        clock: The clock.
        name: The scenario.
        seed: Its seed.
        seconds: How long it lasts.
        begin_s: At which second of it to begin.

    Attributes:
        loses: The commit of each first step of an actor with triggers fails.
    """

    def __init__(
        self,
        cell: Cell,
        clock: testing.ManualClock,
        name: str,
        *,
        seed: int,
        seconds: float,
        begin_s: float,
    ) -> None:
        self.cell, self.clock = cell, clock
        self.scenario = scenario_of(name, seed, seconds)
        self.config = {one.name: one for one in load_config(TEMPLATE).actors}
        self.actors: dict[str, Actor] = {}
        self.loses = False
        self.frozen: set[str] = set()
        self.versions: dict[tuple[str, str, str], list[Kept[Any]]] = {}
        self._newest: dict[tuple[str, str, str], int] = {}
        for actor in self.config:
            self.start(actor)
        self.start_ns = self._begin(begin_s)

    # ---------------------------------------------------------------- actors

    def start(self, name: str) -> None:
        """Start an actor, anew if it has run before."""
        config = self.config[name]
        if name == SETUP:
            played = self.scenario
            actor: Actor = setup.Setup(played.name, played.seed, played.seconds, VOXEL_M)
        elif name.startswith("camera-"):
            actor = self._camera(config)
        else:
            actor = configured_actor(config)
        if name.startswith("background-"):
            actor.images = LEARNED  # type: ignore[attr-defined]
        actor.start()
        actor.start = actor.stop = _nothing  # type: ignore[method-assign]
        self.actors[name] = actor

    def kill(self, name: str) -> None:
        """End an actor without a word."""
        del self.actors[name]

    def _camera(self, config: ActorConfig) -> Actor:
        camera = SimulatedCamera()
        camera.only_entity = words.Entity(config.entity)
        number = config.entity.partition("/")[2]
        source = Source(number)
        camera._simulated, camera._capture = source, Inline(source)
        return camera

    def run(self, *names: str) -> int:
        """Let actors do what is pending for them, those whose names begin so."""
        updates = 0
        for name, actor in list(self.actors.items()):
            if name not in self.frozen and name.startswith(names):
                worlds = dict(self.config[name].worlds) or None
                if self.loses and actor.declaration.triggers:
                    lose_commit(actor, self.cell, worlds)
                updates += testing.run_once(actor, self.cell, worlds)
        return updates

    # ---------------------------------------------------------------- time

    def break_as_planned(self, after_s: float) -> None:
        """Do what the faults of the scenario do; what was killed starts again `after_s` later.

        A shard cannot be killed: it lives in this process.
        """
        for fault in self.scenario.faults:
            number = fault.target.partition("-")[2]
            names = [fault.target, *(f"{kind}-{number}" for kind in SIBLINGS if number)]
            begins = abs(self.at_s - fault.at_s) < TICK_S / 2
            ends_s = fault.at_s + (after_s if fault.kind == "kill" else fault.seconds)
            ends = abs(self.at_s - ends_s) < TICK_S / 2
            if fault.target not in self.config or not (begins or ends):
                continue
            if fault.kind == "stuck":
                self.actors[fault.target].stuck = begins  # type: ignore[attr-defined]
            elif fault.kind == "freeze":
                self.frozen = set(names) if begins else set()
            else:
                for name in names:
                    (self.kill if begins else self.start)(name)

    def tick(self) -> None:
        """Let one period pass, from one exposure to the next."""
        self.run("robot-joints")
        self.run("truth", "camera", "background", "silhouette")
        self.pass_s(MASKS_S)
        self.run("watch", "stand-in")
        self.run("reconstruction")
        self.run("tracking", "speed", "planning")
        if "robot" not in self.frozen:
            self.run("robot")
        self.keep()
        self.pass_s(TICK_S - MASKS_S)

    def pass_s(self, seconds: float) -> None:
        """Let time pass; the arm's loop goes on."""
        for _ in range(round(seconds / CYCLE_S)):
            self.clock.advance(CYCLE_S)
            for arm in robot._arms.values():
                motion = arm.motion
                now_ns = self.clock.wall_ns()
                motion.cycle(now_ns)
                motion.measured(motion.q_rad, motion.dq_rad_s, now_ns)

    @property
    def at_s(self) -> float:
        """The second of the scenario."""
        return (self.clock.wall_ns() - self.start_ns) / 1e9

    def until(
        self,
        at_s: float,
        *,
        before: Callable[[], object] = lambda: None,
        after: Callable[[], object] = lambda: None,
    ) -> None:
        """Play up to a second of the scenario; `before` and `after` are called around each tick."""
        while self.at_s < at_s - 1e-6:
            before()
            self.tick()
            after()

    def _begin(self, begin_s: float) -> int:
        """Learn the backgrounds, and return the stamp of second 0; it may have passed already."""
        self.run(SETUP)
        self.kill(SETUP)
        online = self.cell.world(ONLINE)
        for number, calibration in enumerate(cameras(SCALE)):
            self._write(ONLINE, words.camera_entity(number), words.CALIBRATION, calibration)
        self._write(ONLINE, words.WORKSPACE, words.EMPTY, self.clock.wall_ns())
        while len(online.list_slots(words.CAMERAS, ("background",))) < words.CAMERA_COUNT:
            self.tick()
        start_ns = self.clock.wall_ns() - round(begin_s * 1e9)
        playing = words.Playing(
            self.scenario.name, self.scenario.seed, start_ns, self.scenario.seconds, robot=True
        )
        self._write(TRUTH, words.SCENARIO, words.PLAYING, playing)
        self.kill("reconstruction")  # it has seen nobody outside of the workspace until now
        self.start("reconstruction")
        return start_ns

    def _write(self, world: str, entity: words.Entity, aspect: Any, datum: object) -> None:
        request = Write(self.cell.world(world), entity, aspect)
        with Lock(request) as lock:
            lock[request] = datum

    # ---------------------------------------------------------------- what came of it

    def newest(self, entity: words.Entity, aspect: Any) -> Any:
        """Return a datum of `online`, None if it is null."""
        view = View(self.cell.world(ONLINE), entity, aspect)
        return self.cell.world(ONLINE).view(view).get(view)

    def keep(self) -> None:
        """Keep what a recording would have."""
        for world in (ONLINE, TRUTH):
            context = self.cell.world(world)
            for info in context.list_slots("**", RECORDED):
                slot = world, info.entity.name, info.aspect
                if info.null_reason or self._newest.get(slot) == info.version:
                    continue
                self._newest[slot] = info.version
                view = View(context, info.entity, ASPECTS[info.aspect])
                seen = context.view(view)
                state, datum = seen._readings.state(slot_of(view)), seen.get(view)
                if state is not None:
                    kept = Kept(state.captured_ns, state.stamp_ns, datum)
                    self.versions.setdefault(slot, []).append(kept)

    def trace(self) -> Trace:
        """Return what a recording of the run would give."""
        return Trace(self.versions)


def _nothing() -> None:
    """Start or stop an actor that goes on."""


@contextlib.contextmanager
def stepped(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    *,
    seed: int = 1,
    seconds: float,
    begin_s: float = 0.0,
) -> Iterator[Stepped]:
    """Run a cell that plays a scenario tick by tick."""
    clock = testing.ManualClock()
    with monkeypatch.context() as patch, testing.worlds(ONLINE, TRUTH, clock=clock) as cell:
        patch.setattr(time, "time_ns", clock.wall_ns)
        patch.setattr(robot, "RunningArm", Arm)
        patch.setattr(robot, "_arms", {})
        patch.setattr(robot, "_opened", {})
        patch.setattr(reconstruction, "camera_table", table_of)
        yield Stepped(cell, clock, name, seed=seed, seconds=seconds, begin_s=begin_s)
