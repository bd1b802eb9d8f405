"""Pictures of meshes without a graphics card: rays, soft light, contact shadows.

    viewpoint() -> where to stand        draw_bodies() -> (H, W, 3) RGB

Open3D's own off-screen renderer needs Vulkan and hung here, so rays are cast on the processor:
per sample one to the surface, one to a large lamp, a few to the sky, smoothed over neighbours of
the same plane.  Equal input gives equal pixels.
A picture of 960 x 720 takes about two seconds on two cores.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.open3d_arrays import tensor
from actors.geometry.open3d_on_use import open3d
from actors.geometry.poses import looking_at, moved
from actors.geometry.shapes import Acquisition, Camera
from actors.geometry.surfaces.rendering import directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    Floats = npt.NDArray[np.floating[Any]]
    Picture = npt.NDArray[np.uint8]

SAMPLES: Final = 2
"""Samples per pixel and direction; edges are averaged over four."""

SKY_RAYS: Final = 5
LAMP_RAYS: Final = 2
LAMP_RADIUS: Final = 0.16
"""Radius of the lamp as seen from the scene, radians: soft shadows without a hard rim."""

SMOOTH_REACH: Final = 4
"""Samples to each side over which light is averaged, twice; few rays then suffice."""

CREASE_COS: Final = float(np.cos(np.radians(38.0)))
"""Faces that meet at less than 38 degrees are shaded as one curved surface."""

FIELD_DEG: Final = 30.0
"""Opening across the width; small ones look like a technical drawing."""

FLOOR_REACH: Final = 1.6
"""How far shadows reach, in diagonals of the scene, before they have faded out."""

BACKGROUND_TOP: Final = (250, 251, 252)
BACKGROUND_BOTTOM: Final = (228, 232, 237)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One mesh to draw.

    Attributes:
        vertices_m: (N, 3), metres, world.
        triangles: (K, 3), vertex numbers.
        colours: RGB, 0 … 255: (3,) for all, (N, 3) at vertices or (K, 3) on triangles; where
            N equals K they are taken to be at vertices.
    """

    vertices_m: Floats
    triangles: npt.NDArray[np.integer[Any]]
    colours: npt.NDArray[np.uint8]

    def __post_init__(self) -> None:
        if np.shape(self.colours) not in (
            (3,),
            (len(self.vertices_m), 3),
            (len(self.triangles), 3),
        ):
            raise ValueError(
                f"colours: asked for (3,), one per vertex ({len(self.vertices_m)}) or one per"
                f" triangle ({len(self.triangles)}), found shape {np.shape(self.colours)}"
            )

    def placed(self, world_from_body: npt.NDArray[np.float64]) -> Body:
        """Return the body moved by a rigid transform, (4, 4)."""
        return Body(moved(self.vertices_m, world_from_body), self.triangles, self.colours)


def viewpoint(
    points_m: Floats,
    *,
    azimuth_deg: float = -50.0,
    elevation_deg: float = 30.0,
    size_px: tuple[int, int] = (960, 720),
) -> Acquisition:
    """Return a camera that sees all points, filling the picture.

    Args:
        points_m: (N, 3), metres, world, z up.
        azimuth_deg: Where the camera stands around z; 0 on the side of x, 90 on the side of y.
        elevation_deg: How far above the horizon, below 90.
        size_px: Width and height.
    """
    width, height = size_px
    focal = 0.5 * width / np.tan(np.radians(FIELD_DEG) / 2.0)
    camera = Camera(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)
    low, high = points_m.min(0), points_m.max(0)
    centre = (low + high) / 2.0
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    out = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    turn = looking_at(centre + out, centre)[:3, :3]
    local = (points_m - centre) @ turn
    # The nearest distance at which each point still falls inside the picture, with a margin.
    reach = np.abs(local[:, :2]) * focal / (0.44 * np.array([width, height]))
    distance = float((reach.max(axis=1) - local[:, 2]).max())
    return Acquisition(camera, looking_at(centre + distance * out, centre))


def draw_bodies(
    bodies: Sequence[Body],
    view: Acquisition,
    *,
    ground_z_m: float | None = None,
    relight: float = 1.0,
) -> Picture:
    """Draw meshes in soft light on a light background.

    Args:
        bodies: At least one with triangles.
        view: Camera and pose; `viewpoint` makes one.
        ground_z_m: Height of a floor that catches shadows and fades into the background.
        relight: 1 lights plain colours; 0 shows colours as they are (photographs bring light
            of their own); values between mix.

    Returns:
        RGB, uint8, (H, W, 3).
    """
    scene = _Scene(bodies)
    fine = finer(view.camera)
    rays = directions(fine).reshape(-1, 3) @ view.world_from_camera[:3, :3].T.astype(np.float32)
    eye = view.world_from_camera[:3, 3].astype(np.float32)
    hits = scene.first_hits(eye, rays)
    floor = np.zeros(len(rays), bool)
    if ground_z_m is not None:
        floor = _add_floor(scene, hits, (eye, rays), ground_z_m)
    body = hits.seen & ~floor
    light = _lighting(scene, hits, view.world_from_camera, np.random.default_rng(0))
    light = _smoothed(light, hits, fine.shape)
    picture = background(fine.shape).reshape(-1, 3)
    if floor.any():
        picture[floor] *= _shadow(scene, hits.place[floor], light[floor])[:, None]
    linear = (hits.colour[body] / 255.0) ** 2.2
    shaded = linear * (1.0 - relight + relight * light[body, None])
    picture[body] = 255.0 * np.clip(shaded, 0.0, 1.0) ** (1.0 / 2.2)
    return coarser(picture.reshape(*fine.shape, 3))


class _Hits:
    """What the first rays met: one row per sample of the picture."""

    def __init__(self, count: int) -> None:
        self.seen = np.zeros(count, bool)
        self.depth = np.full(count, np.inf, np.float32)
        self.place = np.zeros((count, 3), np.float32)
        self.normal = np.zeros((count, 3), np.float32)
        self.colour = np.zeros((count, 3), np.float32)


class _Scene:
    """All bodies as one mesh, with colours and normals at the corners of its triangles."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        corners, colours, normals = [], [], []
        for body in bodies:
            vertices = np.asarray(body.vertices_m, np.float32)
            triangles = np.asarray(body.triangles, np.int64)
            corners.append(vertices[triangles])
            colours.append(_corner_colours(body, triangles))
            normals.append(_corner_normals(vertices, triangles))
        self.corners = np.concatenate(corners)
        self.colours = np.concatenate(colours)
        self.normals = np.concatenate(normals)
        self.low, self.high = self.corners.min((0, 1)), self.corners.max((0, 1))
        self.span_m = float(np.linalg.norm(self.high - self.low))
        self._rays = open3d().t.geometry.RaycastingScene()
        count = len(self.corners)
        self._rays.add_triangles(
            tensor(self.corners.reshape(-1, 3)),
            tensor(np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)),
        )

    def first_hits(self, eye: Floats, rays: Floats) -> _Hits:
        """Cast rays from one place and gather what they meet."""
        found = self._cast(np.broadcast_to(eye, rays.shape), rays)
        hits = _Hits(len(rays))
        t = found["t_hit"].numpy()
        hits.seen = np.isfinite(t)
        triangle = found["primitive_ids"].numpy()[hits.seen].astype(np.int64)
        uv = found["primitive_uvs"].numpy()[hits.seen]
        weight = np.stack([1.0 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], 1)
        hits.depth = np.where(hits.seen, t, np.inf).astype(np.float32)
        hits.place[hits.seen] = eye + t[hits.seen, None] * rays[hits.seen]
        hits.colour[hits.seen] = np.einsum("kci,kc->ki", self.colours[triangle], weight)
        normal = _unit(np.einsum("kci,kc->ki", self.normals[triangle], weight))
        face = found["primitive_normals"].numpy()[hits.seen]
        away = _dot(face, rays[hits.seen]) > 0.0
        hits.normal[hits.seen] = np.where(away[:, None], -normal, normal)
        return hits

    def is_free(self, places: Floats, towards: Floats) -> npt.NDArray[np.bool_]:
        """Return for each place whether the given direction is unobstructed."""
        rays = np.concatenate([places, towards], axis=1).astype(np.float32)
        blocked = self._rays.test_occlusions(tensor(rays))
        return ~np.asarray(blocked.numpy())

    def _cast(self, origins: Floats, rays: Floats) -> Any:
        full = np.concatenate([origins, rays], axis=1).astype(np.float32)
        return self._rays.cast_rays(tensor(full))


def _corner_colours(body: Body, triangles: npt.NDArray[np.int64]) -> Floats:
    """Return the colour of every corner, (K, 3, 3) float32."""
    colours = np.asarray(body.colours, np.float32)
    if colours.ndim == 1:
        return np.broadcast_to(colours, (len(triangles), 3, 3))
    if len(colours) == len(body.vertices_m):
        return np.asarray(colours[triangles])
    return np.repeat(colours[:, None], 3, axis=1)


def _corner_normals(vertices: Floats, triangles: npt.NDArray[np.int64]) -> Floats:
    """Return the shading normal of every corner, (K, 3, 3): smooth, but flat across creases."""
    corners = vertices[triangles].astype(np.float64)
    face: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face = _unit(face)
    ahead, back = (_unit(np.roll(corners, -step, axis=1) - corners) for step in (1, 2))
    # Weighted by the angle, not the area: else the cap of a cylinder bends its own rim.
    weighted = np.arccos(np.clip(_dot(ahead, back), -1.0, 1.0))[:, :, None] * face[:, None]
    smooth: Floats = np.stack(
        [
            np.bincount(triangles.ravel(), weighted[:, :, axis].ravel(), len(vertices)) * 1.0
            for axis in range(3)
        ],
        axis=1,
    )
    corner = _unit(smooth)[triangles]
    flat = _dot(corner, face[:, None]) < CREASE_COS
    corner[flat] = np.broadcast_to(face[:, None], corner.shape)[flat]
    return np.asarray(corner, np.float32)


def _lighting(
    scene: _Scene, hits: _Hits, world_from_camera: Floats, random: np.random.Generator
) -> Floats:
    """Return the light that falls on every sample, 1 for a well-lit surface, (N,)."""
    lit = np.flatnonzero(hits.seen)
    place = hits.place[lit] + hits.normal[lit] * (3e-3 * scene.span_m)
    normal = hits.normal[lit]
    right, down, forward = world_from_camera[:3, :3].T.astype(np.float32)
    # Over the viewer's left shoulder: right for any world, even if z does not point up.
    lamp = _unit(-0.8 * forward - 0.55 * right - 0.75 * down)
    lamp_light, sky_light = (np.zeros(len(lit), np.float32) for _ in range(2))
    for _ in range(LAMP_RAYS):
        towards = lamp + LAMP_RADIUS * random.standard_normal((len(lit), 3), np.float32)
        towards = _unit(towards)
        facing = np.maximum(0.0, _dot(normal, towards))
        lamp_light += facing * scene.is_free(place, towards)
    for _ in range(SKY_RAYS):
        towards = random.standard_normal((len(lit), 3), np.float32)
        towards = _unit(normal + 0.98 * _unit(towards))
        # The sky is brighter above than at the horizon, which gives upright faces their shape.
        sky_light += scene.is_free(place, towards) * (0.78 - 0.22 * (towards @ down))
    light = np.zeros(len(hits.seen), np.float32)
    light[lit] = 0.62 * lamp_light / LAMP_RAYS + 0.55 * sky_light / SKY_RAYS
    return light


def _smoothed(light: Floats, hits: _Hits, shape: tuple[int, int]) -> Floats:
    """Average light over neighbours that lie on the same surface, (N,)."""
    image = light.reshape(shape)
    depth = np.where(np.isfinite(hits.depth), hits.depth, 1e6).astype(np.float32).reshape(shape)
    normal = hits.normal.reshape(*shape, 3)
    for along_rows in (True, False, True, False):
        total, weights = image.copy(), np.ones(shape, np.float32)
        for step in range(1, SMOOTH_REACH + 1):
            back, ahead = slice(None, -step), slice(step, None)
            one, other = (
                ((back, slice(None)), (ahead, slice(None)))
                if along_rows
                else ((slice(None), back), (slice(None), ahead))
            )
            alike = np.abs(depth[one] - depth[other]) < 0.01 * depth[one]
            alike &= _dot(normal[one], normal[other]) > 0.9
            total[one] += alike * image[other]
            total[other] += alike * image[one]
            weights[one] += alike
            weights[other] += alike
        image = total / weights
    return image.ravel()


def _dot(one: Floats, other: Floats) -> Floats:
    """Return the scalar products along the last axis; einsum, as sum(-1) is ten times slower."""
    return np.asarray(np.einsum("...i,...i->...", one, other))


def _unit(vectors: Floats) -> Floats:
    """Return vectors along the last axis at length 1, and 0 where they were 0."""
    return vectors / (np.sqrt(_dot(vectors, vectors))[..., None] + 1e-30)


def _add_floor(
    scene: _Scene, hits: _Hits, eye_and_rays: tuple[Floats, Floats], ground_z_m: float
) -> npt.NDArray[np.bool_]:
    """Let rays that meet the floor near the bodies, and nothing before, end there; say which."""
    eye, rays = eye_and_rays
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (ground_z_m - eye[2]) / rays[:, 2]
    floor = np.isfinite(t) & (t > 0.0) & (t < hits.depth)
    place = eye + np.where(floor, t, 0.0)[:, None] * rays
    floor &= _away(scene, place) < FLOOR_REACH
    hits.seen |= floor
    hits.depth = np.where(floor, t, hits.depth).astype(np.float32)
    hits.place[floor] = place[floor]
    hits.normal[floor] = (0.0, 0.0, 1.0)
    return np.asarray(floor)


def _away(scene: _Scene, place: Floats) -> Floats:
    """Return how far places lie from the middle of the scene, in diagonals of the scene."""
    centre = (scene.low + scene.high) / 2.0
    return np.asarray(np.hypot(*(place[:, :2] - centre[:2]).T) / scene.span_m)


def _shadow(scene: _Scene, place: Floats, light: Floats) -> Floats:
    """Return the factor by which the floor's brightness falls, 1 in the open, (N,)."""
    in_the_open = max(float(np.quantile(light, 0.98)), 1e-6)
    fade = np.clip(FLOOR_REACH - _away(scene, place), 0.0, 1.0)
    return np.asarray(1.0 - 0.55 * fade * (1.0 - np.clip(light / in_the_open, 0.0, 1.0)))


def finer(camera: Camera) -> Camera:
    """Return the camera with `SAMPLES` times as many pixels each way."""
    n = SAMPLES
    return Camera(
        camera.width_px * n,
        camera.height_px * n,
        camera.fx_px * n,
        camera.fy_px * n,
        (camera.cx_px + 0.5) * n - 0.5,
        (camera.cy_px + 0.5) * n - 0.5,
    )


def coarser(fine: Floats) -> Picture:
    """Average `SAMPLES` squared samples into each pixel."""
    rows, columns = fine.shape[0] // SAMPLES, fine.shape[1] // SAMPLES
    grid = fine.reshape(rows, SAMPLES, columns, SAMPLES, 3)
    mean = np.einsum("asbtc->abc", grid) / SAMPLES**2
    return np.asarray(np.rint(mean).clip(0, 255), np.uint8)


def background(shape: tuple[int, int]) -> Floats:
    """Return the light gradient that everything stands before, (H, W, 3) float32."""
    down = np.linspace(0.0, 1.0, shape[0], dtype=np.float32)[:, None, None]
    top, bottom = (np.array(c, np.float32) for c in (BACKGROUND_TOP, BACKGROUND_BOTTOM))
    return np.broadcast_to(top + (bottom - top) * down, (*shape, 3)).copy()
