"""The quick readers read what the general one reads, and refuse the rest with the same words."""

from __future__ import annotations

import random
from typing import get_args

import msgpack
import pytest
from wire_samples import CLASSES, sample

from enact_dist.core.protocol.messages import Request
from enact_dist.errors import ProtocolError
from enact_dist.wire import frames
from enact_dist.wire.bodies import BodyReader
from enact_dist.wire.frames import CODES, decode_frame, encode_frame
from enact_dist.wire.message_parts import reader_of
from enact_dist.wire.quick_readers import quick_reader_of, safe_reader

WRONG = (None, True, 0, -1, 1 << 63, 0.5, "", "x" * 201, b"", b"y" * 70_000, (), ("a",), (1, 2, 3))
TEXTS = ("a\x1b[2Jb", "line\nbreak", "right\u202eleft", "a\u00a0space", ("\x07",), ("a", "\x07"))
"""The fourth one is not printable, and safe all the same."""
REQUESTS = frozenset(get_args(Request))


def general_reader_of(cls):
    """Return the general reader of a message, with the check of the texts of a request."""
    return safe_reader(reader_of(cls)) if cls in REQUESTS else reader_of(cls)


def result(read, raw, payload):
    """Return the message and how far the payload was read, or the words of the refusal."""
    bodies = BodyReader(payload)
    try:
        return read(raw, bodies), bodies.end
    except ProtocolError as error:
        return str(error)


def places(raw, path=()):
    """Yield the path to each element of nested tuples."""
    for index, one in enumerate(raw):
        yield (*path, index)
        if isinstance(one, tuple):
            yield from places(one, (*path, index))


def with_other(raw, path, other):
    """Return nested tuples with another value at a path."""
    index, *rest = path
    inner = with_other(raw[index], rest, other) if rest else other
    return (*raw[:index], inner, *raw[index + 1 :])


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_quick_reader_agrees(cls):
    """Samples, and samples with one wrong value anywhere: same message, or same refusal."""
    generator = random.Random(20261121)
    judge = general_reader_of(cls)
    quick = quick_reader_of(cls, judge, printable=cls in REQUESTS)
    refused = 0

    for _ in range(4):
        header, payload = encode_frame(sample(cls, generator))
        raw = msgpack.unpackb(header, use_list=False)[2:]
        assert result(quick, raw, payload or b"") == result(judge, raw, payload or b"")
        raws = [with_other(raw, path, wrong) for path in places(raw) for wrong in (*WRONG, *TEXTS)]
        for wrong_raw in (*raws, raw[:-1], (*raw, 1), [*raw], None, 7):
            expected = result(judge, wrong_raw, payload or b"")
            assert result(quick, wrong_raw, payload or b"") == expected, wrong_raw
            refused += isinstance(expected, str)

    assert refused


def damaged(header, payload, draw):
    """Return a frame with a few things wrong in its parts, its bytes or its payload."""
    way = draw.randrange(4)
    if way == 0:
        raw = msgpack.unpackb(header, use_list=False)
        for _ in range(draw.randrange(1, 4)):
            raw = with_other(raw, draw.choice(list(places(raw))), draw.choice((*WRONG, *TEXTS)))
        header = msgpack.packb(raw)
    elif way == 1:
        flipped = bytearray(header)
        for _ in range(draw.randrange(1, 4)):
            flipped[draw.randrange(len(flipped))] ^= 1 << draw.randrange(8)
        header = bytes(flipped)
    elif way == 2:
        payload = draw.choice((payload[:-1], payload + b"\0", payload[64:], b"\1" + payload))
    else:
        whole = msgpack.unpackb(header, use_list=False)
        at = draw.randrange(2, len(whole) + 1)
        header = msgpack.packb((*whole[:at], draw.choice(whole), *whole[at + draw.randrange(2) :]))
    return header, payload


def answer_of(header, payload):
    """Return the message of a frame, or the words of its refusal."""
    try:
        return decode_frame(header, payload)
    except ProtocolError as error:
        return str(error)


def test_damaged_frames_pass_both_or_neither(monkeypatch):
    """What the general reader refuses does not pass a quick one, however a frame is damaged."""
    draw = random.Random(188545)
    general = {code: general_reader_of(cls) for cls, code in CODES.items()}
    quick, passed, refused = frames._readers, 0, 0

    hot = [cls for cls in CLASSES if cls in frames._OF_EVERY_LOCK]
    for number in range(4000):
        header, payload = encode_frame(sample(hot[number % len(hot)], draw))
        frame = damaged(header, payload or b"", draw)
        monkeypatch.setattr(frames, "_readers", general)
        expected = answer_of(*frame)
        monkeypatch.setattr(frames, "_readers", quick)
        assert answer_of(*frame) == expected, frame
        passed += not isinstance(expected, str)
        refused += isinstance(expected, str)

    assert passed > 400
    assert refused > 1500
