"""Pictures of a printed ChArUco board as known cameras see it, for tests of the calibration."""

import functools

import cv2
import numpy as np

from actors.geometry.cameras.charuco import board_of

BOARD = board_of("7x5,0.08,0.06,4X4_50")
SIZE = (640, 480)
PER_M = 500
"""Coarser than the pictures, so that one ray per pixel draws smooth edges."""
WHITE_M = 0.04


DISTORTION = (-0.12, 0.03, 0.0005, -0.0004, 0.0)
MIDDLE_M = (0.28, 0.2, 0.05)


def texture(board=BOARD):
    """Return the printed board, white around it, (H, W) uint8."""
    size = (round(PER_M * board.width_m), round(PER_M * board.height_m))
    squares = board.drawn.generateImage(size, marginSize=0)
    edge = round(PER_M * WHITE_M)
    return cv2.copyMakeBorder(squares, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255)


def lens(focal_px, distortion=(0.0, 0.0, 0.0, 0.0, 0.0), centre=(322.0, 236.0)):
    """Return a camera matrix and distortion."""
    matrix = np.array([[focal_px, 0, centre[0]], [0, focal_px * 1.01, centre[1]], [0, 0, 1.0]])
    return matrix, np.array(distortion)


@functools.cache
def rays(focal_px, distortion, centre):
    """Return where the image plane at z = 1 lies for the ray of each pixel, (N, 3) float32."""
    width, height = SIZE
    v, u = np.mgrid[0:height, 0:width].reshape(2, -1).astype(float)
    flat = cv2.undistortPoints(
        np.column_stack((u, v))[:, None], *lens(focal_px, distortion, centre)
    )
    return np.column_stack((flat[:, 0], np.ones(len(flat)))).astype(np.float32)


def picture(board, paper, camera, camera_from_board, rng):
    """Return what a camera (arguments of `lens`) sees: the board on grey, a little noise."""
    turn, move = camera_from_board[:3, :3], camera_from_board[:3, 3]
    # a ray (x, y, 1) s = turn (a, b, 0) + move
    to_sheet = np.linalg.inv(np.column_stack((turn[:, 0], turn[:, 1], move)))
    on_paper = np.array([[1, 0, WHITE_M], [0, -1, board.height_m + WHITE_M], [0, 0, 1]])
    a, b, c = (rays(*camera) @ (on_paper @ to_sheet).T.astype(np.float32)).T
    c = np.where(c > 0.0, c, np.nan)
    x, y = (np.nan_to_num(PER_M * one / c - 0.5, nan=-1e4).reshape(SIZE[::-1]) for one in (a, b))
    grey = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 110}
    image = cv2.remap(paper, x, y, cv2.INTER_LINEAR, **grey).astype(np.float32)
    image += rng.standard_normal(image.shape, np.float32) * 2.0
    return np.clip(0.8 * image + 20.0, 0, 255).astype(np.uint8)


def pose(turn_deg, move_m):
    """Return a pose of a rotation vector in degrees and a translation."""
    found = np.eye(4)
    found[:3, :3], _ = cv2.Rodrigues(np.radians(np.asarray(turn_deg, float)))
    found[:3, 3] = move_m
    return found


def looking(eye_m, at_m):
    """Return camera_from_cell of a camera that looks at a point with its image upright."""
    z = np.subtract(at_m, eye_m) / np.linalg.norm(np.subtract(at_m, eye_m))
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    found = np.eye(4)
    found[:3, :3] = np.stack((x, np.cross(z, x), z))
    found[:3, 3] = -found[:3, :3] @ eye_m
    return found


CAMERAS = {
    str(number): (
        (520.0 + 10.0 * number, DISTORTION, (322.0, 236.0)),
        looking((0.28 + 0.6 * np.cos(turn), 0.2 + 0.6 * np.sin(turn), 0.6), MIDDLE_M),
    )
    for number, turn in enumerate((0.2, 1.4, 2.9))
}
"""Arguments of `lens`, and camera_from_cell."""


def moments(count, seed=3):
    """Return places of the board: at the origin, then lifted, turned and tilted."""
    rng = np.random.default_rng(seed)
    found = {"000": np.eye(4)}
    for number in range(1, count):
        tilt = rng.uniform(-35.0, 35.0, 2)
        turned = pose((0, 0, rng.uniform(-180, 180)), (0, 0, 0)) @ pose((*tilt, 0), (0, 0, 0))
        middle_m = np.add(MIDDLE_M, (0, 0, 0.07)) + rng.uniform(-0.2, 0.2, 3) * (1, 1, 0.5)
        turned[:3, 3] = middle_m - turned[:3, :3] @ (0.28, 0.2, 0.0)
        found[f"{number:03d}"] = turned
    return found


def write(folder, board, cameras, moments, seed=1):
    """Write the pictures of cameras (name: lens, camera_from_cell) at moments (name: board's pose)."""
    rng, paper = np.random.default_rng(seed), texture(board)
    for name, (lens_of_it, camera_from_cell) in cameras.items():
        for moment, cell_from_board in moments.items():
            file = folder / "images" / name / f"{moment}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            image = picture(board, paper, lens_of_it, camera_from_cell @ cell_from_board, rng)
            assert cv2.imwrite(str(file), image)
    return folder
