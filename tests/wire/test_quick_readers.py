"""The quick readers read what the general one reads, and refuse the rest with the same words."""

from __future__ import annotations

import random

import msgpack
import pytest
from wire_samples import CLASSES, sample

from enact_dist.errors import ProtocolError
from enact_dist.wire.bodies import BodyReader
from enact_dist.wire.frames import encode_frame
from enact_dist.wire.message_parts import reader_of
from enact_dist.wire.quick_readers import quick_reader_of

WRONG = (None, True, 0, -1, 1 << 63, 0.5, "", "x" * 201, b"", b"y" * 70_000, (), ("a",), (1, 2, 3))


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
    judge, quick = reader_of(cls), quick_reader_of(cls)
    refused = 0

    for _ in range(4):
        header, payload = encode_frame(sample(cls, generator))
        raw = msgpack.unpackb(header, use_list=False)[2:]
        assert result(quick, raw, payload or b"") == result(judge, raw, payload or b"")
        raws = [with_other(raw, path, wrong) for path in places(raw) for wrong in WRONG]
        for wrong_raw in (*raws, raw[:-1], (*raw, 1), [*raw], None, 7):
            expected = result(judge, wrong_raw, payload or b"")
            assert result(quick, wrong_raw, payload or b"") == expected, wrong_raw
            refused += isinstance(expected, str)

    assert refused
