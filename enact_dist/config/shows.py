"""How recordings and `enact view` show the data of an aspect: as configured, or guessed by shape.

::

    [aspects.observation]
    shows = ["image", "calibration", "transform"]     # or one: shows = "point_cloud"
    frame = "camera/{2}"                              # or by entity: { "view/**" = "{entity}", … }
    parent = "tray"

===============  ================================================================================
kind             takes the first part of the datum, in the order of its fields, that is
===============  ================================================================================
``image``        an array (H, W), (H, W, 3) or (H, W, 4) of uint8; (H, W) of uint16 or float32
``mask``         an array (H, W) of bool or uint8, shown as 0 and 255; in a field ``packed`` the
                 bits of an array (H, W / 8) of uint8 (`numpy.packbits` along the rows)
``point_cloud``  an array (N, 3) of floats, metres; with colours if an (N, 3) of uint8 stands beside
``mesh``         an array (N, 3) of floats, metres, and beside it an (M, 3) of integers
``voxels``       an array (N, 3) of integers, indices of occupied voxels: the cubes' outer faces.
                 ``voxel_m`` and ``origin_m`` (the grid's lowest corner) stand beside it or in the
                 aspect's table
``capsules``     an array (N, 7) of floats, metres: centre of one end, of the other, radius
``joints``       an array (J,) of floats, positions of joints in rad or m, or (T, J), of which the
                 last row counts; velocities if a second one of that shape stands beside; names from
                 ``joints = ["…", …]`` in the aspect's table, else ``joint_1`` …  `enact view` draws
                 the arm if ``model`` names an aspect of the same entity whose datum has ``dh``
                 (J, 4): d (m), a (m), alpha (rad), offset of theta (rad), classic; ``base`` (4, 4):
                 the first frame in ``frame``; ``capsules`` (n, 5): frame (0 is the base), offset
                 along its z (m), frame, offset (m), radius (m).  Or ``urdf = "…"`` names a file,
                 relative to ``cell.toml``: the visual shapes of its links, their base in ``frame``,
                 moved by its joints in the order of the file, or as ``joints`` names them
``pose``         a rigid (4, 4), metres: where the thing is in ``frame``
``trajectory``   a path: an array (N, 3) of floats, metres; (N, 2), at height 0; (N, 7), a place and
                 a unit quaternion in each row; or rigid (N, 4, 4): the line through the places in
                 ``frame``, which is drawn again as a whole with each version.  With ``model``, see
                 ``joints``: an array (N, J) of an arm's joints, rad, joined by straight lines of
                 these; `enact view` draws the way of the arm's last frame
``transform``    a rigid (4, 4), metres: where ``frame`` is in ``parent``; with ``inverse = true``
                 in the aspect's table: where ``parent`` is in ``frame``
``calibration``  a pinhole camera: ``width_px height_px fx_px fy_px cx_px cy_px``, or
                 ``camera_matrix`` (3, 3), ``width`` and ``height``, with ``distortion`` if there is
``json``         anything; long arrays only with dtype and shape
===============  ================================================================================

Fields named ``points_m``, ``vertices_m`` and ``triangles`` go before others of their shape.
``of = "acquisition.camera"`` starts at that part instead; ``encoding = "bgr8"`` names the colours
of an image (``rgb8``, ``rgba8``, ``mono8``, ``16UC1`` and ``32FC1`` by shape and dtype).  In a
frame ``{entity}`` stands for the entity's name and ``{1}``, ``{2}`` … for its segments; without a
frame the entity's name is used.

Without configuration, an array (H, W, 3) or (H, W, 4) of uint8 is an image, a rigid (4, 4) a pose,
a dataclass with ``points_m`` a cloud, with ``vertices_m`` and ``triangles`` a mesh, with ``voxels``
and ``voxel_m`` voxels, the rest JSON.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from enact_dist.config.table import TableKey
from enact_dist.errors import ConfigError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Entities

KINDS: Final = (
    "image",
    "mask",
    "point_cloud",
    "mesh",
    "voxels",
    "capsules",
    "joints",
    "pose",
    "trajectory",
    "transform",
    "calibration",
    "json",
)
ENCODINGS: Final = ("rgb8", "bgr8", "rgba8", "bgra8", "mono8", "mono16", "16UC1", "32FC1")

VOXEL_M_MAX: Final = 1000.0

_PLACE: Final = re.compile(r"\{(entity|[1-9][0-9]?)\}")

Frames = str | Mapping[str, str]
"""A frame's name, or one per pattern of entities."""


@dataclass(frozen=True, slots=True)
class Shows:
    """What the data of one aspect are shown as.

    Args:
        kinds: What to show of each datum; none: guessed by its shape.
        frame: Coordinate frame of the data; see above.
        parent: For a transform: the frame in which ``frame`` lies.
        of: Dotted path of the part to look at; the whole datum unless given.
        encoding: Of an image's pixels; by shape and dtype unless given.
        voxel_m: Edge of a voxel if the datum has none; 0: the datum must have it.
        origin_m: Lowest corner of the grid of voxels if the datum has none.
        joints: Names of joints, in order.
        model: Aspect of the same entity that is the model of an arm; see above.
        urdf: File with the links and joints of a robot; see above.
        inverse: A transform gives the parent in the frame, not the frame in the parent.

    Raises:
        ConfigError: A kind or encoding is unknown, a pattern or frame is written wrongly.
    """

    kinds: Annotated[tuple[str, ...], TableKey("shows")] = ()
    frame: Frames = ""
    parent: Frames = ""
    of: str = ""
    encoding: str = ""
    voxel_m: Annotated[float, TableKey(high=VOXEL_M_MAX)] = 0.0
    origin_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    joints: tuple[str, ...] = ()
    model: str = ""
    urdf: Path | None = None
    inverse: bool = False

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in KINDS:
                raise ConfigError(f"unknown kind of display {kind!r}; known: {', '.join(KINDS)}")
        if self.encoding and self.encoding not in ENCODINGS:
            known = ", ".join(ENCODINGS)
            raise ConfigError(f"unknown encoding {self.encoding!r} of an image; known: {known}")
        if len(self.origin_m) != 3:
            raise ConfigError(
                f"origin_m is the place of a corner, three numbers, not {self.origin_m}"
            )
        if "transform" in self.kinds and not self.parent:
            raise ConfigError("a transform needs the frame in which it lies: parent = '…'")
        if self.urdf is not None and (self.model or "joints" not in self.kinds):
            raise ConfigError(
                'urdf draws a robot by its joints: it needs shows = "joints", and no model'
            )
        for frames in (self.frame, self.parent):
            _check_frames(frames)

    def frame_of(self, entity: str) -> str:
        """Return the frame of the data of an entity."""
        return _frame(self.frame, entity) or entity

    def parent_of(self, entity: str) -> str:
        """Return the frame in which an entity's frame lies; "" if none is configured."""
        return _frame(self.parent, entity)


def _by_pattern(frames: Frames) -> Mapping[str, str]:
    return {"**": frames} if isinstance(frames, str) else frames


def _check_frames(frames: Frames) -> None:
    for pattern, text in _by_pattern(frames).items():
        try:
            Entities(pattern)
        except ValueError as error:
            raise ConfigError(f"a table of frames has patterns as keys: {error}") from None
        if not isinstance(text, str) or set("{}") & set(_PLACE.sub("", text)):
            raise ConfigError(f"{text!r} names no frame; it may hold {{entity}}, {{1}}, {{2}} …")


def _frame(frames: Frames, entity: str) -> str:
    """Return the frame of the first pattern that covers the entity, filled in."""
    for pattern, text in _by_pattern(frames).items():
        if pattern_matches(pattern, entity):
            return _PLACE.sub(lambda place: _segment(place[1], entity), text)
    return ""


def _segment(name: str, entity: str) -> str:
    if name == "entity":
        return entity
    segments = entity.split("/")
    number = int(name)
    return segments[number - 1] if number <= len(segments) else ""


GUESSED: Final = Shows()
"""The default for aspects that the configuration does not mention."""
