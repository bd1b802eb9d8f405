"""Robots by their model file: the shapes of a URDF's links, and where joints put them."""

from __future__ import annotations

import itertools
import threading
from functools import lru_cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from enact_dist.recording.drawing.drawables import ShownJoints

ROBOTS_MAX: Final = 16
"""Files that stay loaded."""
OTHER_FORMATS: Final = {"mujoco": "MJCF", "sdf": "SDF", "COLLADA": "COLLADA"}
"""Formats of robots that are not read, by the first element of their files."""
LINK_COLOUR: Final = (190, 192, 198)
"""Of shapes whose material has none."""


class LinkShape(NamedTuple):
    """A part of a robot that moves as one.

    Attributes:
        link: The link that it belongs to.
        vertices_m: (N, 3), metres, in the frame of the link.
        triangles: (M, 3), numbers of vertices.
        corners_m: (8, 3), of the box around it.
        colour: Red, green, blue.
    """

    link: str
    vertices_m: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    corners_m: NDArray[np.float64]
    colour: tuple[int, int, int]


class Robot:
    """A robot as a file describes it.  Any thread may ask.

    Args:
        file: A URDF.

    Raises:
        ConfigError: The file cannot be read, or names a mesh that cannot.

    Attributes:
        joints: Names of the joints that move, without those that mimic another one.
        shapes: What there is to see of it.
    """

    def __init__(self, file: Path) -> None:
        self._file, self._guard = file, threading.Lock()
        self._model = _loaded(file)
        self.joints: tuple[str, ...] = tuple(self._model.actuated_joint_names)
        self.shapes = tuple(self._shapes())

    def _shapes(self) -> Iterator[LinkShape]:
        graph = self._model.scene.graph
        for name in graph.nodes_geometry:
            pose, geometry = graph.get(name)
            mesh = self._model.scene.geometry[geometry]
            if len(getattr(mesh, "faces", ())) == 0:
                continue  # lines and points of a mesh file are no surface
            link = graph.transforms.parents[name]
            in_link = np.linalg.inv(graph.get(link)[0]) @ pose
            vertices = np.asarray(mesh.vertices) @ in_link[:3, :3].T + in_link[:3, 3]
            sides = zip(vertices.min(axis=0), vertices.max(axis=0), strict=True)
            yield LinkShape(
                link,
                vertices.astype(np.float32),
                np.asarray(mesh.faces, np.uint32),
                np.array(list(itertools.product(*sides))),
                _colour(mesh),
            )

    def poses(self, joints: ShownJoints, *, named: bool) -> NDArray[np.float64]:
        """Return where its shapes are, (S, 4, 4) in the frame of its base.

        Args:
            joints: Positions, rad or m.
            named: Whether the joints' names are those of the robot; else their order is.

        Raises:
            ConfigError: These are not the joints of the robot.
        """
        names = joints.names if named else self.joints
        if len(joints.positions) != len(self.joints) or set(names) != set(self.joints):
            given = f": {', '.join(names)}" if named else ""
            raise ConfigError(
                f"{self._file} moves by {len(self.joints)} joints ({', '.join(self.joints)}),"
                f" not by these {len(joints.positions)}{given}"
            )
        with self._guard:
            self._model.update_cfg(dict(zip(names, map(float, joints.positions), strict=True)))
            places = {link: self._model.get_transform(link) for link, *_ in self.shapes}
        return np.array([places[link] for link, *_ in self.shapes]).reshape(-1, 4, 4)


def robot_of(file: Path) -> Robot:
    """Return the robot of a file, read again when the file has changed.

    Raises:
        ConfigError: There is no such file, it is no URDF, or it names a mesh that is missing.
    """
    try:
        changed_ns = file.stat().st_mtime_ns
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}") from error
    found = _robot(file, changed_ns)
    if isinstance(found, str):
        raise ConfigError(found)
    return found


@lru_cache(ROBOTS_MAX)
def _robot(file: Path, _changed_ns: int) -> Robot | str:
    """Return the robot of a file, or why there is none: a bad file is read once, too."""
    try:
        return Robot(file)
    except ConfigError as error:
        return str(error)


def _loaded(file: Path) -> Any:
    """Return the model of a file, whose meshes are all there."""
    if find_spec("yourdfpy") is None:
        raise ConfigError(
            f"{file} needs yourdfpy, which this Python does not have: install the extra 'view'"
            " (pip install -e '.[view]' in the clone of enact-dist)"
        )
    import yourdfpy
    from lxml import etree

    find = partial(yourdfpy.filename_handler_magic, dir=str(file.parent))
    try:
        root = etree.parse(str(file)).getroot()  # yourdfpy guesses what broken XML means
        if root.tag in OTHER_FORMATS:
            raise ConfigError(
                f"{file} is {OTHER_FORMATS[root.tag]}: robots are read from URDF alone"
            )
        model = yourdfpy.URDF.load(str(file), build_scene_graph=False, load_meshes=False)
        wrong = [] if model.validate() else list(map(str, model.errors))
    except ConfigError:
        raise
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{file} is no URDF: {why}") from error
    if wrong or not model.robot.links:
        raise ConfigError(f"{file} is no URDF: {'; '.join(wrong[:3]) or 'it has no link'}")
    for link in model.robot.links:
        for visual in link.visuals:
            mesh = visual.geometry.mesh if visual.geometry is not None else None
            if mesh is not None and not Path(find(mesh.filename)).is_file():
                raise ConfigError(f"{file}: the link {link.name!r} has no mesh {mesh.filename!r}")
    try:
        return yourdfpy.URDF(model.robot, filename_handler=find)
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{file} cannot be drawn: {why}") from error


def _colour(mesh: Any) -> tuple[int, int, int]:
    if not getattr(mesh.visual, "defined", False):
        return LINK_COLOUR
    try:
        red, green, blue = map(int, mesh.visual.to_color().main_color[:3])
    except AttributeError:
        red, green, blue = map(int, mesh.visual.main_color[:3])
    return red, green, blue
