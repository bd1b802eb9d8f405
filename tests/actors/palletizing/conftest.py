"""Products trained once per test run, and a simulated tray."""

import fcntl
import os
import pickle
from functools import lru_cache

import pytest

os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo chooses what draws when it is imported


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Return a function from a product's name to the surface that 14 views of it give, of four images each.

    It is trained once for all processes of a run, which share a folder.
    """
    pytest.importorskip("open3d", exc_type=ImportError)
    from actors.palletizing.simulation.sensors import SimulatedOrbitSensor
    from actors.palletizing.trials.evaluation import train

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent

    @lru_cache
    def surface_of(product):
        with (folder / f"{product}.pickle").open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if not file.tell():  # nobody before has trained it
                pickle.dump(train(product, SimulatedOrbitSensor(seed=5), frames=4), file)
                file.flush()
            file.seek(0)
            return pickle.load(file)

    return surface_of


@pytest.fixture(scope="session")
def tray():
    """Return an overhead sensor whose first package is missing."""
    pytest.importorskip("open3d", exc_type=ImportError)
    from actors.palletizing.simulation.sensors import SimulatedTraySensor
    from actors.palletizing.trials.evaluation import graded

    packages = graded("missing", 0.0, 1, seed=1, products=["milk_carton"])
    return SimulatedTraySensor(packages, seed=2)


@pytest.fixture
def cell():
    """A cell with two products, grasps, and a plan of four packages."""
    pytest.importorskip("mujoco", exc_type=ImportError)
    from .handled_cell import handled_cell

    with handled_cell() as opened:
        yield opened
