"""What only processes can show: the workcell while parts of it are killed, stopped or too late.

One cell runs for all of these tests, and a person crosses the way of its robot all the time.  Each
test breaks something, sees what comes of it, and ends when the robot moves again; the last one
scores the recording of all of them on the truth.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pytest
from polling import until

pytest.importorskip("cv2", exc_type=ImportError)
pytest.importorskip("mcap", exc_type=ImportError)

from actors.workcell import vocabulary as words
from actors.workcell.demo.cell import RunningCell
from actors.workcell.demo.conduct import Conductor, recording
from actors.workcell.demo.options import Options
from actors.workcell.scores.scenario_checks import checks_of
from actors.workcell.scores.trace import RECORDED, trace_of
from actors.workcell.scores.truth_of_run import too_fast_of, truth_of
from actors.workcell.watch import SILENT
from enact_dist import Aspect, Entity, Lock, Write
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from enact_dist import Cell
    from enact_dist.recording import RecordingSummary
    from enact_dist.world.listings import ActorInfo, LockInfo

pytestmark = [pytest.mark.timing, pytest.mark.sampled(1, of="faults of an application")]

T = TypeVar("T")

SECONDS = 300.0
"""Of the scenario: longer than all tests together."""
LONG_S = 60.0
"""What a busy machine may take for anything; it is no claim."""
LEAST_S = 8.0
"""How much of the scenario the truth of a run must cover to say anything."""
SCALE = 0.5
"""Of the images: a busy machine has no time for eight whole ones, and their faults are the same."""
LOOK_S = 0.05
"""Between two looks at the cell, each of which takes some of the machine's time."""
EVERY_CAMERA = [words.camera_entity(number).name for number in range(words.CAMERA_COUNT)]
MOTION = tuple(set(RECORDED) - {"silhouette", "hull", "limbs", "prediction"})
"""What the truth of a run needs: to record masks and hulls, too, a busy machine has no time."""


class Trial:
    """A running cell, and what a test does to it.

    Args:
        processes: The cell's processes.
        cell: The cell.
        path: The recording of the run.
        recorded: It is whole once this is closed.
        summary: What it holds, and what it lacks.
    """

    def __init__(
        self,
        processes: RunningCell,
        cell: Cell,
        path: Path,
        recorded: contextlib.ExitStack,
        summary: RecordingSummary,
    ) -> None:
        self.processes, self.cell, self.path = processes, cell, path
        self.recorded, self.summary = recorded, summary
        self.online = cell.world("online")

    def newest(self, entity: Entity, aspect: Aspect[T]) -> tuple[T, int]:
        """Return the newest datum of a slot and its stamp."""
        version = self.online.history(entity, aspect, count=1)[0]
        return version.datum(), version.stamp_ns

    def until(self, what: str, condition: Callable[[], T]) -> T:
        """Wait until a condition holds, and return what it found; a shard may be away meanwhile."""

        def asked() -> T | None:
            self.processes.check()
            with contextlib.suppress(EnactError, IndexError):
                return condition()
            return None

        def missed() -> str:
            log = self.processes.config.with_name("cell.log").read_text()[-3000:]
            return f"not within {LONG_S:.0f} s: {what}\n{log}"

        found = until(asked, limit_s=LONG_S, pause_s=LOOK_S, missed=missed)
        print(f"{time.strftime('%X')} {what}")
        return found

    def joints(self, since_ns: int) -> words.Joints | None:
        """Return the last 0.3 s of the arm; None as long as part of them is from before a time."""
        joints, _ = self.newest(words.ROBOT, words.JOINTS)
        return joints if joints.stamp_ns[0] > since_ns else None

    def moves(self) -> None:
        """Wait until the arm moves by a command of now, and an exposure of now is known."""
        since_ns = time.time_ns()

        def moving() -> bool:
            done, _ = self.newest(words.ROBOT, words.EXECUTION)
            return done.captured_ns > since_ns and done.speed_m_s > 0.0

        self.until("the robot moves", moving)

    def rests(self) -> None:
        """Wait until the arm has been at rest for 0.3 s."""
        since_ns = time.time_ns()

        def resting() -> bool:
            joints = self.joints(since_ns)
            return joints is not None and float(np.abs(joints.dq).max()) == 0.0

        self.until("the robot rests", resting)

    def has_played(self) -> bool:
        """Whether the scenario has been played, and the arm seen, for `LEAST_S`."""
        truth = self.cell.world("truth")
        playing = truth.history(words.SCENARIO, words.PLAYING, count=1)[0].datum()
        joints, _ = self.newest(words.ROBOT, words.JOINTS)
        return int(joints.stamp_ns[-1]) - playing.start_ns > LEAST_S * 1e9

    def actor(self, name: str) -> ActorInfo:
        """Return the session of an actor that runs."""
        return self.until(
            f"{name} runs",
            lambda: next(
                one for one in [*self.cell.actors(), None] if one is None or name in one.names()
            ),
        )

    def refused(self, name: str) -> int:
        """Return how many attempts of an actor ended outside its code."""
        rows = self.actor(name).report["actors"]
        return sum(row["refused"] for row in rows if row["name"] == name)

    def safety_with(self, text: str) -> words.Safety | None:
        """Return the state of the cell, if its reason has a text."""
        safety, _ = self.newest(words.SYSTEM, words.SAFETY)
        return safety if text in safety.reason else None

    def locks(self, pid: int) -> list[LockInfo]:
        """Return the locks that a process holds or waits for, without what is merely kept."""
        return [one for one in self.cell.locks() if one.pid == pid and one.state != "kept"]

    @contextlib.contextmanager
    def stopped(self, name: str, *, holding: bool = False) -> Iterator[list[LockInfo]]:
        """Stop the process of an actor while the block runs (SIGSTOP).

        Args:
            name: Of the actor.
            holding: Stop it while it holds its lock, else while it holds none.
        """
        pid = self.actor(name).pid

        def caught() -> list[list[LockInfo]]:
            os.kill(pid, signal.SIGSTOP)
            self.locks(pid)  # what the process had sent before is done by now
            held = self.locks(pid)
            if bool(held) == holding and all(one.granted for one in held):
                return [held]
            os.kill(pid, signal.SIGCONT)
            return []

        (held,) = self.until(f"{name} stops with{'' if holding else 'out'} its lock", caught)
        try:
            yield held
        finally:
            os.kill(pid, signal.SIGCONT)

    def kill(self, name: str) -> int:
        """Kill the process of an actor, once its session is known; return its number."""
        pid = self.actor(name).pid
        os.kill(pid, signal.SIGKILL)
        return pid

    def kill_shard(self, name: str) -> None:
        """Kill the process of a shard."""
        os.kill(self.processes.shard_pid(name), signal.SIGKILL)


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trial]:
    """A cell that is up, prepared, recorded, and plays."""
    out = tmp_path_factory.mktemp("cell")
    options = Options(out, scenario="S8", seconds=SECONDS, source="live", voxel_m=0.04, scale=SCALE)
    with RunningCell(options) as processes, processes.joined() as cell:
        Conductor(cell, processes, options, print).prepare()
        with contextlib.ExitStack() as recorded:
            path = out / "run.mcap"
            recorder = recording(cell, path, aspects=MOTION, gives_way=False)
            summary = recorded.enter_context(recorder)
            yield Trial(processes, cell, path, recorded, summary)


def test_a_frozen_camera_is_named_and_replaced_and_taken_back(trial: Trial) -> None:
    """A stand-in takes its place, the cell goes on, and its images count again afterwards."""
    camera = "camera/5"

    def state() -> words.CameraState:
        return trial.newest(words.SYSTEM, words.CAMERA_STATES)[0][camera]

    trial.moves()
    with trial.stopped("camera-5"):
        trial.until("the watch names it", lambda: state().trouble == SILENT)
        since_ns = time.time_ns()

        def without() -> bool:
            hull, stamp_ns = trial.newest(words.WORKSPACE, words.HULL)
            return stamp_ns > since_ns and bool(hull.cameras) and camera not in hull.cameras

        trial.until("a hull of the others", without)
        trial.until("safety names it", lambda: trial.safety_with(camera))
        trial.moves()
    trial.until("it is taken back", lambda: state().alive and not trial.safety_with(camera))
    trial.until(
        "its images count again",
        lambda: camera in trial.newest(words.WORKSPACE, words.HULL)[0].cameras,
    )


def test_the_robot_rests_while_the_hull_is_late_and_goes_on_by_itself(trial: Trial) -> None:
    """Its reconstruction is stopped, not dead: the shard reports no death, and the last commands run out."""
    trial.moves()
    with trial.stopped("reconstruction"):
        trial.rests()
        _, hull_ns = trial.newest(words.WORKSPACE, words.HULL)
        speed, speed_ns = trial.newest(words.ROBOT, words.SPEED)
        assert speed_ns <= hull_ns < time.time_ns() - speed.valid_ms * 1e6
    trial.moves()


def test_a_lock_that_is_lost_commits_nothing(trial: Trial) -> None:
    """An actor that is stopped with its lock beyond its lease is fenced, and takes the next set."""
    hull = Write(trial.online, words.WORKSPACE, words.HULL)
    before = trial.refused("reconstruction")
    with trial.stopped("reconstruction", holding=True) as lost, Lock(hull, wait_s=LONG_S):
        assert words.HULL.name in "".join(slot for one in lost for slot in one.slots)
        newest = trial.online.history(words.WORKSPACE, words.HULL, count=1)[0].version
    trial.moves()

    made = trial.online.history(words.WORKSPACE, words.HULL)
    causes = [one.cause for one in made if one.cause is not None]
    assert made[-1].version > newest
    assert {one.lock_id for one in lost}.isdisjoint(str(one.lock) for one in causes)
    trial.until("it reports the refusal", lambda: trial.refused("reconstruction") > before)


def test_a_command_that_rests_on_an_old_exposure_is_refused(trial: Trial) -> None:
    """The robot says how old it is and stays where it is, though the command allows full speed."""
    request = Write(trial.online, words.ROBOT, words.SPEED)
    with trial.stopped("speed"):
        trial.rests()
        before, _ = trial.newest(words.ROBOT, words.EXECUTION)
        now_ns = time.time_ns()
        old_ns = now_ns - 1_000_000_000
        with Lock(request) as lock:
            old = words.Speed(1.0, 1.5, np.inf, "no person is there", 250.0, old_ns, old_ns)
            lock.put(request, old, stamp_ns=now_ns)

        def refused() -> words.Execution | None:
            every = [
                one.datum() for one in trial.online.history(words.ROBOT, words.EXECUTION, count=9)
            ]
            return next((one for one in every if one.captured_ns == old_ns), None)

        done = trial.until("the robot has it", refused)
        assert (done.state, done.refused) == ("refused", before.refused + 1)
        assert "ms old, 250 are allowed" in done.reason
        trial.rests()
        assert trial.newest(words.ROBOT, words.SPEED)[0].captured_ns == old_ns
    trial.moves()


@pytest.mark.parametrize("name", ["reconstruction", "speed", "camera-3"])
def test_an_actor_that_is_killed_comes_back(trial: Trial, name: str) -> None:
    """`enact up` starts it anew, and the robot goes on."""
    trial.moves()
    pid = trial.kill(name)
    if name != "camera-3":  # of whose images a stand-in takes the place
        trial.rests()
    trial.until("it is back", lambda: trial.actor(name).pid != pid)
    trial.moves()
    trial.until(
        "all cameras count",
        lambda: set(trial.newest(words.WORKSPACE, words.HULL)[0].cameras) == set(EVERY_CAMERA),
    )


def test_the_cell_goes_on_after_its_shard_was_killed(trial: Trial) -> None:
    """What was learned, and what plays, have outlived the shard: the person is seen again."""
    trial.moves()
    trial.kill_shard("cell")
    trial.rests()
    trial.moves()
    trial.until(
        "the person is seen", lambda: len(trial.newest(words.WORKSPACE, words.HULL)[0].voxels)
    )


def test_nothing_of_it_made_the_robot_too_fast(trial: Trial) -> None:
    """On the truth of the whole run, and no command outlived the exposure on which it rests."""
    trial.moves()
    trial.kill("reconstruction")
    trial.rests()
    trial.moves()
    trial.until("the scenario played for some seconds", trial.has_played)
    trial.recorded.close()
    trace = trace_of(trial.path)
    truth = truth_of(trace)
    too_fast = too_fast_of(trace, truth)

    assert len(too_fast) > 500, trial.summary
    assert too_fast.sum() == 0.0
    assert checks_of(trace, {})["at rest within 250 ms and the braking time"]
