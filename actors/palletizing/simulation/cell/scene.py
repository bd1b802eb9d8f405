"""The palletizing cell as MuJoCo reads it: arm, gripper, belt, tray, reject bin, packages.

===========  ==================================================================================
arm          the kinematics and capsules of the workcell's arm, its base at the world's origin
hand         a box with two coupled fingers, 65 to 135 mm apart, pads of 24 x 140 mm
belt         a static box with a surface velocity; a light barrier across its end
tray         that of the simulated depth sensor, with a rim of the layout's height
bin          a box with four walls for rejected packages
packages     free convex bodies: the corners of the true shape of the product
===========  ==================================================================================

Rules a change must keep: the world is the frame of the arm's base, z up, metres; the body of a
package is its product frame (MuJoCo moves the geom of a mesh to its centre: never read a pose off
a geom); a package's friction is that of all its contacts, hence its priority.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.poses import on_tray
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.simulation.products import hull_mesh, product_mesh
from actors.palletizing.simulation.sensors import FLOOR_M, TRAY_M
from actors.workcell.simulation.arm import ARM as WORKCELL_ARM

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.palletizing.simulation.physical_packages import PhysicalPackage

    F64 = npt.NDArray[np.float64]

ARM: Final = replace(WORKCELL_ARM, base=np.eye(4))
"""The arm of this cell: the workcell's, without its pedestal."""
HOME_RAD: Final = (0.9, 0.3, 0.0, -1.6, 0.0, 1.24, 0.0)
"""Where the arm stands at the start: between belt and tray, the hand down, above both."""
STEP_S: Final = 0.002
STIFFNESS_NM_RAD: Final = (4000.0, 4000.0, 3000.0, 3000.0, 2000.0, 1500.0, 1000.0)
DAMPING_NM_S_RAD: Final = (300.0, 300.0, 200.0, 200.0, 100.0, 80.0, 50.0)
"""Of the drives of the joints: 5 N at the tool give way by less than 1 mm."""
JOINT_DAMPING: Final = 5.0
"""Friction of each joint, Nm s/rad."""

OPEN_M: Final = (0.065, 0.135)
"""Least and greatest distance between the fingers."""
PAD_HALF_M: Final = (0.012, 0.006, 0.070)
"""Half of a finger's pad, hand frame."""
PAD_CENTRE_M: Final = 0.150
"""Centre of the pads from the flange, along z: they end 20 mm beyond the tool frame."""
HAND_HALF_M: Final = (0.030, 0.075, 0.040)
FINGER_STIFFNESS_N_M: Final = 8000.0
FINGER_DAMPING_N_S_M: Final = 160.0

TABLE_M: Final = -0.15
"""Height of tray and belt: so low that the arm neither folds nor stretches too far above them."""
BELT_HALF_M: Final = (0.80, 0.11, 0.01)
BELT_AHEAD_M: Final = 0.10
"""So far does the belt go on behind its light barrier."""
BELT_M_S: Final = 0.25
"""Speed of the belt while it runs."""
BARRIER_M: Final = 0.025
"""Height of the light barrier above the belt."""
BIN_HALF_M: Final = (0.16, 0.16)
BIN_WALL_M: Final = 0.10
PACKAGES_GROUP: Final = 2
"""Group of what the light barrier sees."""
_DIRECTIONS: Final = 240


def _at(x_m: float, y_m: float, *, yaw_rad: float = 0.0, z_m: float = 0.0) -> F64:
    pose = on_tray(x_m, y_m, yaw_rad)
    pose[2, 3] = TABLE_M + z_m
    return pose


@dataclass(frozen=True, slots=True, eq=False)
class CellLayout:
    """Where things stand around the arm; frames in the base frame, (4, 4), metres.

    Attributes:
        base_from_tray: Origin in the middle of the tray, on it.
        base_from_belt: Origin on the belt in its light barrier, x where it moves to.
        base_from_bin: Origin in the middle of the bottom of the reject bin.
        rim_m: Height of the tray's rim: packages are pushed against it.
    """

    base_from_tray: F64 = field(default_factory=lambda: _at(0.58, 0.0, yaw_rad=np.pi / 2.0))
    base_from_belt: F64 = field(default_factory=lambda: _at(0.45, 0.62))
    base_from_bin: F64 = field(default_factory=lambda: _at(0.25, -0.66, z_m=-0.09))
    rim_m: float = 0.030

    def frames(self) -> dict[str, F64]:
        """Return base_from_entity of tray, belt and reject bin by name."""
        return {
            "tray": self.base_from_tray,
            "belt": self.base_from_belt,
            "bin": self.base_from_bin,
        }

    def areas(self) -> dict[str, tuple[F64, F64]]:
        """Return where packages can lie: frame (4, 4), least and greatest (x, y) in it (2, 2)."""
        tray, bin_half = np.array(TRAY_M) / 2.0, np.array(BIN_HALF_M)
        across = BELT_HALF_M[1]
        start = BELT_AHEAD_M - 2.0 * BELT_HALF_M[0]
        return {
            "tray": (self.base_from_tray, np.array([-tray, tray])),
            "belt": (self.base_from_belt, np.array([[start, -across], [BELT_AHEAD_M, across]])),
            "bin": (self.base_from_bin, np.array([-bin_half, bin_half])),
        }


def load_mujoco() -> Any:
    """Return MuJoCo's module, which draws by EGL unless the environment names something else.

    Raises:
        ControllerError: It is not installed.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("LP_NUM_THREADS", "1")
    try:
        import mujoco
    except ImportError as error:
        raise ControllerError(
            f"the physical cell needs MuJoCo 4 ({error}); install enact-dist[actors]"
        ) from error
    if int(mujoco.__version__.partition(".")[0]) < 4:
        raise ControllerError(
            f"the physical cell needs MuJoCo 4, for its surface velocities; {mujoco.__version__}"
            " is installed"
        )
    return mujoco


@lru_cache(maxsize=8)
def collision_corners(product: str) -> F64:
    """Return the corners of a product's convex body, (N, 3), metres, product frame.

    They are those points of the true shape that are outermost in some direction: all corners of
    a carton, and enough of a round one that the body is nowhere 0.7 mm inside it.
    """
    vertices, _ = product_mesh(product)
    number = np.arange(_DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * number / _DIRECTIONS
    angle = number * np.pi * (3.0 - np.sqrt(5.0)) + 0.01
    flat = np.sqrt(1.0 - z**2)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    around = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False) + 0.013
    for rise in (-0.999, -0.2, 0.0, 0.2, 0.999):
        level = np.sqrt(1.0 - rise**2)
        ring = [np.cos(around) * level, np.sin(around) * level, np.full(48, rise)]
        directions = np.concatenate([directions, np.stack(ring, axis=1)])
    outermost = np.unique(np.argmax(directions @ vertices.T, axis=1))
    corners = np.array(vertices[outermost])
    corners.setflags(write=False)
    return corners


@lru_cache(maxsize=8)
def centre_of_mass(product: str) -> F64:
    """Return the centre of mass of a product that is filled evenly, (3,), metres, product frame."""
    corners, triangles = hull_mesh(collision_corners(product))
    a, b, c = (corners[triangles[:, i]] for i in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    centre = np.asarray(volumes @ (a + b + c) / 4.0 / volumes.sum())
    centre.setflags(write=False)
    return centre


def scene_xml(
    packages: Sequence[PhysicalPackage], layout: CellLayout, *, picture: tuple[int, int]
) -> str:
    """Return the cell with its packages, none of which is in it yet.

    Args:
        packages: What will come.
        layout: Where things stand.
        picture: Width and height of rendered pictures, px.
    """
    products = sorted({package.product for package in packages})
    meshes = "".join(
        f'<mesh name="{name}" vertex="{_words(collision_corners(name))}"/>' for name in products
    )
    drives = "".join(
        f'<position joint="joint{i}" kp="{STIFFNESS_NM_RAD[i]}" kv="{DAMPING_NM_S_RAD[i]}"/>'
        for i in range(7)
    )
    fingers = "".join(
        f'<position joint="{name}" kp="{FINGER_STIFFNESS_N_M}" kv="{FINGER_DAMPING_N_S_M}"'
        ' forcelimited="true" forcerange="-60 60"/>'
        for name in ("left", "right")
    )
    return f"""<mujoco><option timestep="{STEP_S}" integrator="implicitfast" cone="elliptic"
impratio="5"/><compiler angle="radian"/><statistic extent="2" center="0.4 0 0.2"/>
<visual><global offwidth="{picture[0]}" offheight="{picture[1]}"/><quality shadowsize="2048"/>
<headlight ambient=".35 .35 .35" diffuse=".35 .35 .35"/><map znear="0.01" zfar="20"/></visual>
<asset>{meshes}</asset><default><geom contype="1" conaffinity="1"/>
<default class="arm"><geom contype="0" conaffinity="1" condim="4" friction=".6 .01 .001"/></default>
</default><worldbody><light pos="0.4 -0.6 2.6" dir="0 .25 -1" diffuse=".6 .6 .6"/>
<camera name="cell" pos="1.9 -1.35 1.25" xyaxes=".62 .78 0 -.36 .29 .89"/>
{_surroundings(layout)}{_arm()}{"".join(_package(package) for package in packages)}</worldbody>
<equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0" solref="0.004 1"/></equality>
<actuator>{drives}{fingers}</actuator>
<sensor><force name="force" site="tool"/><torque name="torque" site="tool"/></sensor></mujoco>"""


def _surroundings(layout: CellLayout) -> str:
    """Return everything that stands still."""
    length, width = TRAY_M
    rim, wall = layout.rim_m / 2.0, BIN_WALL_M / 2.0
    grey, dark = ".70 .70 .74 1", ".16 .16 .17 1"
    tray = [("", (length / 2, width / 2, 0.01), (0.0, 0.0, -0.01), grey)]
    tray += [("", (length / 2, 0.002, rim), (0.0, s * width / 2, rim), grey) for s in (-1, 1)]
    tray += [("", (0.002, width / 2, rim), (s * length / 2, 0.0, rim), grey) for s in (-1, 1)]
    middle = BELT_AHEAD_M - BELT_HALF_M[0]
    belt = [("belt", BELT_HALF_M, (middle, 0.0, -BELT_HALF_M[2]), dark)]
    x, y = BIN_HALF_M
    rejects = [("", (x, y, 0.01), (0.0, 0.0, -0.01), dark)]
    rejects += [("", (x, 0.004, wall), (0.0, s * y, wall), dark) for s in (-1, 1)]
    rejects += [("", (0.004, y, wall), (s * x, 0.0, wall), dark) for s in (-1, 1)]
    floor = layout.base_from_tray[2, 3] + FLOOR_M
    text = (
        f'<geom name="floor" type="plane" size="4 4 .1" pos="0 0 {floor}" rgba=".55 .55 .53 1"/>'
        f'<geom class="arm" type="cylinder" fromto="0 0 {floor} 0 0 0" size=".11"'
        ' rgba=".3 .3 .35 1"/>'
    )
    # A geom that is compiled without a surface velocity never gets one.
    moving = f' surfacevel="{BELT_M_S} 0 0"'
    for frame, boxes in (
        (layout.base_from_tray, tray),
        (layout.base_from_belt, belt),
        (layout.base_from_bin, rejects),
    ):
        geoms = "".join(
            f'<geom {_name(name)} type="box" size="{_words(half)}" pos="{_words(at)}"'
            f' rgba="{colour}"{moving if name == "belt" else ""}/>'
            for name, half, at, colour in boxes
        )
        text += f'<body pos="{_words(frame[:3, 3])}" quat="{_words(_turn(frame))}">{geoms}</body>'
    return text


def _arm() -> str:
    """Return the arm: a body per joint, turned into each other as its kinematics say."""
    text = ""
    fixed = ARM.base
    capsules = _capsules_by_body()
    for joint, (d, a, alpha, _) in enumerate(ARM.dh):
        limit = ARM.q_max[joint]
        text += (
            f'<body name="link{joint}" pos="{_words(fixed[:3, 3])}" quat="{_words(_turn(fixed))}"'
            f' gravcomp="1"><inertial pos="0 0 0" mass="{3.0 - 0.3 * joint:.9g}"'
            ' diaginertia=".02 .02 .02"/>'
            f'<joint name="joint{joint}" axis="0 0 1" range="{-limit} {limit}"'
            f' damping="{JOINT_DAMPING}" armature=".3"/>{capsules.get(joint, "")}'
        )
        fixed = np.eye(4)
        fixed[1:3, 1:3] = [[np.cos(alpha), -np.sin(alpha)], [np.sin(alpha), np.cos(alpha)]]
        fixed[:3, 3] = a, 0.0, d
    text += (
        f'<body name="hand" pos="{_words(fixed[:3, 3])}" quat="{_words(_turn(fixed))}"'
        ' gravcomp="1">'
        f'<geom class="arm" type="box" size="{_words(HAND_HALF_M)}" pos="0 0 {HAND_HALF_M[2]}"'
        ' mass=".8" rgba=".3 .3 .35 1"/>'
        f'<site name="tool" pos="0 0 {ARM.capsules[-1, 3]}"/>'
    )
    # The pads get a surface velocity while they carry: see `PhysicalCell`.
    travel = (OPEN_M[1] - OPEN_M[0]) / 2.0
    for name, side in (("left", 1.0), ("right", -1.0)):
        text += (
            f'<body name="{name}" pos="0 {side * OPEN_M[0] / 2.0} 0" gravcomp="1">'
            f'<joint name="{name}" type="slide" axis="0 {side} 0" range="0 {travel}"'
            ' damping="10" armature=".2" solreflimit=".004 1" solimplimit=".99 .999 .0001"/>'
            f'<geom name="{name}" class="arm" type="box" size="{_words(PAD_HALF_M)}"'
            f' pos="0 {side * PAD_HALF_M[1]} {PAD_CENTRE_M}" mass=".08" surfacevel="1 0 0"'
            ' rgba=".2 .2 .2 1"/></body>'
        )
    return text + "</body>" * 8


def _capsules_by_body() -> dict[int, str]:
    """Return the capsules of the links, each in the body that carries its second end.

    Its first end is that body's origin: the joints between the two frames meet in one point.
    """
    found: dict[int, str] = {}
    for number, (first, _, second, _, radius) in enumerate(ARM.capsules):
        joint = int(second) - 1
        if first == second:
            continue  # the tool: the hand is drawn as what it is
        assert not ARM.dh[int(first) : joint, 0].any(), "the joints between meet in one point"
        length = float(ARM.dh[joint, 0])
        if first == 5:
            length -= HAND_HALF_M[2]  # the wrist ends where the hand begins
        colour = "1 .5 .1 1" if number % 2 else ".85 .85 .85 1"
        found[joint] = (
            f'<geom class="arm" type="capsule" fromto="0 0 0 0 0 {length}" size="{radius}"'
            f' mass="0" rgba="{colour}"/>'
        )
    return found


def _package(package: PhysicalPackage) -> str:
    corners = collision_corners(package.product)
    size = np.ptp(corners, axis=0)
    inertia = package.mass_kg / 12.0 * (np.sum(size**2) - size**2)
    centre = centre_of_mass(package.product) + package.centre_offset_m
    return (
        f'<body name="package{package.number}" pos="0 0 {-5.0 - package.number}" gravcomp="1">'
        f'<freejoint/><inertial pos="{_words(centre)}" mass="{package.mass_kg:.9g}"'
        f' diaginertia="{_words(inertia)}"/><geom name="package{package.number}" type="mesh"'
        f' mesh="{package.product}" group="{PACKAGES_GROUP}" priority="1" condim="4"'
        f' friction="{package.friction:.9g} .01 .001" solref="{package.contact_s:.9g} 1"'
        f' contype="0" conaffinity="0" rgba="{package.colour}"/></body>'
    )


def _turn(pose: F64) -> F64:
    """Return the quaternion (w, x, y, z) of a pose."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return np.array([w, x, y, z])


def _words(values: object) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, float).ravel())


def _name(name: str) -> str:
    return f'name="{name}"' if name else ""
