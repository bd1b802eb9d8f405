"""Sheets of pictures for real input: a fused recording, and a model found in a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.pictures.cloud_picture import draw_points, with_box
from actors.geometry.pictures.mesh_picture import Body, draw_bodies, viewpoint
from actors.geometry.pictures.picture import ALARM, GOOD, bars, depth_picture, tiles
from actors.geometry.poses import along_z, inverse, looking_at, moved
from actors.geometry.shapes import Acquisition, Camera

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.geometry.recognition.matching import ModelMatch
    from actors.geometry.scans.pointcloud_files import CloudFile
    from actors.geometry.scans.recordings import Recording
    from actors.geometry.shapes import RecordedFrame
    from actors.geometry.surfaces.coloured_surface import ColouredSurface

    Floats = npt.NDArray[np.floating[Any]]
    Picture = npt.NDArray[np.uint8]
    Pose = npt.NDArray[np.float64]

TILE_PX: Final = (800, 600)
ABOVE_DEG: Final = 10.0
"""So far is a view from beside above the recorded one."""
CLAY: Final = np.array((196, 202, 210), np.uint8)


def recording_sheet(
    recording: Recording, surface: ColouredSurface, captions: tuple[str, str, str, str]
) -> Picture:
    """Show one view as recorded, and the surface made of all of them from two sides.

    Args:
        recording: The recording.
        surface: What was fused from it.
        captions: For colour, depth, coloured surface, bare surface.
    """
    frame = recording.frames[len(recording.frames) // 2]
    coloured = Body(surface.vertices_m, surface.triangles, surface.colours)
    bare = Body(surface.vertices_m, surface.triangles, CLAY)
    return tiles(
        [
            _fitted(frame.colour),
            _fitted(depth_picture(frame.depth.depth_mm)),
            draw_bodies([coloured], orbited(frame, azimuth_deg=-24.0), relight=0.35),
            draw_bodies([bare], orbited(frame, azimuth_deg=24.0)),
        ],
        captions,
    )


def orbited(frame: RecordedFrame, *, azimuth_deg: float) -> Acquisition:
    """Return the view from beside a recorded one, turned about what lies in its middle.

    Args:
        frame: The view to start from.
        azimuth_deg: To the right of it as it looks, negative to the left.
    """
    from scipy.spatial.transform import Rotation

    recorded = frame.depth.acquisition
    # A little wider than the recording, so that what it did not see at the rim shows as rim.
    focal = 0.86 * recorded.camera.fx_px * TILE_PX[0] / recorded.camera.width_px
    width, height = TILE_PX
    turn, pivot, back = np.eye(4), np.eye(4), np.eye(4)
    pivot[2, 3], back[2, 3] = frame.median_m, -frame.median_m
    turn[:3, :3] = Rotation.from_euler("yx", (-azimuth_deg, -ABOVE_DEG), degrees=True).as_matrix()
    return Acquisition(
        Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0),
        recorded.world_from_camera @ pivot @ turn @ back,
    )


def match_sheet(
    model: CloudFile,
    scene: CloudFile,
    match: ModelMatch,
    captions: tuple[str, str, str, str],
    *,
    found_from: float,
) -> Picture:
    """Show where a model was found: scene, close-up, model alone, scores of all clusters.

    Args:
        model: The model's cloud.
        scene: The scene's cloud.
        match: What was found.
        captions: For the four tiles.
        found_from: Score from which a cluster counts as the model.
    """
    level = level_from_scene(match)
    scene_m = moved(scene.points_m, level)
    level_from_model = level @ match.best.scene_from_model
    model_m = moved(model.points_m, level_from_model)
    centre = model_m.mean(0)
    near = np.linalg.norm(scene_m - centre, axis=1) < np.linalg.norm(np.ptp(model_m, axis=0))
    eye_m = moved(scene.eye_m[None], level)[0] if scene.eye_m is not None else None
    size_m = _spacing_m(scene_m, eye_m)
    view = _scene_view(scene_m, eye_m)
    overview = draw_points(scene_m, _colours(scene), view, size_m=size_m)
    box = model.points_m.min(0), model.points_m.max(0)
    overview = with_box(overview, view, box, world_from_box=level_from_model, colour=GOOD)
    side_deg = _azimuth_deg(view, centre)
    close = viewpoint(scene_m[near], azimuth_deg=side_deg + 20.0, size_px=TILE_PX)
    heat = _by_distance(scene_m[near], model_m, _colours(scene)[near], match.tolerance_m)
    alone = viewpoint(model_m, azimuth_deg=side_deg + 20.0, size_px=TILE_PX)
    return tiles(
        [
            overview,
            draw_points(scene_m[near], heat, close, size_m=size_m[near]),
            draw_points(model_m, _colours(model), alone, size_m=1.4 * _spacing_m(model_m, None)),
            bars(
                [(_where(c.centre_m), c.score) for c in match.ranking],
                size_px=TILE_PX,
                threshold=found_from,
            ),
        ],
        captions,
    )


def level_from_scene(match: ModelMatch) -> Pose:
    """Return the transform that stands the scene upright: z normal to its largest plane."""
    if not len(match.planes):
        return np.eye(4)
    scene_from_level = np.eye(4)
    scene_from_level[:3, :3] = along_z(match.planes[0, :3])
    return inverse(scene_from_level)


def _scene_view(scene_m: Floats, eye_m: Floats | None) -> Acquisition:
    """Return the view of the scene's own camera where it is known, else one from above."""
    if eye_m is None:
        return viewpoint(scene_m, elevation_deg=40.0, size_px=TILE_PX)
    pose = looking_at(eye_m, np.median(scene_m, axis=0))
    local = moved(scene_m, inverse(pose))
    local = local[local[:, 2] > 1e-6]
    width, height = TILE_PX
    reach = np.abs(local[:, :2]) / local[:, 2:] / (0.48 * width, 0.48 * height)
    focal = 1.0 / float(np.quantile(reach.max(1), 0.98))
    return Acquisition(
        Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0), pose
    )


def _azimuth_deg(view: Acquisition, centre: Floats) -> float:
    """Return on which side of a place a view stands, degrees around z."""
    away = view.world_from_camera[:3, 3] - centre
    return float(np.degrees(np.arctan2(away[1], away[0])))


def _spacing_m(points_m: Floats, eye_m: Floats | None) -> Floats:
    """Return the edges of splats that close a cloud, (N,): 2.2 times the spacing of neighbours.

    Seen by one camera, points lie the farther apart the farther away they are.
    """
    from scipy.spatial import cKDTree

    away = np.linalg.norm(points_m - eye_m, axis=1) if eye_m is not None else np.ones(len(points_m))
    step = max(1, len(points_m) // 500)
    distance_m, _ = cKDTree(points_m).query(points_m[::step], k=2)
    return np.asarray(2.2 * np.median(distance_m[:, 1] / away[::step]) * away)


def _by_distance(
    scene_m: Floats, model_m: Floats, colours: npt.NDArray[np.uint8], tolerance_m: float
) -> npt.NDArray[np.uint8]:
    """Colour points by their distance from the model; what is farther than twice is grey."""
    from scipy.spatial import cKDTree

    distance_m, _ = cKDTree(model_m).query(scene_m, distance_upper_bound=2.0 * tolerance_m)
    result = np.asarray(np.repeat(120.0 + 0.5 * colours.mean(1, keepdims=True), 3, axis=1))
    near = np.isfinite(distance_m)
    share = np.clip(distance_m[near] / tolerance_m, 0.0, 1.0)
    ramp = np.array([GOOD, (245, 190, 65), ALARM], float)
    for channel in range(3):
        result[near, channel] = np.interp(share, (0.0, 0.5, 1.0), ramp[:, channel])
    return result.astype(np.uint8)


def _colours(cloud: CloudFile) -> npt.NDArray[np.uint8]:
    """Return the colours of a cloud; clay where it has none or one for all."""
    if cloud.colours is not None and len(np.unique(cloud.colours[::50], axis=0)) > 1:
        return cloud.colours
    return np.broadcast_to(CLAY, cloud.points_m.shape)


def _where(place_m: Floats) -> str:
    """Return a place in millimetres, as the label of a bar."""
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(place_m * 1000.0))


def _fitted(picture: Picture) -> Picture:
    """Return a picture scaled to the tile, its proportions kept."""
    import cv2

    scale = min(TILE_PX[0] / picture.shape[1], TILE_PX[1] / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
