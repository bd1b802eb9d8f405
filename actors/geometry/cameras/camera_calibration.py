"""Pictures of a board to calibrated cameras in one frame.

1. `fitted_lens`: each camera by itself, from all its pictures of the board.
2. `linked`: cameras that saw the board at the same moments stand in one frame, directly or by
   others between them.
3. `calibrated`: all of it at once (`bundle_adjustment`); pictures that contradict all the others
   are left out and named, and so are single corners that a shadow or the edge of a marker moved.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.cameras.bundle_adjustment import Lens, Rig, Sight, adjusted, projected
from actors.geometry.poses import inverse

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import numpy.typing as npt

    Numbers = npt.NDArray[np.float64]

VIEWS_LEAST: Final = 4
"""So many pictures of the board a lens needs."""
VIEWS_MOST: Final = 40
"""So many of them are used for its first fit; the adjustment uses all."""
FOCAL_UNSURE: Final = 0.02
"""A focal length whose deviation is a larger share of it is not known."""
TILTED_DEG: Final = 12.0
"""Boards that are tilted by less against each other leave the focal length open."""
CONTRADICTS: Final = 4.0
"""A picture whose error is so many times that of the others is left out …"""
CONTRADICTS_PX: Final = 1.0
"""… if it is also larger than this."""
STRAYS: Final = 6.0
"""A corner whose error is so many times that of the middle one of all corners is left out: three
and more standard deviations of an exact one …"""
STRAYS_PX: Final = 0.1
"""… if it is also larger than this."""
CORNERS_KEPT: Final = 6
"""A picture of which fewer are left is left out."""
AGREES_PX: Final = 8.0
"""A pose that misses the corners of a picture by less than this agrees with it, before all of it
is adjusted."""
AMBIGUOUS: Final = 2.0
"""A flat board seen from afar fits in two poses; the better one must be so many times better."""


class UnfitPicturesError(ValueError):
    """Pictures of a board do not determine a lens; the message says what they lack."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where one picture says that the board is.

    Attributes:
        sight: Its corners.
        camera_from_board: (4, 4).
        doubt: The smaller, the surer.
    """

    sight: Sight
    camera_from_board: Numbers
    doubt: float


@dataclass(slots=True, eq=False)
class Calibrated:
    """What came of all pictures.

    Attributes:
        rig: The cameras that stand in one frame, and the boards.
        origin: The moment whose board gives the frame.
        rms_px: Root mean square error of the corners, by camera.
        sights: Those that were used.
        contradicting: Those that were left out.
        unlinked: Why a camera stands in no frame with the others, by camera.
        strays: How many single corners were left out.
    """

    rig: Rig
    origin: str
    sights: list[Sight]
    rms_px: dict[str, float] = field(default_factory=dict)
    contradicting: list[Sight] = field(default_factory=list)
    unlinked: dict[str, str] = field(default_factory=dict)
    strays: int = 0


def fitted_lens(sights: Sequence[Sight], width: int, height: int, *, k3: bool = False) -> Lens:
    """Return the lens of one camera.

    Args:
        sights: Its pictures of the board, `VIEWS_LEAST` or more.
        width: Columns of the pictures.
        height: Rows.
        k3: Fit the third coefficient of radial distortion, too: of wide lenses.

    Raises:
        UnfitPicturesError: They are too few, or too much alike.
    """
    import cv2

    if len(sights) < VIEWS_LEAST:
        raise UnfitPicturesError(
            f"{len(sights)} pictures that show the board; {VIEWS_LEAST} are needed, 15 are good"
        )
    most = sorted(sights, key=lambda sight: -len(sight.pixels))[:VIEWS_MOST]
    flags = 0 if k3 else cv2.CALIB_FIX_K3
    try:
        # its stubs ask for a matrix where none is known yet
        fit: Any = cv2.calibrateCameraExtended
        _, matrix, distortion, turns, _, deviations, _, _ = fit(
            [sight.points_m.astype(np.float32) for sight in most],
            [sight.pixels.astype(np.float32) for sight in most],
            (width, height),
            None,
            None,
            flags=flags,
        )
    except cv2.error as error:
        raise UnfitPicturesError(f"pictures that fit no lens ({error.err})") from error
    unsure = float(np.max(deviations.ravel()[:2])) / float(matrix[0, 0])
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilted_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    if not (unsure < FOCAL_UNSURE and tilted_deg > TILTED_DEG and np.isfinite(matrix).all()):
        raise UnfitPicturesError(
            f"boards that are tilted by {tilted_deg:.0f} degrees against each other, so that the"
            f" focal length may be wrong by {unsure:.0%}; the pictures are too much alike: tilt the"
            " board by 30 degrees, both ways"
        )
    return Lens(np.asarray(matrix, np.float64), np.asarray(distortion, np.float64).ravel()[:5])


def placed(sight: Sight, lens: Lens) -> Place | None:
    """Return where a picture shows the board; None where no pose fits."""
    import cv2

    flat = cv2.undistortPoints(sight.pixels[:, None], lens.camera_matrix, lens.distortion)
    count, turns, moves, _ = cv2.solvePnPGeneric(
        sight.points_m, flat, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    found = []
    for turn, move in zip(turns[:count], moves[:count], strict=True):
        pose = np.eye(4)
        pose[:3, :3], _ = cv2.Rodrigues(turn)
        pose[:3, 3] = np.asarray(move).ravel()
        off_px = _off_px(sight, pose, Rig({sight.camera: lens}, {}, {}))
        ahead = bool((sight.points_m @ pose[2, :3] + pose[2, 3] > 0.0).all())
        if ahead and np.isfinite(off_px):
            found.append((off_px, pose))
    if not found:
        return None
    found.sort(key=lambda pair: pair[0])
    error_px, pose = found[0]
    sure = len(found) < 2 or found[1][0] > AMBIGUOUS * error_px
    return Place(sight, pose, (error_px + 0.1) / len(sight.pixels) * (1.0 if sure else 10.0))


def linked(places: Sequence[Place], origin: str, cell_from_board: Numbers, rig: Rig) -> Rig:
    """Return all cameras and boards that hang together with the board of one moment.

    Two cameras stand to each other as most of the moments say that both saw; a board lies where
    the cameras that saw it agree best.

    Args:
        places: What all pictures say.
        origin: The moment; at least one camera saw its board.
        cell_from_board: Where the board was then, (4, 4).
        rig: Has the lenses.
    """
    seen: dict[str, dict[str, Place]] = {}
    for place in places:
        seen.setdefault(place.sight.camera, {})[place.sight.moment] = place
    first = min(
        (place for place in places if place.sight.moment == origin), key=lambda place: place.doubt
    ).sight.camera
    cameras = {first: np.eye(4)}
    edges: list[tuple[int, int, str, Numbers]] = []
    count = itertools.count()

    def reach(name: str) -> None:
        for other in sorted(set(seen) - set(cameras)):
            votes, other_from_name = _agreed(seen[name], seen[other], rig)
            if votes:
                pose = other_from_name @ cameras[name]
                heapq.heappush(edges, (-votes, next(count), other, pose))

    reach(first)
    while edges:
        _, _, name, pose = heapq.heappop(edges)
        if name not in cameras:
            cameras[name] = pose
            reach(name)
    boards: dict[str, Numbers] = {}
    for moment in sorted({place.sight.moment for place in places}):
        there = [seen[name][moment] for name in cameras if moment in seen[name]]
        if there:
            boards[moment] = _board(there, cameras, rig)
    cell_from_first = cell_from_board @ inverse(boards[origin])
    return replace(
        rig,
        cameras={name: pose @ inverse(cell_from_first) for name, pose in cameras.items()},
        boards={moment: cell_from_first @ pose for moment, pose in boards.items()},
    )


def _agreed(one: Mapping[str, Place], other: Mapping[str, Place], rig: Rig) -> tuple[int, Numbers]:
    """Return how many moments agree on how two cameras stand, and other_from_one by them."""
    shared = sorted(set(one) & set(other))
    best = 0, -np.inf, np.eye(4)
    for moment in shared:
        other_from_one = other[moment].camera_from_board @ inverse(one[moment].camera_from_board)
        off = [
            _off_px(other[each].sight, other_from_one @ one[each].camera_from_board, rig)
            for each in shared
        ]
        near = [error for error in off if error < AGREES_PX]
        votes = len(near), -float(np.mean(near or [np.inf])), other_from_one
        best = max(best, votes, key=lambda found: found[:2])
    return best[0], best[2]


def _board(places: Sequence[Place], cameras: Mapping[str, Numbers], rig: Rig) -> Numbers:
    """Return where the board lay, as the cameras that saw it agree best."""
    found = [inverse(cameras[one.sight.camera]) @ one.camera_from_board for one in places]

    def off(board: Numbers) -> float:
        each = [_off_px(one.sight, cameras[one.sight.camera] @ board, rig) for one in places]
        return float(np.minimum(each, AGREES_PX).sum())

    return min(found, key=off)


def _off_px(sight: Sight, camera_from_board: Numbers, rig: Rig) -> float:
    """Return by how much a pose misses the corners of a picture, root mean square."""
    off = projected(sight.points_m, camera_from_board, rig.lenses[sight.camera]) - sight.pixels
    return float(np.sqrt((off**2).sum(1).mean()))


def chosen_origin(sights: Iterable[Sight]) -> str:
    """Return the first of the moments at which most cameras saw the board."""
    cameras: dict[str, set[str]] = {}
    for sight in sights:
        cameras.setdefault(sight.moment, set()).add(sight.camera)
    return min(cameras, key=lambda moment: (-len(cameras[moment]), moment))


def calibrated(
    sights: Sequence[Sight],
    lenses: Mapping[str, Lens],
    *,
    origin: str,
    cell_from_board: Numbers,
    free: Sequence[str],
    k3: bool = False,
) -> Calibrated:
    """Return all cameras in one frame, fitted to all pictures at once.

    Args:
        sights: All pictures of the board.
        lenses: A first fit of each camera.
        origin: The moment whose board gives the frame.
        cell_from_board: Where the board was then, (4, 4).
        free: Cameras whose lenses are fitted further; the others keep theirs.
        k3: As of `fitted_lens`.

    Raises:
        UnfitPicturesError: The board of the origin is in no picture.
    """
    places = [
        place for sight in sights if (place := placed(sight, lenses[sight.camera])) is not None
    ]
    if not any(place.sight.moment == origin for place in places):
        raise UnfitPicturesError(f"no pose of the board that fits its pictures of {origin}")
    rig = linked(places, origin, cell_from_board, Rig(lenses, {}, {}))
    used = [place.sight for place in places if place.sight.camera in rig.cameras]
    contradicting: list[Sight] = []
    while used:
        rig = adjusted(rig, used, origin=origin, free=free, k3=k3)
        errors = [float(np.sqrt((rig.errors_px(sight) ** 2).sum(1).mean())) for sight in used]
        most = max(CONTRADICTS_PX, CONTRADICTS * float(np.median(errors)))
        worst: dict[str, tuple[float, int]] = {}  # one of a moment: it may have pulled the others
        for number, (sight, error) in enumerate(zip(used, errors, strict=True)):
            if error > most:
                worst[sight.moment] = max(worst.get(sight.moment, (0.0, 0)), (error, number))
        out = {number for _, number in worst.values()}
        kept = _still_linked([one for at, one in enumerate(used) if at not in out], origin)
        if not out or not kept:
            break
        kept_ids = {id(sight) for sight in kept}
        contradicting += [sight for sight in used if id(sight) not in kept_ids]
        used = kept
    used, strays = _without_strays(rig, used, origin)
    if strays:
        rig = adjusted(rig, used, origin=origin, free=free, k3=k3)
    result = Calibrated(rig, origin, used, contradicting=contradicting, strays=strays)
    names = sorted({sight.camera for sight in used})
    for name in names:
        off = np.concatenate([rig.errors_px(sight) for sight in used if sight.camera == name])
        result.rms_px[name] = float(np.sqrt((off**2).sum(1).mean()))
    result.unlinked = _unlinked(sights, set(names), origin)
    rest = {name: rig.cameras[name] for name in names}
    result.rig = replace(rig, cameras=rest, lenses={name: rig.lenses[name] for name in names})
    return result


def _without_strays(rig: Rig, sights: list[Sight], origin: str) -> tuple[list[Sight], int]:
    """Return sights without single corners that are far off, and how many those were.

    Most corners are found within 0.05 px.  A few are off by half a pixel; as errors grow with the
    square, they would decide.
    """
    if not sights:
        return sights, 0
    errors = [np.linalg.norm(rig.errors_px(sight), axis=1) for sight in sights]
    most_px = max(STRAYS_PX, STRAYS * float(np.median(np.concatenate(errors))))
    near = [error <= most_px for error in errors]
    strays = sum(int((~one).sum()) for one in near)
    kept = [
        replace(sight, points_m=sight.points_m[one], pixels=sight.pixels[one])
        for sight, one in zip(sights, near, strict=True)
        if one.sum() >= CORNERS_KEPT
    ]
    left = _still_linked(kept, origin)
    same = {sight.camera for sight in left} == {sight.camera for sight in sights}
    return (left, strays) if same else (sights, 0)


def _still_linked(sights: list[Sight], origin: str) -> list[Sight]:
    """Return the sights that hang together with the origin."""
    moments, cameras, grew = {origin}, set[str](), True
    while grew:
        before = len(moments) + len(cameras)
        cameras |= {sight.camera for sight in sights if sight.moment in moments}
        moments |= {sight.moment for sight in sights if sight.camera in cameras}
        grew = len(moments) + len(cameras) > before
    return [sight for sight in sights if sight.camera in cameras]


def _unlinked(sights: Sequence[Sight], names: set[str], origin: str) -> dict[str, str]:
    """Say of each camera that is not among `names` why."""
    reached = {sight.moment for sight in sights if sight.camera in names} | {origin}
    why = {}
    for name in sorted({sight.camera for sight in sights} - names):
        moments = [sight.moment for sight in sights if sight.camera == name]
        shared = sorted(moment for moment in moments if moment in reached)
        if shared:
            why[name] = (
                f"its pictures of {shared[0]} contradict those of the others; was the board moved,"
                " or do the names of the pictures not say which were taken together?"
            )
        else:
            others = {sight.camera for sight in sights if sight.moment in moments} - {name}
            with_whom = (
                f"only together with {', '.join(sorted(others))}" if others else "only alone"
            )
            why[name] = (
                f"it saw the board {len(moments)} times, {with_whom}; take pictures that show it"
                " to this camera and one of the others at the same moment"
            )
    return why
