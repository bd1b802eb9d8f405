"""A datum as a file of a common format."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from enact_dist.errors import ConfigError
from enact_dist.recording.drawing.drawables import ShownCloud, ShownImage, ShownMesh, ShownVoxels
from enact_dist.recording.drawing.solids import voxel_faces
from enact_dist.view.drawing.pixels import rgb_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from enact_dist.view.drawing.scene import ShownDatum


def png_of(shown: ShownDatum) -> bytes:
    """Return the image of a datum in its full size; floats are drawn, all others as they are.

    Raises:
        ConfigError: The datum is shown as no image, or the image is empty.
    """
    import imageio.v3 as imageio

    for drawable in shown.drawables.values():
        if isinstance(drawable, ShownImage):
            if not drawable.pixels.size:
                raise ConfigError(f"the image of {shown.recorded.slot} is empty")
            as_it_is = drawable.encoding in {"mono8", "rgb8", "rgba8", "16UC1"}
            pixels = drawable.pixels if as_it_is else rgb_of(drawable, max(drawable.shape))
            stream = BytesIO()
            imageio.imwrite(stream, pixels, extension=".png")
            return stream.getvalue()
    raise ConfigError(f"{shown.recorded.slot} is shown as {_kinds(shown)}, so it has no image")


def ply_of(shown: ShownDatum) -> bytes:
    """Return the cloud, mesh or voxels of a datum as binary PLY, metres.

    Raises:
        ConfigError: The datum is shown as none of these.
    """
    for drawable in shown.drawables.values():
        if isinstance(drawable, ShownMesh):
            return _ply(drawable.vertices_m, None, drawable.triangles)
        if isinstance(drawable, ShownVoxels):
            corners, triangles = voxel_faces(drawable.indices)
            return _ply(drawable.origin_m + drawable.voxel_m * corners, None, triangles)
        if isinstance(drawable, ShownCloud):
            return _ply(drawable.points_m, drawable.colours, None)
    raise ConfigError(
        f"{shown.recorded.slot} is shown as {_kinds(shown)}; PLY holds clouds, meshes and voxels"
    )


def _kinds(shown: ShownDatum) -> str:
    return " and ".join(shown.drawables) or "null"


def _ply(
    points_m: NDArray[Any], colours: NDArray[np.uint8] | None, triangles: NDArray[Any] | None
) -> bytes:
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if colours is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points_m), fields)
    for name, column in zip("xyz", np.asarray(points_m).T, strict=True):
        rows[name] = column
    if colours is not None:
        for name, column in zip(("red", "green", "blue"), colours.T, strict=True):
            rows[name] = column
    words = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {words[kind]} {name}" for name, kind in fields]
    body = rows.tobytes()
    if triangles is not None:
        faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
        faces["count"], faces["corners"] = 3, triangles
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        body += faces.tobytes()
    return "\n".join([*head, "end_header\n"]).encode() + body
