"""Parts of a datum that was decoded without its type, and what its shape makes of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from enact_dist.recording.drawing.geometry import is_rigid

NUMBER_MAX: Final = 1e15
"""Larger sizes and focal lengths are invalid."""

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray


class DatumPart(NamedTuple):
    """A part of a datum and the fields that stand beside it."""

    value: object
    beside: Mapping[str, object]


def part_at(value: object, path: str) -> object:
    """Return the part of a datum at a dotted path; or None."""
    for name in path.split(".") if path else ():
        value = value.get(name) if isinstance(value, dict) else None
    return value


def parts_of(value: object, beside: Mapping[str, object]) -> Iterator[DatumPart]:
    """Yield a value and all that it consists of, in the order of its fields."""
    yield DatumPart(value, beside)
    if isinstance(value, dict):
        for each in value.values():
            yield from parts_of(each, value)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from parts_of(each, beside)


def arrays_of(value: object) -> Iterator[tuple[NDArray[Any], Mapping[str, object]]]:
    """Yield the arrays that a value consists of, each with the fields that stand beside it."""
    for part in parts_of(value, {}):
        if isinstance(part.value, np.ndarray):
            yield part.value, part.beside


def number_of(value: object) -> float:
    """Return a finite number as it is, anything else as 0."""
    if isinstance(value, int | float) and abs(value) < NUMBER_MAX:
        return float(value)
    return 0.0


def guess(value: object) -> str:
    """Return the default kind for showing a datum."""
    if isinstance(value, np.ndarray):
        if is_image(value) and value.ndim == 3:
            return "image"
        return "pose" if is_rigid(value) else "json"
    if isinstance(value, dict) and "__type__" in value:
        if "vertices_m" in value and "triangles" in value:
            return "mesh"
        if "points_m" in value:
            return "point_cloud"
        if "voxels" in value and "voxel_m" in value:
            return "voxels"
    return "json"


def is_image(array: NDArray[Any]) -> bool:
    """Whether an array has the shape and type of an image."""
    if array.ndim == 3:
        return array.dtype == np.uint8 and array.shape[2] in (3, 4) and array.size > 0
    kind = array.dtype.kind + str(array.dtype.itemsize)
    return array.ndim == 2 and kind in ("u1", "u2", "f4") and array.size > 0


def is_points(array: NDArray[Any]) -> bool:
    """Whether an array is (N, 3) of floats."""
    return array.ndim == 2 and array.shape[1] == 3 and array.dtype.kind == "f"


def array_beside(
    beside: Mapping[str, object], kinds: str, length: int | None = None
) -> NDArray[Any] | None:
    """Return the first array (N, 3) of those kinds of dtype among fields."""
    for value in beside.values():
        if (
            isinstance(value, np.ndarray)
            and value.ndim == 2
            and value.shape[1] == 3
            and value.dtype.kind in kinds
            and (length is None or (len(value) == length and value.dtype == np.uint8))
        ):
            return value
    return None
