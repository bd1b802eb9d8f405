"""A client of two real shards in this process: one away, restarted, started wrongly, or mute."""

import socket
import threading
import time

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, View, Write, connect
from enact_dist.core.protocol.messages import ListSessions, Pin, PlacementMap, ShardEntry
from enact_dist.core.shard import owners
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import LinkError, MisuseError, ProtocolError, ShardUnreachableError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings

COUNT = Aspect("count", int, Durability.VOLATILE)
KEPT = Aspect("kept", int)
here, there = Entity("a/1"), Entity("b/1")


class TwoShards:
    """Shards `a` and `b`, with the entities a/** and b/**; each can be stopped and started."""

    def __init__(self, endpoints, folder=None):
        self.endpoints = dict(zip("ab", endpoints, strict=True))
        self.folder = folder
        self.running = {}

    def placement(self, version=1):
        shards = tuple(ShardEntry(name, (at,)) for name, at in self.endpoints.items())
        return PlacementMap(version, shards, (Pin("a/**", "a"), Pin("b/**", "b")))

    def start(self, name, *, version=1):
        shard = ShardSettings(name, self.placement(version), worlds=("online",))
        folder = self.folder / name if self.folder else None
        settings = DaemonSettings("cell", shard, (self.endpoints[name],), folder)
        self.running[name] = start_shard(settings)

    def restart(self, name):
        self.running.pop(name).stop(drain_s=0.0)
        self.start(name)

    def connect(self, **options):
        return connect(self.endpoints["a"], actor="tester", **options)

    def sessions(self, name):
        return list(self.running[name].host._shard.state.sessions)


@pytest.fixture
def two(free):
    shards = TwoShards((free(), free()))
    yield shards
    for shard in shards.running.values():
        shard.stop(drain_s=0.0)


@pytest.fixture
def kept(free, tmp_path):
    shards = TwoShards((free(), free()), tmp_path)
    yield shards
    for shard in shards.running.values():
        shard.stop(drain_s=0.0)


def add_one(world, entity, aspect=COUNT, **options):
    request = Write(world, entity, aspect)
    with Lock(request, **options) as lock:
        lock[request] = lock.get(request, 0) + 1
    return lock


def test_client_locks_on_a_living_shard_when_another_is_away(two):
    """A shard that is down stops only what lies on it, and is named with its endpoint."""
    two.start("a")
    with two.connect() as cell:
        online = cell.world("online")
        add_one(online, here)
        assert online.view(View(online, here, COUNT))[View(online, here, COUNT)] == 1
        with pytest.raises(ShardUnreachableError, match=f"b at {two.endpoints['b']}") as caught:
            add_one(online, there, wait_s=0.2)
        assert (caught.value.shard, caught.value.endpoint) == ("b", two.endpoints["b"])
        assert [shard.reachable for shard in cell.shards()] == [True, False]
        two.start("b")
        add_one(online, there)


@pytest.mark.carrier("socket", "zenoh", "auto")
def test_a_shard_that_was_started_again_is_no_line_in_a_client_s_log(kept, caplog):
    """Its connections ended and came again, as they should: nobody has to do anything."""
    kept.start("a")
    kept.start("b")
    caplog.set_level("INFO", logger="enact")
    with kept.connect() as cell, cell.world("online").watch("**") as watch:
        add_one(cell.world("online"), there, KEPT)
        kept.restart("b")
        add_one(cell.world("online"), there, KEPT)
        assert [watch.next(30.0).version for _ in range(2)] == [1, 2]

    assert [line.getMessage() for line in caplog.records if line.name == "enact.link"] == []


def test_silent_shard_is_waited_for_once_while_all_are_listed(two, monkeypatch):
    """It is greeted and asked at once; one that is known already is only asked."""
    two.start("a")
    with two.connect() as cell:
        asked = []
        send = cell._client.carrier.request_all

        def request_all(calls, **options):
            if any(isinstance(message, ListSessions) for _, message in calls):
                asked.append([(shard, type(message).__name__) for shard, message in calls])
            return send(calls, **options)

        monkeypatch.setattr(cell._client.carrier, "request_all", request_all)
        assert [shard.reachable for shard in cell.shards()] == [True, False]

    assert asked == [[("a", "ListSessions")], [("b", "Hello"), ("b", "ListSessions")]]


@pytest.mark.carrier("auto")
def test_way_to_a_shard_is_that_of_the_next_lock_on_it(two, until):
    """A shard that is away has told nothing; one that is back is met before its way is told."""
    two.start("a")
    with two.connect(observer=True) as cell:
        assert [shard.reachable for shard in cell.shards()] == [True, False]
        untold = cell._client.carrier.transport_of("b")
        two.start("b")

        assert untold == "zenoh (the shard has not welcomed us yet)"
        until(lambda: [shard.carrier for shard in cell.shards()] == ["socket", "socket"])


@pytest.mark.carrier("auto")
@pytest.mark.parametrize("without", ["a", "b"])
def test_forced_socket_that_one_shard_has_not_ends_only_what_lies_there(two, monkeypatch, without):
    """All are listed, that one with its reason, whoever answers first; locks go on elsewhere."""
    other = {"a": "b", "b": "a"}[without]
    for name in "ab":
        two.start(name)
    (two.running[without]._shared.path / "socket").unlink()
    monkeypatch.setenv("ENACT_CARRIER", "socket")

    with two.connect() as cell:
        shards = {shard.name: shard for shard in cell.shards()}
        again = {shard.name: shard for shard in cell.shards()}
        lies = {"a": here, "b": there}
        add_one(cell.world("online"), lies[other])
        with pytest.raises(LinkError, match=f"that of shard {without} cannot be used"):
            add_one(cell.world("online"), lies[without])

        assert shards[other].reachable
        assert shards[other].carrier == "socket"
        assert (shards[other].problem, shards[without].reachable) == ("", False)
        assert f"that of shard {without} cannot be used: it offers none" in shards[without].problem
        assert again[without].problem == shards[without].problem


def test_client_registers_its_aspects_again_when_a_shard_forgot_them(two):
    """A shard without a folder restarts empty; locks that name known aspects go on, unwaiting."""
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        add_one(online, there)
        two.restart("b")
        add_one(online, there)
        add_one(online, there, wait_s=0)
        view = View(online, there, COUNT)
        assert online.view(view)[view] == 2


def test_lock_over_two_shards_is_asked_once_when_wait_is_zero(two):
    """wait_s=0 takes all shards of a lock, each asked once."""
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        read, write = Read(online, here, COUNT), Write(online, there, COUNT)
        with Lock(read, write, wait_s=0) as lock:
            lock[write] = lock.get(read, 0) + 5
        assert lock.statistics().shards == ("a", "b")


def test_lock_is_taken_anew_when_a_part_is_lost_while_it_waits(two, until):
    """Lost on the first shard while queued at the second: both are asked again, none is left."""
    two.start("a")
    two.start("b")
    with two.connect() as cell, two.connect() as other:
        online, elsewhere = cell.world("online"), other.world("online")
        read, write = Read(online, here, COUNT), Write(online, there, COUNT)
        done = []

        def work():
            with Lock(read, write, wait_s=20.0) as lock:
                lock[write] = 7
                done.append(lock)

        waiter = threading.Thread(target=work)
        with Lock(Write(elsewhere, there, COUNT)):
            waiter.start()
            until(lambda: len(cell.locks()) == 3)
            first = next(info for info in cell.locks() if info.shard == "a")
            cell.break_lock(first.number, shard="a", reason="test")
            again = until(
                lambda: [
                    info
                    for info in cell.locks()
                    if info.shard == "a" and info.lock_id != first.lock_id and info.granted
                ]
            )
            assert len(again) == 1
        waiter.join()
        assert done
        assert cell.locks() == ()


def test_client_says_that_shards_disagree_when_their_placements_differ(two):
    """Two shards of two cell.toml files: the error says so instead of waiting for a grant."""
    two.start("a")
    two.start("b", version=2)
    with two.connect() as cell:
        online = cell.world("online")
        read, write = Read(online, here, COUNT), Write(online, there, COUNT)
        with pytest.raises(LinkError, match=r"different cell\.toml"):
            Lock(read, write, wait_s=1.0).__enter__()
        assert cell.locks() == ()


def test_keep_alives_go_on_after_an_answer_that_cannot_be_read(two, monkeypatch):
    """One bad answer is counted; the session is renewed all the same."""
    two.start("a")
    with two.connect() as cell:
        client = cell._client
        request_all = client.carrier.request_all
        went_on = threading.Event()
        failing = iter([True])

        def bad_once(*arguments, **options):
            if next(failing, False):
                raise ProtocolError("garbage")
            went_on.set()
            return request_all(*arguments, **options)

        monkeypatch.setattr(client.core, "ttl_ns", 100_000_000)
        monkeypatch.setattr(client.carrier, "request_all", bad_once)
        assert went_on.wait(30.0)
        assert cell.statistics()["keep_alives_failed"] == 1


def test_watch_tells_what_a_shard_without_folder_lost_when_it_restarted(two):
    """Slots that a restarted shard knows no more are told as null, then what comes anew."""
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        for entity in (here, there, Entity("b/2")):
            add_one(online, entity)
        with online.watch("**", COUNT) as watch:
            assert {watch.next(30.0).entity.name for _ in range(3)} == {"a/1", "b/1", "b/2"}
            two.restart("b")
            add_one(online, there)
            told = [watch.next(30.0) for _ in range(2)]
            assert {(c.entity.name, c.null) for c in told} == {("b/1", False), ("b/2", True)}
            add_one(online, here)
            assert watch.next(30.0).version == 2


@pytest.mark.parametrize("aspect", [COUNT, KEPT], ids=["volatile", "durable"])
def test_watch_tells_a_gap_where_versions_began_anew_at_the_next_number(two, aspect):
    """Version 2 of a restarted shard is no successor of version 1 of before: 1 was missed.

    A shard without a folder keeps nothing of a durable aspect either.
    """
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        add_one(online, there, aspect)
        with online.watch("**", aspect) as watch:
            assert watch.next(30.0).version == 1
            two.restart("b")
            add_one(online, there, aspect)
            add_one(online, there, aspect)
            change = watch.next(30.0)
            assert (change.version, change.gap, change.null) == (2, 1, False)
            assert watch.missed == 1
            add_one(online, there, aspect)
            assert (watch.next(30.0).gap, watch.missed) == (0, 1)


def test_watch_tells_that_it_may_have_missed_what_a_restart_took_along(two):
    """What was committed last before a restart may have been seen by nobody: that is a gap."""
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        add_one(online, there)
        with online.watch("**", COUNT) as watch:
            assert watch.next(30.0).version == 1
            two.restart("b")
            add_one(online, there)
            change = watch.next(30.0)
            assert (change.version, change.gap, change.null) == (1, 1, False)


def test_watch_tells_a_gap_of_a_volatile_aspect_on_a_shard_that_keeps_others(kept):
    """The epoch of a shard with a folder says nothing of its volatile slots."""
    kept.start("a")
    kept.start("b")
    with kept.connect() as cell:
        online = cell.world("online")
        add_one(online, there)
        with online.watch("**", COUNT) as watch:
            assert watch.next(30.0).version == 1
            kept.restart("b")
            add_one(online, there)
            add_one(online, there)
            change = watch.next(30.0)
            assert (change.version, change.gap) == (2, 1)


def test_watch_keeps_durable_slots_over_a_restart_of_their_shard(kept):
    """What a restarted shard still has is no change; what follows is, without a gap."""
    kept.start("a")
    kept.start("b")
    with kept.connect() as cell:
        online = cell.world("online")
        add_one(online, there, KEPT)
        with online.watch("**", KEPT) as watch:
            assert watch.next(30.0).version == 1
            kept.restart("b")
            add_one(online, there, KEPT)
            change = watch.next(30.0)
            assert (change.version, change.gap, change.null) == (2, 0, False)


def test_goodbye_leaves_nothing_to_wait_for_when_the_shard_restarts(kept):
    """A closed connection's session is gone from the disk: the next start has no grace."""
    kept.start("a")
    kept.start("b")
    with kept.connect() as cell:
        online = cell.world("online")
        add_one(online, here, KEPT)
        add_one(online, there, KEPT)
    for name in "ab":
        kept.restart(name)
        assert kept.sessions(name) == []
        assert not kept.running[name].host._shard.state.sessions.in_grace(time.monotonic_ns())


LEFT_OPEN = """
import sys
from enact_dist import *
online = connect(sys.argv[1]).world("online")
online.init(Entity("a/9"), Aspect("count", int, Durability.VOLATILE), 1)
"""


def test_process_says_goodbye_when_it_never_closed_its_cell(two, program):
    """A cell that nobody closed is closed at the interpreter's exit, over a living connection."""
    two.start("a")
    process = program(LEFT_OPEN, two.endpoints["a"])
    assert process.communicate(timeout=180) == ("", "")
    assert two.sessions("a") == []


def test_observer_is_told_that_it_cannot_lock(two):
    """An observing connection views, and its lock is a misuse that says what to change."""
    two.start("a")
    with two.connect(observer=True) as cell:
        online = cell.world("online")
        assert online.view(View(online, here, COUNT)).get(View(online, here, COUNT)) is None
        with pytest.raises(MisuseError, match="observer=True"):
            add_one(online, here)


def test_shard_that_refuses_the_greeting_is_asked_once_and_its_reason_told(two, monkeypatch):
    """Asked again and again without a pause it would have no time for the others."""
    two.start("a")
    two.start("b")
    with two.connect() as cell:
        online = cell.world("online")
        monkeypatch.setattr(owners, "SESSIONS_MAX", 0)
        refused = pytest.raises(LinkError, match="has 0 sessions at this shard")
        with refused, Lock(Write(online, there, COUNT)):
            pass
        counters = two.running["b"].host._shard.counters

    assert counters["quota_refused"] == 1


def test_connect_gives_up_in_time_when_the_peer_is_mute():
    """Something listens and never speaks: the wait is the one that was asked for."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        started_s = time.monotonic()
        with pytest.raises(ShardUnreachableError, match=endpoint):
            connect(endpoint, timeout_s=0.3)
        assert time.monotonic() - started_s < 20.0
