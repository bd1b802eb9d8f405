"""The text of the format, by which somebody may write it in another language, says what is so."""

import re
from typing import get_args

import msgpack
import numpy as np

from enact_dist import wire
from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.wire import limits
from enact_dist.wire.frames import CODES, encode_frame
from enact_dist.wire.payload import encode_datum

TEXT = wire.__doc__
KINDS = {bytes: "bin", int: "int", str: "str"}


def codes_of(table, union):
    """Return the codes that a row of the table of messages says, and those of the code."""
    row = re.search(rf"^{table} (.*?)^(?=\w|=)", TEXT, re.MULTILINE | re.DOTALL)[1]
    told = {name: int(code) for name, code in re.findall(r"(\w+)\s+(\d+)", row)}
    return told, {cls.__name__: CODES[cls] for cls in get_args(union)}


def test_text_names_the_version_of_frames_and_of_data():
    """Both ends must speak the same; who writes one from the text does."""
    assert re.findall(r"version = (\d+)", TEXT) == [str(limits.FRAME_VERSION)]
    assert f"the version {limits.DATUM_VERSION} and a tree" in TEXT


def test_text_names_each_message_with_its_code():
    """Requests, answers and notices, none that is gone."""
    for table, union in (("requests", m.Request), ("answers", m.Answer)):
        told, there = codes_of(table, union)
        assert told == there
    assert codes_of("notices", m.Notice | m.Hello)[0] == {"Notice": CODES[m.Notice]}
    assert len(CODES) == len(get_args(m.Request)) + len(get_args(m.Answer)) + 1


def test_text_names_the_fields_of_a_datum_as_they_travel():
    """Names in order, each with its kind; where a file is named, the offset is 0."""
    fields = re.search(r"``\[(encoding: .*?)\]``", TEXT)[1]
    names = [field.split(": ") for field in fields.split(", ")]
    named = "session-1"
    for datum in (Datum(b"\x01\x05", b"x" * 70, 70, 5), Datum(b"\x01\x05", b"", 70_000, 5, named)):
        write = m.WriteItem(Slot("online", "arm", "cloud"), datum)
        header, _ = encode_frame(m.Commit(LockId("session", 0, 1), Token(1, 1), (write,), 0))
        version, code, *rest = msgpack.unpackb(header, use_list=False)
        sent = rest[2][0][1]

        assert (version, code) == (limits.FRAME_VERSION, CODES[m.Commit])
        assert [kind for _, kind in names] == [KINDS[type(value)] for value in sent]
        by_name = dict(zip((name for name, _ in names), sent, strict=True))
        offset = by_name.pop("offset")
        assert by_name == {name: getattr(datum, name) for name in by_name}
        assert offset == 0


def test_text_s_examples_are_what_is_sent():
    """The int 5 and three float64."""
    five, floats = encode_datum(5, int), encode_datum(np.zeros(3), np.ndarray)

    assert (five.encoding, bytes(five.body)) == (bytes([1, 5]), b"")
    unpacker = msgpack.Unpacker(ext_hook=msgpack.ExtType)
    unpacker.feed(floats.encoding)
    version, array = unpacker
    assert (version, array.code, floats.size) == (1, 1, 24)
    assert msgpack.unpackb(array.data) == ["<f8", [3], "C", 0, 24]
