"""Conduct a run: wait until all are ready, confirm the empty cell, start, break things, record.

The world contexts are the only way to the actors: the operator's word and the scenario's begin are
data like all others.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeVar

from actors import running_cell
from actors.running_cell import DemoError, give_way
from actors.workcell import vocabulary as words
from actors.workcell.demo.cell import SETUP
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.trace import ONLINE, RECORDED, TRUTH
from enact_dist import Lock, View, ViewEach, Write
from enact_dist.actor.running.commands import reports_of, send_to
from enact_dist.config.read import load_config
from enact_dist.errors import EnactError, ForgottenError, NullDatumError, ShardUnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt

    from actors.running_cell import DemoCell
    from actors.workcell.demo.options import Options
    from actors.workcell.scenarios import Fault
    from enact_dist import Aspect, Cell, Entity
    from enact_dist.recording import RecordingSummary
    from enact_dist.types import CauseTree, Version

    Image = npt.NDArray[np.uint8]

T = TypeVar("T")

READY_S: Final = 90.0
"""How long actors and backgrounds may take; on two cores they take a quarter of that."""
LOOK_S: Final = 0.1
"""How often the run is looked at."""
LEAD_S: Final = 2.0
"""Between the word that starts the scenario and its second 0: pictures show the arm by then."""
FRESH_S: Final = 0.5
"""A hull that is not older shows that all stages run."""
WHAT_IF: Final = "what_if"
"""The fork in which another planner tries the same seconds."""
WHAT_IF_S: Final = 10.0
"""How many seconds it tries."""
DEPTH: Final = 3
"""From the speed over the hull to the masks and the images."""
KEPT_EVERY_S: Final = 1.0
"""Shortest time between two updates of the nearest approach."""
ASKED_S: Final = 10.0
"""So long the end of a run waits for what is being kept."""
TRACKS_EVERY_S: Final = 1.0
"""Time between two looks at what people have left."""
NEARER_M: Final = 0.05
"""The nearest approach is kept anew only if it is so much nearer."""


@dataclass(slots=True)
class Notes:
    """What was seen while a run went on.

    Attributes:
        start_ns: Stamp of second 0.
        cameras: How many the cell has.
        stop: Where the first stop came from; None without one.
        images: The images of its masks that smart cameras committed together with them.
        nearest_m: Nearest estimated distance.
        nearest_ns: Exposure of it.
        forked_ns: When the fork was made; 0: it was not.
        lines: What was printed, with the second.
        faults: What was done to which process.
        cores: Processor time per second of each process.
    """

    start_ns: int = 0
    cameras: int = words.CAMERA_COUNT
    stop: CauseTree | None = None
    images: tuple[Version[Image], ...] = ()
    nearest_m: float = math.inf
    nearest_ns: int = 0
    forked_ns: int = 0
    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    cores: dict[str, float] = field(default_factory=dict)


class Conductor:
    """Conducts one run in a cell that is up."""

    def __init__(
        self, cell: Cell, running: DemoCell, options: Options, tell: Callable[[str], None]
    ) -> None:
        self._cell, self._running, self._options, self._tell = cell, running, options, tell
        self._online, self._truth = cell.world(ONLINE), cell.world(TRUTH)
        self.notes = Notes()
        self._kept_s = self._tracks_s = 0.0
        self._foreign: set[Entity] = set()
        self._asking: threading.Thread | None = None

    def prepare(self) -> None:
        """Wait for the actors, confirm that the cell is empty, wait for the backgrounds, start.

        Raises:
            DemoError: The cell went down, or something was not ready within `READY_S`.
        """
        config = load_config(self._running.config)
        actors = {actor.name for actor in config.actors} - {SETUP}
        if not self._options.embedded:
            self._wait(lambda: actors - self._running_actors(), "actors that do not run")
        grid = View(self._online, words.WORKSPACE, words.GRID)
        self._wait(
            lambda: [] if self._online.view(grid).get(grid) is not None else ["setup"], "missing"
        )
        self._write(ONLINE, words.WORKSPACE, words.EMPTY, time.time_ns())
        cameras = self._with("calibration")
        self.notes.cameras = len(cameras)
        self._wait(lambda: cameras - self._with("background"), "cameras without a background")
        self._tell("the operator confirmed the empty cell; backgrounds are learned")
        period_ns = round(words.PERIOD_S * 1e9)
        start_ns = (time.time_ns() + round(LEAD_S * 1e9)) // period_ns * period_ns
        options = self._options
        self._play(start_ns + round(READY_S * 1e9))  # the arm is seen, no person has entered yet
        self._wait(self._stale, "stages without a fresh datum")
        start_ns = (time.time_ns() + round(LEAD_S * 1e9)) // period_ns * period_ns
        self._play(start_ns)
        self.notes.start_ns = start_ns
        self._tell(f"scenario {options.scenario}, seed {options.seed}, {options.seconds:g} s")

    def _play(self, start_ns: int) -> None:
        options = self._options
        playing = words.Playing(
            options.scenario, options.seed, start_ns, options.seconds, robot=True
        )
        self._write(TRUTH, words.SCENARIO, words.PLAYING, playing)

    def _running_actors(self) -> set[str]:
        return {name for info in self._cell.actors() for name in info.names()}

    def _with(self, aspect: str) -> set[str]:
        """Return the cameras that have an aspect."""
        return {slot.entity.name for slot in self._online.list_slots(words.CAMERAS, (aspect,))}

    def _stale(self) -> list[str]:
        """Return which stages have no fresh datum."""
        stale = []
        stages: tuple[tuple[str, Entity, Aspect[Any]], ...] = (
            ("hull", words.WORKSPACE, words.HULL),
            ("speed", words.ROBOT, words.SPEED),
            ("robot", words.ROBOT, words.EXECUTION),
            ("path", words.ROBOT, words.PATH),
        )
        for name, entity, aspect in stages:
            newest = self._online.history(entity, aspect, count=1)
            age_s = (time.time_ns() - newest[0].stamp_ns) / 1e9 if newest else math.inf
            if age_s > FRESH_S and not (name == "path" and newest):
                stale.append(name)
        return stale

    def _wait(self, missing: Callable[[], object], what: str) -> None:
        deadline_s = time.monotonic() + READY_S
        left: object = ["?"]
        while left:
            self._running.check()
            try:
                left = missing()
            except (ShardUnreachableError, NullDatumError):
                left = ["the shard"]
            if left and time.monotonic() > deadline_s:
                names = ", ".join(sorted(str(each) for each in left))  # type: ignore[attr-defined]
                raise DemoError(f"{what} after {READY_S:.0f} s: {names}; see {self._running.log}")
            time.sleep(LOOK_S if left else 0.0)

    def _write(self, world: str, entity: Entity, aspect: Aspect[T], datum: T) -> None:
        request = Write(self._cell.world(world), entity, aspect)
        with Lock(request) as lock:
            lock[request] = datum

    def follow(self) -> None:
        """Look at the run until it is over, keep what is worth it, and break what shall break.

        Raises:
            DemoError: The cell went down.
        """
        options, notes = self._options, self.notes
        faults = list(scenario_of(options.scenario, options.seed, options.seconds).faults)
        fork_at_s = min(0.3 * options.seconds, max(0.0, options.seconds - WHAT_IF_S))
        state, later = "", []
        try:
            while (now_s := (time.time_ns() - notes.start_ns) / 1e9) < options.seconds + 0.5:
                self._running.check()
                while faults and now_s >= faults[0].at_s:
                    later += self._break(faults.pop(0), now_s)
                try:
                    for due in [each for each in later if now_s >= each[0]]:
                        due[1]()  # where the shard is away for now, the next round tries again
                        later.remove(due)
                    if not notes.forked_ns and now_s >= fork_at_s:
                        self._online.fork(WHAT_IF)
                        notes.forked_ns = time.time_ns()
                    state = self._look(now_s, state)
                except EnactError as error:
                    self._say(now_s, f"cannot look or act: {str(error).splitlines()[0]}")
                time.sleep(LOOK_S)
        finally:  # a process that stays frozen could not end with the cell
            for _, act in later:
                with contextlib.suppress(EnactError, DemoError):
                    act()
        if self._asking is not None:
            self._asking.join(timeout=ASKED_S)

    def _look(self, now_s: float, before: str) -> str:
        """Note the state of safety and the nearest approach; return the state."""
        safety = View(self._online, words.SYSTEM, words.SAFETY)
        speed = View(self._online, words.ROBOT, words.SPEED)
        seen = self._online.view(safety, speed)
        found, newest = seen.get(safety), seen.get(speed)
        near = newest is not None and newest.nearest_m < self.notes.nearest_m - NEARER_M
        if newest is not None and near and now_s > self._kept_s + KEPT_EVERY_S:
            self._kept_s = now_s
            self._aside(self._keep)
        if found is not None and found.state == "stop" and not self.notes.stop and now_s > 0.0:
            self._aside(self._keep_stop)
        if now_s > self._tracks_s + TRACKS_EVERY_S:
            self._tracks_s = now_s
            self._look_for_foreign(now_s)
        if found is None:
            return before
        state, line = told(found, newest, time.time_ns())
        if state != before:
            self._say(now_s, line)
        return state

    def _look_for_foreign(self, now_s: float) -> None:
        """Report each object that was left behind, once."""
        request = ViewEach(self._online, words.HUMANS, words.TRACK)
        for name, track in self._online.view(request)[request].items():
            if track.foreign and name not in self._foreign:
                self._foreign.add(name)
                x, y, top = track.position_m
                self._say(
                    now_s,
                    f"foreign: {name}, {top:.2f} m high, still, at x {x:.2f} m, y {y:.2f} m:"
                    " an object that was left, or a person who lies",
                )

    def _aside(self, act: Callable[[], None]) -> None:
        """Ask the shard at length in a thread, unless one does: the run must not wait for it."""
        if self._asking is not None and self._asking.is_alive():
            return

        def ask() -> None:
            give_way()
            with contextlib.suppress(EnactError):  # a shard that dies keeps nothing
                act()

        self._asking = threading.Thread(target=ask, name="keeper", daemon=True)
        self._asking.start()

    def _keep_stop(self) -> None:
        tree = self._tree()
        if tree is not None and len(masks_of(tree)) == self.notes.cameras:
            images = self._images_with(masks_of(tree))
            self._label("first-stop", tree, images)
            self.notes.images, self.notes.stop = images, tree

    def _keep(self) -> None:
        """Keep the newest set and what was made of it, if it is the nearest one of all masks."""
        tree = self._tree()
        if tree is None or len(masks_of(tree)) < self.notes.cameras:
            return
        then = self._online.at(stamp_ns=tree.stamp_ns)
        request = View(then, words.ROBOT, words.SPEED)
        speed = then.view(request).get(request)
        if speed is not None and speed.nearest_m < self.notes.nearest_m:
            self._label("nearest", tree)
            self.notes.nearest_m, self.notes.nearest_ns = speed.nearest_m, tree.stamp_ns

    def _tree(self) -> CauseTree | None:
        """Return where the newest speed comes from; None if part of it is forgotten already."""
        try:
            return self._cell.why(ONLINE, words.ROBOT, words.SPEED, depth=DEPTH)
        except ForgottenError:
            return None  # an image has left its retention meanwhile; the next set comes soon

    def _images_with(self, masks: Sequence[CauseTree]) -> tuple[Version[Image], ...]:
        """Return the images that were committed in one step with masks: no cause, but the same."""
        return tuple(
            image
            for mask in masks
            for image in self._online.history(mask.entity, words.IMAGE)
            if image.position == mask.position
        )

    def _label(self, label: str, tree: CauseTree, images: Sequence[Version[Image]] = ()) -> None:
        """Keep all versions of a tree under a label, in place of what it kept before."""
        if label in self._cell.pinned():
            self._cell.unpin(label)
        known = [cause for cause in tree.walk() if cause.known]
        with contextlib.suppress(ForgottenError):  # images go first; all else is kept
            self._cell.pin(label, (*known, *images))

    def _say(self, now_s: float, text: str) -> None:
        line = f"{now_s:6.1f} s  {text}"
        self.notes.lines.append(line)
        self._tell(line)

    def _break(self, fault: Fault, now_s: float) -> list[tuple[float, Callable[[], None]]]:
        """Do to a process what the scenario says; return what is left to do, and when."""
        self._say(now_s, f"{fault.kind} {fault.target}")
        self.notes.faults.append(f"{fault.kind} {fault.target}")
        end_s = fault.at_s + fault.seconds
        if fault.kind == "stuck":
            return [
                (fault.at_s, lambda: self._set(fault.target, "stuck", "true")),
                (end_s, lambda: self._set(fault.target, "stuck", "false")),
            ]
        pid = self._pid(fault.target)
        if fault.kind == "kill":
            os.kill(pid, signal.SIGKILL)
            return []
        os.kill(pid, signal.SIGSTOP)
        return [(end_s, lambda: go_on(pid))]

    def _set(self, name: str, attribute: str, value: str) -> None:
        """Change an attribute of a running actor, as an operator would.

        Raises:
            DemoError: No actor of that name accepts commands.
            EnactError: The shard did not take the command.
        """
        found = [one for one in reports_of(self._cell, name) if one[1].get("words_in")]
        if not found:
            raise DemoError(f"actor {name} accepts no commands; see {self._running.log}")
        for info, row in found:
            send_to(self._cell, info, row, {"set": {attribute: value}})

    def _pid(self, name: str) -> int:
        """Return the process of an actor, or else of a shard.

        Raises:
            DemoError: Nothing of that name runs.
        """
        for info in self._cell.actors():
            if name in info.names():
                return info.pid
        return self._running.shard_pid(name)


def go_on(pid: int) -> None:
    """Let a frozen process go on, if it is still there."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def told(safety: words.Safety, speed: words.Speed | None, now_ns: int) -> tuple[str, str]:
    """Return the state of the cell in a word and in a line.

    Args:
        safety: What speed control says, who is silent while no hull comes.
        speed: The newest command; None: there was none yet.
        now_ns: The time.
    """
    age_s = 0.0 if speed is None else (now_ns - speed.captured_ns) / 1e9
    if age_s > FRESH_S:
        return "silent", f"silent: the robot rests; its newest command is {age_s:.1f} s old"
    reason = safety.reason.removeprefix("; ")
    return safety.state, f"{safety.state}: {reason}" if reason else safety.state


def masks_of(tree: CauseTree) -> list[CauseTree]:
    """Return the masks of the hull in a tree of causes of a speed, by camera."""
    hulls = [cause for cause in tree.children if str(cause.aspect) == words.HULL.name]
    masks = [
        cause
        for hull in hulls
        for cause in hull.children
        if str(cause.aspect) == words.SILHOUETTE.name
    ]
    return sorted(masks, key=lambda cause: str(cause.entity))


def recording(
    cell: Cell, path: Path, *, aspects: Sequence[str] = RECORDED, gives_way: bool = True
) -> contextlib.AbstractContextManager[RecordingSummary]:
    """Record a cell exactly, without messages for viewers, while the block runs.

    Args:
        cell: The cell.
        path: The file; an older one is replaced.
        aspects: Names of the aspects.
        gives_way: Record only as far as the cell leaves a processor idle.

    Raises:
        DemoError: The recording failed.
    """
    worlds = ONLINE, TRUTH
    return running_cell.recording(
        cell, path, worlds=worlds, aspects=aspects, pictures=False, gives_way=gives_way
    )
