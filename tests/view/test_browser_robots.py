"""A robot by its URDF in a real browser: each link where the joint puts it, in its colour."""

import contextlib

import numpy as np
import pytest
from browsed import Opened, Served, is_blue

from enact_dist import Aspect, Entity, Lock, Write

pytest.importorskip("yourdfpy")
pytestmark = pytest.mark.timing

ROBOT = """\
<robot name="turner">
  <material name="grey"><color rgba="0.6 0.6 0.6 1"/></material>
  <material name="red"><color rgba="0.9 0.1 0.1 1"/></material>
  <material name="green"><color rgba="0.1 0.8 0.1 1"/></material>
  <material name="blue"><color rgba="0.1 0.1 0.9 1"/></material>
  <link name="base">
    <visual>
      <origin xyz="0 0 -0.01"/><geometry><box size="2.4 2.4 0.02"/></geometry>
      <material name="grey"/>
    </visual>
    <visual>
      <origin xyz="0 0 0.2"/><geometry><box size="0.3 0.3 0.4"/></geometry><material name="red"/>
    </visual>
  </link>
  <link name="arm"><visual>
    <origin xyz="0.4 0 0"/><geometry><box size="0.8 0.12 0.1"/></geometry><material name="green"/>
  </visual></link>
  <link name="tool"><visual>
    <geometry><sphere radius="0.12"/></geometry><material name="blue"/>
  </visual></link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0 0 0.45"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="flange" type="fixed">
    <parent link="arm"/><child link="tool"/><origin xyz="0.9 0 0"/>
  </joint>
</robot>
"""
JOINTS = Aspect("joints", np.ndarray)
TURNER = Entity("turner")
LOW_M, HIGH_M = (-1.2, -1.2, -0.02), (1.2, 1.2, 0.57)
"""Corners of the robot, however it turns: its plate lies below all of it."""
PANEL_PX = 860
"""From this column on the panel covers the scene."""


class ServedRobot(Served):
    aspects = '[aspects.joints]\nshows = "joints"\nurdf = "turner.urdf"\nframe = "cell"\n'

    def begin(self):
        (self.folder / "turner.urdf").write_text(ROBOT, "utf-8")
        self.turn(0.0)

    def turn(self, angle_rad):
        joints = Write(self.online, TURNER, JOINTS)
        with Lock(joints) as lock:
            lock[joints] = np.array([angle_rad])


@pytest.fixture
def served(tmp_path):
    with contextlib.ExitStack() as stack:
        yield ServedRobot(tmp_path, stack)


def sphere_at(picture):
    """Return the middle of all that is blue, column and row, and how many pixels it has."""
    red, green, blue = picture[:, :PANEL_PX].astype(int).transpose(2, 0, 1)
    rows, columns = np.nonzero((blue > red + 60) & (blue > green + 60))
    return (columns.mean(), rows.mean(), len(rows)) if len(rows) else (0.0, 0.0, 0)


def is_green(red, green, blue):
    return green > red + 60 and green > blue + 60


def is_red(red, green, blue):
    return red > green + 60 and red > blue + 60


def test_links_are_drawn_where_the_joint_puts_them(served, browser):
    """Along x, then turned against y, which is towards the page's camera."""
    page = Opened(browser, served.url, wide_px=1300, high_px=800)
    page.text("turner/joints")

    def place(*metres):
        return page.pixel_of(np.array(metres), LOW_M, HIGH_M)

    for angle_rad in (0.0, -np.pi / 2.0):
        served.turn(angle_rad)
        along = np.array((np.cos(angle_rad), np.sin(angle_rad), 0.0))
        wanted = place(*(0.9 * along + (0.0, 0.0, 0.45)))
        for _ in range(40):
            picture = page.picture()
            column, row, count = sphere_at(picture)
            if count and np.hypot(column - wanted[0], row - wanted[1]) < 8.0:
                break
            page.page.wait_for_timeout(250)  # frames come when the browser has drawn them
        else:
            raise AssertionError(f"the tool is at {column, row}, {count} px, not at {wanted}")
        looks = {
            "tool": (is_blue, wanted),
            "arm": (is_green, place(*(0.5 * along + (0.0, 0.0, 0.5)))),
            "base": (is_red, place(0.0, -0.15, 0.15)),
        }
        for link, (is_right, (at, down)) in looks.items():
            colour = picture[down, at].astype(int)
            assert is_right(*colour), f"{link} at {at, down}, {angle_rad:.2f} rad, is {colour}"
    assert page.errors == []
    page.page.close()
