"""Robots by their model file: shapes, where joints put them, and what is wrong with a file."""

import re
from pathlib import Path

import numpy as np
import pytest
from quiet_browser import QuietClient
from view_samples import shown, slot

from enact_dist.config.read import parse_config
from enact_dist.config.shows import Shows
from enact_dist.errors import ConfigError
from enact_dist.view.drawing.nodes import RobotNode
from enact_dist.view.drawing.scene import extent_of, scene_of
from enact_dist.view.pages.canvas import Canvas

pytest.importorskip("yourdfpy")

ROBOT = """\
<robot name="gripper">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base">
    <visual>
      <origin xyz="0 0 0.1"/><geometry><box size="0.2 0.2 0.2"/></geometry><material name="red"/>
    </visual>
  </link>
  <link name="upper">
    <visual>
      <origin xyz="0.5 0 0" rpy="0 1.5707963267948966 0"/>
      <geometry><cylinder radius="0.05" length="1"/></geometry>
    </visual>
  </link>
  <link name="finger"><visual><geometry><box size="0.1 0.02 0.02"/></geometry></visual></link>
  <link name="thumb"><visual><geometry><sphere radius="0.02"/></geometry></visual></link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="upper"/><child link="finger"/><origin xyz="1 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/>
  </joint>
  <joint name="mirror" type="prismatic">
    <parent link="upper"/><child link="thumb"/><origin xyz="1 0 0"/><axis xyz="1 0 0"/>
    <limit lower="-0.1" upper="0" effort="1" velocity="1"/><mimic joint="slide" multiplier="-1"/>
  </joint>
</robot>
"""
TRIANGLE = """\
solid hand
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid hand
"""


def with_mesh(name):
    mesh = f'<mesh filename="{name}" scale="0.5 0.5 0.5"/>'
    return ROBOT.replace('<sphere radius="0.02"/>', mesh)


@pytest.fixture
def file(tmp_path):
    found = tmp_path / "robot.urdf"
    found.write_text(ROBOT, "utf-8")
    return found


def scene_at(positions, file, **options):
    joints = shown(np.array(positions), "joints", urdf=file, frame="cell", **options)
    return scene_of({slot("thing"): joints})


def places(scene):
    """Return where the links of the only robot are."""
    (node,) = scene.nodes.values()
    assert isinstance(node, RobotNode)
    return {
        shape.link: np.round(pose[:3, 3], 6).tolist()
        for shape, pose in zip(node.shapes, node.poses, strict=True)
    }


def test_a_robot_stands_as_its_joints_say(file):
    """In the order of the file; a joint that mimics another one is none of the data."""
    scene = scene_at([np.pi / 2, 0.1], file)
    assert places(scene) == {
        "base": [0, 0, 0], "upper": [0, 0, 0.2], "finger": [0, 1.1, 0.2], "thumb": [0, 0.9, 0.2],
    }  # fmt: skip
    assert scene.remarks == ()
    (robot,) = scene.nodes.values()
    assert (robot.frame, robot.shapes[0].colour) == ("cell", (255, 0, 0))
    low, high = extent_of(scene)
    assert np.allclose(low, [-0.1, -0.1, 0.0])
    assert np.allclose(high, [0.1, 1.15, 0.25])


def test_joints_with_names_come_in_any_order(file):
    """With names beside the aspect, each value moves the joint of its name."""
    assert places(scene_at([0.1, 0.0], file, joints=("slide", "shoulder")))["finger"] == [
        1.1,
        0,
        0.2,
    ]


@pytest.mark.parametrize(
    ("positions", "options", "said"),
    [
        ([0.0], {}, "not by these 1"),
        ([0.0, 0.0, 0.0], {}, "not by these 3"),
        ([0.0, 0.0], {"joints": ("slide", "elbow")}, "not by these 2: slide, elbow"),
    ],
)
def test_joints_of_another_robot_are_named(file, positions, options, said):
    """Too few, too many or other names: the remark lists what the file has and what came."""
    scene = scene_at(positions, file, **options)
    assert scene.nodes == {}
    (remark,) = scene.remarks
    assert remark.startswith(f"online:thing/x v1: {file} moves by 2 joints (shoulder, slide), ")
    assert remark.endswith(said)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<robot", "is no URDF"),
        ("<robot name='a'/>", "it has no link"),
        ("<world/>", "is no URDF"),
        ("<mujoco model='arm'/>", "is MJCF: robots are read from URDF alone"),
        (ROBOT.replace('child link="upper"', 'child link="lower"'), "is no URDF|cannot be drawn"),
        (with_mesh("hand.stl"), "the link 'thumb' has no mesh 'hand.stl'"),
        (with_mesh("robot.urdf"), "cannot be drawn"),
    ],
)
def test_what_is_wrong_with_a_file_is_on_the_page(file, text, said):
    """Each time, with the file's path; no robot is drawn."""
    file.write_text(text, "utf-8")
    for _ in range(2):
        scene = scene_at([0.0, 0.0], file)
        assert scene.nodes == {}
        (remark,) = scene.remarks
        assert re.search(said, remark), remark
        assert str(file) in remark


def test_a_file_that_comes_later_is_read_with_its_meshes(tmp_path):
    """A missing file is not remembered as missing."""
    file = tmp_path / "later.urdf"
    (remark,) = scene_at([0.0, 0.0], file).remarks
    assert remark == f"online:thing/x v1: cannot read {file}: No such file or directory"
    (tmp_path / "hand.stl").write_text(TRIANGLE, "utf-8")
    file.write_text(with_mesh("package://robot/hand.stl"), "utf-8")
    (robot,) = scene_at([0.0, 0.0], file).nodes.values()
    (thumb,) = (shape for shape in robot.shapes if shape.link == "thumb")
    assert thumb.vertices_m.max(axis=0).tolist() == [0.5, 0.5, 0.0]


def test_a_missing_library_is_named_with_the_extra_that_brings_it(file, monkeypatch):
    """The page stays; only the robot is left out."""
    monkeypatch.setattr("enact_dist.view.drawing.robots.find_spec", lambda _: None)
    file.write_text(ROBOT + "<!-- read anew -->", "utf-8")
    (remark,) = scene_at([0.0, 0.0], file).remarks
    assert "yourdfpy" in remark
    assert "'.[view]'" in remark


def test_a_robot_that_moves_is_not_sent_again(file, monkeypatch):
    """Its shapes get new poses."""
    canvas, added = Canvas(QuietClient()), []
    monkeypatch.setattr(
        canvas, "_scene", Recorder(lambda *_, **__: added.append(Handle()) or added[-1])
    )
    canvas.draw({"": scene_at([0.0, 0.0], file)})
    count = len(added)
    canvas.draw({"": scene_at([np.pi / 2, 0.0], file)})
    assert len(added) == count
    assert np.allclose(added[-2].position, [0, 1, 0.2])


class Handle:
    wxyz = position = ()


class Recorder:
    def __init__(self, add):
        self._add = add

    def __getattr__(self, _):
        return self._add


def test_a_file_is_named_relative_to_the_cell():
    """Not to the folder in which a tool was started."""
    text = (
        'name = "c"\n[shards.s]\nlisten = "tcp/127.0.0.1:7447"\n[aspects.joints]\n'
        'shows = "joints"\nurdf = "models/arm.urdf"\n'
    )
    config = parse_config(text, Path("/cells/one/cell.toml"), environment={})
    assert config.aspects[0].shows.urdf == Path("/cells/one/models/arm.urdf")


@pytest.mark.parametrize("options", [{"kinds": ("pose",)}, {"kinds": ("joints",), "model": "m"}])
def test_a_robot_is_drawn_by_joints_alone(options):
    """A URDF beside another kind, or beside a model, is refused."""
    with pytest.raises(ConfigError, match="needs shows"):
        Shows(urdf=Path("arm.urdf"), **options)
