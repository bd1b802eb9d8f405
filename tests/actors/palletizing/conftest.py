"""Products trained once per test run, and a simulated tray."""

import os
from functools import lru_cache

import pytest

os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo chooses what draws when it is imported


@pytest.fixture(scope="session")
def trained():
    """Return a function from a product's name to the surface that 14 views of it give, of four images each."""
    pytest.importorskip("open3d", exc_type=ImportError)
    from actors.palletizing.simulation.sensors import SimulatedOrbitSensor
    from actors.palletizing.trials.evaluation import train

    return lru_cache(lambda product: train(product, SimulatedOrbitSensor(seed=5), frames=4))


@pytest.fixture(scope="session")
def tray():
    """Return an overhead sensor whose first package is missing."""
    pytest.importorskip("open3d", exc_type=ImportError)
    from actors.palletizing.simulation.sensors import SimulatedTraySensor
    from actors.palletizing.trials.evaluation import graded

    packages = graded("missing", 0.0, 1, seed=1, products=["milk_carton"])
    return SimulatedTraySensor(packages, seed=2)


@pytest.fixture
def cell(trained):
    """A cell with two trained products, grasps, and a plan of four packages."""
    pytest.importorskip("mujoco", exc_type=ImportError)
    from .handled_cell import handled_cell

    with handled_cell(trained) as opened:
        yield opened
