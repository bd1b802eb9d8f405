"""A shard that is away takes nothing from the page that another shard has."""

import subprocess
import sys

import pytest
from polling import until
from ports import free_port

from enact_dist import Aspect, Entity, connect
from enact_dist.core.protocol.datum import Slot
from enact_dist.view.pages.viewer import Viewer, ViewSettings

SHARD = [sys.executable, "-m", "enact_dist.cli.main", "shard", "run"]
SPEED = Aspect("speed", float)
CELL = """
name = "halved"
worlds = ["online"]
data_folder = "data"

[shards.left]
listen = "tcp/127.0.0.1:{}"

[shards.right]
listen = "tcp/127.0.0.1:{}"
"""


def start(folder, name):
    words = [*SHARD, name, "--cell", "cell.toml"]
    process = subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert any("ready: shard" in line for line in process.stdout)
    return process


@pytest.fixture
def halved(tmp_path):
    """The cell.toml of two shards of which only one is left, a slot on each, and the shards."""
    (tmp_path / "cell.toml").write_text(CELL.format(free_port(), free_port()))
    processes = {}
    try:
        for name in ("left", "right"):
            processes[name] = start(tmp_path, name)
        with connect(tmp_path / "cell.toml", actor="writer") as cell:
            online, slots = cell.world("online"), {}
            for number in range(8):
                slot = Slot("online", f"gauge/{number}", "speed")
                online.init(Entity(slot.entity), SPEED, float(number))
                slots.setdefault(online.session.client.shard_of(slot.entity), slot)
        end(processes["right"])
        yield tmp_path / "cell.toml", slots["left"], slots["right"], processes
    finally:
        for process in processes.values():
            end(process)


def end(process):
    process.kill()
    process.wait(60)
    process.stdout.close()


def test_what_the_other_shards_have_is_shown(halved):
    """At the start, in the present, in the past, and in what the rows say; until it is back."""
    path, left, right, processes = halved
    options = {"observer": True, "timeout_s": 10.0, "request_timeout_s": 0.5}
    with connect(path, **options) as cell, Viewer(cell, ViewSettings(world="online")) as viewer:
        viewer.feed.wish("page", [left, right])
        viewer.list_for("page", [left])
        until(lambda: viewer.feed.shown([left]) and viewer.entry(left) is not None)
        (shown,) = viewer.feed.shown([left, right]).values()
        assert shown.recorded.slot == left
        assert viewer.entry(left).cause.actor == "writer"
        until(lambda: "right" in viewer.feed.problem)
        source, at_ns = viewer.source, viewer.feed.moment_ns
        assert source.data_at([left, right], at_ns).data.keys() == {left}
        assert source.histories([left, right]).keys() == {left}
        processes["right"] = start(path.parent, "right")
        until(lambda: viewer.feed.shown([right]))
        until(lambda: viewer.feed.problem == "")
