"""Where coordinate frames are, of the transforms between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray


class InParent(NamedTuple):
    """Where a frame is: a rigid (4, 4), metres, in its parent."""

    parent: str
    matrix: NDArray[Any]


class PlacedFrames(NamedTuple):
    """All frames in one space.

    Attributes:
        poses: (4, 4) of each frame in its root.
        roots: Frames without a parent.  They all stand at the origin, although nothing says how
            they lie to each other.
        circular: Frames that are their own ancestor; they stand at the origin.
    """

    poses: dict[str, NDArray[np.float64]]
    roots: tuple[str, ...]
    circular: tuple[str, ...]


def placed(transforms: Mapping[str, InParent], frames: Iterable[str]) -> PlacedFrames:
    """Return where frames are.

    Args:
        transforms: Each frame that has a parent.
        frames: The frames that are asked for; their ancestors are added.
    """
    poses: dict[str, NDArray[np.float64]] = {}
    roots: dict[str, None] = {}
    circular: dict[str, None] = {}
    for asked in frames:
        chain: list[str] = []
        frame = asked
        while frame not in poses and frame in transforms and frame not in chain:
            chain.append(frame)
            frame = transforms[frame].parent
        if frame in chain:
            circular |= dict.fromkeys(chain)
            poses |= {each: np.eye(4) for each in chain}
            continue
        if frame not in poses:
            roots[frame] = None
            poses[frame] = np.eye(4)
        for each in reversed(chain):
            found = transforms[each]
            poses[each] = poses[found.parent] @ np.asarray(found.matrix, np.float64)
    return PlacedFrames(poses, tuple(roots), tuple(circular))
