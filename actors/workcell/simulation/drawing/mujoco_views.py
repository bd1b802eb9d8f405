"""MuJoCo as a renderer of recordings: soft shadows, its own textures, 0.15 s per view.

It needs EGL or another OpenGL of MuJoCo; without it, the error says so.  Geometry,
cameras and lamp are those of the composite renderer; lenses have no distortion here.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.workcell.cameras.sources import CameraError
from actors.workcell.simulation.drawing.render import person_colours, robot_colours
from actors.workcell.simulation.room import HALF_M, HEIGHT_M, LAMP_M

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt

    from actors.workcell.simulation.room import Box
    from actors.workcell.simulation.stage import Scene, Stage
    from actors.workcell.vocabulary import Calibration

    F64 = npt.NDArray[np.float64]
    Image = npt.NDArray[np.uint8]

SHADOW_PX: Final = 2048
SAMPLES: Final = 4
_AWAY_M: Final = (0.0, 0.0, -50.0)


def mujoco_draws(
    calibrations: Sequence[Calibration], stage: Stage
) -> list[Callable[[Scene], Image]]:
    """Return a function per camera that draws a scene; all share one OpenGL context and thread.

    Raises:
        CameraError: MuJoCo is not installed or cannot draw here, or a lens is distorted.
    """
    if any(calibration.distortion.any() for calibration in calibrations):
        raise CameraError("renderer mujoco: asked for a distorted lens; it has none; use composite")
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("LP_NUM_THREADS", "1")
    made: list[_Views] = []

    def draw_of(number: int) -> Callable[[Scene], Image]:
        def draw(scene: Scene) -> Image:
            if not made:  # in the thread that draws: an OpenGL context belongs to one
                made.append(_Views(calibrations, stage))
            return made[0].draw(number, scene)

        return draw

    return [draw_of(number) for number in range(len(calibrations))]


class _Views:
    """A MuJoCo model of the room in which capsules are put where a scene has them."""

    def __init__(self, calibrations: Sequence[Calibration], stage: Stage) -> None:
        things = stage.things_at(np.inf)
        self._things = {box: number for number, box in enumerate(things)}
        arm, people = robot_colours(5), [person_colours(n) for n in range(len(stage.people))]
        self._colours = np.concatenate([arm, *people])
        try:
            import mujoco

            self._mujoco: Any = mujoco
            text = _xml(calibrations, stage.boxes, things, self._colours)
            self._model = mujoco.MjModel.from_xml_string(text)
            self._data = mujoco.MjData(self._model)
            first = calibrations[0]
            self._renderer = mujoco.Renderer(self._model, first.height, first.width)
        except Exception as error:
            raise CameraError(
                f"renderer mujoco: it cannot draw here ({type(error).__name__}: {error}); install"
                " libegl1 and libgl1-mesa-dri and set MUJOCO_GL=egl, or use the renderer composite"
            ) from error

    def draw(self, number: int, scene: Scene) -> Image:
        """Return the view of a camera."""
        data, model = self._data, self._model
        data.mocap_pos[:] = _AWAY_M
        used = np.zeros(len(self._colours), np.bool_)
        for capsule, colour in zip(scene.capsules, scene.colours, strict=True):
            free = (self._colours == colour).all(1) & ~used
            place = int(np.flatnonzero(free)[0])
            used[place] = True
            along = capsule[3:6] - capsule[:3]
            data.mocap_pos[place] = (capsule[:3] + capsule[3:6]) / 2.0
            data.mocap_quat[place] = _turn_of_z(along)
            geom = int(model.body_geomadr[model.body(f"capsule{place}").id])
            model.geom_size[geom, :2] = capsule[6], max(np.linalg.norm(along) / 2.0, 1e-4)
        for box in scene.boxes:
            if box in self._things:
                data.mocap_pos[len(self._colours) + self._things[box]] = box.centre_m
        self._mujoco.mj_forward(model, data)
        self._renderer.update_scene(data, f"camera{number}")
        return np.ascontiguousarray(self._renderer.render()[:, :, ::-1])


def _turn_of_z(along: F64) -> F64:
    """Return the quaternion that turns z along a vector."""
    length = float(np.linalg.norm(along))
    if length < 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    x, y, z = along / length
    if z < -0.999999:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn = np.array([1.0 + z, -y, x, 0.0])
    return np.asarray(turn / np.linalg.norm(turn))


def _xml(
    calibrations: Sequence[Calibration],
    boxes: Sequence[Box],
    things: Sequence[Box],
    colours: F64,
) -> str:
    """Return the room as MuJoCo reads it."""

    def words(values: object) -> str:
        return " ".join(f"{value:.9g}" for value in np.asarray(values, float).ravel())

    first = calibrations[0]
    wall, up = HALF_M + 0.05, HEIGHT_M / 2.0
    parts = [
        f'<geom type="box" pos="{words(at)}" size="{words(size)}" material="wall"/>'
        for at, size in (
            ((wall, 0, up), (0.05, wall, up)),
            ((-wall, 0, up), (0.05, wall, up)),
            ((0, wall, up), (wall, 0.05, up)),
            ((0, -wall, up), (wall, 0.05, up)),
        )
    ]
    parts += [
        f'<geom type="box" pos="{words(box.centre_m)}" size="{words(box.half_m)}"'
        f' material="box" rgba="{words(box.colour[::-1])} 1"/>'
        for box in boxes
    ]
    for number, calibration in enumerate(calibrations):
        turn = calibration.camera_from_cell[:3, :3]
        eye = -turn.T @ calibration.camera_from_cell[:3, 3]
        fovy = np.rad2deg(
            2.0 * np.arctan(calibration.height / 2.0 / calibration.camera_matrix[1, 1])
        )
        parts.append(
            f'<camera name="camera{number}" pos="{words(eye)}" fovy="{fovy:.9g}"'
            f' xyaxes="{words(turn[0])} {words(-turn[1])}"/>'
        )
    for number, colour in enumerate(colours):
        parts.append(
            f'<body name="capsule{number}" mocap="true"><geom type="capsule" size="0.1 0.1"'
            f' rgba="{words(colour[::-1])} 1" contype="0" conaffinity="0"/></body>'
        )
    for number, box in enumerate(things):
        parts.append(
            f'<body name="thing{number}" mocap="true"><geom type="box" size="{words(box.half_m)}"'
            f' rgba="{words(box.colour[::-1])} 1" contype="0" conaffinity="0"/></body>'
        )
    newline = "\n"
    return f"""<mujoco><statistic extent="5" center="0 0 1"/>
<visual><quality shadowsize="{SHADOW_PX}" offsamples="{SAMPLES}"/>
<global offwidth="{first.width}" offheight="{first.height}"/><map znear="0.01" zfar="30"/>
<headlight ambient=".6 .6 .6" diffuse=".25 .25 .25" specular="0 0 0"/></visual>
<asset><texture name="floor" type="2d" builtin="checker" rgb1=".56 .55 .52" rgb2=".5 .5 .47"
 width="256" height="256"/><material name="floor" texture="floor" texrepeat="12 12" specular="0"/>
<texture name="wall" type="2d" builtin="flat" rgb1=".66 .68 .7" width="64" height="64"
 mark="random" markrgb=".5 .5 .5" random=".03"/>
<material name="wall" texture="wall" texrepeat="3 3" specular="0"/>
<texture name="box" type="2d" builtin="gradient" rgb1="1 1 1" rgb2=".85 .85 .85" width="128"
 height="128"/><material name="box" texture="box" specular="0"/></asset>
<worldbody><light pos="{words(LAMP_M)}" dir="0 0 -1" diffuse=".6 .6 .6" specular="0 0 0"
 cutoff="80"/><geom type="plane" size="6 6 .1" material="floor"/>
{newline.join(parts)}</worldbody></mujoco>"""
