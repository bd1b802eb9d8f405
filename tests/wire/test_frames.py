"""Frames: every message comes back equal, bodies aligned, and its bytes never change by accident."""

from __future__ import annotations

import weakref

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_samples import CLASSES, messages

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.errors import ProtocolError
from enact_dist.wire.frames import CODES, decode_frame, encode_frame
from enact_dist.wire.limits import ALIGNMENT, SMALL_BODY_BYTES

LOCK = LockId("a1b2c3", 3, 17)
SLOT = Slot("online", "tray/package/3", "surface")


def commit(*bodies):
    writes = [m.WriteItem(SLOT, Datum(b"\x01\x00", body, len(body), 5)) for body in bodies]
    return m.Commit(LOCK, Token(9, 1), tuple(writes), 0)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
@settings(max_examples=12)
@given(data=st.data())
def test_frame_comes_back_equal_for_every_class(cls, data):
    """What is encoded decodes to an equal message of the same class, all parts of their types."""
    message = data.draw(messages(cls))

    header, payload = encode_frame(message)
    decoded = decode_frame(header, payload or b"")

    assert decoded == message
    assert type(decoded) is cls


@settings(max_examples=30)
@given(messages(m.Granted))
def test_frame_restores_the_types_of_parts(message):
    """NamedTuples come back as such, not as bare tuples that happen to be equal."""
    header, payload = encode_frame(message)

    decoded = decode_frame(header, payload or b"")

    assert type(decoded.lock) is LockId
    assert all(type(state) is m.SlotState and type(state.slot) is Slot for state in decoded.states)


def test_frame_header_is_an_array_of_version_code_and_fields():
    """The documented layout, byte by byte: another language depends on it."""
    header, payload = encode_frame(m.Validate(LOCK, Token(9, 1)))

    head, rest = bytes([0x96, 12, 9, 0x93, 0xA6]), bytes([3, 17, 0x92, 9, 1, 0x90, 0xC2])
    assert header == head + b"a1b2c3" + rest
    assert payload is None


def test_frame_codes_stand_still():
    """A code belongs to its message for ever: a change here breaks running cells."""
    names = {cls.__name__: code for cls, code in CODES.items()}

    assert names.items() >= {
        ("Hello", 1), ("Register", 2), ("Acquire", 3), ("TakeView", 4), ("Fetch", 5),
        ("KeepAlive", 6), ("Commit", 7), ("Outcome", 8), ("Validate", 9), ("Release", 10),
        ("Goodbye", 11), ("AwaitStamp", 12), ("Survey", 13), ("ListLocks", 14),
        ("ListSessions", 15), ("Break", 16), ("Welcome", 33), ("Registered", 34), ("Granted", 35),
        ("Waiting", 36), ("Stale", 37), ("Viewed", 38), ("Slice", 39), ("Gone", 40), ("Alive", 41),
        ("Committed", 42), ("Fenced", 43), ("OutcomeIs", 44), ("Valid", 45), ("Released", 46),
        ("Reached", 47), ("Surveyed", 48), ("Locks", 49), ("Sessions", 50), ("Broken", 51),
        ("EpochChanged", 52), ("WrongShard", 53), ("Refused", 54), ("Changed", 55),
        ("ForceAbort", 20), ("ListAudit", 21), ("Stage", 22), ("Audited", 59), ("Staged", 60),
        ("Ping", 29), ("Pong", 66), ("ListPlaces", 30), ("Places", 67),
        ("ListRefusals", 31), ("Refusals", 68),
        ("Notice", 97),
    }  # fmt: skip


def test_frame_aligns_bodies_in_the_order_of_the_header():
    """Bodies start at multiples of 64 with zeros between; empty ones take no place."""
    header, payload = encode_frame(commit(b"a" * 3, b"", b"b" * 64, b"c"))

    places = [write[1][1:3] for write in msgpack.unpackb(header)[4]]
    assert places == [[0, 3], [0, 0], [64, 64], [128, 1]]
    assert payload == b"a" * 3 + bytes(61) + b"b" * 64 + b"c"
    assert all(offset % ALIGNMENT == 0 for offset, _ in places)


def test_frame_shares_a_single_body_instead_of_copying_it():
    """One body alone is the payload itself, both ways."""
    body = b"x" * 1000

    header, payload = encode_frame(commit(body))

    assert payload is body
    assert decode_frame(header, payload).writes[0].datum.body is payload


class Received(bytearray):
    """A payload whose end can be seen."""


def test_datum_keeps_at_most_twice_its_own_bytes_alive():
    """Of a frame of many large data one does not pin the others; most of a frame is no copy."""
    part = SMALL_BODY_BYTES
    for sizes in ([3 * part, part, part], [part] * 16, [part, 9 * part]):
        header, payload = encode_frame(commit(*(b"x" * size for size in sizes)))
        received = Received(payload)
        data = [write.datum for write in decode_frame(header, received).writes]
        ended = weakref.ref(received)
        largest = max(data, key=lambda datum: datum.size)
        is_view = type(largest.body) is memoryview and largest.body.obj is received
        assert is_view == (2 * max(sizes) >= len(payload))
        del received, largest
        data = [datum for datum in data if 2 * datum.size < len(payload)]

        assert ended() is None
        assert all(bytes(datum.body) == b"x" * datum.size for datum in data)


def test_frame_views_large_bodies_and_copies_small_ones():
    """A small datum does not keep a large payload alive; a large one is not copied."""
    large = b"x" * SMALL_BODY_BYTES
    header, payload = encode_frame(commit(b"small", large))

    small, view = (write.datum.body for write in decode_frame(header, payload).writes)

    assert type(small) is bytes
    assert type(view) is memoryview
    assert view.readonly
    assert view.obj is payload
    assert view == large


def test_frame_never_hands_out_a_writable_body():
    """Whoever owns the received buffer cannot be reached through a datum."""
    for bodies in ([b"x" * 10], [b"x" * SMALL_BODY_BYTES, b"y" * SMALL_BODY_BYTES]):
        header, payload = encode_frame(commit(*bodies))

        message = decode_frame(header, memoryview(bytearray(payload)))

        assert all(memoryview(write.datum.body).readonly for write in message.writes)


@pytest.mark.parametrize(
    "message",
    [
        m.Outcome(LockId("s", 1, 1 << 64)),
        m.Refused("protocol", object()),
        m.Refused("protocol", "\ud800"),
        commit(b"abc").writes[0],
        m.Commit(LOCK, Token(1, 1), (m.WriteItem(SLOT, Datum(b"", b"abc", 4)),), 0),
    ],
    ids=["over 64 bits", "an object", "a lone surrogate", "no message", "a size that lies"],
)
def test_frame_refuses_to_send_what_cannot_be_read(message):
    """The sender learns of its own mistake, as a ProtocolError."""
    with pytest.raises(ProtocolError):
        encode_frame(message)


def test_frame_names_a_payload_in_place_of_its_bytes():
    """A datum with a file travels by name: its size is told, and none of its bytes."""
    named = Datum(b"\x01\x00", b"x" * 100, 100, 5, "a1b2c3-1f")

    header, payload = encode_frame(m.Commit(LOCK, Token(1, 1), (m.WriteItem(SLOT, named),), 0))

    assert payload is None
    assert decode_frame(header).writes[0].datum == Datum(b"\x01\x00", b"", 100, 5, "a1b2c3-1f")
