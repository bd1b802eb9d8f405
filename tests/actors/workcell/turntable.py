"""Calibrated pictures of a made-up thing, as folders in all formats: for tests of `folders`.

The thing is two balls and a box, so that no picture of it is like its mirror image.  Masks are
exact: a pixel is foreground if the ray through its centre meets the thing.
"""

import json

import cv2
import numpy as np

from actors.geometry.cameras.camera_sets import SetCamera

BALLS = (((0.05, 0.02, 0.12), 0.14), ((-0.07, 0.05, 0.26), 0.08))
BOX = ((-0.05, -0.22, 0.0), (0.17, -0.05, 0.10))
"""Lowest and highest corner, metres."""
SIZE = (320, 240)
FOCAL_PX = 330.0


def camera(name, eye_m, *, at_m=(0.0, 0.0, 0.15), distortion=(0, 0, 0, 0, 0)):
    """Return a camera that looks at a point with its image upright."""
    z = np.subtract(at_m, eye_m)
    z = z / np.linalg.norm(z)
    x = np.cross(z, (0.0, 0.0, 1.0))
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((x, np.cross(z, x), z))
    pose[:3, 3] = -pose[:3, :3] @ eye_m
    k = np.array([[FOCAL_PX, 0, 158.0], [0, FOCAL_PX, 121.5], [0, 0, 1]])
    return SetCamera(name, k, np.asarray(distortion, float), pose, *SIZE)


def ring(count=8, **options):
    """Return cameras around the thing, every second one higher."""
    turns = 2.0 * np.pi * (np.arange(count) + 0.3) / count
    return [
        camera(str(number), (np.cos(turn), np.sin(turn), 0.35 + 0.5 * (number % 2)), **options)
        for number, turn in enumerate(turns)
    ]


def mask_of(one):
    """Return what a camera sees of the thing, (H, W) bool."""
    pixels = np.indices((one.height, one.width))[::-1].reshape(2, -1).T.astype(np.float64)
    flat = cv2.undistortPoints(pixels[:, None], one.camera_matrix, one.distortion)[:, 0]
    rays = np.column_stack((flat, np.ones(len(flat)))) @ one.camera_from_cell[:3, :3]
    eye = one.centre_m
    hit = np.zeros(len(rays), bool)
    for centre, radius in BALLS:
        to = np.subtract(centre, eye)
        across = np.cross(rays, to)
        hit |= (across**2).sum(1) <= radius**2 * (rays**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = (np.stack(BOX) - eye)[:, None] / rays
    hit |= np.min(sides.max(0), axis=1) >= np.max(sides.min(0), axis=1)
    return hit.reshape(one.height, one.width)


def volume_l():
    """Return the volume of the thing, litres, by counting cubes of 5 mm."""
    x, y, z = np.meshgrid(*[np.arange(-0.3, 0.45, 0.005)] * 3, indexing="ij", sparse=True)
    inside = np.zeros(np.broadcast_shapes(x.shape, y.shape, z.shape), bool)
    for (a, b, c), radius in BALLS:
        inside |= (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < radius**2
    box = np.ones_like(inside)
    for axis, low, high in zip((x, y, z), *BOX, strict=True):
        box &= (low < axis) & (axis < high)
    return 1e3 * np.count_nonzero(inside | box) * 0.005**3


def write_masks(folder, cameras, *, place="masks/{}.png", frame=""):
    """Write the masks of cameras; returns them."""
    masks = [mask_of(one) for one in cameras]
    for one, mask in zip(cameras, masks, strict=True):
        file = folder / place.format(one.name, frame=frame)
        file.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(file), mask.astype(np.uint8) * 255)
    return masks


def write_json(folder, cameras, *, unit="m", scale=1.0, projections=False, size=True):
    """Write `cameras.json`, lengths times `scale`."""
    listed = []
    for one in cameras:
        pose = one.camera_from_cell.copy()
        pose[:3, 3] *= scale
        entry = {"name": one.name}
        if projections:
            entry["P"] = (-3.0 * one.camera_matrix @ pose[:3]).tolist()
        else:
            entry |= {"K": one.camera_matrix.tolist(), "R": pose[:3, :3].tolist(),
                      "t": pose[:3, 3].tolist(), "distortion": one.distortion.tolist()}  # fmt: skip
        listed.append(entry | ({"width": one.width, "height": one.height} if size else {}))
    (folder / "cameras.json").write_text(json.dumps({"unit": unit, "cameras": listed}))


def write_parameters(folder, cameras):
    """Write one text line per camera."""
    lines = [str(len(cameras))]
    for one in cameras:
        pose = one.camera_from_cell
        numbers = (*one.camera_matrix.ravel(), *pose[:3, :3].ravel(), *pose[:3, 3])
        lines.append(" ".join((f"{one.name}.png", *(f"{number:.8f}" for number in numbers))))
    (folder / "thing_par.txt").write_text("\n".join(lines))


def write_projections(folder, cameras):
    """Write a 3 x 4 matrix per text file, with the header of some sets."""
    (folder / "calib").mkdir()
    for one in cameras:
        matrix = one.camera_matrix @ one.camera_from_cell[:3]
        text = "CONTOUR\n" + "\n".join(" ".join(map(str, row)) for row in matrix)
        (folder / "calib" / f"{one.name}.txt").write_text(text)


def write_opencv(folder, cameras, *, ending=".yml", rvec=False):
    """Write a file of `cv2.FileStorage` per camera."""
    (folder / "cameras").mkdir()
    for one in cameras:
        pose = one.camera_from_cell
        file = cv2.FileStorage(
            str(folder / "cameras" / f"{one.name}{ending}"), cv2.FILE_STORAGE_WRITE
        )
        file.write("camera_matrix", one.camera_matrix)
        file.write("distortion_coefficients", one.distortion)
        if rvec:
            file.write("rvec", cv2.Rodrigues(pose[:3, :3])[0])
            file.write("tvec", pose[:3, 3])
        else:
            file.write("R", pose[:3, :3])
            file.write("T", pose[:3, 3])
        file.write("image_width", one.width)
        file.write("image_height", one.height)
        file.release()


def write_colmap(folder, cameras):
    """Write `cameras.txt` and `images.txt`, the centre of the first pixel at (0.5, 0.5)."""
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    intrinsics, images = ["# made up"], ["# two lines per image"]
    for number, one in enumerate(cameras, 1):
        k, (k1, k2, p1, p2, _) = one.camera_matrix, one.distortion
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, k1, k2, p1, p2)
        intrinsics.append(f"{number} OPENCV {one.width} {one.height} {' '.join(map(str, numbers))}")
        turn = cv2.Rodrigues(one.camera_from_cell[:3, :3])[0].ravel()
        angle = np.linalg.norm(turn)
        q = (np.cos(angle / 2), *(np.sin(angle / 2) * turn / angle))
        t = one.camera_from_cell[:3, 3]
        images += [" ".join(map(str, (number, *q, *t, number, f"{one.name}.png"))), ""]
    (place / "cameras.txt").write_text("\n".join(intrinsics))
    (place / "images.txt").write_text("\n".join(images))
