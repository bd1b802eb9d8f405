"""The compose file, as far as it can be read without an engine."""

import re
from pathlib import Path

import pytest

from enact_dist.cli.main import build_parser, main
from enact_dist.config.read import load_config

ACTORS = Path(__file__).parents[2] / "actors"
DEPLOY = Path(__file__).parents[2] / "deploy"
TEXT = (DEPLOY / "compose.yaml").read_text("utf-8")


@pytest.mark.parametrize("name", ["left", "right"])
def test_a_shard_of_the_compose_file_drains_before_it_is_killed(name):
    """The engine waits longer than the drain that the command asks for, which is a good while."""
    commands = set(re.findall(rf"command: \[(shard, run, {name}.*)\]", TEXT))
    (grace_s,) = re.findall(r"stop_grace_period: (\d+)s", TEXT)

    assert commands
    for command in commands:
        arguments = build_parser().parse_args([word.strip(' "') for word in command.split(",")])
        assert (arguments.drain_s or 0.0) >= 5.0
        assert float(grace_s) > arguments.drain_s + 5.0


@pytest.mark.parametrize(
    ("profile", "file"),
    [("workcell", "workcell/cell.toml"), ("packing", "palletizing/robot_cell.toml")],
)
def test_a_profile_of_the_compose_file_runs_every_process_of_its_cell_once(profile, file):
    """A process that the cell gets runs in containers, too."""
    cell = load_config(ACTORS / file)
    processes = {one.process or one.name for one in cell.actors}
    found = re.findall(rf"  {profile}-[\w-]+:\n.*\n    command: \[actor, run, ([^\]]*)\]", TEXT)
    shards = re.findall(
        rf"  {profile}-[\w-]+:\n(?:    (?!command).*\n)+    command: \[shard, run, (\w+)", TEXT
    )

    run = [words.removeprefix("--process, ").partition(",")[0] for words in found]

    assert sorted(run) == sorted(processes)
    for words, name in zip(found, run, strict=True):
        shared = any(one.process == name for one in cell.actors)
        assert words.startswith("--process") == shared, name
    assert sorted(shard.name for shard in cell.shards) == sorted(shards)


def test_the_containers_with_keys_are_the_names_of_their_cell(tmp_path, monkeypatch):
    """One key for each name, of the file that the container `keys` puts together; all rights given."""
    for variable, value in re.findall(
        r"^  (ENACT_SHARD\w+): (\S+)",
        (DEPLOY / "compose.secure.yaml").read_text("utf-8"),
        re.MULTILINE,
    ):
        monkeypatch.setenv(variable, value)
    file = tmp_path / "cell.toml"
    parts = (ACTORS / "palletizing" / "cell.toml", DEPLOY / "secure" / "cell.toml")
    file.write_text("".join(part.read_text("utf-8") for part in parts), "utf-8")
    folders = re.findall(
        r"- keys-[\w-]+:/hosts/(\S+)", (DEPLOY / "compose.secure.yaml").read_text("utf-8")
    )

    written = main(["actor", "check", "--rights", "--cell", str(file)])
    cell = load_config(file)

    assert written == main(["actor", "check", "--cell", str(file)]) == 0
    assert sorted(folders) == sorted(
        (*cell.key_holders, *(f"shard.{shard.name}" for shard in cell.shards))
    )
