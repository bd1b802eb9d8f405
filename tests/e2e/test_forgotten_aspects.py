"""A cell of real daemons forgets an aspect; programs that knew it with its old type live through."""

import signal

import pytest

from enact_dist import Aspect, Entity, Lock, View, Write, connect
from enact_dist.errors import DatumTypeError, NullDatumError

pytestmark = pytest.mark.slow
OLD, NEW = Aspect("pose", list), Aspect("pose", list[int])
"""Data of the one can be read as the other's: nothing but the catalogue tells them apart."""
PART, OTHER = Entity("part/1"), Entity("part/2")


def put(world, aspect, datum, entity=PART):
    """Commit one datum; return its version."""
    write = Write(world, entity, aspect)
    with Lock(write, wait_s=30.0) as lock:
        lock[write] = datum
    return world.history(entity, aspect)[-1].version


def fall_silent(cell, monkeypatch):
    """Let a connection say and hear nothing by itself: it learns of a restart when it is used."""
    monkeypatch.setattr(cell._client, "renew_once", lambda: None)
    monkeypatch.setattr(cell._client, "_shard_returned", lambda _: None)
    cell._client.carrier.on_reconnect(lambda _: None)


def restart(cell, *forgets):
    """Stop all daemons, forget, start them again."""
    for daemon in cell.daemons.values():
        daemon.signal(signal.SIGTERM)
    assert [daemon.finish() for daemon in cell.daemons.values()] == [0] * len(cell.daemons)
    done = cell.enact("shard", "forget", *forgets, "--yes")
    assert done.returncode == 0, done.stderr
    cell.start_all()


@pytest.mark.sampled(2)
@pytest.mark.parametrize("use", ["write", "view", "look_in_lock", "diff"])
def test_who_knew_the_old_type_gets_an_error_and_no_data(make_cell, monkeypatch, use):
    """Its first act after the restart is by the old type, with a catalogue of before."""
    cell = make_cell(shards=("s0", "s1"), ttl_s=1.0)
    cell.start_all()
    with connect(cell.file) as before:
        online = before.world("online")
        last = put(online, OLD, [1, 2])
        put(online, OLD, [3], OTHER)
        before.create_world("copy")
        fall_silent(before, monkeypatch)
        running = cell.enact("shard", "forget", "pose", "--yes")
        assert (running.returncode, "shard s0: " in running.stderr) == (1, True)
        restart(cell, "pose")
        with connect(cell.file) as after:
            world = after.world("online")
            with pytest.raises(NullDatumError):
                world.view(view := View(world, PART, NEW))[view]
            assert put(world, NEW, [7]) == last + 1
            assert put(after.world("copy"), NEW, [8]) == last + 1

            with pytest.raises(DatumTypeError, match="enact shard forget pose"):
                use_by_the_old_type(before, use)

            with Lock(View(world, PART, NEW)) as lock:
                assert lock.version(View(world, PART, NEW)) == last + 1
            assert put(world, NEW, [9]) == last + 2
        with pytest.raises(DatumTypeError):
            put(online, OLD, [4])


def use_by_the_old_type(cell, use):
    """Write or read by the type that the aspect had."""
    online = cell.world("online")
    view = View(online, PART, OLD)
    match use:
        case "write":
            put(online, OLD, [4])
        case "view":
            online.view(view)
        case "look_in_lock":
            with Lock(view) as lock:
                lock.get(view)
        case "diff":
            online.diff(cell.world("copy"), "**", OLD)


def test_the_old_type_is_taken_again_where_nobody_has_a_new_one(make_cell, monkeypatch):
    """Whoever comes first decides: a program that was not told goes on, on all shards."""
    cell = make_cell(shards=("s0", "s1"), ttl_s=1.0)
    cell.start_all()
    with connect(cell.file) as before:
        online = before.world("online")
        last = put(online, OLD, [1])
        with online.watch(PART, OLD) as watch:
            assert next(watch).version == last
            restart(cell, "pose")
            gone = next(watch)
            assert (gone.version, gone.null) == (0, True)
            assert put(online, OLD, [2]) == last + 1
            assert next(watch).version == last + 1
        with connect(cell.file) as after, pytest.raises(DatumTypeError):
            put(after.world("online"), NEW, [7])
