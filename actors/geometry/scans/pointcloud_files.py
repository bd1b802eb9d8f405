"""Read point clouds from files: PCD (ascii, binary, compressed), PLY, and meshes as clouds.

A mesh is sampled evenly, because its vertices alone say little: a box has eight.
Points that are not finite (a depth camera's "nothing here" in organised clouds) are left out and
counted.  Open3D does the decoding; it answers a truncated or foreign file with an empty cloud
and a line on the terminal, or with memory it never wrote; the header is judged first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.files import InputFileError, existing_file
from actors.geometry.open3d_on_use import open3d
from actors.geometry.scans.cloud_headers import checked_header
from actors.geometry.surfaces.surface_distance import Mesh, samples_on

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

ENDINGS: Final = (".pcd", ".ply")
MESH_SAMPLES: Final = 40_000
"""Points drawn on a mesh: 1.5 mm apart on a carton of milk."""

SPAN_M_MAX: Final = 200.0
"""A cloud wider than this was not taken by a depth camera, or is in millimetres."""

POINTS_MIN: Final = 10
"""Fewer points have no shape."""


@dataclass(frozen=True, slots=True)
class CloudFile:
    """A cloud as it was read: at least `POINTS_MIN` points, all finite.

    Attributes:
        points_m: (N, 3) float64, metres, frame of the file.
        colours: RGB, uint8, (N, 3), or None.
        left_out: Points of the file that were not finite.
        from_mesh: Whether the points were drawn on triangles.
        eye_m: Where the camera stood, if one took the whole cloud and the file says so, (3,).
    """

    points_m: npt.NDArray[np.float64]
    colours: npt.NDArray[np.uint8] | None
    left_out: int
    from_mesh: bool
    eye_m: npt.NDArray[np.float64] | None


def read_cloud(path: Path, *, asked: str = "a point cloud (PCD or PLY)") -> CloudFile:
    """Read a point cloud, or a mesh as one.

    Args:
        path: File ending in `.pcd` or `.ply`, coordinates in metres.
        asked: What the file should be, for the message.

    Raises:
        InputFileError: Not such a file, damaged, empty, without finite points, or not in metres.
    """
    existing_file(path, asked=asked)
    if path.suffix.lower() not in ENDINGS:
        raise InputFileError(
            path,
            asked=asked,
            found=f"a file ending in {path.suffix!r}",
            remedy="convert it to .pcd or .ply",
        )
    header = checked_header(path, asked=asked)
    if header.points == 0:
        raise InputFileError(
            path, asked=asked, found="no points", remedy="record or export it again"
        )
    points_m, colours, from_mesh = _decoded(path, mesh=header.faces > 0)
    if not from_mesh and len(points_m) != header.points:
        raise InputFileError(
            path,
            asked=asked,
            found=f"{len(points_m)} readable points where the header promises {header.points}",
            remedy="the file is damaged: copy or export it again",
        )
    finite = np.isfinite(points_m).all(axis=1)
    kept = points_m[finite]
    if len(kept) < POINTS_MIN:
        raise InputFileError(
            path,
            asked=asked,
            found=f"{len(kept)} finite points of {len(points_m)}",
            remedy="the camera saw nothing: record again with the scene in its range",
        )
    _check_span(path, kept, asked)
    return CloudFile(
        points_m=kept,
        colours=colours[finite] if colours is not None else None,
        left_out=int((~finite).sum()),
        from_mesh=from_mesh,
        eye_m=np.array(header.eye_m) if header.eye_m is not None else None,
    )


def _decoded(
    path: Path, *, mesh: bool
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8] | None, bool]:
    """Return points, colours or None, and whether they were drawn on a mesh."""
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        if mesh:
            read = o3d.io.read_triangle_mesh(path)
            vertices_m, triangles = np.asarray(read.vertices), np.asarray(read.triangles)
            if triangles.size and triangles.min() >= 0 and triangles.max() < len(vertices_m):
                return samples_on(Mesh(vertices_m, triangles), MESH_SAMPLES)[0], None, True
        cloud = o3d.io.read_point_cloud(path)
    colours = None
    if cloud.has_colors():
        colours = np.rint(np.asarray(cloud.colors) * 255.0).clip(0, 255).astype(np.uint8)
    return np.asarray(cloud.points).copy(), colours, False


def _check_span(path: Path, points_m: npt.NDArray[np.float64], asked: str) -> None:
    """Refuse a cloud whose extent says that its unit is not the metre."""
    span_m = float(np.linalg.norm(np.ptp(points_m, axis=0)))
    if 1e-3 <= span_m <= SPAN_M_MAX:
        return
    raise InputFileError(
        path,
        asked=f"{asked} in metres",
        found=f"points that span {span_m:.4g}",
        remedy="all points coincide: export it again"
        if span_m < 1e-3
        else "it looks like millimetres: divide all coordinates by 1000",
    )
