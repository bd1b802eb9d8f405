"""What the actors need of the cell's controllers: of the arm, of the gripper, and of the belt.

The simulated cell and a real one both give this; no actor knows which.  Arm and gripper are two
devices with a process each.  To connect a real arm, write a class with the methods of
`ArmController` over the interface of its controller for cyclic commands (KUKA FRI, UR servoj,
Franka joint positions) and name it in `cell.toml`; for a gripper likewise (`GripperController`):

=============  ====================================================================================
method         over a real controller
=============  ====================================================================================
start          connect, release the brakes, wait until the controller takes positions
measured       the newest state that arrived; never waits for the next one
command        hand on the next position; the controller interpolates until the one after it
brake          the controller's own stop at full deceleration; positions are refused from then on
close          come to rest, disconnect
grip_width     position mode of the gripper with its force limit
grip_force     force mode of the gripper: close until the fingers press so hard
=============  ====================================================================================

Rules a change must keep: SI units; every pose is in the frame of the arm's base; the wrench is the
sensor's, not tared, since the executor tares before each guarded motion; an arm that gets no
commands any more comes to rest by itself, and a gripper goes on holding what it holds, since the
processes that command them can be killed.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

import importlib
from dataclasses import dataclass
from typing import Any, Protocol
from urllib.parse import parse_qsl

import numpy as np
import numpy.typing as npt

from actors.geometry.arms.joint_paths import Arm


class ControllerError(RuntimeError):
    """The controller cannot do what it was asked to; the text names what, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmMeasured:
    """The state of the arm at one moment.

    Attributes:
        stamp_ns: When it was measured, nanoseconds since 1970.  It is the clock of a control loop:
            a simulated arm's time may run faster or slower than the host's.
        q: (7,) float64, joints, rad.
        dq: (7,) float64, their speeds, rad/s.
        tcp: (4, 4) float64, base_from_tool, metres: z points out of the hand, the fingers move
            along y.
        wrench: (6,) float64, what the wrist carries, N and Nm, at the origin and in the axes of
            the tool frame, not tared: the hand at rest shows its weight.  A force that presses
            the fingertips into the hand is negative in z.
    """

    stamp_ns: int
    q: npt.NDArray[np.float64]
    dq: npt.NDArray[np.float64]
    tcp: npt.NDArray[np.float64]
    wrench: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Measured(ArmMeasured):
    """The state of arm and gripper at one moment, as nets are executed by it.

    Attributes:
        width_m: Distance between the fingers.
        width_rate_m_s: How fast it grows.
        grip_force_n: With what force the drive closes the fingers; negative when it opens them.
    """

    width_m: float
    width_rate_m_s: float
    grip_force_n: float


@dataclass(frozen=True, slots=True)
class GripperMeasured:
    """The state of the gripper at one moment.

    Attributes:
        stamp_ns: When it was measured, nanoseconds since 1970, by the clock of the arm.
        width_m: Distance between the fingers.
        width_rate_m_s: How fast it grows.
        force_n: With what force the drive closes the fingers; negative when it opens them.
    """

    stamp_ns: int
    width_m: float
    width_rate_m_s: float
    force_n: float


class ArmController(Protocol):
    """An arm of seven axes with a wrist sensor."""

    @property
    def cycle_s(self) -> float:
        """How often a position is to be commanded, s; 0.004 for 250 Hz."""
        ...

    @property
    def model(self) -> Arm:
        """Kinematics and limits; known before it is started."""
        ...

    @property
    def posture_rad(self) -> npt.NDArray[np.float64]:
        """(7,), rad: where the joints go as far as the tool leaves it open."""
        ...

    def start(self) -> None:
        """Take commands from now on; also after `brake`.

        Raises:
            ControllerError: The controller cannot be reached, or is not ready.
        """
        ...

    def measured(self) -> ArmMeasured:
        """Return the newest state; at once."""
        ...

    def command(self, q: npt.NDArray[np.float64]) -> None:
        """Command where the joints are to be one cycle from now.

        The controller keeps its own limits of speed, acceleration and jerk: an arm that is
        commanded too far away comes later.

        Args:
            q: (7,) float64, rad.

        Raises:
            ControllerError: The position is out of the range of a joint, or the arm is braked.
        """
        ...

    def brake(self) -> None:
        """Stop the arm as fast as it can."""
        ...

    def close(self) -> None:
        """Come to rest and disconnect."""
        ...


class GripperController(Protocol):
    """A parallel gripper."""

    def start(self) -> None:
        """Take commands from now on.

        Raises:
            ControllerError: The gripper cannot be reached, or is not ready.
        """
        ...

    def gripped(self) -> GripperMeasured:
        """Return the newest state; at once."""
        ...

    def grip_width(self, width_m: float, force_limit_n: float) -> None:
        """Move the fingers to a distance, pressing no harder than the limit.

        Raises:
            ControllerError: The gripper cannot open so far or close so far.
        """
        ...

    def grip_force(self, force_n: float) -> None:
        """Close the fingers until they press with a force; hold it from then on.

        Raises:
            ControllerError: The gripper cannot press so hard.
        """
        ...

    def close(self) -> None:
        """Disconnect; what the gripper holds stays held."""
        ...


class BeltController(Protocol):
    """A conveyor belt with a light barrier where packages are picked up."""

    def run_belt(self) -> None:
        """Let a package come, and move the belt until it interrupts the light barrier."""
        ...

    def change_tray(self) -> object:
        """Bring an empty tray."""
        ...

    def stop_belt(self) -> None:
        """Stop the belt."""
        ...

    def arrived(self) -> bool:
        """Return whether a package stands in the light barrier, the belt at rest."""
        ...


def open_controller(address: str, kind: str = "controller") -> Any:
    """Return the controller at an address, not yet started; the caller knows its protocol.

    Args:
        address: ``MODULE:FUNCTION?name=value&name=value``; the function gets the values as text.
        kind: What it is, for the errors: a sensor is opened likewise.

    Raises:
        ValueError: The text is malformed, or the function does not exist or refuses the values.
    """
    path, _, query = address.partition("?")
    module_name, colon, function_name = path.partition(":")
    if not colon:
        raise ValueError(f"{address!r} is no {kind}; write MODULE:FUNCTION?name=value")
    try:
        make = getattr(importlib.import_module(module_name), function_name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"no {kind} at {address!r}: {error}") from error
    try:
        return make(**dict(parse_qsl(query, strict_parsing=bool(query))))
    except TypeError as error:
        raise ValueError(f"the {kind} {address!r} refuses its values: {error}") from error
