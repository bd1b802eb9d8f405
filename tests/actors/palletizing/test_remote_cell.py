"""Claims about the physical cell that is used over a connection."""

import socket
from contextlib import closing

import numpy as np
import pytest

from actors.palletizing.control.controller import ControllerError, open_controller
from actors.palletizing.sight.sensor import open_sensor
from actors.palletizing.simulation.cell.messages import receive, send
from actors.palletizing.simulation.cell.scene import HOME_RAD
from actors.palletizing.simulation.cell.server import CellServer, main
from actors.palletizing.simulation.cell.thread import RunningCell
from actors.palletizing.simulation.physics import PhysicalCell
from actors.palletizing.simulation.remote_cell import RemoteCell

from .moves import carton

pytest.importorskip("open3d", exc_type=ImportError)
pytest.importorskip("mujoco", exc_type=ImportError)

REMOTE = "actors.palletizing.simulation.remote_cell"


@pytest.fixture
def cell():
    """Return a served cell: what runs, and its port."""
    running = RunningCell(PhysicalCell([carton(0), carton(1)], seed=1), speed=10.0)
    with running, CellServer(running) as server:
        yield running, server.port


def test_cell_is_used_by_addresses(cell):
    """Arm, belt and sensors at an address do what those of the cell itself do."""
    running, port = cell
    arm, gripper, belt = (
        open_controller(f"{REMOTE}:{name}?port={port}") for name in ("arm", "gripper", "belt")
    )
    sensor = open_sensor(f"{REMOTE}:tray_sensor?port={port}&seed=3")

    arm.start()
    goal = np.array(HOME_RAD) + 0.1
    arm.command(goal)
    gripper.start()
    gripper.grip_width(0.07, 30.0)
    number = belt.feed()
    belt.run_belt()
    running.wait_cycles(1000)

    np.testing.assert_allclose(arm.measured().q, goal, atol=1e-3)
    assert gripper.gripped().width_m == pytest.approx(0.07, abs=1e-3)
    np.testing.assert_allclose(arm.measured().tcp, running.arm.measured().tcp, atol=1e-3)
    np.testing.assert_array_equal(arm.model.dh, running.arm.model.dh)
    np.testing.assert_array_equal(arm.posture_rad, HOME_RAD)
    assert (number, belt.arrived(), belt.coming()) == (0, True, 1)
    with closing(RemoteCell(port)) as remote:
        truth = remote.truth()
    assert [package.where for package in truth.packages] == ["belt", "coming"]
    assert sensor.capture(0).depth_mm.shape == (480, 640)
    with pytest.raises(ControllerError, match="its range is"):
        arm.command(goal + 5.0)
    for one in (arm, gripper, belt):
        one.close()


def test_arm_brakes_when_its_commander_is_gone():
    """A connection that ends in mid-motion brakes the arm; another one may start it then."""
    away = np.array(HOME_RAD) - [2.8, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    running = RunningCell(PhysicalCell([carton()], seed=1))
    with running, CellServer(running) as server:
        first, second = (open_controller(f"{REMOTE}:arm?port={server.port}") for _ in range(2))
        first.start()
        first.command(away)
        running.wait_cycles(20)
        with pytest.raises(ControllerError, match="takes no commands from this connection"):
            second.command(np.array(HOME_RAD))

        first.close()
        for _ in range(1000):
            running.wait_cycles(1)
            if np.abs(running.arm.limiter.dq_rad_s).max() < 1e-9:
                break

        stopped = running.arm.limiter.q_rad
        assert 0.001 < HOME_RAD[0] - stopped[0] < 2.0, "it stopped on the way"
        second.start()
        second.command(stopped)
        running.wait_cycles(2)
        assert np.abs(second.measured().q - stopped).max() < 0.02
        second.close()


def test_last_start_takes_over(cell):
    """A restarted process takes the arm from a connection that hangs."""
    _, port = cell
    first, second = (open_controller(f"{REMOTE}:arm?port={port}") for _ in range(2))
    first.start()

    second.start()

    second.command(np.array(HOME_RAD))
    with pytest.raises(ControllerError, match="call start"):
        first.command(np.array(HOME_RAD))
    first.close()
    second.command(np.array(HOME_RAD))
    second.close()


def test_arm_and_gripper_have_an_owner_each(cell):
    """Who commands the one does not command the other; the gripper holds when its owner is gone."""
    running, port = cell
    arm, gripper, other = (
        open_controller(f"{REMOTE}:{name}?port={port}") for name in ("arm", "gripper", "gripper")
    )
    arm.start()
    with pytest.raises(ControllerError, match=r"the gripper takes no commands .* call start\(\)"):
        gripper.grip_force(30.0)
    gripper.start()
    gripper.grip_force(30.0)

    gripper.close()
    running.wait_cycles(200)

    assert running.arm.gripping
    arm.command(np.array(HOME_RAD))
    other.start()
    other.grip_width(0.08, 30.0)
    assert not running.arm.gripping
    for one in (arm, other):
        one.close()


def test_no_cell_is_one_line():
    """Where nothing listens, the error names address, request and remedy."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    with pytest.raises(ControllerError, match=f"127.0.0.1:{port} for measured: .*; run actors"):
        open_controller(f"{REMOTE}:arm?port={port}").measured()


def test_what_is_no_request_is_refused(cell):
    """Unknown names and wrong arguments are answered, garbage ends the connection, others go on."""
    _, port = cell
    remote = RemoteCell(port)

    with pytest.raises(ControllerError, match="does not know 'model'"):
        remote.ask("model")
    with pytest.raises(ControllerError, match="positional argument"):
        remote.ask("feed", 1, 2, 3)
    with socket.create_connection(("127.0.0.1", port)) as raw:
        send(raw, 7)
        assert receive(raw) == {"error": "7 is no request"}
    with socket.create_connection(("127.0.0.1", port)) as raw:
        raw.sendall(b"\xff\xff\xff\xff")
        assert raw.recv(1) == b""

    assert remote.ask("coming") == 2
    remote.close()


def test_wrong_options_are_one_line(capsys):
    """A cell that cannot be made says why, and leaves with 1."""
    assert main(["--packages", "0", "--port", "0"]) == 1
    assert capsys.readouterr().out == "cell: asked for 0 packages; at least 1\n"
