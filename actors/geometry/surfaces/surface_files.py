"""A surface as the bytes of a PLY file.

Encoded here rather than by Open3D, which writes straight to the final name and answers a full
disk with `False`: encoded bytes can be written atomically (`files.write_whole`).
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt


def ply_bytes(
    vertices_m: npt.NDArray[np.floating[Any]],
    triangles: npt.NDArray[np.integer[Any]],
    *,
    normals: npt.NDArray[np.floating[Any]] | None = None,
    colours: npt.NDArray[np.uint8] | None = None,
    comment: str = "metres",
) -> bytes:
    """Encode a triangle mesh as binary PLY, little endian.

    Args:
        vertices_m: (N, 3), metres; stored as float32.
        triangles: (K, 3), indices of vertices.
        normals: Unit vectors at the vertices, (N, 3).
        colours: RGB at the vertices, (N, 3).
        comment: One line for the header: unit and frame.

    Returns:
        The whole content of the file.
    """
    columns: list[tuple[str, str, str, npt.NDArray[Any]]] = [("x y z", "float", "<f4", vertices_m)]
    if normals is not None:
        columns.append(("nx ny nz", "float", "<f4", normals))
    if colours is not None:
        columns.append(("red green blue", "uchar", "u1", colours))
    vertex = np.empty(len(vertices_m), [(names, code, 3) for names, _, code, _ in columns])
    for names, _, _, values in columns:
        vertex[names] = values
    face = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    face["count"], face["corners"] = 3, triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {comment}",
        f"element vertex {len(vertex)}",
        *(f"property {kind} {name}" for names, kind, _, _ in columns for name in names.split()),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    content = io.BytesIO()
    content.write(("\n".join(header) + "\n").encode("ascii"))
    content.write(vertex.tobytes())
    content.write(face.tobytes())
    return content.getvalue()
