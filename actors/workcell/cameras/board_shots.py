"""Pictures of a board by connected cameras: taken whenever it lies still in a new place.

A picture of each camera is kept under the same name, `images/<camera>/<moment>.png`, as
`calibrate` reads them.
"""

from __future__ import annotations

import contextlib
import re
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.cameras.charuco import find_board
from actors.geometry.files import write_whole
from actors.workcell.cameras.sources import CameraError, source_of
from actors.workcell.vocabulary import PERIOD_NS, Calibration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from actors.geometry.cameras.charuco import Board, Seen
    from actors.workcell.cameras.sources import CameraSource

    Image = npt.NDArray[np.uint8]

STILL_PX: Final = 0.7
"""A board whose corners moved by less since the last look lies still."""
NEW_SHARE: Final = 0.04
"""A place is new if in some camera the corners moved by this share of the picture's width."""


def take_shots(
    folder: Path,
    sources: Mapping[str, CameraSource],
    board: Board,
    shots: int,
    *,
    tell: Callable[[str], None],
    wait: Callable[[float], None] = time.sleep,
) -> list[str]:
    """Take pictures until there are enough; return the names of the moments.

    Args:
        folder: Gets ``images/<camera>/<moment>.png``; names go on after those that are there.
        sources: Open sources by the name of the camera.
        board: The board.
        shots: How many moments.
        tell: Told how far it is.
        wait: Waits between two looks, seconds.

    Raises:
        CameraError: A camera fails.
    """
    import cv2

    names: list[str] = []
    first = _first_number(folder)
    last: dict[str, Seen] = {}
    kept: list[dict[str, Seen]] = []
    while len(names) < shots:
        images = _look(sources)
        seen = {name: find_board(image, board) for name, image in images.items()}
        shown = {name: one for name, one in seen.items() if len(one.numbers)}
        tell(
            f"{len(names)} of {shots} taken; the board is seen by"
            f" {', '.join(shown) or 'no camera'}; lay it still, then move and tilt it"
        )
        still = bool(shown) and all(
            name in last and _moved_px(one, last[name]) < STILL_PX for name, one in shown.items()
        )
        if still and all(_is_new(shown, before, images) for before in kept):
            moment = f"{first + len(names):03d}"
            contents = {}
            for name in shown:
                done, data = cv2.imencode(".png", images[name])
                assert done
                contents[folder / "images" / name / f"{moment}.png"] = data.tobytes()
            write_whole(contents)
            names.append(moment)
            kept.append(shown)
        last = seen
        wait(0.2)
    return names


def _look(sources: Mapping[str, CameraSource]) -> dict[str, Image]:
    """Return an image of each camera, as near in time as they come."""
    stamp_ns = time.time_ns() // PERIOD_NS * PERIOD_NS
    return {name: source.frame(stamp_ns) for name, source in sources.items()}


def _first_number(folder: Path) -> int:
    """Return the first number after those of the pictures that are there."""
    numbers = [int(file.stem) for file in folder.glob("images/*/*.png") if file.stem.isdecimal()]
    return max(numbers, default=-1) + 1


def _moved_px(one: Seen, other: Seen) -> float:
    """Return by how much the corners that both show have moved, pixels; infinite without any."""
    _, here, there = np.intersect1d(one.numbers, other.numbers, return_indices=True)
    if not len(here):
        return float("inf")
    return float(np.linalg.norm(one.pixels[here] - other.pixels[there], axis=1).mean())


def _is_new(
    shown: Mapping[str, Seen], before: Mapping[str, Seen], images: Mapping[str, Image]
) -> bool:
    """Say whether some camera sees the board elsewhere than before."""
    return any(
        name not in before or _moved_px(one, before[name]) > NEW_SHARE * images[name].shape[1]
        for name, one in shown.items()
    )


@contextlib.contextmanager
def opened_sources(addresses: Sequence[str]) -> Iterator[dict[str, CameraSource]]:
    """Open sources, named 0, 1, 2 … in the order of their addresses; closed after the block.

    Args:
        addresses: As of the `Camera` actor; each names its `size`.

    Raises:
        CameraError: One has no size, or cannot be opened.
    """
    with contextlib.ExitStack() as stack:
        found: dict[str, CameraSource] = {}
        for number, address in enumerate(addresses):
            size = re.search(r"[?&]size=(\d+)x(\d+)", address)
            if size is None:
                raise CameraError(
                    f"{address}: asked for the size in which the camera will be used; found none;"
                    " write v4l2:/dev/video0?size=640x480"
                )
            source = source_of(address, str(number))
            nothing_known = Calibration(
                np.eye(3), np.zeros(5), np.eye(4), int(size[1]), int(size[2])
            )
            stack.callback(source.close)
            source.open(nothing_known)
            found[str(number)] = source
        yield found
