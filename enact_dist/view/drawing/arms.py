"""Arms by their model: where the capsules of an arm are at positions of its joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from enact_dist.recording.drawing.geometry import is_rigid
from enact_dist.recording.drawing.solids import Capsule, capsule_of

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
    for (along, aside, tilt, zero), position in zip(rows, positions_rad, strict=True):  # type: ignore[arg-type]
        poses.append(poses[-1] @ _step(along, aside, tilt, zero + float(position)))
    found = []
    for first, first_m, second, second_m, radius_m in shapes:  # type: ignore[union-attr]
        if not (0 <= first <= count and 0 <= second <= count):
            return None
        ends = [
            poses[int(at)] @ (0, 0, z_m, 1) for at, z_m in ((first, first_m), (second, second_m))
        ]
        found.append(capsule_of(np.array([*ends[0][:3], *ends[1][:3], radius_m])))
    return tuple(found)


def _is_table(value: object, columns: int) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == 2
        and value.shape[1] == columns
        and value.dtype.kind == "f"
        and bool(np.isfinite(value).all())
    )


def _step(along_m: float, aside_m: float, tilt_rad: float, turn_rad: float) -> NDArray[np.float64]:
    """Return where the frame behind a joint is in the one before it, classic Denavit-Hartenberg."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    cos_tilt, sin_tilt = np.cos(tilt_rad), np.sin(tilt_rad)
    return np.array(
        [
            [c, -s * cos_tilt, s * sin_tilt, aside_m * c],
            [s, c * cos_tilt, -c * sin_tilt, aside_m * s],
            [0.0, sin_tilt, cos_tilt, along_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
