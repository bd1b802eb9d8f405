"""Arms by their model: where the capsules of an arm are at positions of its joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from enact_dist.recording.drawing.geometry import is_rigid
from enact_dist.recording.drawing.solids import Capsule, capsules_of

if TYPE_CHECKING:
    from numpy.typing import NDArray


def arm_capsules(model: object, positions_rad: NDArray[Any]) -> tuple[Capsule, ...] | None:
    """Return the capsules of an arm in the frame of its base; None if the model is none.

    Args:
        model: A datum with the fields that `enact_dist.config.shows` describes under ``model``.
        positions_rad: (J,) positions of its revolute joints.
    """
    if not isinstance(model, dict):
        return None
    rows, base, shapes = (model.get(name) for name in ("dh", "base", "capsules"))
    count = len(positions_rad)
    if not (
        _is_table(rows, 4)
        and _is_table(shapes, 5)
        and isinstance(base, np.ndarray)
        and is_rigid(base)
        and len(rows) == count  # type: ignore[arg-type]
    ):
        return None
    poses = [np.asarray(base, np.float64)]
    for step in _steps(rows, positions_rad):  # type: ignore[arg-type]
        poses.append(poses[-1] @ step)
    first, first_m, second, second_m, radius_m = np.asarray(shapes, np.float64).T
    if min(first.min(), second.min()) < 0 or max(first.max(), second.max()) > count:
        return None
    frames = np.stack(poses)[np.stack((first, second), axis=1).astype(int)]
    along_m = np.stack((first_m, second_m), axis=1)[:, :, None]
    ends_m = frames[:, :, :3, 3] + along_m * frames[:, :, :3, 2]
    return capsules_of(np.column_stack((ends_m.reshape(-1, 6), radius_m)))


def _is_table(value: object, columns: int) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == 2
        and value.shape[1] == columns
        and value.dtype.kind == "f"
        and bool(np.isfinite(value).all())
    )


def _steps(rows: NDArray[Any], positions_rad: NDArray[Any]) -> NDArray[np.float64]:
    """Return where the frame behind each joint is in the one before it, (J, 4, 4).

    The rows are classic Denavit-Hartenberg.
    """
    along_m, aside_m, tilt_rad, zero_rad = np.asarray(rows, np.float64).T
    c, s = np.cos(zero_rad + positions_rad), np.sin(zero_rad + positions_rad)
    cos_tilt, sin_tilt = np.cos(tilt_rad), np.sin(tilt_rad)
    none, one = np.zeros(len(rows)), np.ones(len(rows))
    columns = [
        [c, -s * cos_tilt, s * sin_tilt, aside_m * c],
        [s, c * cos_tilt, -c * sin_tilt, aside_m * s],
        [none, sin_tilt, cos_tilt, along_m],
        [none, none, none, one],
    ]
    return np.moveaxis(np.array(columns), 2, 0)
