"""Arms by their model: where joints put their capsules, and where a path of joints leads."""

from dataclasses import dataclass

import numpy as np
import pytest
from view_samples import moved, shown

from enact_dist.view.drawing.arms import PLACES_MAX
from enact_dist.view.drawing.nodes import CapsulesNode, LineNode
from enact_dist.view.drawing.scene import scene_of

BASE = moved(0.0)
BASE[2, 3] = 0.5


@dataclass(frozen=True, eq=False)
class Model:
    dh: np.ndarray
    base: np.ndarray
    capsules: np.ndarray


def test_an_arm_stands_as_its_joints_say():
    """Two links of 1 m in a plane; the second joint is bent by a quarter turn."""
    links = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    shapes = np.array([[0, 0, 1, 0, 0.1], [1, 0, 2, 0, 0.05]], np.float64)
    model = shown(Model(links, BASE, shapes), entity="arm", aspect="model")
    joints = shown(np.array([0.0, np.pi / 2]), "joints", entity="arm", frame="cell", model="model")
    data = {one.recorded.slot: one for one in (model, joints)}
    (node,) = scene_of(data).nodes.values()
    assert node is next(iter(scene_of(data).nodes.values()))
    first, second = (capsule.ends_m for capsule in node.capsules)
    assert np.allclose(first, [[0, 0, 0.5], [1, 0, 0.5]])
    assert np.allclose(second, [[1, 0, 0.5], [1, 1, 0.5]])
    assert scene_of({joints.recorded.slot: joints}).nodes == {}


@pytest.mark.parametrize("waypoints", [[[0.0, 0.0], [np.pi, 0.0]], [[0.0, 0.0]], []])
def test_a_path_of_joints_is_the_way_of_the_last_frame(waypoints):
    """Half a turn of a straight arm of 2 m is half a circle, and not the line between its ends."""
    links = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    model = Model(links, BASE, np.zeros((0, 5)))
    base = shown(model, entity="arm", aspect="model")
    rows = np.array([*waypoints, [np.nan, 0.0]]).reshape(-1, 2)
    path = shown(rows, "trajectory", entity="arm", aspect="path", frame="cell", model="model")
    nodes = scene_of({one.recorded.slot: one for one in (base, path)}).nodes
    if len(waypoints) < 2:
        assert nodes == {}
        return
    places_m = nodes["online:arm/path#trajectory"].places_m
    assert np.allclose(places_m[[0, -1]], [[2, 0, 0.5], [-2, 0, 0.5]], atol=1e-6)
    assert np.allclose(np.linalg.norm(places_m[:, :2], axis=1), 2.0)
    assert np.linalg.norm(np.diff(places_m, axis=0), axis=1).max() < 0.11
    assert places_m[:, 1].min() > -1e-6
    alone = scene_of({path.recorded.slot: path})
    assert (alone.nodes, alone.remarks) == ({}, ())


def path_of(rows, model=None, *kinds):
    """Return the scene of a path of the joints of a straight arm, each link 1 m long."""
    links = np.tile([0.0, 1.0, 0.0, 0.0], (np.shape(rows)[1] if model is None else 2, 1))
    base = shown(model or Model(links, BASE, np.zeros((0, 5))), entity="arm", aspect="model")
    path = shown(rows, *(kinds or ("trajectory",)), entity="arm", aspect="path", model="model")
    return scene_of({one.recorded.slot: one for one in (base, path)})


@pytest.mark.parametrize(
    "rows",
    [
        np.random.default_rng(7).uniform(-3.0, 3.0, (5 * PLACES_MAX // 2, 3)),
        np.array([[0.0], [1e9], [0.0]]),
        np.array([[-1e308], [1e308]]),
    ],
    ids=["long", "far", "farther than a float"],
)
def test_a_path_of_joints_takes_bounded_memory(rows):
    """However many waypoints it has, and however far apart they are."""
    scene = path_of(rows)
    places_m = scene.nodes["online:arm/path#trajectory"].places_m
    assert 2 < len(places_m) <= PLACES_MAX + 1
    ends = np.cos(np.cumsum(rows[[0, -1]], axis=1)).sum(axis=1)
    assert np.allclose(places_m[[0, -1], 0], ends, atol=1e-5)
    assert bool(scene.remarks and "places" in scene.remarks[0]) == (len(rows) > PLACES_MAX)


@dataclass(frozen=True, eq=False)
class Move:
    positions: np.ndarray
    path: np.ndarray


def test_a_datum_may_hold_an_arm_and_its_path():
    """Each is drawn, whichever is made first."""
    links = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    model = Model(links, BASE, np.array([[0, 0, 1, 0, 0.1]], np.float64))
    move = Move(np.zeros(2), np.array([[0.0, 0.0], [1.0, 1.0]]))
    nodes = path_of(move, model, "joints", "trajectory").nodes
    assert isinstance(nodes["online:arm/path#joints"], CapsulesNode)
    assert isinstance(nodes["online:arm/path#trajectory"], LineNode)


def test_an_arm_without_capsules_is_not_drawn():
    """Its path has no nodes, and no error."""
    model = Model(np.array([[0.0, 1.0, 0.0, 0.0]] * 2), BASE, np.zeros((0, 5)))
    assert path_of(np.zeros(2), model, "joints").nodes == {}
