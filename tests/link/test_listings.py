"""Long listings reach people over either carrier, and what cannot be sent is refused by name."""

import threading

import msgpack
import pytest

from enact_dist import Aspect, Durability, Entities, Entity, Lock, WriteEach, connect
from enact_dist.core.protocol import pages
from enact_dist.core.protocol.datum import LockId, Position, Slot
from enact_dist.core.protocol.messages import (
    Alive,
    AwaitStamp,
    Hello,
    KeepAlive,
    KeepVersions,
    Kept,
    OutcomeIs,
    Refused,
    SlotVersion,
    Welcome,
)
from enact_dist.core.protocol.records import Reply
from enact_dist.errors import MisuseError
from enact_dist.link.daemon.health import of_endpoint
from enact_dist.wire import frames

SESSIONS = 300
both = pytest.mark.carrier("socket", "zenoh")


def asked(shard, message):
    answers = []
    shard.host.submit(message, answers.append)
    return answers[0]


def crowd(shard, report):
    """Open sessions of actors that give such a report."""
    for number in range(SESSIONS):
        session = f"session{number:03}"
        hello = Hello(session, 0, 60_000_000_000, f"actor{number:03}", "host", 1, True)
        assert isinstance(asked(shard, hello), Welcome)
        assert isinstance(asked(shard, KeepAlive(session, shard.host.epoch, 1, (), report)), Alive)


@both
def test_shard_with_many_long_reports_answers_whoever_looks(daemon, endpoint):
    """What `actor ls`, `shard ls` and `shard check` ask, with 19 MB of reports at the shard."""
    shard = daemon(endpoint)
    crowd(shard, msgpack.packb({"actors": [{"name": "a" * 65_000, "state": "running"}]}))

    with connect(endpoint, observer=True) as cell:
        actors, (info,) = cell.actors(), cell.shards()
        (health,) = of_endpoint(endpoint, None, timeout_s=30.0)

    names = [actor.actor for actor in actors if actor.host == "host"]
    assert names == [f"actor{number:03}" for number in range(SESSIONS)]
    assert (info.reachable, info.sessions >= SESSIONS, health.ready) == (True, True, True)


@both
def test_listing_of_several_pages_is_whole(daemon, endpoint, monkeypatch):
    """Reports of 4 kB are shown as they are, on as many pages as that takes."""
    monkeypatch.setattr(pages, "PAGE_BYTES_MAX", 100_000)
    shard = daemon(endpoint)
    report = {"actors": [{"name": "a" * 4_000, "state": "running"}]}
    crowd(shard, msgpack.packb(report))

    with connect(endpoint, observer=True) as cell:
        actors, (info,) = cell.actors(), cell.shards()

    assert [actor.report for actor in actors if actor.host == "host"] == [report] * SESSIONS
    assert info.sessions >= SESSIONS


SLOT = Slot("online", "e" * 200, "a" * 200)
LONG = OutcomeIs(
    LockId("session", 0, 1), 1, "committed", Position(1, "s0"), (SlotVersion(SLOT, 1),) * 60_000
)


@pytest.mark.parametrize("carry", ["socket", "zenoh"], indirect=True)
@pytest.mark.parametrize("brought", ["at once", "later"])
def test_answer_that_cannot_be_sent_is_refused_by_name(
    daemon, carry, endpoint, monkeypatch, brought
):
    """A dropped one looks like a dead shard, and is asked for again and again."""
    host = daemon(endpoint).host
    carrier = carry(endpoint)

    def answer(_message, reply_to):
        if brought == "at once":
            yield Reply(reply_to, LONG)
        else:
            threading.Timer(0.05, lambda: host._replies.pop(reply_to)(LONG)).start()

    monkeypatch.setitem(host._shard._handlers, AwaitStamp, answer)

    found = carrier.request("s0", AwaitStamp(1, 0), timeout_s=30.0)

    assert isinstance(found, Refused)
    assert found.code == "too_long"
    assert "OutcomeIs has a header of" in found.text
    assert host._shard.counters["answers_refused"] == 1


@both
def test_lock_that_shows_more_than_an_answer_holds_is_refused_and_held_by_nobody(
    daemon, endpoint, monkeypatch
):
    """The shard has granted it: the refusal must give it back."""
    count = Aspect("count", int, Durability.VOLATILE)
    daemon(endpoint)
    with connect(endpoint) as cell:
        online = cell.world("online")
        for number in range(60):
            online.init(Entity(f"tray/{number:0100}"), count, number)
        with monkeypatch.context() as short:
            short.setattr(frames, "HEADER_BYTES_MAX", 5_000)
            with pytest.raises(
                MisuseError, match=r"Granted has a header of .* ask for less at once"
            ):
                Lock(WriteEach(online, Entities("tray/*"), count), wait_s=30.0).__enter__()

        assert cell.locks() == ()


@both
def test_label_that_keeps_more_than_a_page_is_told_whole(daemon, endpoint, monkeypatch):
    """One answer with all of it would outgrow a frame."""
    count = Aspect("count", int, Durability.VOLATILE)
    daemon(endpoint)
    monkeypatch.setattr(pages, "WORK_MAX", 3)
    sent = []
    with connect(endpoint) as cell:
        online = cell.world("online")
        for number in range(8):
            online.init(Entity(f"tray/{number}"), count, number)
        versions = [one for n in range(8) for one in online.history(Entity(f"tray/{n}"), count)]
        cell.pin("all", versions)
        asked = [SlotVersion(one.slot, one.version) for one in versions]
        client = cell._client
        take = client.carrier.request

        def counted(shard, message, *, timeout_s):
            answer = take(shard, message, timeout_s=timeout_s)
            sent.append(len(answer.versions))
            return answer

        monkeypatch.setattr(client.carrier, "request", counted)
        epoch, number = client.core.epoch("s0"), client.core.sendings.next(client._now_ns())
        again = KeepVersions(client.core.session, "all", tuple(asked[:1]), epoch, number)
        kept = client.call("s0", again)
        monkeypatch.undo()

    assert sent == [3, 3, 2]
    assert kept == Kept(tuple(asked), ())
