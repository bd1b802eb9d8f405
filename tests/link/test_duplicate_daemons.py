"""Two daemons under one shard's name: the later one, clients and the doctor see it."""

import logging
import queue
from types import SimpleNamespace

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.cli.shard.shard import _state
from enact_dist.config.rights import SecurityConfig
from enact_dist.core.protocol.messages import (
    ListPlaces,
    ListSessions,
    Pin,
    PlacementMap,
    Pong,
    Sessions,
    ShardEntry,
)
from enact_dist.core.protocol.records import Compare
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import LinkError
from enact_dist.link.client.duplicate_daemons import (
    Comparing,
    Doubts,
    Serving,
    moved_places,
    serving,
)
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.zenoh.discovery import FoundShard
from enact_dist.operate.doctor_cell import duplicate_daemons
from enact_dist.world.look import welcomes

COUNT = Aspect("count", int)
ASK_S = 10.0
"""A machine with much other work is waited for; the product has other clients to serve."""


@pytest.fixture
def begin(tmp_path, monkeypatch, carrier):
    """Start shards of a cell: `begin(name, listen, left=…, right=…)`; stopped after the test."""
    monkeypatch.setattr("enact_dist.link.daemon.second_daemon.PROBE_S", ASK_S)
    monkeypatch.setattr(Doubts, "ASK_S", ASK_S)
    monkeypatch.setattr(Doubts, "AGAIN_S", 0.0)
    monkeypatch.setattr(Comparing, "ASK_S", ASK_S)
    monkeypatch.setattr(Comparing, "AGAIN_S", 0.1)
    running = []

    def start(name, listen, **places):
        entries = tuple(ShardEntry(shard, (place,)) for shard, place in places.items())
        pins = (Pin("left/**", "left"), Pin("right/**", "right"))
        settings = ShardSettings(name, PlacementMap(1, entries, pins), worlds=("online",))
        folder = tmp_path / f"{name}-{len(running)}"
        daemon = DaemonSettings("cell", settings, (listen,), folder, carrier=carrier)
        running.append(start_shard(daemon))
        return running[-1]

    yield start
    for shard in running:
        shard.stop(drain_s=0.0)


def put(cell, entity, number):
    """Commit a number."""
    with Lock(write := Write(cell.world("online"), Entity(entity), COUNT), wait_s=30.0) as lock:
        lock[write] = number


def test_shards_that_start_show_nobody_who_is_not_there(begin, free):
    """A shard that starts asks those that run where they expect it; that is no client."""
    left, right = free(), free()
    first = begin("left", left, left=left, right=right)
    begin("right", right, left=left, right=right)
    answers = []

    first.host.submit(ListSessions(), answers.append)

    (answer,) = answers
    assert isinstance(answer, Sessions)
    assert answer.sessions == ()


def test_later_daemon_is_refused_where_other_shards_expect_the_first_one(begin, free):
    """It has another folder and another endpoint; no client would know which one it talks to."""
    first, second, right = free(), free(), free()
    begin("left", first, left=first, right=right)
    begin("right", right, left=first, right=right)

    with pytest.raises(LinkError, match=r"shard left of cell cell already runs") as refused:
        begin("left", second, left=second, right=right)

    assert first in str(refused.value)
    assert second in str(refused.value)


def test_shard_is_refused_beside_another_one_that_runs_twice(begin, free, monkeypatch):
    """Nobody listened at that time who could have told the second one."""
    first, second, right = free(), free(), free()
    begin("left", first, left=first, right=right)
    begin("left", second, left=second, right=right)
    third = free()
    with monkeypatch.context() as brief:
        brief.setattr("enact_dist.link.daemon.second_daemon.PROBE_S", 0.3)  # right never answers
        begin("third", third, left=second, right=right, third=third)

    with pytest.raises(LinkError, match=r"2 daemons serve shard left") as refused:
        begin("right", right, left=first, right=right, third=third)

    assert first in str(refused.value)
    assert second in str(refused.value)


def test_daemon_started_elsewhere_than_its_file_says_finds_the_one_there(begin, free):
    """A cell of one shard has nobody else to ask but its own `cell.toml`."""
    first, second = free(), free()
    begin("left", first, left=first)
    settings = ShardSettings("left", PlacementMap(1, (ShardEntry("left", (second,)),), ()))

    with pytest.raises(LinkError, match="already runs"):
        start_shard(DaemonSettings("cell", settings, (second,), written=(first,)))


def test_same_daemon_at_another_address_is_no_second_one(begin, free):
    """A restart at another address, and a host with two, go on as before."""
    first, right = free(), free()
    other = first.replace("127.0.0.1", "localhost")
    begin("left", first, left=first, right=right)
    begin("right", right, left=other, right=right)
    with connect(first) as cell:
        put(cell, "left/a", 1)
        put(cell, "right/a", 1)
        put(cell, "left/a", 2)
        assert "shards_doubted" not in cell.statistics()
        assert list(duplicate_daemons("cell", None, welcomes(cell))) == []
    assert len(serving("cell", "left", (first, other), timeout_s=ASK_S)) == 1


def test_client_that_hears_of_a_second_daemon_trusts_neither(begin, free):
    """Its error names both and what to do; once one of them is gone the other is trusted."""
    first, second, right = free(), free(), free()
    begin("left", first, left=first, right=right)
    impostor = begin("left", second, left=second, right=right)
    begin("right", right, left=second, right=right)
    with connect(first) as cell:
        with pytest.raises(LinkError, match=r"2 daemons serve shard left") as refused:
            for number in range(3):  # the first one brings the welcome of the other shard
                put(cell, "right/a", number)
                put(cell, "left/a", number)
        assert first in str(refused.value)
        assert second in str(refused.value)
        assert cell.statistics()["shards_doubted"] == 1
        (finding,) = duplicate_daemons("cell", None, welcomes(cell))
        assert (finding.subject, first in finding.text, second in finding.text) == (
            "shard left",
            True,
            True,
        )
        put(cell, "right/a", 7)  # the other shards go on

        impostor.stop(drain_s=0.0)

        put(cell, "left/a", 8)


def test_doctor_asks_at_each_place_that_file_and_shards_name(begin, free):
    """A copy of the cell with another endpoint is seen by whoever has its file."""
    first, second = free(), free()
    begin("left", first, left=first)
    begin("left", second, left=second)
    file = SimpleNamespace(
        security=SecurityConfig(),
        placement_map=lambda: PlacementMap(1, (ShardEntry("left", (second,)),), ()),
    )
    with connect(first) as cell:
        (finding,) = duplicate_daemons("cell", file, welcomes(cell))
    assert "stop all but the one whose data you want to keep" in finding.remedy


def test_only_places_that_share_nothing_are_looked_into():
    """A shard with an address in common is the same one."""
    known = {"a": ["x"], "b": ["x", "y"], "c": ["x"], "d": [], "e": ["x"]}
    told = {"a": ["z"], "b": ["y", "z"], "c": [], "d": ["x"], "f": ["x"]}
    assert moved_places(known, told.items()) == {"a": ["x", "z"]}


def test_all_places_that_others_name_are_looked_into():
    """One shard expects it elsewhere and has heard of a third place; another knows a fourth."""
    told = (("a", ["y"]), ("a", ["z"]), ("a", ["y", "w"]))
    assert moved_places({"a": ["x"]}, told) == {"a": ["x", "y", "z", "w"]}


def test_places_that_cannot_be_do_not_keep_the_others_from_being_asked(begin, free):
    """Somebody has named them; who serves at the others is known all the same."""
    first, second = free(), free()
    begin("left", first, left=first)
    begin("left", second, left=second)
    nowhere = ("garbage", "", "foo/127.0.0.1:5", "tcp/127.0.0.1:99999", "tcp/127.0.0.1:1#a=b;c")

    found = serving("cell", "left", (*nowhere, first, second), timeout_s=ASK_S)

    assert len(found) == 2


def test_daemon_that_restarts_between_two_questions_is_one(monkeypatch):
    """It has two addresses, and answered at the first one before it ended."""
    starts = iter((1, 2, 2, 2))
    shard = FoundShard("cell", "left")

    def ask(*_, **__):
        return {shard: Pong("left", 1, True, "", 0, next(starts))}

    monkeypatch.setattr("enact_dist.link.client.duplicate_daemons.somebody_listens", lambda _: True)
    monkeypatch.setattr("enact_dist.link.client.duplicate_daemons.ask_shards", ask)

    found = serving("cell", "left", ("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"), timeout_s=ASK_S)

    assert [one.start for one in found] == [2]


def test_shard_that_ran_twice_is_asked_about_after_one_of_them_was_silent(monkeypatch):
    """One that was stopped or slow is back without a word of it; the alarm is back with it."""
    both = tuple(Serving(place, start, 1, 1.0) for start, place in enumerate(("x", "y")))
    answers = iter((both, both[:1], both[:1], both))
    monkeypatch.setattr(Comparing, "AGAIN_S", 0.01)
    monkeypatch.setattr(Comparing, "LATER_S", 0.01)
    monkeypatch.setattr(
        "enact_dist.link.client.duplicate_daemons.serving", lambda *_, **__: next(answers, both)
    )
    told = queue.SimpleQueue()
    comparing = Comparing("cell", told.put)
    try:
        comparing.submit(Compare("left", ("x", "y")))
        starts = [told.get(timeout=30.0).starts for _ in range(4)]
    finally:
        comparing.close()

    assert starts == [(0, 1), (0,), (0,), (0, 1)]


def places(shard):
    """Return where a running shard, and those that talk to it, expect each shard."""
    answers = []
    shard.host.submit(ListPlaces(), answers.append)
    return answers[0].shards


def alarms(shard):
    """Return how many shards a running shard holds for doubled, and how often it found one so."""
    answers = []
    shard.host.submit(ListSessions(), answers.append)
    counters = dict(answers[0].counters)
    return counters.get("namesakes", 0), counters.get("namesakes_found", 0)


def test_running_shards_notice_a_daemon_that_comes_back_beside_its_successor(
    begin, free, until, caplog
):
    """A shard was lost and begun elsewhere; then the lost one is back, where nobody was asked."""
    first, second, right = free(), free(), free()
    running = begin("right", right, left=first, right=right)
    successor = begin("left", second, left=second, right=right)
    until(lambda: second in str(places(running)))
    assert alarms(running) == (0, 0)  # it may have moved: nobody serves at its first place

    with pytest.raises(LinkError, match="already runs"):
        begin("left", first, left=first, right=right)
    begin("left", first, left=first)  # its file names no other shard: it asks nobody

    until(lambda: alarms(running) == (1, 1))
    told = [one for one in caplog.records if "daemons serve shard left" in one.getMessage()]
    assert told[0].levelno >= logging.ERROR
    assert first in told[0].getMessage()
    assert second in told[0].getMessage()
    with connect(right) as cell:
        (shown,) = [shard for shard in cell.shards() if shard.name == "right"]
        assert "SHARDS RUNNING TWICE: 1" in _state(shown)
    entries = (ShardEntry("left", (first,)), ShardEntry("right", (right,)))
    file = SimpleNamespace(
        placement_map=lambda: PlacementMap(1, entries, ()), security=SecurityConfig()
    )
    (finding,) = duplicate_daemons("cell", file, {})
    assert (finding.subject, second in finding.text) == ("shard left", True)

    successor.stop(drain_s=0.0)

    until(lambda: alarms(running) == (0, 1))
