"""Things that stand in a scene, each in the coordinates of its frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from enact_dist.recording.drawing.solids import Capsule
    from enact_dist.view.drawing.robots import LinkShape

    Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False, slots=True)
class Node:
    """A thing in the scene, in the coordinates of its frame; the same object is drawn once."""

    frame: str


@dataclass(frozen=True, eq=False, slots=True)
class PointsNode(Node):
    """Points (N, 3), metres, with one colour, or (N, 3) uint8; as squares of `size_m`, or round.

    They are one in `one_in` of those that the datum has.
    """

    points_m: NDArray[np.float32]
    colours: NDArray[np.uint8] | Colour
    size_m: float = 0.0
    one_in: int = 1


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceNode(Node):
    """Triangles (M, 3) over vertices (N, 3), metres."""

    vertices_m: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    colour: Colour


@dataclass(frozen=True, eq=False, slots=True)
class CubesNode(Node):
    """Cubes with an edge of `edge_m` around centres (N, 3)."""

    centres_m: NDArray[np.float32]
    edge_m: float
    colour: Colour


@dataclass(frozen=True, eq=False, slots=True)
class CapsulesNode(Node):
    """Capsules, at least one."""

    capsules: tuple[Capsule, ...]
    colour: Colour


@dataclass(frozen=True, eq=False, slots=True)
class RobotNode(Node):
    """The shapes of a robot and where each is, (S, 4, 4); in their own colours or in one."""

    shapes: tuple[LinkShape, ...]
    poses: NDArray[np.float64]
    colour: Colour | None


@dataclass(frozen=True, eq=False, slots=True)
class AxesNode(Node):
    """Axes at a rigid (4, 4)."""

    matrix: NDArray[Any]
    colour: Colour | None = None


@dataclass(frozen=True, eq=False, slots=True)
class LineNode(Node):
    """A line through places (N, 3), N > 1."""

    places_m: NDArray[np.float32]
    colour: Colour


@dataclass(frozen=True, eq=False, slots=True)
class FrustumNode(Node):
    """A camera, looking along z, with its image (H, W, 3) uint8 or without one."""

    field_rad: float
    aspect: float
    image: NDArray[np.uint8] | None
    colour: Colour


@dataclass(frozen=True, eq=False, slots=True)
class LabelNode(Node):
    """A text at a place (3,)."""

    text: str
    place_m: NDArray[np.float64]
