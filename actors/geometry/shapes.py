"""What the arrays of a cell mean: data types of aspects and arguments of the geometry functions.

Rules a change must keep: a field's docstring gives shape, dtype, unit and frame; every class is a
frozen dataclass of arrays and plain values, so that it travels as a datum; the constructors refuse
arrays of another shape or dtype, because a float64 cloud in place of a float32 one would pass all
later code and cost twice the bytes.

Annotations stay real types here (no `from __future__ import annotations`): the wire reads them.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.floating[Any]]

DEPTH_UNKNOWN_MM = 0
"""What a depth sensor reports where it has no answer."""

NEAREST_MM = 50.0
"""No depth sensor sees nearer; an image whose largest depth is below is in metres."""

FREE_FORM = -1
"""Patch number of a vertex that lies on no planar patch."""


def _check(name: str, array: object, dtype: type, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` unless `array` has this dtype and shape; -1 stands for any length."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name}: asked for an array, found {type(array).__name__}")  # noqa: TRY004
    fits = array.ndim == len(shape) and all(
        asked in (-1, found) for asked, found in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype != dtype:
        asked = "x".join("N" if length < 0 else str(length) for length in shape)
        raise ValueError(
            f"{name}: asked for {np.dtype(dtype)} of shape {asked},"
            f" found {array.dtype} of shape {array.shape}"
        )


def _no_normals() -> npt.NDArray[np.float32]:
    return np.empty((0, 3), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera without distortion; where it stands is part of an `Acquisition`.

    Attributes:
        width_px: Columns of the image.
        height_px: Rows of the image.
        fx_px: Focal length along columns, pixels.
        fy_px: Focal length along rows, pixels.
        cx_px: Column of the optical axis, pixels; the centre of the first pixel is 0.
        cy_px: Row of the optical axis, pixels.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px) < 1 or min(self.fx_px, self.fy_px) <= 0.0:
            raise ValueError(f"a camera needs pixels and focal lengths above zero: {self}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its images."""
        return self.height_px, self.width_px

    def column_row(self, x: Values, y: Values, z: Values) -> tuple[Values, Values]:
        """Return at which column and row, not rounded, it sees points ahead of it, metres."""
        return x / z * self.fx_px + self.cx_px, y / z * self.fy_px + self.cy_px


VGA = Camera(width_px=640, height_px=480, fx_px=577.0, fy_px=577.0, cx_px=319.5, cy_px=239.5)
"""A structured-light sensor of the first generation: 640 x 480, 58 degrees across."""


@dataclass(frozen=True, slots=True, eq=False)
class Acquisition:
    """How an image came about: which camera, and where it stood.

    Attributes:
        camera: Intrinsic parameters.
        world_from_camera: Rigid transform, (4, 4) float64, metres; z of the camera points forward.
    """

    camera: Camera
    world_from_camera: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        _check("world_from_camera", self.world_from_camera, np.float64, (4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One image of a depth sensor.

    Attributes:
        depth_mm: (H, W) millimetres along the optical axis, 0 where unknown: uint16 as a sensor
            gives them, float32 where several images were fused (`depth.fused`).
        acquisition: The camera and its pose; H and W are those of the camera.
    """

    depth_mm: npt.NDArray[Any]
    acquisition: Acquisition

    def __post_init__(self) -> None:
        fused = getattr(self.depth_mm, "dtype", None) == np.float32
        dtype = np.float32 if fused else np.uint16
        _check("depth_mm", self.depth_mm, dtype, self.acquisition.camera.shape)
        if fused and 0.0 < self.depth_mm.max() < NEAREST_MM:
            raise ValueError(
                f"depth_mm: asked for millimetres, found at most {self.depth_mm.max():.3f}:"
                " these are metres"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points without connection; the frame is the owner's to name.

    Attributes:
        points_m: (N, 3) float32, metres.
        normals: (N, 3) float32, unit length, outwards; (0, 3) when not known.
    """

    points_m: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32] = field(default_factory=_no_normals)

    def __post_init__(self) -> None:
        _check("points_m", self.points_m, np.float32, (-1, 3))
        _check("normals", self.normals, np.float32, (-1, 3))
        if len(self.normals) not in (0, len(self.points_m)):
            raise ValueError(
                f"normals: asked for none or {len(self.points_m)}, found {len(self.normals)}"
            )

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A boundary representation: triangles, and the planar patches that some of them form.

    Attributes:
        vertices_m: (N, 3) float32, metres, frame of the entity.
        triangles: (M, 3) int32, vertex numbers, counter-clockwise seen from outside.
        patch_of_vertex: (N,) int32, number of the planar patch, `FREE_FORM` for none.
        patch_planes: (P, 4) float64, unit outward normal and offset: normal . x + offset = 0.
    """

    vertices_m: npt.NDArray[np.float32]
    triangles: npt.NDArray[np.int32]
    patch_of_vertex: npt.NDArray[np.int32]
    patch_planes: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        _check("vertices_m", self.vertices_m, np.float32, (-1, 3))
        _check("triangles", self.triangles, np.int32, (-1, 3))
        _check("patch_of_vertex", self.patch_of_vertex, np.int32, (len(self.vertices_m),))
        _check("patch_planes", self.patch_planes, np.float64, (-1, 4))

    @staticmethod
    def free_form(
        vertices_m: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer]
    ) -> "Surface":
        """Return a surface without planar patches, converted to the dtypes of the class.

        Args:
            vertices_m: (N, 3), metres.
            triangles: (M, 3), vertex numbers.
        """
        return Surface(
            vertices_m=np.ascontiguousarray(vertices_m, np.float32),
            triangles=np.ascontiguousarray(triangles, np.int32),
            patch_of_vertex=np.full(len(vertices_m), FREE_FORM, np.int32),
            patch_planes=np.empty((0, 4)),
        )


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """One shot of the camera.

    Attributes:
        name: File name of the depth image.
        depth: Depth in millimetres with camera and pose, world frame of the trajectory.
        colour: RGB, uint8, (H, W, 3), registered to the depth image.
    """

    name: str
    depth: DepthFrame
    colour: npt.NDArray[np.uint8]

    @property
    def world_from_camera(self) -> npt.NDArray[np.float64]:
        """Pose of the camera, (4, 4), metres."""
        return self.depth.acquisition.world_from_camera

    @property
    def median_m(self) -> float:
        """Median of what was measured, metres along the optical axis."""
        depth_mm = self.depth.depth_mm
        return float(np.median(depth_mm[depth_mm > 0])) / 1000.0
