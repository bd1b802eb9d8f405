"""Pictures of a demonstration: the trained models, and each tray with what deviates in colour."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.pictures.mesh_picture import Body, draw_bodies, viewpoint
from actors.geometry.pictures.picture import tiles, with_label
from actors.geometry.poses import inverse, moved
from actors.geometry.recognition.segmentation import RISE_MIN_M, rise
from actors.geometry.shapes import FREE_FORM
from actors.geometry.surfaces.depth import mean_known, median_known, metres, points_grid
from actors.geometry.surfaces.depth_reconstruction import grid_triangles

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from actors.geometry.shapes import Camera, DepthFrame, Surface
    from actors.palletizing.vocabulary import Deviation

    Picture = npt.NDArray[np.uint8]
    Mask = npt.NDArray[np.bool_]

CLAY: Final = (196, 202, 210)
STEEL: Final = (206, 211, 216)
CARTON: Final = (222, 196, 152)
ALARM: Final = (226, 61, 40)
UNSEEN: Final = (172, 158, 136)
FACES: Final = (
    (122, 162, 214),
    (150, 196, 142),
    (232, 178, 112),
    (188, 150, 206),
    (230, 148, 148),
    (138, 200, 200),
    (210, 206, 130),
    (176, 176, 190),
)
"""One colour per planar patch, in turn; free form is clay."""

TRAY_PX: Final = (1080, 780)
LABEL_PX: Final = 17
"""Height of a capital letter of a verdict; its plate is less than twice as high."""
OVER_M: Final = 0.25
"""What is higher stands on no tray: the arm."""
TRAY_HALF_M: Final = (0.447, 0.317)
"""What is drawn around the middle of the tray: all but its rim, where the floor shines through."""


def model_picture(name: str, surface: Surface) -> Picture:
    """Show the trained surface of a product from two sides, each planar patch in its colour.

    Args:
        name: Name of the product, for the caption.
        surface: Product frame.
    """
    palette = np.array([*FACES, CLAY], np.uint8)
    patch = surface.patch_of_vertex
    colours = palette[np.where(patch == FREE_FORM, len(FACES), patch % len(FACES))]
    body = Body(surface.vertices_m, surface.triangles, colours)
    pictures = [
        draw_bodies(
            [body],
            viewpoint(
                surface.vertices_m, azimuth_deg=azimuth, elevation_deg=32.0, size_px=(560, 420)
            ),
            ground_z_m=0.0,
        )
        for azimuth in (-60.0, 120.0)
    ]
    faces = f"{len(surface.patch_planes)} plane face{'s' if len(surface.patch_planes) != 1 else ''}"
    size_mm = 1000.0 * np.ptp(surface.vertices_m, axis=0)
    size = " x ".join(f"{side:.0f}" for side in size_mm)
    return tiles(
        pictures,
        [
            f"{name}: trained from depth views",
            f"{size} mm, {len(surface.triangles)} triangles, {faces}",
        ],
    )


def tray_picture(
    frame: DepthFrame,
    empty_mm: npt.NDArray[np.uint16],
    regions: Sequence[tuple[str, Deviation, Mask]],
) -> Picture:
    """Show a tray as the sensor saw it, with the deviating regions in red, each under its verdict.

    Args:
        frame: The last image of the tray; its world is the tray frame.
        empty_mm: (H, W) uint16, the empty tray, millimetres.
        regions: Name of the place, its flag and its region (H, W) bool, for each deviating place.
    """
    camera, pose = frame.acquisition.camera, frame.acquisition.world_from_camera
    depth_m = mean_known(median_known(metres(frame.depth_mm), 5), 3)
    points = moved(points_grid(depth_m, camera).reshape(-1, 3), pose)
    with np.errstate(invalid="ignore"):
        risen = (rise(frame, empty_mm) > RISE_MIN_M).ravel()
        beside = (np.abs(points[:, :2]) > TRAY_HALF_M).any(axis=1) | (points[:, 2] > OVER_M)
        depth_m[beside.reshape(camera.shape)] = np.nan
    colours = np.where(risen[:, None], CARTON, STEEL).astype(np.uint8)
    for _, _, region in regions:
        colours[region.ravel()] = ALARM
    view = viewpoint(
        np.array([[x, y, z] for x in (-0.46, 0.46) for y in (-0.33, 0.33) for z in (0.0, 0.08)]),
        azimuth_deg=-90.0,
        elevation_deg=52.0,
        size_px=TRAY_PX,
    )
    picture = draw_bodies(_bodies(points_grid(depth_m, camera), points, colours, camera), view)
    for place, flag, region in regions:
        seen = moved(points[region.ravel()], inverse(view.world_from_camera))
        columns, rows = view.camera.column_row(*seen.T)
        column, top = np.nanmean(columns), np.nanmin(rows)
        at = round(float(column)) - 80, round(float(top)) - 2 * LABEL_PX
        amount = f" {flag.deviation_mm:.0f} mm" if flag.verdict != "missing" else ""
        picture = with_label(picture, f"{place}: {flag.verdict}{amount}", at, height_px=LABEL_PX)
    return picture


def _bodies(
    grid: npt.NDArray[np.float32],
    points_m: npt.NDArray[np.float64],
    colours: npt.NDArray[np.uint8],
    camera: Camera,
) -> list[Body]:
    """Return what the sensor saw, and in a tone of its own the walls that it could not see."""
    seen, every = (grid_triangles(grid, camera, broken=broken) for broken in (False, True))
    walls = every[~np.isin(every @ [1, 1000, 1000000], seen @ [1, 1000, 1000000])]
    bodies = []
    for triangles, tint in ((seen, colours), (walls, np.array(UNSEEN, np.uint8))):
        used, renumbered = np.unique(triangles, return_inverse=True)
        tone = tint[used] if tint.ndim == 2 else tint
        bodies.append(Body(points_m[used], renumbered.reshape(-1, 3), tone))
    return bodies
