"""What several tests of sockets share: one slot, one act on it, and questions over a bare socket."""

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Write
from enact_dist.link.socket.frames import Stream, send_frame
from enact_dist.wire.frames import decode_frame, encode_frame

COUNT = Aspect("count", int, Durability.VOLATILE)
CUP = Entity("cup")
over_socket = pytest.mark.parametrize("carry", ["socket"], indirect=True)


def counters(shard):
    return shard.host._shard.counters


def carrier_of(cell):
    return cell._client.carrier


def add_one(cell, entity=CUP):
    request = Write(cell.world("online"), entity, COUNT)
    with Lock(request) as lock:
        lock[request] = lock.get(request, 0) + 1
    return request


def ask(near, message, stream=None):
    send_frame(near, encode_frame(message)[0])
    _, header, payload = (stream or Stream(near)).receive()
    return decode_frame(header, payload)


def speak(carrier, make_peer, session, *, timeout_s=30.0):
    def call(shard, message):
        return carrier.request(shard, message, timeout_s=timeout_s)

    peer = make_peer(call, session=session)
    peer.hello()
    return peer
