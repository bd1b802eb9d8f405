"""The physical cell in real time, in a thread of its own.

    with RunningCell(PhysicalCell(12, seed=59), speed=2.0) as running:
        running.arm.start()
        running.arm.command(q)            # any thread, at any time
        with running.stopped() as cell:   # between two cycles
            cell.truth()

Rules a change must keep: a thread that reads or changes more than the arm's commands does so
between two cycles; a cell that was held up goes on from now and never makes up for
lost cycles in a burst.
"""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Self

from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.arm import CYCLE_S

if TYPE_CHECKING:
    from collections.abc import Iterator

    from actors.palletizing.simulation.cell.arm import SimulatedArm
    from actors.palletizing.simulation.physics import PhysicalCell

LATE_S: Final = 0.05
"""A cell that is farther behind than this has lost the time in between."""


class RunningCell:
    """A physical cell whose time runs by itself.

    Args:
        cell: The cell; no other thread steps it from now on.
        speed: Simulated seconds per second; a slow machine does less.

    Attributes:
        arm: The controller of arm and gripper.
        lost_s: How much time the machine was too slow for, seconds.
    """

    def __init__(self, cell: PhysicalCell, *, speed: float = 1.0) -> None:
        if not speed > 0.0:
            raise ValueError(f"asked for {speed:g} times real time; it has to be more than 0")
        self._cell, self._speed = cell, speed
        self._between = threading.Condition()
        self._stop = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="physical cell", daemon=True)
        self.lost_s = 0.0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def arm(self) -> SimulatedArm:
        """The controller of arm and gripper."""
        return self._cell.arm

    def close(self) -> None:
        """Stop the time.  Takes as long as a cycle does."""
        with self._between:
            self._stop = True
            self._between.notify_all()
        if self._thread.is_alive():
            self._thread.join()

    @contextmanager
    def stopped(self) -> Iterator[PhysicalCell]:
        """Give the cell between two cycles; its time stands still until the block ends.

        Raises:
            ControllerError: The cell does not run any more.
        """
        with self._between:
            self._check()
            try:
                yield self._cell
            finally:
                self._between.notify_all()

    def wait_cycles(self, cycles: int = 1) -> None:
        """Wait until so many cycles have passed.

        Raises:
            ControllerError: The cell does not run any more.
        """
        with self._between:
            until_s = self._cell.time_s + (cycles - 0.5) * CYCLE_S
            while self._cell.time_s < until_s:
                self._check()
                self._between.wait(1.0)

    def _check(self) -> None:
        if self._error is not None:
            raise ControllerError(f"the physical cell has ended: {self._error}") from self._error
        if self._stop or not self._thread.is_alive():
            raise ControllerError("the physical cell does not run")

    def _run(self) -> None:
        period_s = CYCLE_S / self._speed
        next_s = time.monotonic()
        try:
            while True:
                with self._between:
                    if self._stop:
                        return
                    self._cell.step()
                    self._between.notify_all()
                next_s += period_s
                now_s = time.monotonic()
                if now_s - next_s > LATE_S:
                    self.lost_s += now_s - next_s
                    next_s = now_s
                # A lock that is released and taken at once starves the threads that wait for it.
                time.sleep(max(0.0001, next_s - now_s))
        except Exception as error:  # noqa: BLE001 (who uses the cell gets it: a thread has no caller)
            with self._between:
                self._error = error
                self._between.notify_all()
