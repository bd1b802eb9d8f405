"""Real recordings instead of the simulated sensor: `enact demo palletizing --views | --model`.

    run_views(directory, out)      recording -> fused surface: surface.ply, surface.png
    run_match(model, scene, out)   model in scene -> pose and fit: match.json, match.png

Each reads and judges all input, computes, and only then writes its files, all of them whole; a
wrong input is one line on the error stream and exit status 1.
A recording goes the way of the simulated views: perception, reconstruction and fusion as actors on
a world context (`real.training`); a model and a scene are two files and need no actor.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.files import InputFileError, check_output, write_whole
from actors.geometry.pictures.picture import png_bytes
from actors.geometry.recognition.matching import NoMatchError, find_model
from actors.geometry.scans.pointcloud_files import read_cloud
from actors.geometry.surfaces.rgbd_fusion import FusionError, natural_voxel_m, residual
from actors.geometry.surfaces.surface_files import ply_bytes
from actors.laps import Laps
from actors.palletizing.real.pictures import match_sheet, recording_sheet
from actors.palletizing.real.recorded import RecordedPerception
from actors.palletizing.real.training import trained_surface

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from actors.geometry.recognition.matching import ModelMatch
    from actors.geometry.scans.pointcloud_files import CloudFile
    from actors.geometry.scans.recordings import Recording

    Say = Callable[[str], None]

FOUND_SCORE_MIN: Final = 0.85
"""Below this a model counts as not found; wrong packages of like size reach 0.74."""

REFUSALS: Final = (InputFileError, NoMatchError, FusionError, OSError)
"""What the user can act on; anything else is a defect and keeps its traceback.  A missing library
is for the command line to tell, as for every other command."""


def run_views(directory: Path, out: Path, *, voxel_m: float | None = None, say: Say = print) -> int:
    """Train from a real RGB-D recording and report.

    Args:
        directory: The recording, as `recordings` describes.
        out: Where `surface.ply` and `surface.png` go; made if missing.
        voxel_m: Grid of the fusion; by default two pixels at the median depth.
        say: Takes the lines of the report.

    Returns:
        Exit status: 0 done, 1 refused, the reason on the error stream and nothing written.
    """
    try:
        _train(directory, out, voxel_m, say)
    except REFUSALS as error:
        return _refused(error)
    return 0


def run_match(
    model_file: Path, scene_file: Path, out: Path, *, seed: int = 0, say: Say = print
) -> int:
    """Find a real model in a real cloud and report pose and fit.

    Args:
        model_file: Cloud or mesh of the object (PCD, PLY), metres.
        scene_file: Cloud of the place (PCD, PLY), metres.
        out: Where `match.json` and `match.png` go; made if missing.
        seed: Seed of the search; equal seeds give equal poses.
        say: Takes the lines of the report.

    Returns:
        Exit status: 0 found, 1 not found or refused, the reason on the error stream and nothing
        written.
    """
    try:
        return _find((model_file, scene_file), out, seed, say)
    except REFUSALS as error:
        return _refused(error)


def _train(directory: Path, out: Path, voxel_m: float | None, say: Say) -> None:
    """Read, train, draw, write."""
    clock = Laps()
    check_output(out)
    perception = RecordedPerception(str(directory))
    recording = perception.recording
    for line in _recording_lines(recording):
        say(line)
    clock.lap("read")
    voxel_m = voxel_m or natural_voxel_m(recording.frames)
    surface = trained_surface(perception, voxel_m=voxel_m, progress=_Progress(recording))
    spread = residual(surface, recording.frames)
    size_m = " x ".join(f"{edge:.2f}" for edge in np.ptp(surface.vertices_m, axis=0))
    grid = f"grid of {voxel_m * 1e3:.1f} mm"
    agree = f"median {spread.median_m * 1e3:.1f} mm, 95 % within {spread.p95_m * 1e3:.1f} mm"
    say(f"surface    {len(surface.triangles):,} triangles on a {grid}, {size_m} m")
    say(f"agreement  of the views with the surface: {agree}")
    clock.lap("trained")
    near, far = _depth_range_m(recording)
    sheet = recording_sheet(
        recording,
        surface,
        (
            f"Recorded: view {len(recording.frames) // 2 + 1} of {len(recording.frames)}, colour",
            f"Recorded: depth, {near:.2f} to {far:.2f} m",
            f"Fused surface: {len(surface.triangles):,} triangles, {grid}",
            f"Its shape alone: {agree}",
        ),
    )
    ply = ply_bytes(
        surface.vertices_m,
        surface.triangles,
        normals=surface.normals,
        colours=surface.colours,
        comment="metres, world frame of the recording",
    )
    clock.lap("drawn")
    _write(out, {"surface.ply": ply, "surface.png": png_bytes(sheet)}, say)
    say(f"time       {clock}")


def _find(files: tuple[Path, Path], out: Path, seed: int, say: Say) -> int:
    """Read, search, judge, draw, write."""
    clock = Laps()
    check_output(out)
    model = read_cloud(files[0], asked="a model: point cloud or mesh (PCD or PLY)")
    scene = read_cloud(files[1], asked="a scene: point cloud (PCD or PLY)")
    for line in _cloud_lines(files, model, scene):
        say(line)
    clock.lap("read")
    match = find_model(model.points_m, scene.points_m, eye_m=scene.eye_m, seed=seed)
    clock.lap("searched")
    best = match.best
    others = [other.score for other in match.ranking[1:]]
    rivals = f"the best of {len(others)} others {others[0]:.2f}" if others else "no other cluster"
    if best.score < FOUND_SCORE_MIN:
        print(
            f"error: {files[0]} is not in {files[1]}: asked for a score of {FOUND_SCORE_MIN};"
            f" found {best.score:.2f} in the best of {len(match.ranking)} clusters, with"
            f" {best.fitness:.0%} of the model within {match.tolerance_m * 1e3:.1f} mm; is the"
            " model in the scene, and are both in metres?",
            file=sys.stderr,
        )
        return 1
    for line in _match_lines(match, rivals):
        say(line)
    sheet = match_sheet(
        model,
        scene,
        match,
        (
            f"Found: {files[0].name} in {files[1].name}",
            f"Distance from the model: green 0, red {match.tolerance_m * 1e3:.0f} mm or more",
            f"Model: {len(model.points_m):,} points",
            f"Score of each cluster; found from {FOUND_SCORE_MIN}",
        ),
        found_from=FOUND_SCORE_MIN,
    )
    clock.lap("drawn")
    facts = json.dumps(_match_facts(files, match), indent=2) + "\n"
    _write(out, {"match.json": facts.encode(), "match.png": png_bytes(sheet)}, say)
    say(f"time       {clock}")
    return 0


def _recording_lines(recording: Recording) -> list[str]:
    """Return the report on what was read."""
    camera, frames = recording.camera, recording.frames
    near, far = _depth_range_m(recording)
    places = np.array([frame.world_from_camera[:3, 3] for frame in frames])
    travel_m = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    thinned = f" of {recording.recorded}" if recording.recorded > len(frames) else ""
    count = f"{len(frames)}{thinned}"
    size = f"{camera.width_px} x {camera.height_px} pixels"
    depth = f"depth {near:.2f} to {far:.2f} m"
    return [f"recording  {count} views of {size}, {depth}, camera moved {travel_m:.3f} m"]


def _depth_range_m(recording: Recording) -> tuple[float, float]:
    """Return the depth between which 98 % of all measurements lie."""
    depth_mm = np.concatenate([f.depth.depth_mm[::4, ::4].ravel() for f in recording.frames])
    near, far = np.quantile(depth_mm[depth_mm > 0], (0.01, 0.99)) / 1000.0
    return float(near), float(far)


def _cloud_lines(files: tuple[Path, Path], model: CloudFile, scene: CloudFile) -> list[str]:
    """Return the report on the two clouds."""
    size = " x ".join(f"{edge * 1e3:.0f}" for edge in np.ptp(model.points_m, axis=0))
    kind = "drawn on its triangles" if model.from_mesh else "points"
    camera = "taken by one camera" if scene.eye_m is not None else "camera unknown"
    count = f"{len(scene.points_m):,} points ({scene.left_out:,} without measurement)"
    return [
        f"model      {files[0].name}: {len(model.points_m):,} {kind}, {size} mm",
        f"scene      {files[1].name}: {count}, {camera}",
    ]


def _match_lines(match: ModelMatch, rivals: str) -> list[str]:
    """Return the report on what was found."""
    best = match.best
    x, y, z = best.scene_from_model[:3, 3] * 1000.0
    xyz = f"x {x:.1f}, y {y:.1f}, z {z:.1f} mm"
    turn = ", ".join(f"{part:.4f}" for part in _quaternion(match))
    centre = ", ".join(f"{part * 1e3:.1f}" for part in best.centre_m)
    aside = f"{len(match.planes)} large planes and {len(match.ranking) - 1} other clusters"
    near = f"{best.fitness:.1%} of the visible model within {match.tolerance_m * 1e3:.1f} mm"
    rest = f"rms {best.rmse_m * 1e3:.1f} mm; {best.explained:.1%} of the cluster explained"
    return [
        f"found      at ({centre}) mm; {aside} set aside",
        f"pose       scene_from_model: {xyz}; quaternion xyzw ({turn})",
        f"fit        {near}, {rest}",
        f"score      {best.score:.2f}, {rivals}",
    ]


def _match_facts(files: tuple[Path, Path], match: ModelMatch) -> dict[str, Any]:
    """Return what `match.json` holds: metres, scene frame."""
    return {
        "model": str(files[0]),
        "scene": str(files[1]),
        "scene_from_model": match.best.scene_from_model.tolist(),
        "xyz_m": match.best.scene_from_model[:3, 3].tolist(),
        "quaternion_xyzw": _quaternion(match),
        "tolerance_m": match.tolerance_m,
        "clusters": [
            {
                "centre_m": cluster.centre_m.tolist(),
                "score": cluster.score,
                "fitness": cluster.fitness,
                "explained": cluster.explained,
                "rmse_m": cluster.rmse_m if np.isfinite(cluster.rmse_m) else None,
            }
            for cluster in match.ranking
        ],
    }


def _quaternion(match: ModelMatch) -> list[float]:
    """Return the rotation of the best pose as x, y, z, w with w >= 0."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(match.best.scene_from_model[:3, :3])
    return [float(part) for part in turn.as_quat(canonical=True)]


def _write(out: Path, contents: dict[str, bytes], say: Say) -> None:
    """Write all files of a run, whole, and name them."""
    write_whole({out / name: content for name, content in contents.items()})
    names = ", ".join(
        f"{out / name} ({len(content) / 1e3:,.0f} kB)" for name, content in contents.items()
    )
    say(f"written    {names}")


def _refused(error: Exception) -> int:
    """Print one line on the error stream; return the exit status."""
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
    return 1


class _Progress:
    """Counts the views on a terminal; prints nothing to a file or pipe."""

    def __init__(self, recording: Recording) -> None:
        self._views = len(recording.frames)

    def __call__(self, done: int) -> None:
        """Show that so many views have their surface."""
        if sys.stderr.isatty():
            end = "\n" if done == self._views else ""
            print(
                f"\rtraining   {done} of {self._views} views", end=end, file=sys.stderr, flush=True
            )
