"""Clients that come and go in every way, at any moment: a shard keeps nothing of them."""

import contextlib
import os
import random
import socket
import threading
import time

import pytest
from socket_parts import ask, counters

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Acquire, Hello, Item, ListLocks, Locks
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, prefixed, send_frame
from enact_dist.terms import Access
from enact_dist.wire.frames import encode_frame

pytestmark = pytest.mark.carrier("socket")

THREADS, VISITS = 6, 25


class Visitor:
    """One connection after another, each with some acts and an end that are drawn."""

    def __init__(self, shard, seed):
        self._host, self._address = shard.host, shard._shared.address("socket")
        self._draw = random.Random(seed)
        self._name = f"visitor{seed % 4}"  # several connections speak for one session
        self._seq = 0

    def run(self):
        for _ in range(VISITS):
            near = socket.socket(socket.AF_UNIX)
            near.settimeout(30)
            near.connect(self._address)
            with near, contextlib.suppress(OSError, EOFError):
                self._visit(near)
                if self._draw.random() < 0.3:
                    near.shutdown(self._draw.choice((socket.SHUT_RD, socket.SHUT_WR)))

    def _visit(self, near):
        if self._draw.random() < 0.1:
            return
        known = self._draw.random() < 0.9
        greeting = greeting_of(self._name, "crowd") if known else os.urandom(9)
        send_frame(near, greeting, kind=FrameKind.OPEN)
        if self._draw.random() < 0.2:
            return  # before it is answered
        stream = Stream(near)
        stream.receive()
        acts = (self._hello, self._lock, self._garbage, self._half, self._watch)
        for _ in range(self._draw.randrange(6)):
            act = self._draw.choice(acts)
            act(near)
            if act not in (self._hello, self._lock) or self._draw.random() < 0.3:
                return  # with an answer on its way, perhaps
            stream.receive()

    def _hello(self, near):
        message = Hello(self._name, 0, 2_000_000_000, self._name, "host", 1, False)
        send_frame(near, encode_frame(message)[0])

    def _lock(self, near):
        self._seq += 1
        item = Item(int(Access.WRITE), "online", f"cup/{self._draw.randrange(3)}", "count")
        lock = LockId(self._name, self._draw.randrange(4), self._seq)
        wait_ns, hold_ns = self._draw.choice((0, 200_000_000)), 300_000_000
        message = Acquire(lock, self._host.epoch, 1, 0, (item,), wait_ns, hold_ns, 0)
        send_frame(near, encode_frame(message)[0])

    def _garbage(self, near):
        near.sendall(self._draw.randbytes(self._draw.randrange(1, 200)))

    def _half(self, near):
        header = encode_frame(ListLocks())[0]
        near.sendall(prefixed(header, 0)[: self._draw.randrange(1, len(header))])

    def _watch(self, near):
        send_frame(near, b"", kind=FrameKind.WATCH)


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_shard_keeps_nothing_of_clients_that_come_and_go(raw, until):
    """No place, no watcher, no unanswered request and no thread is left; others are served."""
    shard = raw.shard
    service = shard._sockets
    visitors = [threading.Thread(target=Visitor(shard, seed).run) for seed in range(THREADS)]
    for visitor in visitors:
        visitor.start()
    near, slowest_s = raw("steady"), 0.0
    stream = Stream(near)
    while any(visitor.is_alive() for visitor in visitors):
        began_s = time.monotonic()
        assert isinstance(ask(near, ListLocks(), stream), Locks)
        slowest_s = max(slowest_s, time.monotonic() - began_s)
    near.close()

    until(lambda: not [t for t in threading.enumerate() if t.name == "enact-socket"])
    until(lambda: not shard.host._replies)
    assert service._count == 0
    assert service._connections == {}
    assert service._watchers == ()
    assert all(not watched.connections for watched in service._deaths._watched.values())
    assert shard.host.failure is None
    assert counters(shard)["connections_refused"] > 0
    assert slowest_s < 30.0
