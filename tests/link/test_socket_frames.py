"""Frames on a stream: whole, in pieces, damaged, over a limit."""

import os
import random
import socket
import struct
import threading

import pytest

from enact_dist.errors import ProtocolError
from enact_dist.link.socket.frames import (
    BUFFER_BYTES,
    PREFIX_BYTES,
    STREAM_VERSION,
    FrameKind,
    Stream,
    prefixed,
    rounded_s,
    send_frame,
    wait_at_most,
)
from enact_dist.wire.limits import HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX


@pytest.fixture
def ends():
    """Two ends of one stream."""
    near, far = socket.socketpair()
    near.settimeout(None)
    yield near, far
    near.close()
    far.close()


FRAMES = [
    (b"", 0),
    (b"h", 1),
    (b"h" * 100, BUFFER_BYTES - PREFIX_BYTES - 100),
    (b"h" * 100, BUFFER_BYTES - PREFIX_BYTES - 99),
    (b"h" * (BUFFER_BYTES + 1), 0),
    (b"h" * (BUFFER_BYTES + 1), 5),
    (b"h" * 50, 3_000_000),
]


@pytest.mark.parametrize(("header", "body"), FRAMES)
def test_frame_arrives_as_it_was_sent(ends, header, body):
    """Short ones and long ones, with the buffer's edge between them."""
    near, far = ends
    payload = os.urandom(body)
    halves = [payload[: body // 2], memoryview(payload)[body // 2 :]] if body else []
    sender = threading.Thread(target=send_frame, args=(near, header, halves))
    sender.start()

    kind, found, found_payload = Stream(far).receive()
    sender.join()

    assert (kind, found, bytes(found_payload)) == (FrameKind.MESSAGE, header, payload)


@pytest.mark.parametrize(("header", "body"), FRAMES)
def test_frame_is_taken_when_all_of_it_is_here(ends, header, body):
    """However it is cut: a part of it is kept, and nobody waits for the rest."""
    near, far = ends
    payload = os.urandom(body)
    frame = prefixed(header, body) + payload
    rest = memoryview(frame + prefixed(b"next", 0))
    stream, found = Stream(far), []

    for length in (1, 14, 3, len(frame) // 2, len(rest)):
        part, rest = rest[:length], rest[length:]
        while part:
            part = part[near.send(part[: 1 << 16]) :]
            while (one := stream.receive_here()) is not None:
                found.append(one)

    assert [(kind, head, bytes(body)) for kind, head, body in found] == [
        (FrameKind.MESSAGE, header, payload),
        (FrameKind.MESSAGE, b"next", b""),
    ]
    assert not stream.begun
    near.close()
    with pytest.raises(EOFError):
        stream.receive_here()


def test_frames_that_come_in_any_pieces_are_put_together(ends):
    """Several frames in one piece, one frame in many."""
    near, far = ends
    frames = [(b"h%d" % number, bytes([number]) * (number * 37 % 200)) for number in range(100)]
    raw = b"".join(prefixed(header, len(body)) + body for header, body in frames)
    cuts = random.Random(1)

    def dribble():
        at = 0
        while at < len(raw):
            step = cuts.choice((1, 3, 50, 2000))
            near.sendall(raw[at : at + step])
            at += step

    sender = threading.Thread(target=dribble)
    sender.start()
    stream = Stream(far)
    found = [stream.receive()[1:] for _ in frames]
    sender.join()

    assert found == frames


def test_frame_of_many_pieces_is_sent_whole(ends):
    """More pieces than one system call takes."""
    near, far = ends
    bodies = [bytes([number % 256]) * 64 for number in range(3000)]
    sender = threading.Thread(target=send_frame, args=(near, b"h", bodies))
    sender.start()

    found = Stream(far).receive()[2]
    sender.join()

    assert bytes(found) == b"".join(bodies)


@pytest.mark.parametrize(
    "prefix",
    [
        struct.pack("<2sBBIQ", b"XX", 1, 4, 0, 0),
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION + 1, 4, 0, 0),
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION, 0, 0, 0),
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION, 99, 0, 0),
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION, 4, HEADER_BYTES_MAX + 1, 0),
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION, 4, 0, PAYLOAD_BYTES_MAX + 1),
        b"GET / HTTP/1.1\r\n",
    ],
)
def test_prefix_that_is_none_is_refused_before_memory_is_taken(ends, prefix):
    """A stranger, another version, an unknown kind and absurd lengths are told by the prefix."""
    near, far = ends
    near.sendall(prefix)

    with pytest.raises(ProtocolError):
        Stream(far).receive()


def test_claimed_length_costs_nothing_until_it_comes(ends):
    """A gigabyte that is announced and never sent is not touched: the reader just waits."""
    near, far = ends
    near.sendall(
        struct.pack("<2sBBIQ", b"ED", STREAM_VERSION, 4, 1, PAYLOAD_BYTES_MAX) + b"h" + b"x" * 1000
    )
    near.close()
    before = _resident_bytes()

    with pytest.raises(EOFError):
        Stream(far).receive()

    assert _resident_bytes() - before < 50_000_000


def _resident_bytes():
    with open("/proc/self/statm") as file:  # noqa: PTH123
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_end_in_mid_frame_is_an_end_and_no_frame(ends):
    """A peer that dies while it sends leaves nothing that looks whole."""
    near, far = ends
    near.sendall(prefixed(b"header", 100) + b"half")
    near.close()

    with pytest.raises(EOFError):
        Stream(far).receive()


def test_kernel_ends_a_wait(ends):
    """A time to wait is kept without Python's own timeout."""
    _, far = ends
    wait_at_most(far, socket.SO_RCVTIMEO, 0.05)

    with pytest.raises(BlockingIOError):
        Stream(far).receive()


@pytest.mark.parametrize(
    ("asked", "expected"), [(0.0, 0.01), (0.1, 0.1), (0.101, 0.11), (1.0, 1.0), (1.9001, 2.0)]
)
def test_waits_are_rounded_up(asked, expected):
    """Few different times occur, none of them too short."""
    assert rounded_s(asked) == pytest.approx(expected)


@pytest.mark.parametrize(("room", "placed"), [(200_000, True), (199_999, False), (200_001, False)])
def test_payload_is_put_where_it_will_stay_if_it_fits(ends, room, placed):
    """A payload exactly as long as the memory that is offered is received there, without a copy."""
    near, far = ends
    body, memory = random.Random(1).randbytes(200_000), bytearray(room)
    sender = threading.Thread(target=send_frame, args=(near, b"head", [body]))
    sender.start()
    _, header, payload = Stream(far).receive(memoryview(memory))
    sender.join()

    assert (header, bytes(payload)) == (b"head", body)
    assert (payload.obj is memory) == placed
    assert any(memory) == placed


@pytest.mark.parametrize("other", [STREAM_VERSION - 1, STREAM_VERSION + 1])
def test_stream_of_another_release_is_refused_with_both_versions(ends, other):
    """The reader names the version that came, its own, and what to do."""
    near, far = ends
    near.sendall(struct.pack("<2sBBIQ", b"ED", other, FrameKind.MESSAGE, 0, 0))

    said = (
        f"a stream of version {other} came; this side speaks {STREAM_VERSION}; run the same release"
    )
    with pytest.raises(ProtocolError, match=said):
        Stream(far).receive()
