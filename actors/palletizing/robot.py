"""The robot: executes the net that is attached to the system, and publishes how far it is.

Two actors share one arm, hence one process (`process = "robot"` in `cell.toml`).  `Robot` takes
each net at most once, whatever is killed, and holds no lock while the arm moves.  `RobotJoints`
runs the arm's inner loop, publishes what it does, and hands on what it asks of the gripper.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from actors.palletizing.control.control_loop import ControlLoop, ended_without_step
from actors.palletizing.control.controller import open_controller
from actors.palletizing.control.urgency import make_urgent
from actors.palletizing.handling.nets import TraceStep
from actors.palletizing.vocabulary import (
    COMMAND,
    CONTROL,
    EXECUTION,
    GRIPPER,
    NET,
    NET_OUTCOME,
    ROBOT,
    STATE,
    SYSTEM,
)
from actors.workcell.vocabulary import JOINTS
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from actors.palletizing.handling.nets import Execution
    from actors.palletizing.vocabulary import Attached
    from enact_dist import Lock, Outcome

LEASE_S: Final = 2.0
OPENING_S: Final = 5.0
"""How long a net waits for the arm to be opened."""
LOOK_S: Final = 0.02
"""How often a running net looks whether it is to end."""
EVERY_S: Final = 0.025
JOINTS_TICKS: Final = 4
"""The joints are published at every so many ticks."""
CONTROL_TICKS: Final = 40

_loops: Final[dict[str, ControlLoop]] = {}
"""The running loops of this process, by the address of their controller."""
_opened: Final[dict[str, threading.Event]] = {}
"""Set while the loop of an address runs in this process."""


def _is_open(address: str) -> threading.Event:
    return _opened.setdefault(address, threading.Event())


class Robot(Actor):
    """Execute each net that is attached to the system, once (ENACT 4.2).

    Args:
        controller: Address of the arm, as of `RobotJoints`, which has to run in the same process.
    """

    online = World("online")
    net = View(online, SYSTEM, NET)
    net_outcome = Write(online, ROBOT, NET_OUTCOME)
    triggers = (net,)
    once = True

    def __init__(self, controller: str) -> None:
        self.controller = controller

    def update(self, lock: Lock) -> None:
        """Execute the net to its end; a newer one, or none any more, brakes it."""
        loop = _loops.get(self.controller) if _is_open(self.controller).wait(OPENING_S) else None
        if loop is None:
            raise RuntimeError(
                f"no arm {self.controller!r} is open in this process; run RobotJoints with this"
                ' controller beside Robot: process = "robot" in the tables of both in cell.toml'
            )
        loop.execute(lock[self.net])
        while not loop.wait(LOOK_S):
            if lock.newer.is_set():
                loop.brake(lock.newer.reason)


class RobotJoints(Actor):
    """Run the arm's inner loop; publish execution, joints, and the commands to the gripper.

    Args:
        controller: Address of the arm, ``MODULE:FUNCTION?name=value``, see `ArmController`.
        lease_s: A net ends when no shard answers, or the gripper is silent, for longer than this.
        every_s: Period of publishing, s.
        urgent: Let this process go before others on its host, where the system allows it.
    """

    online = World("online")
    net = View(online, SYSTEM, NET)
    net_outcome = View(online, ROBOT, NET_OUTCOME)
    gripper = View(online, GRIPPER, STATE)
    execution = Write(online, ROBOT, EXECUTION)
    joints = Write(online, ROBOT, JOINTS)
    control = Write(online, ROBOT, CONTROL)
    command = Write(online, GRIPPER, COMMAND)

    def __init__(
        self,
        controller: str,
        lease_s: float = LEASE_S,
        every_s: float = EVERY_S,
        *,
        urgent: bool = False,
    ) -> None:
        if not lease_s > 0.0:
            raise ValueError(f"lease_s is {lease_s}; it has to be more than 0 s")
        self.controller, self.lease_s, self.every_s = controller, lease_s, every_s
        self.urgent = urgent
        self._told: tuple[Execution | None, int] = None, 0
        """The state of an execution that was published last, and its version if that stands."""
        self._ticks, self._locked_ms = 0, 0.0

    def start(self) -> None:
        """Open the arm."""
        if self.urgent:
            make_urgent()
        _loops[self.controller] = ControlLoop(
            open_controller(self.controller), lease_s=self.lease_s
        )
        _is_open(self.controller).set()

    def stop(self) -> None:
        """Brake and close the arm."""
        _is_open(self.controller).clear()
        loop = _loops.pop(self.controller, None)
        if loop is not None:
            loop.close()

    def update(self, lock: Lock) -> None:
        """Publish what is new."""
        began_s, loop = time.monotonic(), _loops[self.controller]
        gripper, command = lock.get(self.gripper), lock.get(self.command)
        if self._ticks == 0:
            numbers = [one.number for one in (gripper, command) if one is not None]
            loop.grip_number = max(numbers, default=0)
        loop.reached(gripper)
        self._tell_execution(lock, loop)
        if (grip := loop.grip) is not None and command != grip:
            lock[self.command] = grip
        if self._ticks % JOINTS_TICKS == 0 and (joints := loop.joints()) is not None:
            lock[self.joints] = joints
        if self._ticks % CONTROL_TICKS == 0:
            lock[self.control] = replace(loop.figures(), locked_ms=self._locked_ms)
        self._ticks += 1
        self._locked_ms = max(self._locked_ms, 1e3 * (time.monotonic() - began_s))

    def _tell_execution(self, lock: Lock, loop: ControlLoop) -> None:
        """Publish the result of each net until it stands, then how far the present one is."""
        found, version = lock.get(self.execution), lock.version(self.execution)
        while loop.ended and _is(found, loop.ended[0]):
            loop.ended.popleft()
        doing, told = loop.execution, loop.ended[0] if loop.ended else None
        if told is None:
            if doing is not None and not doing.result and self._told != (doing, version):
                told, self._told = doing, (doing, version + 1)
            else:
                net, outcome = lock.get(self.net), lock.get(self.net_outcome)
                number, is_begun = lock.version(self.net), doing is not None
                told = unexecuted(net, outcome, found, version=number, begun_here=is_begun)
        if told is not None:
            lock[self.execution] = told


def unexecuted(
    attached: Attached | None,
    taken: Outcome | None,
    before: Execution | None,
    *,
    version: int,
    begun_here: bool,
) -> Execution | None:
    """Return how a net ends that was taken, and that no process executes any more; None if none.

    An earlier process may have begun it; or `Robot` failed or was stopped before the loop got it.
    Without a result the cell would stand still.

    Args:
        attached: The newest net.
        taken: What became of the version of `NET` that was taken last.
        before: What is published of the robot.
        version: Of the newest net: one that was not taken yet does not end.
        begun_here: The loop of this process has a net.
    """
    if before is not None and not before.result:
        return None if begun_here else interrupted(before)
    if taken is None or attached is None or taken.state == "taken" or taken.version != version:
        return None
    if before is not None and before.net_version == attached.number:
        return None
    if taken.state in {"interrupted", "done"}:
        return interrupted(ended_without_step(attached, before, None, ""))
    unbegun = ended_without_step(attached, before, None, f"braked:{taken.state}")
    step = TraceStep(unbegun.primitive, unbegun.result, 0.0, taken.text)
    return replace(unbegun, trace=(step,))


def _is(found: Execution | None, published: Execution) -> bool:
    return found is not None and (found.net_version, found.result) == (
        published.net_version,
        published.result,
    )


def interrupted(execution: Execution) -> Execution:
    """Return the execution of a net whose process ended in midst of it."""
    result = f"interrupted:{execution.primitive}"
    step = TraceStep(execution.primitive, result, 0.0, "the robot was started again")
    return replace(execution, result=result, trace=(*execution.trace, step))
