"""A cell of real daemons that gets a third shard, and one of which goes back to a backup."""

import json
import signal

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, Write, connect
from enact_dist.errors import LeaseLostError

pytestmark = pytest.mark.slow
POSE = Aspect("pose", list)
CLOUD = Aspect("cloud", np.ndarray, Durability.OS)
PARTS = tuple(Entity(f"part/{number}") for number in range(8))


def put(world, entity, aspect, datum):
    """Commit one datum; return its version."""
    write = Write(world, entity, aspect)
    with Lock(write, wait_s=60.0) as lock:
        lock[write] = datum
    return world.history(entity, aspect)[-1].version


def shown(cell):
    """Return everything that a cell shows of the parts."""
    found = {}
    for name in ("online", "what_if"):
        world = cell.world(name)
        for entity in PARTS:
            for aspect in (POSE, CLOUD):
                for one in world.history(entity, aspect):
                    why = cell.why(world, entity, aspect, version=one.version)
                    made_of = sorted((*cause.slot, cause.version) for cause in why.walk())
                    datum = np.asarray(one.datum()).tobytes()
                    row = (datum, one.position.stamp_ns, one.until_ns, one.pinned, made_of)
                    found[name, entity.name, aspect.name, one.version] = row
    return found


def stop(cell):
    """End all daemons, as a signal does."""
    for daemon in cell.daemons.values():
        daemon.signal(signal.SIGTERM)
    assert [daemon.finish() for daemon in cell.daemons.values()] == [0] * len(cell.daemons)
    cell.daemons.clear()


def test_a_third_shard_gets_its_entities_and_a_backup_comes_back(make_cell, port):
    """All is as before, over all shards; then clients live through a shard's step back."""
    cell = make_cell(shards=("s0", "s1"))
    cell.start_all()
    with connect(cell.file) as joined:
        online = joined.world("online")
        for number, entity in enumerate(PARTS):
            put(online, entity, POSE, [number])
            read, write = Read(online, PARTS[number - 1], POSE), Write(online, entity, CLOUD)
            with Lock(read, write) as lock:
                lock.get(read, None)
                lock[write] = np.full(20_000, number)
            put(online, entity, POSE, [number, number])
        joined.pin("best", online.history(PARTS[3], POSE)[:1])
        online.fork("what_if")
        before = shown(joined)

    third = f'[shards.s2]\nlisten = "tcp/127.0.0.1:{port}"\n'
    cell.file.write_text(cell.file.read_text() + third)
    cell.ports["s2"] = 0
    refused = cell.enact("shard", "rebalance", "--new", "s2")
    assert (refused.returncode, "in use by process" in refused.stderr) == (1, True)
    stop(cell)
    refused = cell.enact("shard", "run", "s0")
    assert (refused.returncode, "enact shard rebalance" in refused.stderr) == (1, True)
    done = cell.enact("shard", "rebalance", "--new", "s2")
    assert done.returncode == 0, done.stderr
    assert "moved" in done.stdout
    assert cell.enact("shard", "rebalance").stdout == "every entity is where it belongs\n"
    whole = cell.file.read_text()
    cell.file.write_text(whole.replace(third, ""))
    told = cell.enact("shard", "rebalance", "--dry-run", "--json")
    assert (json.loads(told.stdout)["moves"], "say --store s2=" in told.stderr) == ([], True)
    cell.file.write_text(whole)

    cell.start_all()
    with connect(cell.file) as joined:
        assert shown(joined) == before
        online = joined.world("online")
        moved = next(e for e in PARTS if online.history(e, POSE)[-1].position.shard == "s2")
        assert put(online, moved, POSE, [1]) == 3
        _step_back(cell, online, moved)


def _step_back(cell, online, entity):
    """Back s2 up, go on, restore it: a client that saw more goes on with what is there."""
    folder = cell.folder / "backup"
    made = cell.enact("shard", "backup", "s2", "--to", str(folder))
    assert made.returncode == 0, made.stderr
    with online.watch(entity, POSE) as watch:
        assert (next(watch).version, put(online, entity, POSE, [2])) == (3, 4)
        assert next(watch).version == 4
        write = Write(online, entity, POSE)
        with pytest.raises(LeaseLostError), Lock(write) as lock:
            lock[write] = [3]
            cell.kill("s2")
            back = ("shard", "restore", "s2", "--from", str(folder), "--replace")
            done = cell.enact(*back)
            assert done.returncode == 0, done.stderr
            cell.start("s2")
        change = next(watch)
        assert (change.version, change.gap > 0) == (3, True)
        read = Read(online, entity, POSE)
        with Lock(read, wait_s=60.0) as lock:
            assert lock[read] == [1]
        assert put(online, entity, POSE, [5]) == 4
        assert next(watch).version == 4
