"""An actor as a process of its own: started afresh, works on its trigger, leaves on SIGTERM."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from ports import free_port

from enact_dist import Aspect, Durability, Entity, View, connect
from enact_dist.actor.report import read_reports

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PATIENCE_S = 120.0
NUMBER = Aspect("number", int, Durability.VOLATILE)
PRODUCT = Aspect("product", int, Durability.VOLATILE)

SCALE = """
from enact_dist import Actor, Aspect, Durability, Entities, View, World, Write

class Scale(Actor):
    online = World("online")
    number = View(online, Entities("v/*"), Aspect("number", int, Durability.VOLATILE))
    product = Write(online, Entities("v/*"), Aspect("product", int, Durability.VOLATILE))
    triggers = (number,)

    def __init__(self, factor: int) -> None:
        self.factor = factor

    def update(self, lock) -> None:
        lock[self.product] = self.factor * lock[self.number]
"""
CELL = """
name = "process"
worlds = ["online"]
[shards.one]
listen = "tcp/127.0.0.1:{port}"
"""


@pytest.fixture
def endpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A shard daemon, and a folder with `sample_scale.py` as the working folder."""
    port = free_port()
    (tmp_path / "sample_scale.py").write_text(SCALE)
    (tmp_path / "cell.toml").write_text(CELL.format(port=port))
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "enact_dist.cli.main", "shard", "run", "one"]
    with subprocess.Popen([*command, "--cell", "cell.toml"], stdout=subprocess.PIPE) as shard:
        assert shard.stdout is not None
        assert shard.stdout.readline().startswith(b"ready")
        yield f"tcp/127.0.0.1:{port}"
        shard.terminate()
        assert shard.wait(PATIENCE_S) == 0


@pytest.mark.slow
def test_spawned_actor_updates_reports_and_ends_when_terminated(endpoint: str):
    """Its options and roles come from the command; its report is seen by others; exit is 0."""
    entity = Entity("v/1")
    command = [
        *(sys.executable, "-m", "enact_dist.cli.main", "actor", "run", "sample_scale:Scale"),
        *("--cell", endpoint, "--name", "scale", "--world", "online=online"),
        *("--option", "factor=3"),
    ]
    actor = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        with connect(endpoint, actor="test") as cell:
            online = cell.world("online")
            online.init(entity, NUMBER, 5)
            with online.watch(entity, PRODUCT) as watch:
                assert watch.next(PATIENCE_S) is not None
            request = View(online, entity, PRODUCT)
            assert online.view(request)[request] == 15
            info = next(info for info in cell.actors() if info.actor == "scale")
            assert info.pid == actor.pid
            assert {report.name for report in read_reports(info.report)} <= {"scale"}
    finally:
        actor.terminate()
    assert actor.wait(PATIENCE_S) == 0
