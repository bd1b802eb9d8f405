"""Notices that fell back to Zenoh come back to the socket: none is lost, none comes twice."""

import threading

import pytest
from socket_parts import over_socket, speak

from enact_dist.core.protocol.messages import Alive, KeepAlive
from enact_dist.link.socket import feed as socket_feed
from enact_dist.link.socket.line import SocketLine

pytestmark = pytest.mark.carrier("auto")  # both are used at once


def alive(carrier, peer):
    """Give a sign of life, as a session does by itself some times per TTL."""
    request = KeepAlive(peer.session, peer.epoch, 1, (), b"")
    (answer,) = carrier.request_all([("s0", request)], timeout_s=30)
    assert isinstance(answer, Alive)


def fallen_feed(carrier, monkeypatch):
    """Return a feed whose connection ended when no other could be had."""
    queue = carrier.subscribe()
    feed = carrier._feeds[queue]
    with monkeypatch.context() as patch:
        patch.setattr(SocketLine, "connect", lambda _: None)
        feed._pumps["s0"][1].wake()
        assert queue.get(0.01) is None
    assert (feed._pumps, feed._over_zenoh) == ({}, True)
    return queue, feed


def coming(carrier, peer, feed):
    """Give a sign of life; return the connection by which a feed comes back, if it has one."""
    alive(carrier, peer)
    return feed._coming.get("s0", (None,))[0]


def numbers_until(queue, last):
    """Return the numbers of the notices that come, up to one."""
    numbers = []
    while not numbers or numbers[-1] < last:
        notice = queue.get(30.0)
        assert notice is not None
        numbers.append(notice.number)
    return numbers


def no_feed_is_left():
    return "enact-notices" not in {thread.name for thread in threading.enumerate()}


@over_socket
def test_feed_comes_back_to_the_socket(daemon, carry, make_peer, endpoint, monkeypatch, until):
    """At a sign of life, no notice is lost or comes twice; without one it stays with Zenoh."""
    daemon(endpoint)
    carrier = carry(endpoint, session="a" * 32)
    peer = speak(carrier, make_peer, "a" * 32)
    queue, feed = fallen_feed(carrier, monkeypatch)
    peer.write("cup", b"1")
    while (notice := queue.get(5.0)) is None:  # until the shard has heard of the feed
        peer.write("cup", b"1")
    first = notice.number

    until(lambda: coming(carrier, peer, feed))
    alive(carrier, peer)  # one is enough
    for count in range(50):
        peer.write("cup", b"%d" % count)
    until(lambda: not feed._over_zenoh)
    peer.write("cup", b"last")

    assert numbers_until(queue, first + 51) == list(range(first + 1, first + 52))
    assert queue.get(0.0) is None
    assert feed._coming == {}
    assert carrier.behind._feeds == {}
    queue.close()
    until(no_feed_is_left)


@over_socket
def test_feed_that_comes_back_waits_for_what_zenoh_still_brings(
    daemon, carry, make_peer, endpoint, monkeypatch, until
):
    """What is on its way there when the socket brings its first notice is not passed over."""
    daemon(endpoint)
    carrier = carry(endpoint, session="a" * 32)
    peer = speak(carrier, make_peer, "a" * 32)
    queue, feed = fallen_feed(carrier, monkeypatch)
    late, put, arrived = [], queue.put, threading.Event()

    def keep(notice):
        late.append(notice)
        arrived.set()

    monkeypatch.setattr(queue, "put", keep)
    peer.write("cup", b"1")
    while not arrived.wait(5):  # until the shard has heard of the feed
        peer.write("cup", b"1")
    waited = threading.Event()
    earlier = queue.wait_for_earlier

    def wait_for_earlier(*arguments):
        waited.set()
        earlier(*arguments)

    monkeypatch.setattr(queue, "wait_for_earlier", wait_for_earlier)
    monkeypatch.setattr(socket_feed, "EARLIER_S", 30.0)
    until(lambda: coming(carrier, peer, feed))
    before = list(late)
    peer.write("cup", b"2")
    assert waited.wait(30)
    assert queue.get(0.0) is None
    for notice in before:
        put(notice)

    numbers = [notice.number for notice in before]
    assert numbers_until(queue, numbers[-1] + 1) == [*numbers, numbers[-1] + 1]


@over_socket
def test_feed_is_closed_while_it_comes_back(daemon, carry, make_peer, endpoint, monkeypatch, until):
    """Its thread, which waits for a first notice, and its connection end with it."""
    daemon(endpoint)
    carrier = carry(endpoint, session="a" * 32)
    peer = speak(carrier, make_peer, "a" * 32)
    queue, feed = fallen_feed(carrier, monkeypatch)
    connection = until(lambda: coming(carrier, peer, feed))

    queue.close()

    until(no_feed_is_left)
    until(lambda: connection.socket.fileno() == -1)
