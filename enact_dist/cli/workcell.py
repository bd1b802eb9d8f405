"""`enact workcell`: what a cell with cameras of one's own needs before it runs."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from enact_dist.cli.arguments import counted, file_of
from enact_dist.cli.text.output import ProgressLine, print_table
from enact_dist.cli.verbs import DONE, FAILED, OptionGroup, Output, Verb, flag, option
from enact_dist.errors import ConfigError, EnactError
from enact_dist.extras import needing

if TYPE_CHECKING:
    from actors.geometry.cameras.charuco import Board
    from actors.workcell.folders.calibrate import CalibrateReport

BOARD: Final = "8x11,0.024,0.018,4X4_50"
"""Fits on A4."""
_COLUMNS: Final = (
    "CAMERA", "PICTURES", "BOARD", "SHARED", "COVERED", "FOCAL PX", "RMS PX", "X, Y, Z M",
)  # fmt: skip


def place(text: str) -> tuple[float, float, float, float]:
    """Read where a board lies; an `argparse` type."""
    try:
        x_m, y_m, z_m, turn_deg = (float(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no place such as 0.5,0,0.75,90") from None
    return x_m, y_m, z_m, turn_deg


VERBS: Final = (
    Verb(
        "calibrate", "find the lenses and poses of cameras from pictures of a ChArUco board",
        "run_calibrate",
        "enact workcell calibrate --print-board board.pdf\n"
        "enact workcell calibrate pictures --origin 000\n"
        "enact workcell calibrate pictures --board 7x5,0.08,0.06,5X5_100 --json\n"
        "enact workcell calibrate pictures --from 'v4l2:/dev/video0?size=640x480' --shots 20\n"
        "enact demo workcell --cameras pictures",
        (
            file_of("folder", "FOLDER",
                    "holds images/CAMERA/MOMENT.png; pictures of one MOMENT show the board in one"
                    " place", nargs="?"),
            option("--board", "B",
                   "COLUMNSxROWS,SQUARE_M,MARKER_M,DICTIONARY[,legacy] as it was printed (default:"
                   f" {BOARD}, which fits on A4)", default=BOARD),
            file_of("--print-board", "FILE", "write the board for printing: .pdf, .svg or .png"),
            file_of("--out", "FILE", "file of the calibration (default: FOLDER/cameras.json)"),
            option("--origin", "MOMENT",
                   "the board lay at the cell's origin then: its lower left corner, x right, y up"
                   " the sheet, z out of it (default: a moment at which most cameras saw it)",
                   default=""),
            option("--board-at", "X,Y,Z,TURN",
                   "where it lay then instead, face up: metres, and degrees about z",
                   type=place, default=(0.0, 0.0, 0.0, 0.0)),
            file_of("--intrinsics", "DIR",
                    "keep the lenses of a calibration in that folder, and seek poses only"),
            flag("--k3", "fit k3, too: wide lenses need it"),
            flag("--json", "print the report as JSON"),
            OptionGroup("pictures by cameras that are connected", (
                option("--from", "ADDRESS",
                       "take them into FOLDER first, whenever the board lies still in a new place;"
                       " the cameras are named 0, 1, 2 … in this order", dest="sources",
                       nargs="+"),
                counted("--shots", "at how many places (default 30)", 30),
            )),
        ),
    ),
)  # fmt: skip


@needing("the calibration", "workcell", "cv2", "scipy")
def run_calibrate(options: argparse.Namespace) -> Output | int:
    """Print a board, or calibrate cameras: what the options ask for."""
    from actors.geometry.cameras.charuco import board_of
    from actors.geometry.files import InputFileError

    try:
        board = board_of(options.board)
    except ValueError as error:
        raise ConfigError(f"--board: {error}") from None
    if options.print_board:
        return _print_board(board, options)
    folder: Path | None = options.folder
    if folder is None:
        raise ConfigError("name the folder of the pictures, or --print-board FILE")
    line = ProgressLine()
    try:
        if options.sources:
            _take(folder, board, options, line)
        report = _report_of(folder, board, options, line)
    except InputFileError as error:
        line.end()
        print(f"enact workcell: {error}", file=sys.stderr)
        return FAILED
    for camera, why in report.left_out.items():
        print(f"enact workcell: camera {camera} is not in {report.file}: {why}", file=sys.stderr)
    return Output(report, partial(_print, report), status=FAILED if report.left_out else DONE)


def _take(folder: Path, board: Board, options: argparse.Namespace, line: ProgressLine) -> None:
    """Take pictures of the board.

    Raises:
        EnactError: A camera cannot be used.
    """
    from actors.workcell.cameras.board_shots import opened_sources, take_shots
    from actors.workcell.cameras.sources import CameraError

    try:
        with opened_sources(options.sources) as sources:
            take_shots(folder, sources, board, options.shots, tell=line.show)
    except CameraError as error:
        raise EnactError(str(error)) from error
    finally:
        line.end()


def _report_of(
    folder: Path, board: Board, options: argparse.Namespace, line: ProgressLine
) -> CalibrateReport:
    from actors.workcell.folders.calibrate import FILE, CalibrateOptions, calibrate

    wanted = CalibrateOptions(
        board,
        options.out or folder / FILE,
        origin=options.origin,
        board_at=options.board_at,
        intrinsics=options.intrinsics,
        k3=options.k3,
    )

    def progress(done: int, total: int) -> None:
        line.show(f"pictures {done} of {total}")
        if done == total:
            line.show("fitting lenses and poses", at_once=True)

    report = calibrate(folder, wanted, progress=progress)
    line.end()
    return report


def _print_board(board: Board, options: argparse.Namespace) -> Output:
    from actors.geometry.cameras.board_sheet import KINDS, MARGIN_M, sheet
    from actors.geometry.files import check_output, write_whole

    file: Path = options.print_board
    if options.folder is not None:
        raise ConfigError("--print-board writes a board and ends; leave out FOLDER")
    if file.suffix.lower() not in KINDS:
        raise ConfigError(f"--print-board {file}: name a file that ends in {', '.join(KINDS)}")
    check_output(file.parent)
    write_whole({file: sheet(board, file.suffix.lower())})
    wide, high = (1e3 * (edge + 2.0 * MARGIN_M) for edge in (board.width_m, board.height_m))
    return Output(
        {"path": str(file), "wide_mm": wide, "high_mm": high, "board": str(board)},
        f"{file}: {wide:g} x {high:g} mm; print it at 100 %, glue it to something flat, measure a"
        f" square ({1e3 * board.square_m:g} mm), and say what you measured: --board {board}",
    )


def _print(report: CalibrateReport) -> None:
    print(f"board        {report.board}")
    print(f"origin       the board of moment {report.origin}, of {report.moments} moments")
    strays = f"; {report.strays} stray ones were left out" if report.strays else ""
    print(f"error        {report.rms_px:.3f} px rms of {report.corners} corners{strays}\n")
    rows = []
    for one in report.cameras:
        known: list[Any] = ["-", "-", "-"]
        if not one.left_out:
            centre = ", ".join(f"{value:.3f}" for value in one.centre_m)
            known = [f"{one.focal_px:.1f}", f"{one.rms_px:.3f}", centre]
        rows.append(
            [one.camera, one.pictures, one.boards, one.shared, f"{one.covered:.0%}", *known]
        )
    print_table(_COLUMNS, rows, empty="no camera")
    print()
    for picture in report.contradicting:
        print(f"left out     {picture}: all others contradict it; was the board moved?")
    for note in report.notes:
        print(f"look at      {note}")
    print(f"written      {report.file}")
