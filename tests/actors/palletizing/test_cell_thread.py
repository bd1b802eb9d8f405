"""Claims about the physical cell in a thread of its own."""

import time

import numpy as np
import pytest

from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.cell.scene import HOME_RAD
from actors.palletizing.simulation.cell.thread import RunningCell
from actors.palletizing.simulation.physics import PhysicalCell

from .moves import carton

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)


def test_cell_runs_by_itself():
    """The belt brings a package and the arm comes where it was commanded, while no caller steps."""
    with RunningCell(PhysicalCell([carton()], seed=1), speed=8.0) as running:
        running.arm.start()
        goal = np.array(HOME_RAD) + 0.2
        running.arm.command(goal)
        with running.stopped() as cell:
            assert cell.feed() == 0
            cell.run_belt()

        running.wait_cycles(1000)

        with running.stopped() as cell:
            assert cell.arrived()
            assert cell.truth().packages[0].where == "belt"
            assert [package.number for package in cell.shown().packages] == [0]
        np.testing.assert_allclose(running.arm.measured().q, goal, atol=1e-3)


def test_time_runs_no_faster_than_asked():
    """At twice real time, a second of simulation takes half a second at least."""
    with RunningCell(PhysicalCell([carton()], seed=1), speed=2.0) as running:
        running.wait_cycles(1)
        before_s = time.monotonic()

        running.wait_cycles(250)

        assert time.monotonic() - before_s > 0.5 - 0.06


def test_time_stands_still_in_a_block():
    """Between two cycles nothing changes, and the cell goes on afterwards."""
    with RunningCell(PhysicalCell([carton()], seed=1), speed=20.0) as running:
        with running.stopped() as cell, RunningCell(PhysicalCell([], seed=1), speed=20.0) as beside:
            first = cell.time_s
            beside.wait_cycles(5)
            second = cell.time_s
        running.wait_cycles(2)

        assert first == second
        with running.stopped() as cell:
            assert cell.time_s > second


def test_ended_cell_says_so():
    """After its end, and after an error inside, every call is one line with the cause."""
    with RunningCell(PhysicalCell([carton()], seed=1)) as running:
        running.wait_cycles(1)
    with pytest.raises(ControllerError, match="the physical cell does not run"), running.stopped():
        pass

    broken = PhysicalCell([carton()], seed=1)
    broken.step = lambda: 1 / 0
    with RunningCell(broken) as running, pytest.raises(ControllerError, match="division by zero"):
        running.wait_cycles(1)
    with pytest.raises(ValueError, match="asked for 0 times real time"):
        RunningCell(broken, speed=0.0)
