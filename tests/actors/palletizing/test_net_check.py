"""The command that checks a net file and draws it."""

from xml.etree import ElementTree as ET

import pytest

from actors.palletizing.handling.grounding import FOLDER, SKELETONS
from actors.palletizing.handling.net_files import write_net
from enact_dist.cli.main import main

from .sound_nets import net, primitive, way

SOUND = net({"trial": primitive(way("done", "elapsed_s > 1"), way("failed", "force > 90"))})


def checked(file, out, capsys, *more):
    """Run the command; return exit code, output and error text."""
    code = main(["demo", "palletizing", "--check-net", str(file), "--out", str(out), *more])
    return (code, *capsys.readouterr())


@pytest.mark.parametrize("name", SKELETONS)
def test_every_skeleton_that_comes_with_the_cell_is_sound(tmp_path, capsys, name):
    """It is bound to an example, checked and drawn."""
    code, said, _ = checked(FOLDER / f"{name}.toml", tmp_path / "nets", capsys)

    assert code == 0
    assert f"net {name} is sound" in said
    assert "(success)" in said
    assert ET.parse(tmp_path / "nets" / f"{name}.svg").getroot().tag.endswith("svg")


def test_net_of_ones_own_is_drawn(tmp_path, capsys):
    """One line says what it is, and where the picture is."""
    write_net(SOUND, tmp_path / "own.toml")

    code, said, _ = checked(tmp_path / "own.toml", tmp_path, capsys)

    assert code == 0
    assert "1 primitives, ends done (success), failed (failure)" in said
    assert said.count("\n") == 1
    assert (tmp_path / "own.svg").exists()


def test_bad_files_are_one_line(tmp_path, capsys):
    """What is wrong stands there with the file; nothing is drawn."""
    bad = tmp_path / "bad.toml"
    write_net(SOUND, bad)
    bad.write_text(bad.read_text().replace("elapsed_s > 1", "elapsed_s > 9"))
    typo = tmp_path / "typo.toml"
    typo.write_text(bad.read_text().replace("limit_s", "limits"))
    for file, text in (
        (bad, "never met"),
        (typo, "limits"),
        (tmp_path / "none.toml", "No such file"),
    ):
        code, said, error = checked(file, tmp_path / "out", capsys)
        assert code != 0
        assert text in error
        assert "Traceback" not in error
        assert not said
    assert not (tmp_path / "out").exists()


def test_it_goes_with_no_option_of_a_run(tmp_path, capsys):
    """What only a run needs is refused by name."""
    code, _, error = checked(tmp_path / "own.toml", tmp_path, capsys, "--packages", "3")

    assert code != 0
    assert "--check-net only checks a file" in error
