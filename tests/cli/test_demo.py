"""`enact demo`: which options belong together, and what is said when the extra is missing."""

import sys

import pytest


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--model", "m.ply"), "--model and --scene belong together"),
        (("--scene", "s.ply"), "--model and --scene belong together"),
        (("--views", "d", "--model", "m", "--scene", "s"), "--views trains"),
        (("--views", "d", "--packages", "3"), "--packages belongs to the simulated sensor"),
        (("--views", "d", "--keep-running"), "--keep-running belongs to the simulated sensor"),
        (("--cell", "c", "--seed", "3"), "--seed can only be set when the cell is started"),
        (("--cell", "c", "--views", "d"), "--cell watches a cell that runs"),
        (("--cell", "c", "--fail-over-after", "2"), "--fail-over-after can only be set when the"),
        (("--fail-over-after", "2"), "--fail-over-after needs a store"),
    ],
)
def test_options_that_do_not_fit_are_refused(enact, words, reason):
    """A mixture of simulated and real input is refused before anything is loaded."""
    result = enact("demo", "palletizing", *words)

    assert result.status == 2
    assert reason in result.err


def test_a_password_in_the_command_is_refused(enact):
    """Every user of the host would see it."""
    result = enact("demo", "palletizing", "--store", "postgresql://me:secret@db/cell")

    assert result.status == 1
    assert "can see the password of a command" in result.err
    assert "secret" not in result.err


def test_missing_extra_is_named_with_its_command(enact, monkeypatch):
    """Without Open3D the error says which extra to install."""
    monkeypatch.setitem(sys.modules, "actors.palletizing.demo.packing", None)
    error = ModuleNotFoundError("No module named 'open3d'", name="open3d")

    class Finder:
        @staticmethod
        def find_spec(name, *_):
            if name == "actors.palletizing.demo.packing":
                raise error

    monkeypatch.delitem(sys.modules, "actors.palletizing.demo.packing")
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])

    result = enact("demo", "palletizing")

    assert result.status == 2
    assert result.err == (
        "enact: the demo needs open3d, which is not installed: install the extra 'actors'"
        " (pip install -e '.[actors]' in the clone of enact-dist)\n"
    )


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--scenario", "S13"), "no scenario 'S13'; there are visit, S1,"),
        (("--scenario", "S8", "--embedded"), "--embedded has one"),
        (("--cameras", "d", "--live"), "--live belongs to the simulated cell"),
        (("--grid", "64"), "--grid belongs to --cameras FOLDER"),
        (("--cell", "c.toml", "--seed", "2"), "--seed is the choice of those who started the cell"),
        (("--cell", "c.toml", "--cameras", "d"), "--cameras is the choice of those who started"),
    ],
)
def test_options_of_the_workcell_that_do_not_fit_are_refused(enact, words, reason, tmp_path):
    """Nothing is started for a scenario that does not exist."""
    result = enact("demo", "workcell", "--out", str(tmp_path / "out"), *words)

    assert result.status == 2
    assert reason in result.err
    assert not (tmp_path / "out").exists()


def test_formats_of_pictures_are_in_the_help(enact, capsys):
    """An error about a folder without a calibration sends its reader there."""
    with pytest.raises(SystemExit):
        enact("demo", "workcell", "--help")
    said = capsys.readouterr().out
    for name in ("cameras.json", "cameras.txt", "masks/", "images/", "bounds.json", ".yml"):
        assert name in said


def test_missing_extra_of_the_workcell_is_named_with_its_command(enact, monkeypatch):
    """Without OpenCV the error says which extras to install."""
    error = ModuleNotFoundError("No module named 'cv2'", name="cv2")

    class Finder:
        @staticmethod
        def find_spec(name, *_):
            if name == "actors.workcell.demo.run":
                raise error

    monkeypatch.delitem(sys.modules, "actors.workcell.demo.run", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])

    result = enact("demo", "workcell")

    assert result.status == 2
    assert "pip install -e '.[workcell,record]'" in result.err
