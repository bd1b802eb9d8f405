"""The robot: obeys the newest path and speed, and publishes where its joints are.

Two actors share one arm, hence one process (`process = "robot"` in `cell.toml`): `RobotJoints`
opens the arm and publishes at a fixed rate; `Robot` hands on what is commanded as it comes, since
an obeyed limit must not wait for a tick.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from actors.palletizing.sight.sensor import open_sensor
from actors.workcell.motion import CYCLE_S, HostClock, Motion
from actors.workcell.vocabulary import (
    EXECUTION,
    JOINTS,
    MODEL,
    PATH,
    PERIOD_S,
    ROBOT,
    SPEED,
)
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from actors.workcell.motion import RobotDriver
    from actors.workcell.vocabulary import ArmModel
    from enact_dist import Lock

SIMULATED_ARM: Final = "actors.workcell.motion:CommandedArm"
"""Address of the arm of a simulated cell."""
OPENING_S: Final = 3.0
"""How long a command waits for the arm to be opened."""


class RunningArm:
    """An open arm with its loop in a thread.

    Args:
        driver: The arm.
        model: Its kinematics.
        last_rad: Where it was when it was last published, (7,); None at the first start.

    Attributes:
        motion: The loop's state.
    """

    def __init__(
        self, driver: RobotDriver, model: ArmModel, last_rad: npt.NDArray[np.float64] | None
    ) -> None:
        self._driver = driver
        self.motion = Motion(model, driver.open(last_rad), time.time_ns())
        self._stop = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="robot loop", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Raise what has ended the loop.

        Raises:
            RuntimeError: The loop has ended; its cause is the error of the driver.
        """
        if self._error is not None:
            raise RuntimeError(f"the robot's loop has ended: {self._error}") from self._error

    def close(self) -> None:
        """Brake, then disconnect.  Takes as long as braking does."""
        self._stop.set()
        self._thread.join()
        self._driver.close()

    def _run(self) -> None:
        next_s, clock = time.monotonic(), HostClock()
        try:
            while not (self._stop.is_set() and self.motion.doing.speed_m_s == 0.0):
                before_ns, now_ns = time.monotonic_ns(), time.time_ns()
                if clock.was_set(now_ns, before_ns, time.monotonic_ns()):
                    self.motion.silence("the clock of the robot's host was set")
                if self._stop.is_set():
                    self.motion.silence("the robot's process ends")
                self.motion.cycle(now_ns)
                measured = self._driver.command(self.motion.q_rad, self.motion.dq_rad_s)
                self.motion.measured(*measured, now_ns)
                # A loop that was held up goes on from now: it never makes up for lost cycles.
                next_s = max(next_s + CYCLE_S, time.monotonic())
                time.sleep(max(0.0, next_s - time.monotonic()))
        except Exception as error:  # noqa: BLE001 (the actor reports it: the thread has no caller)
            self._error = error


_arms: Final[dict[str, RunningArm]] = {}
"""The open arms of this process, by the address of their driver."""
_opened: Final[dict[str, threading.Event]] = {}
"""Set while the arm of an address is open in this process."""


def _is_open(address: str) -> threading.Event:
    return _opened.setdefault(address, threading.Event())


class RobotJoints(Actor):
    """Open the arm and publish its last 0.3 s at the rate of the cameras.

    Args:
        driver: Address of the arm, ``MODULE:CLASS?name=value``, see `RobotDriver`.
    """

    online = World("online")
    model = View(online, ROBOT, MODEL)
    joints = Write(online, ROBOT, JOINTS)
    every_s = PERIOD_S

    def __init__(self, driver: str = SIMULATED_ARM) -> None:
        self.driver = driver

    def update(self, lock: Lock) -> None:
        """Publish the newest samples; before there is a model, wait for one."""
        if lock.is_null(self.model):
            return
        if self.driver not in _arms:
            last = lock.get(self.joints)
            last_rad = None if last is None else last.q[-1]
            driver = open_sensor(self.driver)
            _arms[self.driver] = RunningArm(driver, lock[self.model], last_rad)
            _is_open(self.driver).set()
        arm = _arms[self.driver]
        arm.check()
        lock[self.joints] = arm.motion.joints()

    def stop(self) -> None:
        """Brake and close the arm."""
        _is_open(self.driver).clear()
        arm = _arms.pop(self.driver, None)
        if arm is not None:
            arm.close()


class Robot(Actor):
    """Hand the newest path and speed to the arm's loop, as they come (ENACT 4.1).

    A command whose stamps are too old is refused; `execution` says so, and how old they are.

    Args:
        driver: Address of the arm, as of `RobotJoints`, which has to run in the same process.
    """

    online = World("online")
    speed = View(online, ROBOT, SPEED)
    path = View(online, ROBOT, PATH)
    execution = Write(online, ROBOT, EXECUTION)
    triggers = (speed, path)

    def __init__(self, driver: str = SIMULATED_ARM) -> None:
        self.driver = driver
        self._taken_ns, self._refusal = 0, ""

    def update(self, lock: Lock) -> None:
        """Hand on what is new, and say what came of it."""
        arm = self._arm()
        motion, received_ns = arm.motion, time.time_ns()
        speed, said = lock.get(self.speed), lock.get(self.execution)
        if speed is not None and speed.captured_ns != self._taken_ns:
            self._taken_ns, self._refusal = speed.captured_ns, motion.obey(speed, received_ns)
        elif said is not None and said.captured_ns == self._taken_ns:
            self._refusal = ""
        if not lock.is_null(self.path):
            motion.follow(lock[self.path], received_ns)
        lock[self.execution] = motion.execution(self._taken_ns, received_ns, self._refusal)

    def _arm(self) -> RunningArm:
        arm = _arms.get(self.driver) if _is_open(self.driver).wait(OPENING_S) else None
        if arm is None:
            raise RuntimeError(
                f"no arm {self.driver!r} is open in this process; run RobotJoints with this driver"
                ' beside Robot: process = "robot" in the tables of both in cell.toml'
            )
        arm.check()
        return arm
