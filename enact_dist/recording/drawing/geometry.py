"""Arrays as the bytes and numbers that Foxglove's schemas want; units stay metres and pixels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

RIGID_TOLERANCE: Final = 1e-3
"""How far from orthonormal the rotation of a pose may be; float32 chains reach 1e-5."""

_POINT: Final = np.dtype(
    [("x_tag", "u1"), ("x", "<f8"), ("y_tag", "u1"), ("y", "<f8"), ("z_tag", "u1"), ("z", "<f8")]
)
"""A `foxglove.Point3` on the wire: three doubles, each behind its tag."""
_COORDINATE_TAGS: Final = (0x09, 0x11, 0x19)


def is_rigid(matrix: NDArray[Any]) -> bool:
    """Say whether a (4, 4) array is a rigid transform."""
    if matrix.shape != (4, 4) or matrix.dtype.kind != "f" or not np.isfinite(matrix).all():
        return False
    rotation = np.asarray(matrix[:3, :3], np.float64)
    return bool(
        np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() <= RIGID_TOLERANCE
        and np.abs(rotation @ rotation.T - np.eye(3)).max() <= RIGID_TOLERANCE
        and np.linalg.det(rotation) > 0.0
    )


def path_of(array: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return the places (N, 3) along a path, metres; None if the array is none.

    Args:
        array: Floats: (N, 3) places, (N, 2) places at height 0, (N, 7) places each with a unit
            quaternion behind it, or (N, 4, 4) rigid transforms.
    """
    if array.dtype.kind != "f":
        return None
    if array.ndim == 2 and array.shape[1] == 2:
        return np.column_stack((array, np.zeros(len(array)))).astype(np.float64)
    if array.ndim == 2 and array.shape[1] == 3:
        return np.asarray(array, np.float64)
    if array.ndim == 2 and array.shape[1] == 7:
        # Rows of seven are capsules and the joints of an arm, too: these have no unit quaternions.
        rows = np.asarray(array, np.float64)
        turns = rows[np.isfinite(rows).all(axis=1), 3:]
        with np.errstate(over="ignore"):
            is_path = np.allclose(np.linalg.norm(turns, axis=1), 1.0, atol=RIGID_TOLERANCE)
        return rows[:, :3] if is_path else None
    if array.shape[1:] == (4, 4) and all(map(is_rigid, array)):
        return np.asarray(array[:, :3, 3], np.float64)
    return None


def quaternion(rotation: NDArray[Any]) -> tuple[float, float, float, float]:
    """Return (x, y, z, w), unit length, w not negative, of a rotation matrix (3, 3).

    The largest of the four is computed first, so that nothing is divided by a small number.
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = rotation.tolist()
    yz, zx, xy = m21 - m12, m02 - m20, m10 - m01
    products = (
        (1.0 + m00 - m11 - m22, m01 + m10, m02 + m20, yz),
        (m01 + m10, 1.0 - m00 + m11 - m22, m12 + m21, zx),
        (m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22, xy),
        (yz, zx, xy, 1.0 + m00 + m11 + m22),
    )
    largest = max(range(4), key=lambda at: products[at][at])
    x, y, z, w = products[largest]
    length = math.copysign(math.hypot(x, y, z, w), w)
    return x / length, y / length, z / length, w / length


def packed_points(
    points_m: NDArray[Any], colours: NDArray[Any] | None
) -> tuple[bytes, int, tuple[tuple[str, int, bool], ...]]:
    """Return points as packed little-endian elements.

    Args:
        points_m: (N, 3), metres.
        colours: (N, 3) uint8, red, green, blue; or None.

    Returns:
        The bytes, the bytes of one point, and (name, offset, is a float32) of each field.
    """
    names: list[tuple[str, int, bool]] = [("x", 0, True), ("y", 4, True), ("z", 8, True)]
    with np.errstate(over="ignore"):  # what no float32 can hold is infinitely far
        points = np.ascontiguousarray(points_m, "<f4")
    if colours is None:
        return points.tobytes(), 12, tuple(names)
    packed = np.empty(len(points), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
    packed["xyz"], packed["rgba"][:, :3], packed["rgba"][:, 3] = points, colours, 255
    names += [("red", 12, False), ("green", 13, False), ("blue", 14, False), ("alpha", 15, False)]
    return packed.tobytes(), 16, tuple(names)


def encoded_points(points_m: NDArray[Any], field_number: int) -> bytes:
    """Return (N, 3) points as the repeated field of `foxglove.Point3` of that number.

    A message object per vertex would take a second for a surface of 300,000.
    """
    head = field_number << 3 | 2
    assert head < 0x80, "a tag of one byte"
    rows = np.empty(len(points_m), [("tag", "u1"), ("length", "u1"), ("point", _POINT)])
    rows["tag"], rows["length"] = head, _POINT.itemsize
    for name, tag, column in zip("xyz", _COORDINATE_TAGS, points_m.T, strict=True):
        rows["point"][f"{name}_tag"] = tag
        rows["point"][name] = column
    return rows.tobytes()


def encoded_indices(triangles: NDArray[Any], field_number: int) -> bytes:
    """Return (M, 3) vertex numbers as the packed field of `fixed32` of that number."""
    packed = np.ascontiguousarray(triangles, "<u4").tobytes()
    length, digits = len(packed), bytearray()
    while length >= 0x80:
        digits.append(length & 0x7F | 0x80)
        length >>= 7
    digits.append(length)
    return bytes([field_number << 3 | 2]) + bytes(digits) + packed


def image_bytes(pixels: NDArray[Any]) -> tuple[bytes, int]:
    """Return an image's rows, little-endian, without padding, and the bytes of one row."""
    whole = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("<"))
    return whole.tobytes(), whole.nbytes // max(1, len(whole))
