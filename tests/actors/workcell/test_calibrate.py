"""Calibration by a board: known cameras are found again, wrong pictures are one line each."""

import json
import shutil

import cv2
import numpy as np
import pytest

from actors.geometry.cameras.board_sheet import rectangles, sheet
from actors.geometry.cameras.camera_sets import read_cameras
from actors.geometry.cameras.charuco import board_of, find_board
from actors.geometry.files import InputFileError
from actors.workcell.folders.calibrate import CalibrateOptions, calibrate

from . import boards
from .boards import BOARD, CAMERAS, DISTORTION, lens, moments


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Pictures of three cameras at fourteen moments; for reading only."""
    return boards.write(tmp_path_factory.mktemp("board"), BOARD, CAMERAS, moments(14))


@pytest.fixture
def copied(pictures, tmp_path):
    """The same, to be changed."""
    shutil.copytree(pictures / "images", tmp_path / "images")
    return tmp_path


def options(folder, **more):
    return CalibrateOptions(more.pop("board", BOARD), folder / "cameras.json", **more)


def refusal(folder, **more):
    with pytest.raises(InputFileError) as caught:
        calibrate(folder, options(folder, **more))
    assert "\n" not in str(caught.value)
    assert not (folder / "cameras.json").exists()
    return str(caught.value)


def off_from(one, name, cell_from_cell=None):
    """Return by how much a found camera differs: focal share, degrees, metres."""
    matrix, _ = lens(*CAMERAS[name][0])
    true = CAMERAS[name][1] if cell_from_cell is None else CAMERAS[name][1] @ cell_from_cell
    turn, _ = cv2.Rodrigues((one.camera_from_cell @ np.linalg.inv(true))[:3, :3])
    centre_m = np.linalg.inv(true)[:3, 3]
    return (
        abs(one.camera_matrix[[0, 1], [0, 1]] / matrix[[0, 1], [0, 1]] - 1.0).max(),
        float(np.degrees(np.linalg.norm(turn))),
        float(np.linalg.norm(one.centre_m - centre_m)),
    )


def test_known_cameras_are_found_again(pictures, tmp_path):
    """Lenses and poses, by pictures alone, and the file can be read as every other one."""
    told = []
    report = calibrate(
        pictures,
        CalibrateOptions(BOARD, tmp_path / "cameras.json", origin="000"),
        progress=lambda done, total: told.append((done, total)),
    )

    assert report.left_out == {}
    assert report.rms_px < 0.12
    assert 0 < report.strays < 0.15 * report.corners
    assert told[-1] == (42, 42)
    found = read_cameras(tmp_path)
    assert (found.reader, found.unit_m("m")) == ("cameras.json", 1.0)
    for one in found.cameras:
        focal, turn_deg, move_m = off_from(one, one.name)
        assert focal < 0.005
        assert turn_deg < 0.075
        assert move_m < 0.001
        assert one.distortion[0] == pytest.approx(DISTORTION[0], abs=0.02)
        assert (one.width, one.height) == boards.SIZE
    for entry in report.cameras:
        assert entry.pictures == 14
        assert 6 <= entry.shared <= entry.boards <= 14
        assert entry.rms_px < 0.4
        assert entry.covered > 0.3


def test_lenses_that_are_known_are_kept(copied, tmp_path):
    """With three pictures each a lens could not be found; poses can."""
    known = tmp_path / "known"
    known.mkdir()
    listed = [
        {
            "name": name,
            "K": lens(*words)[0].tolist(),
            "R": np.eye(3).tolist(),
            "t": [0, 0, 0],
            "distortion": DISTORTION,
        }
        for name, (words, _) in CAMERAS.items()
    ]
    (known / "cameras.json").write_text(json.dumps({"cameras": listed}))
    for file in (copied / "images").glob("*/*.png"):
        if file.stem > "002":
            file.unlink()
    assert "4 are needed" in refusal(copied, origin="000")

    calibrate(copied, options(copied, origin="000", intrinsics=known))

    for one in read_cameras(copied).cameras:
        focal, turn_deg, move_m = off_from(one, one.name)
        assert focal == 0.0
        assert turn_deg < 0.15
        assert move_m < 0.001


def test_a_camera_that_saw_the_board_alone_is_left_out_and_named(copied):
    """The others are calibrated, and the message says which pictures to take."""
    for file in (copied / "images" / "2").iterdir():
        file.rename(file.with_name(f"alone-{file.name}"))

    report = calibrate(copied, options(copied))

    assert list(report.left_out) == ["2"]
    assert (
        "only alone; take pictures that show it to this camera and one of" in report.left_out["2"]
    )
    assert [one.name for one in read_cameras(copied).cameras] == ["0", "1"]
    assert [one.focal_px is None for one in report.cameras] == [False, False, True]


def test_an_older_file_is_kept_beside(copied):
    """What was there is kept as `cameras.json.before`."""
    (copied / "cameras.json").write_text("by hand")

    calibrate(copied, options(copied))

    assert (copied / "cameras.json.before").read_text() == "by hand"
    assert read_cameras(copied).cameras


@pytest.mark.parametrize(
    ("board", "said"),
    [
        ("5x7,0.08,0.06,4X4_50", "found another board: "),
        ("7x5,0.08,0.045,4X4_50", "of a square, and the board has 0.56"),
        ("7x4,0.08,0.06,4X4_50", "marker 16, and the board has 0 to 13"),
        ("7x5,0.08,0.06,6X6_50", "none of its markers in 2 pictures, but 17 markers of 4X4_1000"),
    ],
)
def test_another_board_is_named(copied, board, said):
    """Nothing is measured by a board that was not the printed one."""
    for camera in "012":
        folder = copied / "images" / camera
        for file in folder.iterdir():
            if camera != "2" or file.stem not in {"000", "010"}:
                file.unlink()

    assert said in refusal(copied, board=board_of(board))


def test_rows_that_were_never_seen_are_told(copied):
    """A board with fewer rows looks the same as the upper part of the one that is asked for."""
    report = calibrate(copied, options(copied, board=board_of("7x6,0.08,0.06,4X4_50")))

    assert any("does the board have 6 rows?" in note for note in report.notes)


def test_pictures_that_are_too_much_alike_are_refused(copied):
    """Copies of one picture lead to the advice to tilt the board."""
    for camera in "012":
        folder = copied / "images" / camera
        first = (folder / "000.png").read_bytes()
        for file in folder.iterdir():
            file.write_bytes(first)

    assert "tilt the board" in refusal(copied)


def test_wrong_pictures_are_one_line_each(copied, tmp_path):
    """Absent, empty, of another size, no picture, a wrong origin: each is named."""
    assert "no such folder" in refusal(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    assert "no folder images" in refusal(tmp_path / "empty")
    (tmp_path / "empty" / "images").mkdir()
    assert "no folder of a camera" in refusal(tmp_path / "empty")
    (tmp_path / "empty" / "images" / "0").mkdir()
    assert "found no picture" in refusal(tmp_path / "empty")
    assert "for --origin; found it at 000, 001" in refusal(copied, origin="900")
    image = copied / "images" / "1" / "003.png"
    cv2.imwrite(str(image), np.zeros((240, 320), np.uint8))
    assert "asked for 640 x 480 pixels, as the other pictures of camera 1" in refusal(copied)
    image.write_bytes(b"no picture")
    assert "003.png: asked for a picture; found 10 bytes that are none" in refusal(copied)


# ---------------------------------------------------------------- the board


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("7x5", "asked for a board as COLUMNSxROWS,SQUARE_M"),
        ("7x2,0.1,0.05,4X4_50", "needs three or more each way"),
        ("7x5,0.05,0.06,4X4_50", "a marker is smaller than its square"),
        ("7x5,80,60,4X4_50", "lengths are in metres"),
        ("7x5,0.08,0.06,9X9", "dictionary '9X9'; known are 4X4_100"),
        ("17x15,0.08,0.06,4X4_50", "a board of 127 markers; 4X4_50 has 50"),
    ],
)
def test_boards_that_there_are_not(text, said):
    """A wrong layout, size, unit or dictionary is named, with what was asked."""
    with pytest.raises(ValueError, match="asked for a board") as caught:
        board_of(text)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["7x5,0.08,0.06,4X4_50", "8x6,0.03,0.022,5X5_100,legacy", "6x8,0.03,0.02,APRILTAG_36h11"],
)
def test_a_printed_board_is_found_where_its_rectangles_are(text):
    """The sheet, its size in the file, and the frame: x right, y up, from the lower left corner."""
    board = board_of(text)
    assert str(board) == text
    data = sheet(board, ".png")
    at = data.index(b"pHYs")
    per_m = int.from_bytes(data[at + 4 : at + 8], "big")
    assert per_m == 11811  # 300 dots per inch
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape[1] == pytest.approx(per_m * (board.width_m + 0.02), abs=1)
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)

    seen = find_board(small, board)

    assert len(seen.numbers) == len(board.corners_m)
    x, y = ((seen.pixels + 0.5) * 4.0 / per_m - 0.01).T
    true = board.corners_m[seen.numbers]
    assert np.abs(x - true[:, 0]).max() < 2e-4
    assert np.abs(board.height_m - y - true[:, 1]).max() < 2e-4
    other = board_of(text.removesuffix(",legacy") if board.legacy else f"{text},legacy")
    assert len(find_board(small, other).numbers) in ({0} if board.rows % 2 == 0 else {24})


def test_all_kinds_of_sheets_have_the_same_rectangles():
    """SVG and PDF draw as many, in the size of the board; the PDF's table is right."""
    board = board_of("7x5,0.08,0.06,4X4_50")
    count = len(list(rectangles(board)))

    svg, pdf = sheet(board, ".svg").decode(), sheet(board, ".pdf")

    assert svg.count("<rect") == count + 1  # the paper
    assert 'width="580mm" height="420mm"' in svg
    assert pdf.count(b" re\n") == count
    assert b"/MediaBox [0 0 1644.0945 1190.5512]" in pdf
    table = int(pdf.rsplit(b"startxref\n", 1)[1].split()[0])
    assert pdf[table:].startswith(b"xref\n0 6\n")
    first = int(pdf[table:].splitlines()[3].split()[0])
    assert pdf[first:].startswith(b"1 0 obj")
