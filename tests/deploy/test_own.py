"""deploy/own, the example of a project of one's own: cell, image, compose file and unit fit together."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from enact_dist.cli.main import build_parser
from enact_dist.config.read import load_config

ROOT = Path(__file__).parents[2]
OWN = ROOT / "deploy" / "own"
CELL = load_config(OWN / "cell.toml")
DROP_IN = OWN / "enact-actor@counter.service.d" / "own.conf"
UNIT = ROOT / "deploy" / "systemd" / "enact-actor@.service"
FOLDER = "/opt/own"


def text(name):
    return (OWN / name).read_text("utf-8")


def test_its_actors_fit_its_cell():
    """As `enact actor check` prints it in that folder."""
    done = subprocess.run(
        [sys.executable, "-m", "enact_dist.cli.main", "actor", "check"],
        cwd=OWN,
        capture_output=True,
        text=True,
        check=False,
    )

    assert (done.returncode, done.stdout) == (0, "ok: 1 actors of cell own fit together\n")


def test_compose_starts_the_shard_and_the_actors_of_the_cell():
    """Each with a command that exists, under the name that cell.toml gives it."""
    commands = re.findall(
        r"^    command: \[((?:shard|actor), run, .*)\]", text("compose.yaml"), re.MULTILINE
    )
    parsed = [
        build_parser().parse_args([word.strip(' "') for word in command.split(",")])
        for command in commands
    ]

    assert [(one.noun, one.targets if one.noun == "actor" else [one.name]) for one in parsed] == [
        *(("shard", [shard.name]) for shard in CELL.shards),
        *(("actor", [actor.name]) for actor in CELL.actors),
    ]


def test_image_and_unit_look_for_modules_in_the_same_folder():
    """Where the page puts them."""
    assert f"ENV PYTHONPATH={FOLDER}\n" in text("Dockerfile")
    assert f"COPY *.py {FOLDER}/\n" in text("Dockerfile")
    assert f"Environment=PYTHONPATH={FOLDER}\n" in DROP_IN.read_text("utf-8")
    page = (ROOT / "enact_dist" / "docs" / "own_actors.md").read_text("utf-8")
    assert f"install -D -m 644 -t {FOLDER} deploy/own/own_actors.py\n" in page


@pytest.fixture
def verified(tmp_path):
    """What systemd says of the unit of the actor with a drop-in."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze: command not found (Debian package systemd)")

    def verify(drop_in):
        unit = UNIT.read_text("utf-8").replace("/opt/enact/bin/enact", "/bin/true")
        (tmp_path / UNIT.name).write_text(unit)
        folder = tmp_path / DROP_IN.parent.name
        folder.mkdir()
        (folder / DROP_IN.name).write_text(drop_in)
        done = subprocess.run(
            ["systemd-analyze", "verify", tmp_path / "enact-actor@counter.service"],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
        return done.returncode, done.stderr

    return verify


def test_systemd_finds_nothing_wrong_with_the_drop_in(verified):
    """With the lines that stand in it as comments, too."""
    drop_in = DROP_IN.read_text("utf-8")
    commented = re.findall(r"^#([A-Z]\w+=.*)$", drop_in, re.MULTILINE)

    assert len(commented) == 4
    assert verified(drop_in + "\n".join(["", *commented, ""])) == (0, "")


def test_a_misspelt_key_of_a_drop_in_is_found(verified):
    """The check above bites."""
    assert "PrivateDevice" in verified(DROP_IN.read_text("utf-8") + "PrivateDevice=no\n")[1]
