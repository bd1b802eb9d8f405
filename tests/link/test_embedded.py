"""The embedded carrier: a call is a function call, with the manners of a network."""

import os
import threading

import pytest

from enact_dist.core.protocol.messages import Granted, ListLocks, ListSessions, Locks
from enact_dist.errors import MisuseError, ShardUnreachableError
from enact_dist.link.daemon.embedded import EmbeddedCarrier
from enact_dist.link.opening import open_host
from enact_dist.link.store.store import Store


@pytest.fixture
def host(make_settings):
    opened = open_host(make_settings(), None)
    yield opened
    opened.close()


@pytest.fixture
def embedded(host):
    opened = EmbeddedCarrier(host, "me")
    yield opened
    opened.close()


def test_carrier_answers_all_requests_in_their_order(embedded, make_peer):
    """Answers come in the order of the requests, whatever was parked between."""
    peer = make_peer(lambda shard, message: embedded.request(shard, message, timeout_s=5))
    peer.hello()
    peer.acquire("cup")
    waiter = make_peer(peer.call)
    waiter.hello()

    answers = embedded.request_all(
        [("s0", ListLocks()), ("s0", waiter.acquire_message("cup", wait_s=9)), ("s0", ListLocks())],
        timeout_s=0.05,
    )

    assert [type(answer) for answer in answers] == [Locks, type(None), Locks]


def test_carrier_waits_for_a_parked_answer_from_another_thread(embedded, make_peer):
    """A request in one thread is answered when another thread releases what it waits for."""
    call = lambda shard, message: embedded.request(shard, message, timeout_s=61)  # noqa: E731
    holder, waiter = make_peer(call), make_peer(call)
    holder.hello()
    waiter.hello()
    granted = holder.acquire("cup")
    answers = []
    thread = threading.Thread(target=lambda: answers.append(waiter.acquire("cup", wait_s=60.0)))
    thread.start()

    holder.commit(granted, "cup", b"1")
    thread.join(90)

    assert [type(answer) for answer in answers] == [Granted]


@pytest.mark.parametrize("in_main", [True, False], ids=["main thread", "thread"])
def test_carrier_gives_up_a_commit_in_time_while_the_disk_stands_still(
    make_settings, make_peer, tmp_path, monkeypatch, in_main
):
    """The calling thread never writes itself: the disk may take longer than the call may."""
    host = open_host(make_settings(durability="durable"), tmp_path)
    goes_on, write = threading.Event(), Store.write
    embedded = EmbeddedCarrier(host, "me")
    peer = make_peer(lambda _, asked: embedded.request("s0", asked, timeout_s=20.0))
    peer.hello()
    granted = peer.acquire("cup")
    answers = []

    def commit():
        peer.call = lambda _, asked: embedded.request("s0", asked, timeout_s=0.05)
        answers.append(peer.commit(granted, "cup", b"x"))

    monkeypatch.setattr(
        Store, "write", lambda store, batch: goes_on.wait(20.0) and write(store, batch)
    )
    try:
        if in_main:
            commit()
        else:
            thread = threading.Thread(target=commit)
            thread.start()
            thread.join(10.0)
        assert answers == [None]
    finally:
        goes_on.set()
        host.close()


def test_carrier_shows_its_session_as_present_until_it_is_closed(host, make_peer):
    """The token of an embedded session is there as long as its carrier is open."""
    embedded = EmbeddedCarrier(host, "me")
    watcher = EmbeddedCarrier(host, "watcher")
    peer = make_peer(
        lambda shard, message: embedded.request(shard, message, timeout_s=5), session="me"
    )
    peer.hello()

    def present():
        sessions = watcher.request("s0", ListSessions(), timeout_s=5).sessions
        return {info.session: info.token_present for info in sessions}["me"]

    before = present()
    embedded.close()

    assert before
    assert not present()


def test_carrier_refuses_a_shard_that_is_not_here(embedded):
    """A request for another shard is an error that names both, never an empty answer."""
    with pytest.raises(ShardUnreachableError, match=r"s9 is not in this process.*s0"):
        embedded.request("s9", ListLocks(), timeout_s=1)


def test_carrier_refuses_to_be_used_after_its_end(embedded):
    """A closed carrier says so."""
    embedded.close()

    with pytest.raises(MisuseError, match="closed"):
        embedded.request("s0", ListLocks(), timeout_s=1)


def test_carrier_feeds_notices_until_the_feed_is_closed(embedded, make_peer):
    """A feed has every commit; a closed feed gets none and the others go on."""
    peer = make_peer(lambda shard, message: embedded.request(shard, message, timeout_s=5))
    peer.hello()
    feed, closed = embedded.subscribe(), embedded.subscribe()
    closed.close()

    peer.write("cup", b"1")
    peer.write("tray", b"2")

    notices = [feed.get(5), feed.get(5)]
    assert [n.changes[0].slot.entity for n in notices] == ["cup", "tray"]
    assert feed.get(0) is None
    assert closed.get(0) is None


def test_carrier_raises_in_a_forked_child(embedded):
    """A child that uses its parent's cell is told so, and neither hangs nor answers."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            embedded.request("s0", ListLocks(), timeout_s=1)
            os.write(writer, b"answered")
        except MisuseError as error:
            os.write(writer, str(error).encode())
        finally:
            os._exit(0)
    os.close(writer)

    told = os.read(reader, 4096).decode()
    os.waitpid(child, 0)
    os.close(reader)

    assert "was forked" in told
