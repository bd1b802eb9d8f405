"""Folders and a recording of the version before open unchanged; see `make_stored.py`."""

import json
import tarfile
from pathlib import Path

import pytest
from make_stored import cell_file
from stored_facts import REPLAYED, facts_of, replayed

from enact_dist import connect

ENACT = "enact_dist.cli.main"
STORED = Path(__file__).with_name("stored_before")
FACTS = json.loads((STORED / "facts.json").read_text("utf-8"))


@pytest.fixture
def opened(tmp_path, make_process):
    """The cell of that version, whose shards the present version serves."""
    with tarfile.open(STORED / "shards.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    file = cell_file(tmp_path)
    for name in ("left", "right"):
        make_process("-m", ENACT, "shard", "run", name, "--cell", file).expect("ready:")
    with connect(file) as cell:
        yield cell


def test_folders_of_the_version_before_open_unchanged(opened):
    """Every version of every datum, labels, a diff, a fork and lineage are as that version saw them."""
    found = json.loads(json.dumps(facts_of(opened)))

    for part in found:
        assert found[part] == FACTS[part], part
    assert len(FACTS["versions"]) == 40
    assert max(map(len, FACTS["versions"].values())) == 8
    assert FACTS["diff"]
    assert len(FACTS["why"]) > 2


def test_recording_of_the_version_before_replays_the_same(opened, tmp_path, make_process):
    """The same data and as many versions of each as when that version replayed it."""
    opened.drop_world("replayed")
    opened.create_world("replayed")
    file = str(tmp_path / "cell.toml")
    recording = str(STORED / "recording.mcap")

    process = make_process(
        "-m", ENACT, "replay", recording, "--into", file, "--speed", "0", *REPLAYED
    )

    assert process.finish() == 0, process.story()
    assert replayed(opened.world("replayed")) == FACTS["replayed"]
    assert max(FACTS["replayed"]["versions"].values()) > 2
