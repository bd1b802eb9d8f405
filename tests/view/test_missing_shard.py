"""A shard that is away takes nothing from the page that another shard has."""

import subprocess
import sys
import threading

import pytest
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


@pytest.fixture
def file(tmp_path):
    """The cell.toml of two shards of which only one is left, and a slot on each."""
    (tmp_path / "cell.toml").write_text(CELL.format(free_port(), free_port()))
    processes = {
        name: subprocess.Popen(
            [*SHARD, name, "--cell", "cell.toml"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
        )
        for name in ("left", "right")
    }
    try:
        for process in processes.values():
            assert any("ready: shard" in line for line in process.stdout)
        with connect(tmp_path / "cell.toml", actor="writer") as cell:
            online, slots = cell.world("online"), {}
            for number in range(8):
                slot = Slot("online", f"gauge/{number}", "speed")
                online.init(Entity(slot.entity), SPEED, float(number))
                slots.setdefault(online.session.client.shard_of(slot.entity), slot)
        processes["right"].kill()
        processes["right"].wait(60)
        yield tmp_path / "cell.toml", slots["left"], slots["right"]
    finally:
        for process in processes.values():
            process.kill()
            process.wait(60)
            process.stdout.close()


def test_what_the_other_shards_have_is_shown(file):
    """At the start, in the present, in the past, and in what the rows say."""
    path, left, right = file
    pause = threading.Event()
    options = {"observer": True, "timeout_s": 10.0, "request_timeout_s": 0.5}
    with connect(path, **options) as cell, Viewer(cell, ViewSettings(world="online")) as viewer:
        viewer.feed.wish("page", [left, right])
        viewer.list_for("page", [left])
        for _ in range(1000):
            if viewer.feed.shown([left]) and viewer.entry(left) is not None:
                break
            pause.wait(0.01)
        (shown,) = viewer.feed.shown([left, right]).values()
        assert shown.recorded.slot == left
        assert viewer.entry(left).cause.actor == "writer"
        source, at_ns = viewer.source, viewer.feed.moment_ns
        assert source.data_at([left, right], at_ns).data.keys() == {left}
        assert source.histories([left, right]).keys() == {left}
        assert "right" in viewer.feed.problem
