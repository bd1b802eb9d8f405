"""A ChArUco board: what it looks like, as a sheet to print, and where a picture shows its corners.

The frame of a board lies in its sheet: the origin at the lower left corner of its squares, x to the
right, y up the sheet, z out of the paper.  On a floor it lies as a cell's frame does, z up.

Rules a change must keep: a corner counts only if the whole picture of the board agrees with it, so
another board is refused, not measured; lengths are those of the printed sheet, metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Numbers = npt.NDArray[np.float64]
    Image = npt.NDArray[np.uint8]

FORM: Final = "COLUMNSxROWS,SQUARE_M,MARKER_M,DICTIONARY[,legacy]"
CORNERS_LEAST: Final = 6
"""Fewer corners of a board say too little about where it is."""
SPREAD_LEAST: Final = 0.5
"""The corners of one picture must cover so many squares in their narrower direction."""
MISFIT_SQUARES: Final = 0.25
"""Corners that lie further than this from a plane picture of the board are of another board."""
MARKER_SHARE_OFF: Final = 0.1
"""By so much of itself a marker may look larger or smaller than the board says."""
OTHERS: Final = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "ARUCO_ORIGINAL")
"""Dictionaries that are tried where no marker of the right one is found; the others are parts."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Attributes:
        columns: Squares across.
        rows: Squares down.
        square_m: Edge of a square, metres, as printed.
        marker_m: Edge of a marker's black frame, metres.
        dictionary: Its markers, as OpenCV names them, without ``DICT_``.
        legacy: The upper left square is white where the number of rows is even, as OpenCV drew
            boards before 4.6.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    legacy: bool = False

    def __str__(self) -> str:
        """Return the form that `board_of` reads."""
        text = f"{self.columns}x{self.rows},{self.square_m:g},{self.marker_m:g},{self.dictionary}"
        return text + ",legacy" * self.legacy

    @property
    def width_m(self) -> float:
        """Of the squares together, metres."""
        return self.columns * self.square_m

    @property
    def height_m(self) -> float:
        """Of the squares together, metres."""
        return self.rows * self.square_m

    @cached_property
    def markers(self) -> int:
        """How many markers it has."""
        return len(self.drawn.getIds())

    @cached_property
    def drawn(self) -> Any:
        """The board as OpenCV has it, a `cv2.aruco.CharucoBoard`."""
        import cv2

        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, words)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def corners_m(self) -> Numbers:
        """Where four squares meet, by number: (N, 3), metres, in the frame of the board."""
        return self._upright(np.asarray(self.drawn.getChessboardCorners(), np.float64))

    @cached_property
    def marker_corners_m(self) -> Numbers:
        """The corners of each marker, (M, 4, 3), metres: upper left first, then clockwise."""
        return self._upright(np.asarray(self.drawn.getObjPoints(), np.float64))

    def marker_bits(self, number: int) -> npt.NDArray[np.bool_]:
        """Return a marker with its frame, true is black, one entry per module."""
        words = self.drawn.getDictionary()
        modules = words.markerSize + 2
        picture = words.generateImageMarker(number, modules, borderBits=1)
        return np.asarray(np.asarray(picture) == 0)

    def _upright(self, points_m: Numbers) -> Numbers:
        """Turn OpenCV's points (y down, z into the sheet) into the frame of the board."""
        return np.asarray(points_m * (1.0, -1.0, -1.0) + (0.0, self.height_m, 0.0))


def board_of(text: str) -> Board:
    """Read a board, written `FORM`.

    Raises:
        ValueError: It is none; the message is one line.
    """
    words = text.split(",")
    legacy = len(words) == 5 and words[4] == "legacy"
    try:
        size, square, marker, dictionary = words[: 4 if legacy else None]
        columns, rows = (int(number) for number in size.lower().split("x"))
        square_m, marker_m = float(square), float(marker)
    except ValueError:
        raise ValueError(
            f"asked for a board as {FORM}, such as 8x11,0.024,0.018,4X4_50; found {text!r}"
        ) from None
    board = Board(columns, rows, square_m, marker_m, dictionary.removeprefix("DICT_"), legacy)
    found = _fault(board)
    if found:
        raise ValueError(f"asked for a board as {FORM}; found {found}")
    return board


def _fault(board: Board) -> str:
    """Say what is wrong with a board; nothing of a good one."""
    import cv2

    if min(board.columns, board.rows) < 3:
        return f"{board.columns} x {board.rows} squares; it needs three or more each way"
    if not 0.0 < board.marker_m < board.square_m:
        return (
            f"markers of {board.marker_m:g} m in squares of {board.square_m:g} m; a marker is"
            " smaller than its square"
        )
    if board.square_m > 1.0:
        return f"squares of {board.square_m:g} m; lengths are in metres, 24 mm is 0.024"
    known = sorted(name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if board.dictionary not in known:
        return f"dictionary {board.dictionary!r}; known are {', '.join(known)}"
    number = getattr(cv2.aruco, f"DICT_{board.dictionary}")
    held = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
    needed = board.columns * board.rows // 2
    if needed > held:
        return f"a board of {needed} markers; {board.dictionary} has {held}"
    return ""


# ---------------------------------------------------------------- finding it


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a picture shows of a board.

    Attributes:
        numbers: (N,) int, numbers of its corners; empty where it is not seen well enough.
        pixels: (N, 2) float64, column and row; the centre of the first pixel is (0, 0).
        markers: How many markers of the board's dictionary were found.
        last_marker: Highest number of them; -1 without any.
        fault: Why `numbers` is empty; nothing of a picture without any marker.
    """

    numbers: npt.NDArray[np.int64]
    pixels: Numbers
    markers: int
    last_marker: int = -1
    fault: str = ""


def find_board(image: Image, board: Board) -> Seen:
    """Return the corners of a board in a picture.

    Args:
        image: (H, W) or (H, W, 3) uint8.
        board: The board.
    """
    import cv2

    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board.drawn, cv2.aruco.CharucoParameters(), settings)
    found, numbers, markers, names = detector.detectBoard(grey)
    count = 0 if names is None else len(names)
    if count == 0:
        return _unseen(0, -1, "")
    last = int(np.max(names))
    if last >= board.markers:
        return _unseen(count, last, f"marker {last}, and the board has 0 to {board.markers - 1}")
    corners = 0 if numbers is None else len(numbers)
    if corners < CORNERS_LEAST:
        fault = f"{count} markers and {corners} corners; {CORNERS_LEAST} are needed"
        return _unseen(count, last, fault)
    seen = Seen(
        np.asarray(numbers, np.int64).ravel(),
        np.asarray(found, np.float64).reshape(-1, 2),
        count,
        last,
    )
    fault = _misfit(seen, board, np.asarray(markers, np.float64).reshape(-1, 4, 2))
    return _unseen(count, last, fault) if fault else seen


def _unseen(markers: int, last: int, fault: str) -> Seen:
    return Seen(np.zeros(0, np.int64), np.zeros((0, 2)), markers, last, fault)


def _misfit(seen: Seen, board: Board, quads: Numbers) -> str:
    """Say why corners and markers are not those of a plane picture of the board."""
    import cv2

    flat_m = board.corners_m[seen.numbers, :2]
    spread = np.linalg.svd(flat_m - flat_m.mean(0), compute_uv=False)
    if spread[1] < SPREAD_LEAST * board.square_m:
        return "corners in one row only"
    most_m = MISFIT_SQUARES * board.square_m
    on_sheet: Any = cv2.findHomography(seen.pixels, flat_m, cv2.RANSAC, most_m)[0]
    if on_sheet is None:
        return "corners that lie on no sheet"
    off = np.linalg.norm(_moved(seen.pixels, on_sheet) - flat_m, axis=1)
    if np.mean(off > most_m) > 0.2:
        return "corners in another order: a board with another number of squares"
    sheet_m = _moved(quads.reshape(-1, 2), on_sheet).reshape(-1, 4, 2)
    edges_m = np.linalg.norm(np.roll(sheet_m, -1, axis=1) - sheet_m, axis=2)
    share = float(np.median(edges_m)) / board.marker_m
    if abs(share - 1.0) > MARKER_SHARE_OFF:
        return (
            f"markers of {share * board.marker_m / board.square_m:.2f} of a square, and the board"
            f" has {board.marker_m / board.square_m:.2f}"
        )
    return ""


def _moved(points: Numbers, homography: Any) -> Numbers:
    """Return points (N, 2) moved by a homography."""
    import cv2

    moved = cv2.perspectiveTransform(points[:, None], homography)
    return np.asarray(moved, np.float64)[:, 0]


def other_markers(image: Image) -> str:
    """Return of which dictionary a picture shows most markers, and how many; or nothing."""
    import cv2

    best, most = "", 1
    for name in OTHERS:
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        _, numbers, _ = cv2.aruco.ArucoDetector(words).detectMarkers(image)
        if numbers is not None and len(numbers) > most:
            best, most = f"{len(numbers)} markers of {name}", len(numbers)
    return best
