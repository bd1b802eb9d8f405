"""Arms by their model: where an arm's capsules are, and where a path of its joints leads."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.recording.drawing.geometry import is_rigid
from enact_dist.recording.drawing.solids import Capsule, capsules_of

if TYPE_CHECKING:
    from typing import TypeGuard

    from numpy.typing import NDArray

STEP_RAD: Final = 0.05
"""Farthest that a joint goes from one place of a drawn path to the next."""
PLACES_MAX: Final = 10_000
"""Places of a longer path are thinned; of joints, that go farther, there are fewer on the way."""


def arm_capsules(model: object, positions_rad: NDArray[Any]) -> tuple[Capsule, ...] | None:
    """Return the capsules of an arm in the frame of its base; None if the model is none.

    Args:
        model: A datum with the fields that `enact_dist.config.shows` describes under ``model``.
        positions_rad: (J,) positions of its revolute joints.
    """
    poses = _poses(model, positions_rad)
    shapes = model.get("capsules") if isinstance(model, dict) else None
    if poses is None or not _is_table(shapes, 5) or not len(shapes):
        return None
    first, first_m, second, second_m, radius_m = np.asarray(shapes, np.float64).T
    if min(first.min(), second.min()) < 0 or max(first.max(), second.max()) >= len(poses):
        return None
    frames = poses[np.stack((first, second), axis=1).astype(int)]
    along_m = np.stack((first_m, second_m), axis=1)[:, :, None]
    ends_m = frames[:, :, :3, 3] + along_m * frames[:, :, :3, 2]
    return capsules_of(np.column_stack((ends_m.reshape(-1, 6), radius_m)))


def arm_path(model: object, path_rad: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the places (N, 3) of the last frame of an arm along a path, metres; None as above.

    Args:
        model: As above; without capsules, too.
        path_rad: (M, J) waypoints of its joints, joined by straight lines of the joints.
    """
    path_rad = thinned(path_rad)
    with np.errstate(over="ignore"):
        apart_rad = np.abs(np.diff(path_rad, axis=0)).max(axis=1, initial=0.0)
    steps = np.clip(np.ceil(apart_rad / STEP_RAD), 1, PLACES_MAX)
    steps = np.ceil(steps * min(1.0, PLACES_MAX / max(1.0, steps.sum()))).astype(int)
    begins = np.repeat(np.arange(len(steps)), steps)
    shares = (np.arange(1, len(begins) + 1) - (np.cumsum(steps) - steps)[begins]) / steps[begins]
    rows = path_rad[begins] * (1.0 - shares[:, None]) + path_rad[begins + 1] * shares[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        poses = _poses(model, np.concatenate((path_rad[:1], rows)))
    return None if poses is None else poses[-1, :, :3, 3]


def thinned(rows: NDArray[Any]) -> NDArray[Any]:
    """Return a path (N, ...) with at most about `PLACES_MAX` of its rows, both ends among them."""
    step = max(1, -(-len(rows) // PLACES_MAX))
    return np.concatenate((rows[:-1:step], rows[-1:]))


def _poses(model: object, positions_rad: NDArray[Any]) -> NDArray[np.float64] | None:
    """Return where each frame of an arm is, (J + 1, ..., 4, 4); None if the model is none.

    Args:
        model: See above.
        positions_rad: (..., J) positions of its joints.
    """
    rows, base = (model.get("dh"), model.get("base")) if isinstance(model, dict) else (None, None)
    if not (_is_table(rows, 4) and isinstance(base, np.ndarray) and is_rigid(base)):
        return None
    if len(rows) != positions_rad.shape[-1]:
        return None
    begin = np.broadcast_to(base.astype(np.float64), (*positions_rad.shape[:-1], 4, 4))
    steps = np.moveaxis(_steps(rows, positions_rad), -3, 0)
    return np.stack([*itertools.accumulate(steps, np.matmul, initial=begin)])


def _is_table(value: object, columns: int) -> TypeGuard[NDArray[np.floating[Any]]]:
    return (
        isinstance(value, np.ndarray)
        and value.ndim == 2
        and value.shape[1] == columns
        and value.dtype.kind == "f"
        and bool(np.isfinite(value).all())
    )


def _steps(rows: NDArray[Any], positions_rad: NDArray[Any]) -> NDArray[np.float64]:
    """Return where the frame behind each joint is in the one before it, (..., J, 4, 4).

    The rows are classic Denavit-Hartenberg.
    """
    along_m, aside_m, tilt_rad, zero_rad = np.asarray(rows, np.float64).T
    c, s = np.cos(zero_rad + positions_rad), np.sin(zero_rad + positions_rad)
    cos_tilt, sin_tilt = np.cos(tilt_rad), np.sin(tilt_rad)
    found = np.zeros((*c.shape, 4, 4))
    found[..., 0, :] = np.stack((c, -s * cos_tilt, s * sin_tilt, aside_m * c), axis=-1)
    found[..., 1, :] = np.stack((s, c * cos_tilt, -c * sin_tilt, aside_m * s), axis=-1)
    found[..., 2, 1:] = np.column_stack((sin_tilt, cos_tilt, along_m))
    found[..., 3, 3] = 1.0
    return found
