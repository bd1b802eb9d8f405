"""A bench in a cell that runs: its context goes with it, and what others have there stays."""

import contextlib
from types import SimpleNamespace

import pytest

from enact_dist import Aspect, Entity, Lock, View, connect
from enact_dist.bench import command
from enact_dist.bench.cases import history, updates
from enact_dist.bench.visit import PEAK_BYTES, Visit, without_room
from enact_dist.errors import EnactError, LinkError, ShardUnreachableError
from enact_dist.world.listings import ShardInfo


def worlds_of(enact, cell_file):
    found = enact("world", "ls", "--cell", str(cell_file), "--json").json
    return sorted(row["world"] for row in found)


def write_some(run):
    """Write a number; a bench that takes no time."""
    updates.update(updates.slots(run.place.world("auto"), 1))


def interrupted(run):
    """Be interrupted while a lock is held, which stays."""
    world = run.place.world("auto")
    (write,) = updates.slots(world, 1)
    stack.enter_context(Lock(write))
    raise KeyboardInterrupt


stack = contextlib.ExitStack()
"""Holds a lock that nobody gives back."""


def failing(run):
    """Write a number, then fail."""
    write_some(run)
    raise LinkError("the worker has gone")


@pytest.mark.parametrize(("act", "status"), [(write_some, 0), (failing, 1), (interrupted, 130)])
def test_context_of_a_bench_goes_with_its_end(enact, cell_file, monkeypatch, act, status):
    """However it ended, a lock that was left included; nothing is said of it."""
    monkeypatch.setitem(command.BENCHES, "multi", act)

    result = enact("bench", "multi", "--connect", str(cell_file))

    with contextlib.suppress(EnactError):
        stack.close()
    assert result.status == status
    assert "world context" not in result.err
    assert worlds_of(enact, cell_file) == ["online", "training"]


def test_context_that_was_there_before_stays(enact, cell_file, monkeypatch):
    """Somebody's figures may be in it; how to drop it is said."""
    monkeypatch.setitem(command.BENCHES, "multi", write_some)
    with connect(cell_file) as cell:
        cell.create_world("bench")
        try:
            result = enact("bench", "multi", "--connect", str(cell_file))
            assert result.status == 0
            assert "bench" in worlds_of(enact, cell_file)
        finally:
            cell.drop_world("bench")

    assert "'bench' was there before this run and stays" in result.err
    assert f"`enact world drop bench --cell {cell_file}` drops it" in result.err


@pytest.fixture
def half_kept(write_cell, spawn, until):
    """A running cell whose shard right keeps nothing on disk: its file, and what restarts right."""
    file = write_cell()
    text = file.read_text().replace('data_folder = "data"\n', "")
    text = text.replace("[shards.left]\n", '[shards.left]\nfolder = "left"\n')
    file.write_text(f'{text}\n[[pins]]\nentities = "kept"\nshard = "left"\n')
    right = []

    def run(name):
        process = spawn("shard", "run", name, "--cell", file)
        until(process, "ready: shard")
        return process

    def restart():
        right[0].kill()
        right[0].wait(60)
        right[0] = run("right")

    run("left")
    right.append(run("right"))
    return file, restart


def test_context_of_which_one_shard_has_the_data_stays(enact, half_kept, monkeypatch):
    """A shard that has forgotten it says nothing of the other's data."""
    file, restart = half_kept
    monkeypatch.setitem(command.BENCHES, "multi", write_some)
    aspect = Aspect("weight_g", int)
    with connect(file) as cell:
        cell.create_world("bench").init(Entity("kept"), aspect, 7)
    restart()

    result = enact("bench", "multi", "--connect", str(file))

    assert result.status == 0, result.err
    assert "'bench' was there before this run and stays" in result.err
    with connect(file) as cell:
        kept = View(cell.world("bench"), Entity("kept"), aspect)
        assert kept.world.view(kept)[kept] == 7


def test_context_of_a_bench_goes_from_the_shard_that_still_has_it(enact, half_kept, monkeypatch):
    """Though another one has restarted meanwhile and knows nothing of it."""
    file, restart = half_kept

    def restarted(run):
        write_some(run)
        restart()

    monkeypatch.setitem(command.BENCHES, "multi", restarted)

    result = enact("bench", "multi", "--connect", str(file))

    assert (result.status, "world context" in result.err) == (0, False), result.err
    with connect(file) as cell:
        cell.worlds()
        assert cell._client.worlds_at("bench") == {}


def test_fork_of_a_bench_takes_the_place_of_no_context(enact, cell_file, monkeypatch):
    """It is dropped before each next one; somebody's of its name is not."""
    theirs, seen = "bench_history_10_fork", []
    monkeypatch.setattr(history, "FORKED", 1)
    monkeypatch.setattr(history, "FORKED_BYTES", {"10 B": 10})

    def forks(run):
        for case in history._forks(run, "auto", ("floor", "")):
            seen.extend(case.measure(0.01))

    monkeypatch.setitem(command.BENCHES, "multi", forks)
    aspect = Aspect("weight_g", int)
    with connect(cell_file) as cell:
        world = cell.create_world(theirs)
        world.init(Entity("kept"), aspect, 7)
        kept = View(world, Entity("kept"), aspect)
        try:
            result = enact("bench", "multi", "--connect", str(cell_file))
            assert world.view(kept)[kept] == 7
            assert worlds_of(enact, cell_file) == [theirs, "online", "training"]
        finally:
            cell.drop_world(theirs)

    assert (result.status, len(seen) > 0) == (0, True), result.err


def test_context_that_cannot_be_dropped_is_told():
    """The cell may have gone meanwhile."""

    def gone():
        raise ShardUnreachableError("no shard answers", shard="s", endpoint="e")

    client = SimpleNamespace(worlds_at=lambda _name: {})
    cell = SimpleNamespace(worlds=tuple, _client=client)
    said = []
    visit = Visit("my cell.toml", connected=gone, said=said.append)
    visit.leave()
    assert said == []
    visit.uses(cell, "bench")
    visit.leave()

    (text,) = said
    assert "'bench' may still be there: no shard answers" in text
    assert "--cell 'my cell.toml'` drops it" in text


def test_bench_that_would_push_history_out_is_not_run(enact, cell_file, monkeypatch):
    """Refused where it is named, left out where it is not, before anything is written."""
    ran = []
    monkeypatch.setitem(PEAK_BYTES, "fetch", 1 << 60)
    monkeypatch.setattr(
        command, "BENCHES", {"core": lambda _: ran.append("core"), "fetch": ran.append}
    )
    words = ("bench", "--connect", str(cell_file))

    refused = enact(*words, "fetch", "core")
    assert (refused.status, ran) == (1, [])
    assert "its oldest history would go; raise shared_bytes_max" in refused.err

    left_out = enact(*words)
    assert (left_out.status, ran) == (0, ["core"])
    assert "left out: fetch writes up to" in left_out.err
    assert worlds_of(enact, cell_file) == ["online", "training"]


def test_room_is_that_of_the_fullest_shard_and_used_up_by_the_benches_before():
    """Who has no cap has no history in shared memory that could go."""

    def shard(name, used, cap):
        return ShardInfo(name, "", True, counters={"payload_bytes": used, "payload_bytes_max": cap})

    roomy, full, bare = shard("a", 0, 10**9), shard("b", 600 * 10**6, 10**9), shard("c", 0, 0)

    assert without_room([roomy, bare], ["update", "fetch", "wakeup"]) == {}
    found = without_room([roomy, full, bare], ["update", "stopped", "fetch", "publish", "wakeup"])
    assert list(found) == ["fetch", "publish"]
    assert "shard b has 400 MB left of its cap of 1000 MB" in found["fetch"]
    assert "benches before it take up to 70 MB" in found["fetch"]
