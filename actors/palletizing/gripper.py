"""The gripper: follows the newest command and publishes what its fingers do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from actors.palletizing.control.controller import ControllerError, open_controller
from actors.palletizing.vocabulary import COMMAND, GRIPPER, STATE, GripState
from enact_dist import Actor, View, World, Write

if TYPE_CHECKING:
    from actors.palletizing.control.controller import GripperController
    from actors.palletizing.vocabulary import GripCommand
    from enact_dist import Lock

EVERY_S: Final = 0.025


class Gripper(Actor):
    """Follow the newest command, publish the state at 40 Hz (ENACT 4.2).

    A command is a level: after a restart the newest one is followed again.  One that the gripper
    refuses is reported once, and the state goes on naming the command before it.

    Args:
        controller: Address of the gripper, ``MODULE:FUNCTION?name=value``, see `GripperController`.
        force_limit_n: With which it moves to a width.
        every_s: Period of publishing, s.
    """

    online = World("online")
    command = View(online, GRIPPER, COMMAND)
    state = Write(online, GRIPPER, STATE)

    def __init__(
        self, controller: str, force_limit_n: float = 40.0, every_s: float = EVERY_S
    ) -> None:
        self.controller, self.force_limit_n, self.every_s = controller, force_limit_n, every_s
        self._gripper: GripperController | None = None
        self._started = False
        self._number = self._refused = 0

    def start(self) -> None:
        """Make the connection ready; it is opened by the first update."""
        self._gripper = open_controller(self.controller)

    def stop(self) -> None:
        """Disconnect; what the gripper holds stays held."""
        if self._gripper is not None:
            self._gripper.close()

    def update(self, lock: Lock) -> None:
        """Hand on a new command, publish the state."""
        gripper = self._gripper
        assert gripper is not None
        if not self._started:
            gripper.start()
            self._started, self._number, self._refused = True, 0, 0
        command = lock.get(self.command)
        try:
            if command is not None and command.number not in (self._number, self._refused):
                self._obey(gripper, command)
            now = gripper.gripped()
        except ControllerError:
            # A connection that is made anew has to be started again, and the command repeated.
            self._started = False
            raise
        lock[self.state] = GripState(
            number=self._number,
            width_m=now.width_m,
            width_rate_m_s=now.width_rate_m_s,
            force_n=now.force_n,
            stamp_ns=now.stamp_ns,
        )

    def _obey(self, gripper: GripperController, command: GripCommand) -> None:
        try:
            if command.kind == "width":
                gripper.grip_width(command.value, self.force_limit_n)
            else:
                gripper.grip_force(command.value)
        except ControllerError as error:
            gripper.gripped()  # raises if it is out of reach, which is no refusal
            self._refused = command.number
            print(f"command {command.number} is refused: {error}", flush=True)
        else:
            self._number = command.number
