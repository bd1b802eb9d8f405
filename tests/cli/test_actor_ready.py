"""An actor says that it is ready when nothing can keep it from its first update any more."""

import signal

import pytest

from enact_dist import Aspect, Entity, connect

MODULE = """\
from enact_dist import Actor, Aspect, Entity, View, World, Write

COUNT = Aspect("count_of_ready", int)


class Beat(Actor):
    online = World("online")
    count = Write(online, Entity("beat"), COUNT)
    every_s = 0.05

    def update(self, lock):
        lock[self.count] = lock.get(self.count, 0) + 1


class Blind(Beat):
    def start(self):
        raise RuntimeError("no camera")


class NoUpdate(Actor):
    online = World("online")
    count = View(online, Entity("beat"), COUNT)


class Far(Beat):
    count = Write(World("online"), Entity("far"), COUNT)


class Misfit(Beat):
    count = Write(World("online"), Entity("beat"), Aspect("registered", str))
"""
PINNED = (
    '[[pins]]\nentities = "beat"\nshard = "left"\n[[pins]]\nentities = "far"\nshard = "right"\n'
)


@pytest.fixture(autouse=True)
def module(tmp_path):
    """The actors' module in the working folder, as a user would have it."""
    (tmp_path / "my_actors.py").write_text(MODULE, encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "status", "reason"),
    [
        (("Beat", "--world", "onlin=online"), 2, "Beat has no role 'onlin'; it has online"),
        (("Beat", "--world", "online=offline"), 1, "no world context 'offline'"),
        (("NoUpdate",), 2, "NoUpdate of my_actors is no actor that can run"),
        (("Blind",), 1, "RuntimeError at my_actors.py:17: no camera"),
        (("Misfit",), 1, "registered"),
    ],
)
def test_actor_that_cannot_run_is_never_ready(spawn, cell_file, words, status, reason):
    """Neither an operator nor a service manager takes for ready what ends at once."""
    with connect(cell_file) as cell:
        cell.world("online").init(Entity("other"), Aspect("registered", int), 1)
    name, *more = words
    actor = spawn("actor", "run", f"my_actors:{name}", *more, "--cell", cell_file)

    said = actor.stdout.read()

    assert actor.wait(60) == status, said
    assert reason in said
    assert "ready:" not in said


def test_actor_whose_shard_is_away_waits_and_is_ready_once_it_answers(write_cell, spawn, until):
    """It has joined the cell over the other shard; one of the other shard's data is ready."""
    file = write_cell(PINNED)
    until(spawn("shard", "run", "left", "--cell", file), "ready: shard")
    until(spawn("actor", "run", "my_actors:Beat", "--cell", file), "ready: actor Beat")
    far = spawn("actor", "run", "my_actors:Far", "--cell", file)
    before = until(far, "not ready before its shards answer")
    until(spawn("shard", "run", "right", "--cell", file), "ready: shard")

    after = until(far, "ready: actor Far")
    with connect(file) as cell, cell.world("online").watch("far") as watch:
        assert next(iter(watch)).entity == Entity("far")
    far.send_signal(signal.SIGTERM)

    assert not any("ready:" in line for line in (*before, *after[:-1]))
    assert far.wait(60) == 0


def test_actor_that_is_stopped_before_it_is_ready_ends(write_cell, spawn, until):
    """A signal ends the wait for a shard; the actor has done nothing."""
    file = write_cell(PINNED)
    until(spawn("shard", "run", "left", "--cell", file), "ready: shard")
    far = spawn("actor", "run", "my_actors:Far", "--cell", file)
    until(far, "not ready before its shards answer")
    far.send_signal(signal.SIGTERM)

    said = far.stdout.read()

    assert far.wait(60) == 0
    assert "ready:" not in said
    assert "stopped: actor Far after 0 updates" in said
