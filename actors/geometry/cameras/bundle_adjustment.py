"""Cameras that stand still and a board that moves: lenses and poses that fit all corners at once.

Least squares on pixels with a loss that outliers cannot pull, exact derivatives, sparse matrices.
The board of one moment does not move: it is where the cell's frame comes from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy.typing as npt
    from scipy.sparse import csr_matrix

    Numbers = npt.NDArray[np.float64]

LENS: Final = 9
"""Parameters of a lens: fx, fy, cx, cy, k1, k2, p1, p2, k3."""
OUTLIER_PX: Final = 1.0
"""From here on a corner's error counts by its size, no longer by its square."""


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """What a camera does to a ray.

    Attributes:
        camera_matrix: (3, 3) float64, pixels; the centre of the first pixel is (0, 0).
        distortion: (5,) float64: k1, k2, p1, p2, k3 of OpenCV.
    """

    camera_matrix: Numbers
    distortion: Numbers

    def numbers(self) -> Numbers:
        """Return it as `LENS` parameters."""
        k = self.camera_matrix
        return np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], self.distortion])


def lens_of(numbers: Numbers) -> Lens:
    """Return the lens of `LENS` parameters."""
    fx, fy, cx, cy = numbers[:4]
    return Lens(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), numbers[4:].copy())


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """The corners of a board in one picture.

    Attributes:
        camera: Name of the camera.
        moment: When: pictures of one moment show the board in one place.
        points_m: (N, 3) float64, metres, in the frame of the board.
        pixels: (N, 2) float64.
    """

    camera: str
    moment: str
    points_m: Numbers
    pixels: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras and boards in one frame.

    Attributes:
        lenses: By camera.
        cameras: camera_from_cell, (4, 4), by camera.
        boards: cell_from_board, (4, 4), by moment.
    """

    lenses: Mapping[str, Lens]
    cameras: Mapping[str, Numbers]
    boards: Mapping[str, Numbers]

    def errors_px(self, sight: Sight) -> Numbers:
        """Return where the rig sees the corners less where the picture shows them, (N, 2)."""
        camera_from_board = self.cameras[sight.camera] @ self.boards[sight.moment]
        return (
            projected(sight.points_m, camera_from_board, self.lenses[sight.camera]) - sight.pixels
        )


def projected(points_m: Numbers, camera_from_points: Numbers, lens: Lens) -> Numbers:
    """Return the pixels (N, 2) of points (N, 3) that a pose (4, 4) carries into a camera."""
    import cv2

    turn, _ = cv2.Rodrigues(camera_from_points[:3, :3])
    pixels, _ = cv2.projectPoints(
        points_m, turn, camera_from_points[:3, 3], lens.camera_matrix, lens.distortion
    )
    return np.asarray(pixels, np.float64)[:, 0]


def adjusted(
    rig: Rig, sights: Sequence[Sight], *, origin: str, free: Sequence[str], k3: bool = False
) -> Rig:
    """Return the rig that fits all sights best.

    Args:
        rig: Where to begin; it has every camera and moment of the sights.
        sights: At least one.
        origin: The moment whose board stays where it is.
        free: Cameras whose lenses are fitted, too; the others keep theirs.
        k3: Fit k3, too; else it stays.
    """
    from scipy.optimize import least_squares

    problem = _Problem(rig, sights, origin, free, k3)
    found = least_squares(
        problem.errors,
        problem.start,
        problem.derivatives,
        method="trf",
        loss="soft_l1",
        f_scale=OUTLIER_PX,
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=60,
    )
    return problem.rig(found.x)


class _Problem:
    """The parameters: of each camera its lens and pose, of each board but the origin its pose."""

    def __init__(
        self, rig: Rig, sights: Sequence[Sight], origin: str, free: Sequence[str], k3: bool
    ) -> None:
        self._rig, self._sights, self._free = rig, sights, frozenset(free)
        self._k3 = k3
        cameras = sorted({sight.camera for sight in sights})
        moments = sorted({sight.moment for sight in sights} - {origin})
        self._camera_at = {name: (LENS + 6) * number for number, name in enumerate(cameras)}
        behind = (LENS + 6) * len(cameras)
        self._board_at = {name: behind + 6 * number for number, name in enumerate(moments)}
        self.start = np.zeros(behind + 6 * len(moments))
        for name, at in self._camera_at.items():
            self.start[at : at + LENS] = rig.lenses[name].numbers()
            self.start[at + LENS : at + LENS + 6] = _turn_and_move(rig.cameras[name])
        for name, at in self._board_at.items():
            self.start[at : at + 6] = _turn_and_move(rig.boards[name])
        self._fixed = {
            name: _turn_and_move(rig.boards[name]) for name in ({origin} & set(rig.boards))
        }

    def errors(self, numbers: Numbers) -> Numbers:
        return np.concatenate([self._one(numbers, sight)[0] for sight in self._sights])

    def derivatives(self, numbers: Numbers) -> csr_matrix:
        from scipy.sparse import coo_matrix

        rows, columns, values, first = [], [], [], 0
        for sight in self._sights:
            error, by_camera, by_board = self._one(numbers, sight)
            down = np.arange(first, first + len(error))
            first += len(error)
            blocks = [(self._camera_at[sight.camera], by_camera)]
            if sight.moment in self._board_at:
                blocks.append((self._board_at[sight.moment], by_board))
            for at, block in blocks:
                across = np.arange(at, at + block.shape[1])
                rows.append(np.repeat(down, len(across)))
                columns.append(np.tile(across, len(down)))
                values.append(block.ravel())
        shape = (first, len(numbers))
        places = (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix((np.concatenate(values), places), shape=shape).tocsr()

    def _one(self, numbers: Numbers, sight: Sight) -> tuple[Numbers, Numbers, Numbers]:
        """Return the errors of a sight (2 N,), and their derivatives by camera and board."""
        import cv2

        at = self._camera_at[sight.camera]
        lens, camera = lens_of(numbers[at : at + LENS]), numbers[at + LENS : at + LENS + 6]
        board_at = self._board_at.get(sight.moment)
        board = self._fixed[sight.moment] if board_at is None else numbers[board_at : board_at + 6]
        turn, move, rr1, rt1, rr2, rt2, tr1, tt1, tr2, tt2 = cv2.composeRT(
            board[:3], board[3:], camera[:3], camera[3:]
        )
        pixels, by = cv2.projectPoints(
            sight.points_m, turn, move, lens.camera_matrix, lens.distortion
        )
        by_turn, by_move, by_lens = by[:, :3], by[:, 3:6], by[:, 6 : 6 + LENS].copy()
        if sight.camera not in self._free:
            by_lens[:] = 0.0
        elif not self._k3:
            by_lens[:, -1] = 0.0
        by_camera = by_turn @ np.hstack([rr2, rt2]) + by_move @ np.hstack([tr2, tt2])
        by_board = by_turn @ np.hstack([rr1, rt1]) + by_move @ np.hstack([tr1, tt1])
        errors = (np.asarray(pixels)[:, 0] - sight.pixels).ravel()
        return errors, np.hstack([by_lens, by_camera]), np.asarray(by_board)

    def rig(self, numbers: Numbers) -> Rig:
        lenses, cameras = dict(self._rig.lenses), dict(self._rig.cameras)
        boards = dict(self._rig.boards)
        for name, at in self._camera_at.items():
            lenses[name] = lens_of(numbers[at : at + LENS])
            cameras[name] = _pose(numbers[at + LENS : at + LENS + 6])
        for name, at in self._board_at.items():
            boards[name] = _pose(numbers[at : at + 6])
        return replace(self._rig, lenses=lenses, cameras=cameras, boards=boards)


def _turn_and_move(pose: Numbers) -> Numbers:
    """Return a pose (4, 4) as rotation vector and translation, (6,)."""
    import cv2

    turn, _ = cv2.Rodrigues(pose[:3, :3])
    return np.concatenate([np.asarray(turn, np.float64).ravel(), pose[:3, 3]])


def _pose(numbers: Numbers) -> Numbers:
    """Return the pose (4, 4) of a rotation vector and a translation."""
    import cv2

    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(numbers[:3])
    pose[:3, 3] = numbers[3:]
    return pose
