"""What a user of `Cell` may rely on: contexts, people's views of it, and its end."""

import pickle
import threading
import time

import msgpack
import numpy as np
import pytest

from enact_dist import Aspect, Entity, Lock, Position, Read, View, Write, connect, local
from enact_dist.errors import (
    ConfigError,
    DatumTypeError,
    LockHeldError,
    MisuseError,
    ShardUnreachableError,
    StoreError,
    UnknownWorldError,
)

pytestmark = pytest.mark.carrier("local", "drawn")

COUNT = Aspect("count", int)
bench, piece = Entity("work_bench"), Entity("work_piece")


def test_create_world_makes_it_once_and_for_good(tmp_path):
    """create_world is idempotent, and its context is there after a restart."""
    with local(tmp_path) as cell:
        made = cell.create_world("what_if")
        made.init(bench, COUNT, 1)
        again = cell.create_world("what_if")
        assert again.view(View(again, bench, COUNT))[View(again, bench, COUNT)] == 1
    with local(tmp_path, worlds=["online"]) as cell:
        assert cell.worlds() == ("online", "what_if")
        assert cell.world("what_if").entities() == (bench,)


@pytest.mark.parametrize("name", ["", "a b", "a/b", "-a", "x" * 300])
def test_create_world_refuses_a_name_that_cannot_be(cell, name):
    """A name that no key can carry is refused where it is made."""
    with pytest.raises(ValueError, match="world context"):
        cell.create_world(name)


def test_local_refuses_worlds_that_are_no_names():
    """One string is not a sequence of names, and each name is checked."""
    with pytest.raises(MisuseError, match=r"worlds=\['online'\]"):
        local(worlds="online")
    with pytest.raises(MisuseError, match="on line"):
        local(worlds=["on line"])


def test_unknown_world_says_none_when_there_is_none():
    """An empty cell says so instead of listing nothing."""
    with local() as cell, pytest.raises(UnknownWorldError, match="it has none") as caught:
        cell.world("online")
    assert caught.value.known == ()


def test_second_cell_on_a_folder_is_refused_and_the_first_goes_on(tmp_path):
    """Two cells never share a folder; the refusal names it."""
    with local(tmp_path, worlds=["online"]) as cell:
        with pytest.raises(StoreError, match=str(tmp_path)):
            local(tmp_path)
        assert cell.world("online").init(bench, COUNT, 1)


def test_folder_is_free_again_when_opening_failed_half_way(tmp_path, monkeypatch):
    """A cell that could not be opened leaves its folder to the next one."""
    from enact_dist.link.client import locks as client

    with monkeypatch.context() as patch, pytest.raises(RuntimeError):
        patch.setattr(client, "CellClient", lambda *_, **__: (_ for _ in ()).throw(RuntimeError))
        local(tmp_path)
    with local(tmp_path):
        pass


def test_closed_cell_leaves_no_grace_to_the_next(tmp_path):
    """Goodbye removes the session for good: the next shard waits for nobody."""
    with local(tmp_path, worlds=["online"]) as cell:
        cell.world("online").init(bench, COUNT, 1)
    with local(tmp_path) as cell:
        assert cell.shards()[0].open
        assert cell.shards()[0].sessions == 1


def test_failed_shard_in_process_is_told_with_its_reason(tmp_path):
    """A full disk ends the shard; calls say so, and nothing that was kept is lost."""
    with local(tmp_path, worlds=["online"]) as cell:
        online = cell.world("online")
        online.init(bench, COUNT, 1)
        cell._host._fail(OSError("no space left on device"))
        with pytest.raises(ShardUnreachableError, match=r"no space left on device.*open a new one"):
            Lock(Read(online, bench, COUNT), wait_s=0.05).__enter__()
    with local(tmp_path) as cell:
        assert cell.world("online").entities() == (bench,)


def test_cell_survives_a_long_rest():
    """A session in process lives on without keep-alives, far beyond its lease."""
    from enact_dist import testing

    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as resting:
        online = resting.world("online")
        online.init(bench, COUNT, 1)
        clock.advance(600.0)
        with Lock(Read(online, bench, COUNT), wait_s=0) as lock:
            assert lock[Read(online, bench, COUNT)] == 1
        assert resting.shards()[0].sessions == 1


class JumpingClock:
    """A host whose wall clock people set."""

    ahead_ns = 0

    def monotonic_ns(self):
        return time.monotonic_ns()

    def wall_ns(self):
        return time.time_ns() + self.ahead_ns


def test_nothing_happens_when_the_wall_clock_is_set():
    """Two hours forward and back: locks, commits and waiting for positions go on, in order."""
    clock, stamps = JumpingClock(), []
    with local(worlds=["online"], clock=clock) as cell:
        count = Write(cell.world("online"), bench, COUNT)
        for ahead_h in (0, 2, -2, 0):
            with Lock(count) as lock:
                clock.ahead_ns = ahead_h * 3600 * 10**9
                lock[count] = ahead_h
            assert cell.wait(lock.position)
            stamps.append(lock.position.stamp_ns)
    assert stamps == sorted(set(stamps))


def test_close_twice_is_harmless(cell):
    """A closed cell may be closed again."""
    cell.close()
    cell.close()


def test_a_cell_and_what_was_made_from_it_are_not_pickled(cell, online):
    """`multiprocessing` with "spawn" tries to, and named an object of the interpreter."""
    for made in (cell, online, View(online, bench, COUNT)):
        with pytest.raises(MisuseError, match="let the other process connect by itself"):
            pickle.dumps(made)


def test_a_type_that_no_datum_can_have_is_refused_with_the_name_of_the_aspect(online):
    """A lock may have many."""
    with pytest.raises(DatumTypeError, match="aspect 'tags': set: set cannot be a datum"):
        Lock(Write(online, bench, COUNT), Write(online, bench, Aspect("tags", set))).__enter__()


def test_two_cells_in_one_process_are_apart(cell, online):
    """Each cell has its data; one lock cannot name two; a thread holds one lock over both."""
    with local(worlds=["online"]) as other:
        there = other.world("online")
        there.init(bench, COUNT, 1)
        assert online.entities() == ()
        with pytest.raises(MisuseError, match="two connections"):
            Lock(Read(online, bench, COUNT), Read(there, bench, COUNT))
        with Lock(Read(online, bench, COUNT)), pytest.raises(LockHeldError):
            Lock(Read(there, bench, COUNT)).__enter__()


def test_wait_says_whether_a_position_is_visible(cell, online):
    """A committed position is visible at once; one in the future is not, in time."""
    count = Write(online, bench, COUNT)
    with Lock(count) as lock:
        lock[count] = 1
    assert cell.wait(lock.position)
    far = Position(lock.position.stamp_ns + 3600 * 10**9, lock.position.shard)
    assert not cell.wait(far, timeout_s=0.05)


def test_wait_refuses_what_is_no_position_of_the_cell(cell, online):
    """A lock that wrote nothing has no position to wait for; an unknown shard has none either."""
    with Lock(Read(online, bench, COUNT)) as lock:
        pass
    for position in (lock.position, Position(1, "elsewhere")):
        with pytest.raises(MisuseError, match="no position of cell"):
            cell.wait(position)


def test_locks_show_holder_and_waiter(cell, online):
    """Who holds, who waits for whom, how, and for how long it may last."""
    waiting = threading.Thread(target=lambda: Lock(Read(online, bench, COUNT)).__enter__())
    with Lock(Write(online, bench, COUNT), hold_s=600.0):
        waiting.start()
        while len(cell.locks()) < 2:
            assert waiting.is_alive()
        holder, waiter = cell.locks()
    waiting.join()
    assert (holder.granted, holder.modes, holder.waits_for) == (True, "write", ())
    assert (waiter.granted, waiter.modes, waiter.waits_for) == (False, "read", (holder.number,))
    assert holder.slots == ("online:work_bench/count (write)",)
    assert holder.pid == waiter.pid > 0
    assert 500.0 < holder.hold_left_s <= 600.0


def test_break_lock_tells_whether_there_was_one(cell, online):
    """An unknown number breaks nothing; an unknown shard is a misuse that lists those known."""
    assert cell.break_lock(12345, shard="local") is None
    with pytest.raises(MisuseError, match="it has local"):
        cell.break_lock(1, shard="elsewhere")


def test_shards_show_what_a_shard_is_doing(cell, online):
    """Slots, bytes, sessions, locks and counters come from the shard itself."""
    online.init(bench, COUNT, 1)
    online.init(piece, Aspect("name", bytes), bytes(1000))
    with Lock(Read(online, bench, COUNT)):
        shard = cell.shards()[0]
    assert (shard.name, shard.reachable, shard.open) == ("local", True, True)
    assert (shard.slots, shard.sessions, shard.locks) == (2, 1, 1)
    assert shard.size_bytes >= 1000
    assert shard.counters["commits"] == 2
    assert abs(shard.clock_ahead_s) < 30.0


@pytest.mark.carrier("local")
def test_actors_show_the_newest_report(cell):
    """A report reaches the shard at once where that is in the process."""
    cell._client.set_report(msgpack.packb({"updates": 3}))
    cell._client.set_report(msgpack.packb({"updates": 4}))
    (actor,) = cell.actors()
    assert actor.report == {"updates": 4}
    assert actor.shards == ("local",)
    assert actor.lease_left_s > 0


@pytest.mark.parametrize("report", [b"\xc1", b"\x93\x01", msgpack.packb([1, 2]), b"\x81\xa1a"])
def test_actors_are_listed_when_a_report_cannot_be_read(cell, report):
    """Any client may send anything as its report; the list stays readable."""
    cell._client.set_report(report)
    assert [actor.report for actor in cell.actors()] == [{}]


@pytest.mark.carrier("local")
def test_report_that_a_shard_would_leave_out_is_refused(cell):
    """The error names the size and the limit; the report before it stays."""
    cell._client.set_report(msgpack.packb({"updates": 3}))
    with pytest.raises(MisuseError, match="4097 bytes; at most 4096"):
        cell._client.set_report(bytes(4097))
    assert [actor.report for actor in cell.actors()] == [{"updates": 3}]


def test_set_report_is_quiet_when_cell_is_closed(cell):
    """A last report after the end is no error."""
    cell.close()
    cell._client.set_report(b"\x80")


def test_aspects_show_types_and_durability(cell, online):
    """The catalogue names each aspect's type; in memory everything is volatile."""
    online.init(bench, COUNT, 1)
    assert cell.aspects()[0].type == "int"


@pytest.mark.parametrize(
    "target",
    [
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:",
        "tcp/:7447",
        "tcp/127.0.0.1:x",
        "tcp/127.0.0.1:99999",
        "tpc/127.0.0.1:7447",
        "127.0.0.1:7447",
        "tcp://127.0.0.1:7447",
        "",
    ],
)
def test_connect_says_what_an_endpoint_looks_like_when_it_gets_none(target):
    """A mistyped endpoint is refused at once, with one that is right."""
    with pytest.raises(ConfigError, match="tcp/host:7447"):
        connect(target)


def test_connect_names_the_endpoint_when_nobody_listens():
    """Nobody there: the error comes in time and names what was asked."""
    with pytest.raises(ShardUnreachableError, match=r"127.0.0.1:9 .*waited 0.2 s"):
        connect("tcp/127.0.0.1:9", timeout_s=0.2)


@pytest.mark.parametrize("word", ["timeout_s", "request_timeout_s"])
@pytest.mark.parametrize("waits_s", [-1.0, float("nan")])
def test_connect_refuses_what_is_no_time(word, waits_s):
    """Before anything is asked: a wait that is no number would never end, or at once."""
    with pytest.raises(MisuseError, match=f"{word} is .*must be 0 or more seconds"):
        connect("tcp/127.0.0.1:9", **{word: waits_s})


@pytest.mark.parametrize(
    ("datum_type", "datum", "least"),
    [
        (int, 1 << 40, 0),
        (float, 1.5, 0),
        (str, "x" * 256, 0),
        (bytes, b"x" * 256, 0),
        (list[int], list(range(100)), 0),
        (str, "x" * 257, 257),
        (bytes, b"x" * 257, 257),
        (list[int], list(range(10_000)), 10_000),
        (np.ndarray, np.zeros(3), 24),
    ],
)
def test_bytes_of_data_are_those_of_their_bodies(cell, datum_type, datum, least):
    """As the metrics and `enact shard ls` say: arrays, what is longer than 256 B, long lists."""
    before = cell.shards()[0]
    online, aspect = cell.world("online"), Aspect("datum", datum_type)
    online.init(piece, aspect, datum)
    after = cell.shards()[0]

    found = after.size_bytes - before.size_bytes
    written = after.counters.get("bytes_written", 0) - before.counters.get("bytes_written", 0)
    assert found == written == online.list_slots()[0].size_bytes
    assert (found >= least) if least else (found == 0)
