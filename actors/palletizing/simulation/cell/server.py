"""The physical cell as a process of its own, so that it outlives the actors that use it.

    python -m actors.palletizing.simulation.cell.server --packages 12 --seed 59 --port 7460

It runs in real time from the start, or at another speed.  `remote_cell` has what the actors open:
controller, belt and sensors at an address with this port.

Rules a change must keep: one connection commands the arm and one the gripper, those that started
them last; when that of the arm ends, for whatever reason, the arm brakes; when that of the gripper
ends, it goes on holding what it holds.
"""

from __future__ import annotations

import argparse
import signal
import socket
import sys
import threading
import time
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any, Final, Self

from actors.palletizing.control.controller import ControllerError
from actors.palletizing.control.urgency import make_urgent
from actors.palletizing.simulation.cell.messages import receive, send
from actors.palletizing.simulation.cell.picture import CellPictures
from actors.palletizing.simulation.cell.thread import RunningCell
from actors.palletizing.simulation.physics import PhysicalCell

if TYPE_CHECKING:
    from collections.abc import Sequence

STARTS: Final = {"start": "arm", "start_gripper": "gripper"}
"""The requests that make a connection the one that commands a device."""
COMMANDS: Final = {
    "command": "arm",
    "brake": "arm",
    "grip_width": "gripper",
    "grip_force": "gripper",
}
"""What only the connection that started a device may ask of it."""
MEASURED: Final = {"measured": "arm_measured", "gripped": "gripped"}
"""What anybody may ask at any time, by its name and that of the simulated arm."""
STOPPED: Final = (
    "run_belt",
    "stop_belt",
    "arrived",
    "feed",
    "put",
    "take_away",
    "change_tray",
    "fail",
    "failures",
    "truth",
    "shown",
)
"""What is done between two cycles."""


class CellServer:
    """Serves a running cell on a port.

    Args:
        running: The cell; the caller enters and closes it.
        host: Address to listen at; anybody who reaches it can move the arm.
        port: Port to listen at; 0 for any free one.

    Attributes:
        port: The port it listens at.
    """

    def __init__(self, running: RunningCell, *, host: str = "127.0.0.1", port: int = 0) -> None:
        self._running = running
        self._listener = socket.create_server((host, port))
        self.port = int(self._listener.getsockname()[1])
        self._owners: dict[str, socket.socket] = {}
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._thread = threading.Thread(target=self._accept, name="cell server", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port and all connections."""
        with suppress(OSError):  # which some systems have for a socket that listens
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            connections = list(self._open)
        for connection in connections:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue
        if self._thread.is_alive():
            self._thread.join()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return  # closed
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._lock:
                self._open.add(connection)
            threading.Thread(
                target=self._serve, args=(connection,), name="cell connection", daemon=True
            ).start()

    def _serve(self, connection: socket.socket) -> None:
        pictures: dict[tuple[int, int], CellPictures] = {}
        with closing(connection):
            try:
                while True:
                    request = receive(connection)
                    try:
                        answer = {"value": self._answer(connection, request, pictures)}
                    except (ControllerError, TypeError, ValueError, IndexError) as error:
                        answer = {"error": str(error)}
                    send(connection, answer)
            except (OSError, EOFError, ControllerError):
                pass
            finally:
                for drawn in pictures.values():
                    drawn.close()
                self._leave(connection)

    def _leave(self, connection: socket.socket) -> None:
        with self._lock:
            self._open.discard(connection)
            for device, owner in list(self._owners.items()):
                if owner is connection:
                    del self._owners[device]
                    if device == "arm":
                        self._running.arm.brake()

    def _answer(
        self,
        connection: socket.socket,
        request: Any,
        pictures: dict[tuple[int, int], CellPictures],
    ) -> Any:
        if not isinstance(request, tuple) or not request:
            raise ControllerError(f"{request!r} is no request")
        name, *arguments = request
        if name in MEASURED:
            return getattr(self._running.arm, MEASURED[name])()
        if name in STARTS:
            with self._lock:
                self._owners[STARTS[name]] = connection
                if STARTS[name] == "arm":
                    self._running.arm.start()
            return None
        if name in COMMANDS:
            with self._lock:
                if self._owners.get(COMMANDS[name]) is not connection:
                    raise ControllerError(
                        f"the {COMMANDS[name]} takes no commands from this connection; call"
                        " start() first"
                    )
                return getattr(self._running.arm, name)(*arguments)
        if name in STOPPED:
            with self._running.stopped() as cell:
                return getattr(cell, name)(*arguments)
        if name == "coming":
            with self._running.stopped() as cell:
                return cell.coming
        if name == "picture":
            return self._picture(pictures, *arguments)
        raise ControllerError(f"this cell does not know {name!r}")

    def _picture(
        self, pictures: dict[tuple[int, int], CellPictures], width: int, height: int
    ) -> Any:
        with self._running.stopped() as cell:
            if (width, height) not in pictures:
                pictures[width, height] = CellPictures(cell, width=width, height=height)
            pictures[width, height].look()
        return pictures[width, height].drawn()


def _until_eof(ended: threading.Event) -> None:
    sys.stdin.read()
    ended.set()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a cell until a signal ends it; return the exit code."""
    parser = argparse.ArgumentParser(description="The simulated palletizing cell with physics.")
    parser.add_argument("--packages", type=int, default=12, help="how many come (12)")
    parser.add_argument("--seed", type=int, default=59, help="of all that is random (59)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (this host's)")
    parser.add_argument("--port", type=int, default=7460, help="port to listen at (7460)")
    parser.add_argument("--speed", type=float, default=1.0, help="times real time (1)")
    parser.add_argument(
        "--until-eof", action="store_true", help="end with the process that started it"
    )
    options = parser.parse_args(arguments)
    try:
        cell = PhysicalCell(options.packages, seed=options.seed, epoch_ns=time.time_ns())
        running = RunningCell(cell, speed=options.speed)
        server = CellServer(running, host=options.host, port=options.port)
    except (ControllerError, ValueError, OSError) as error:
        print(f"cell: {error}")
        return 1
    make_urgent()  # it stands for a machine that has a computer of its own
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    if options.until_eof:
        threading.Thread(target=_until_eof, args=(ended,), daemon=True).start()
    with running, server:
        print(f"cell: {options.packages} packages, port {server.port}", flush=True)
        ended.wait()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
