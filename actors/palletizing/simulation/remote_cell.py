"""The physical cell in another process: what actors open of it, by address.

==================================  ================================================================
`…remote_cell:arm?port=7460`        an `ArmController`, for `open_controller`
`…remote_cell:gripper?port=7460`    a `GripperController`, for `open_controller`
`…remote_cell:belt?port=7460`       a `BeltController`; `&feeds=1`: packages come by themselves
`…remote_cell:hands?port=7460`      what a person does, for the operator
`…remote_cell:cell_frames`          where tray, belt and bin stand
`…remote_cell:tray_sensor?port=…`   a `TraySensor`, for `open_sensor`
`…remote_cell:belt_sensor?port=…`   the same above the belt
==================================  ================================================================

Rule a change must keep: one request at a time over a connection; a connection that was lost is made
anew by the next request, but the process that commanded arm or gripper has to start it again.
"""

from __future__ import annotations

import os
import socket
import threading
from contextlib import closing
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.palletizing.control.controller import ArmMeasured, ControllerError, GripperMeasured
from actors.palletizing.simulation.cell.arm import ArmOfCell
from actors.palletizing.simulation.cell.messages import receive, send
from actors.palletizing.simulation.cell.scene import CellLayout
from actors.palletizing.simulation.physical_sensors import PhysicalBeltSensor, PhysicalTraySensor

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from actors.palletizing.simulation.cell.truth import CellTruth, ShownCell

    F64 = npt.NDArray[np.float64]

HOST: Final = "ENACT_HARDWARE_HOST"
"""Variable of the environment with the host of the cell's process, where an address names none."""
ANSWER_S: Final = 10.0
"""A cell that does not answer for so long is gone; drawing the first picture takes 2 s."""


class RemoteCell:
    """A connection to a cell's process; opened by the first request.

    Args:
        port: Where it listens.
        host: On which host; empty: see `HOST`, else this one.
    """

    def __init__(self, port: int, host: str = "") -> None:
        self._address = (host or os.environ.get(HOST, "127.0.0.1"), port)
        self._connection: socket.socket | None = None
        self._lock = threading.Lock()

    def ask(self, name: str, *arguments: Any) -> Any:
        """Return the cell's answer to a request.

        Raises:
            ControllerError: The cell cannot be reached, or it refuses.
        """
        with self._lock:
            try:
                if self._connection is None:
                    self._connection = socket.create_connection(self._address, timeout=ANSWER_S)
                    self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                send(self._connection, [name, *arguments])
                answer = receive(self._connection)
            except (OSError, EOFError, ControllerError) as error:
                self._drop()
                host, port = self._address
                raise ControllerError(
                    f"asked the cell at {host}:{port} for {name}: {error}; run"
                    " actors.palletizing.simulation.cell.server with this port"
                ) from error
        if "error" in answer:
            raise ControllerError(answer["error"])
        return answer["value"]

    def close(self) -> None:
        """Close the connection; an arm that it commanded brakes."""
        with self._lock:
            self._drop()

    def truth(self) -> CellTruth:
        """Return what is true now."""
        found: CellTruth = self.ask("truth")
        return found

    def shown(self) -> ShownCell:
        """Return what a sensor can see now."""
        found: ShownCell = self.ask("shown")
        return found

    def fail(self, kind: str, seconds: float, when: str = "") -> None:
        """Let something fail, at once or when something is so, see `physics.FAILURES`.

        Raises:
            ControllerError: No such kind, or nothing that can be waited for.
        """
        self.ask("fail", kind, float(seconds), when)

    def failures(self) -> dict[str, tuple[float, float]]:
        """Return from when to when each failure that has begun lasts, simulated seconds."""
        found: dict[str, tuple[float, float]] = self.ask("failures")
        return found

    def picture(self, width: int = 640, height: int = 480) -> npt.NDArray[np.uint8]:
        """Return the cell as a person would see it, (height, width, 3) uint8, red first.

        Raises:
            ControllerError: The cell's process cannot draw; the text says why.
        """
        found: npt.NDArray[np.uint8] = self.ask("picture", width, height)
        return found

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class _Remote:
    """Something of a cell in another process."""

    def __init__(self, cell: RemoteCell) -> None:
        self._cell = cell

    def close(self) -> None:
        """Disconnect; an arm brakes, what a gripper holds stays held."""
        self._cell.close()


class RemoteArm(_Remote, ArmOfCell):
    """The arm of a cell in another process; an `ArmController`."""

    def start(self) -> None:
        """Take commands of this connection from now on, and of no other."""
        self._cell.ask("start")

    def measured(self) -> ArmMeasured:
        """Return the newest state."""
        found: ArmMeasured = self._cell.ask("measured")
        return found

    def command(self, q: F64) -> None:
        """Command where the joints are to be one cycle from now."""
        self._cell.ask("command", q)

    def brake(self) -> None:
        """Stop the arm."""
        self._cell.ask("brake")


class RemoteGripper(_Remote):
    """The gripper of a cell in another process; a `GripperController`."""

    def start(self) -> None:
        """Take commands of this connection from now on, and of no other."""
        self._cell.ask("start_gripper")

    def gripped(self) -> GripperMeasured:
        """Return the newest state."""
        found: GripperMeasured = self._cell.ask("gripped")
        return found

    def grip_width(self, width_m: float, force_limit_n: float) -> None:
        """Move the fingers to a distance."""
        self._cell.ask("grip_width", float(width_m), float(force_limit_n))

    def grip_force(self, force_n: float) -> None:
        """Close the fingers until they press with a force."""
        self._cell.ask("grip_force", float(force_n))


class RemoteBelt(_Remote):
    """Belt and tray of a cell in another process; a `BeltController`.

    Args:
        cell: The cell.
        feeds: Whether a package is put onto the start of the belt each time that it is run, as a
            plant does upstream.
    """

    def __init__(self, cell: RemoteCell, *, feeds: bool = False) -> None:
        super().__init__(cell)
        self._feeds, self._fed = feeds, False

    def run_belt(self) -> None:
        """Let a package come, if the belt feeds; move it until one interrupts the barrier."""
        if self._feeds and not self._fed and not self.arrived() and self.coming():
            self.feed()
            self._fed = True
        self._cell.ask("run_belt")

    def stop_belt(self) -> None:
        """Stop the belt."""
        self._cell.ask("stop_belt")

    def arrived(self) -> bool:
        """Return whether a package stands in the light barrier, the belt at rest."""
        there = bool(self._cell.ask("arrived"))
        self._fed = self._fed and not there
        return there

    def coming(self) -> int:
        """Return how many packages have not come yet."""
        return int(self._cell.ask("coming"))

    def feed(self) -> int:
        """Put the next package onto the start of the belt; return its number."""
        return int(self._cell.ask("feed"))

    def change_tray(self) -> list[int]:
        """Take the tray away with all that is on it; return the numbers of those packages."""
        return list(self._cell.ask("change_tray"))


class RemoteHands(_Remote):
    """What a person does by hand in a cell in another process."""

    def remove(self, number: int) -> None:
        """Take the package that came as the number-th out of the cell."""
        self._cell.ask("take_away", number)


def arm(port: str, host: str = "") -> RemoteArm:
    """Return the arm of the cell at a port; for `open_controller`."""
    return RemoteArm(RemoteCell(int(port), host))


def gripper(port: str, host: str = "") -> RemoteGripper:
    """Return the gripper of the cell at a port; for `open_controller`."""
    return RemoteGripper(RemoteCell(int(port), host))


def belt(port: str, host: str = "", feeds: str = "") -> RemoteBelt:
    """Return the belt of the cell at a port; for `open_controller`."""
    return RemoteBelt(RemoteCell(int(port), host), feeds=bool(feeds))


def hands(port: str, host: str = "") -> RemoteHands:
    """Return the hands of a person at the cell at a port; for `open_controller`."""
    return RemoteHands(RemoteCell(int(port), host))


def cell_frames() -> dict[str, F64]:
    """Return where tray, belt and reject bin of the cell stand, base_from_entity by name."""
    return CellLayout().frames()


def tray_sensor(port: str, seed: str = "1", host: str = "") -> PhysicalTraySensor:
    """Return the sensor above the tray of the cell at a port; for `open_sensor`."""
    return PhysicalTraySensor(_shown_of(int(port), host), seed=int(seed))


def belt_sensor(port: str, seed: str = "1", host: str = "") -> PhysicalBeltSensor:
    """Return the sensor above the belt of the cell at a port; for `open_sensor`."""
    return PhysicalBeltSensor(_shown_of(int(port), host), seed=int(seed))


def _shown_of(port: int, host: str) -> Callable[[], ShownCell]:
    """Return what shows a cell; a connection for each image, as sensors are never closed."""

    def shown() -> ShownCell:
        with closing(RemoteCell(port, host)) as cell:
            return cell.shown()

    return shown
