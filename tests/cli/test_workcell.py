"""`enact workcell calibrate`: the board to print, what is refused, and what is missing."""

import sys

import cv2
import numpy as np
import pytest


def test_a_board_is_written_to_print(enact, tmp_path):
    """In three formats, with its size and the option that a calibration needs."""
    for kind, head in (("png", b"\x89PNG"), ("svg", b"<svg"), ("pdf", b"%PDF")):
        file = tmp_path / "sheets" / f"board.{kind}"

        result = enact("workcell", "calibrate", "--print-board", str(file))

        assert result.status == 0
        assert file.read_bytes().startswith(head)
        assert "212 x 284 mm; print it at 100 %" in result.out
        assert "--board 8x11,0.024,0.018,4X4_50" in result.out

    told = enact("workcell", "calibrate", "--print-board", str(file), "--json").json
    assert (told["path"], round(told["wide_mm"]), round(told["high_mm"])) == (str(file), 212, 284)


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        ((), 2, "name the folder of the pictures, or --print-board FILE"),
        (("d", "--board", "8x11"), 2, "--board: asked for a board as COLUMNSxROWS"),
        (("--print-board", "b.jpg"), 2, "name a file that ends in .png, .svg, .pdf"),
        (("d", "--print-board", "b.png"), 2, "leave out FOLDER"),
        (("no-such-folder",), 1, "found no such folder; check the path"),
        (("d", "--from", "v4l2:/dev/no-such?size=64x48"), 1, "found no such device or file"),
    ],
)
def test_what_cannot_be_done_is_one_line(enact, words, status, reason):
    """Wrong words end with status 2, missing files and devices with 1."""
    result = enact("workcell", "calibrate", *words)

    assert result.status == status
    assert reason in result.err
    assert "Traceback" not in result.err


def test_pictures_without_a_board(enact, tmp_path):
    """The board that was looked for is in the refusal, and nothing is printed."""
    for camera in "01":
        (tmp_path / "images" / camera).mkdir(parents=True)
        grey = np.full((120, 160), 120, np.uint8)
        assert cv2.imwrite(str(tmp_path / "images" / camera / "0.png"), grey)

    result = enact("workcell", "calibrate", str(tmp_path), "--json")

    assert result.status == 1
    assert result.out == ""
    assert "asked for pictures of the board 8x11,0.024,0.018,4X4_50; found none of" in result.err


def test_missing_extra_is_named_with_its_command(enact, monkeypatch):
    """Without OpenCV there is a line, no traceback."""
    monkeypatch.setitem(sys.modules, "cv2", None)

    result = enact("workcell", "calibrate", "--print-board", "b.png")

    assert result.status == 2
    assert "the calibration needs cv2, which is not installed" in result.err
    assert "pip install -e '.[workcell]'" in result.err


def test_a_place_that_is_none(enact, capsys):
    """The refusal gives an example of one."""
    with pytest.raises(SystemExit, match="2"):
        enact("workcell", "calibrate", "d", "--board-at", "1,2")

    assert "'1,2' is no place such as 0.5,0,0.75,90" in capsys.readouterr().err
