"""The one way from arrays to Open3D: with a copy, so that a lock's data never change.

Open3D ignores that an array is read-only. `Tensor.from_numpy` shares its memory, and so does every
array that is passed where Open3D takes a tensor; `translate` and the like then write into it.  An
array from a lock lies in memory that all readers of the process share: it would change for all of
them, and with `local()` in the shard itself.

Rule to keep: nothing else in `actors` makes tensors, vectors, clouds or images of Open3D.  A copy
of 300,000 points takes 0.3 ms as a tensor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from actors.geometry.open3d_on_use import open3d


def tensor(array: npt.NDArray[Any], dtype: npt.DTypeLike | None = None) -> Any:
    """Return an Open3D tensor with memory of its own.

    Args:
        array: Of any shape, order and byte order; numbers or bool.
        dtype: What it becomes; None keeps the dtype.
    """
    native = np.dtype(array.dtype if dtype is None else dtype).newbyteorder("=")
    own = np.array(array, native, order="C")
    return open3d().core.Tensor.from_numpy(own)  # it keeps `own` alive; no other reference exists


def image(array: npt.NDArray[Any]) -> Any:
    """Return an image of Open3D's tensor side, with memory of its own.

    Args:
        array: (H, W) or (H, W, C).
    """
    return open3d().t.geometry.Image(tensor(array))


def point_cloud(
    points_m: npt.NDArray[np.floating], normals: npt.NDArray[np.floating] | None = None
) -> Any:
    """Return points as a legacy Open3D cloud, with memory of its own.

    Args:
        points_m: (N, 3), metres.
        normals: (N, 3), of length 1; none when absent.
    """
    cloud = open3d().geometry.PointCloud(_vectors(points_m))
    if normals is not None:
        cloud.normals = _vectors(normals)
    return cloud


def mesh(vertices_m: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer]) -> Any:
    """Return a legacy Open3D mesh, with memory of its own.

    Args:
        vertices_m: (V, 3), metres.
        triangles: (T, 3), indices into the vertices.
    """
    legacy, utility = open3d().geometry, open3d().utility
    return legacy.TriangleMesh(
        _vectors(vertices_m), utility.Vector3iVector(np.array(triangles, np.int32, order="C"))
    )


def _vectors(array: npt.NDArray[np.floating]) -> Any:
    # Open3D copies, but float32 one by one (half a second for 300,000 points), and it refuses
    # read-only arrays.
    return open3d().utility.Vector3dVector(np.require(array, np.float64, ["C", "W"]))
