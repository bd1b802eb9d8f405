"""Long headers of requests: read as all others are, refused at the first list that is too long."""

import msgpack
import pytest

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.errors import ProtocolError
from enact_dist.wire import limits
from enact_dist.wire.frames import CODES, decode_frame, decode_request, encode_frame
from enact_dist.wire.long_headers import LONG_HEADER_BYTES, list_length

SLOT = Slot("online", "tray/package/3", "surface")
VERSIONS = (m.SlotVersion(SLOT, 1),)
LOCK, TOKEN = LockId("a1b2c3", 3, 17), Token(1, 1)
WRITE = m.WriteItem(SLOT, Datum(b"\x01\x00", b"", 0))
LONG = 100_000


def header_of(cls, *fields, code=None):
    return msgpack.packb([limits.FRAME_VERSION, code or CODES[cls], *fields])


@pytest.mark.parametrize(
    "message",
    [
        m.Survey(("online",), ("*a*",) * limits.ITEMS_MAX, ("n",) * limits.ITEMS_MAX),
        m.Explain(VERSIONS * limits.ITEMS_MAX),
        m.Commit(LOCK, TOKEN, (WRITE,) * limits.ITEMS_MAX, 0, VERSIONS * limits.ITEMS_MAX),
        m.KeepVersions("s", "label", VERSIONS * limits.KEPT_VERSIONS_MAX, 1, 1),
        m.KeepAlive("s", 1, 1, (), b"r" * limits.REPORT_FIELD_BYTES_MAX),
        m.Register("s", tuple(f"w{index}" for index in range(LONG)), ()),
    ],
    ids=lambda message: type(message).__name__,
)
def test_long_request_is_read_as_a_short_one(message):
    """At the limits of its lists it is the same message by either way of reading."""
    header, payload = encode_frame(message)

    assert len(header) > LONG_HEADER_BYTES
    assert decode_request(header, payload or b"") == decode_frame(header, payload or b"") == message


@pytest.mark.parametrize(
    ("cls", "before", "field"),
    [
        (m.Survey, (), "Survey.contexts"),
        (m.Survey, ((),), "Survey.patterns"),
        (m.Explain, (), "Explain.versions"),
        (m.Validate, (LOCK, TOKEN), "Validate.expects"),
        (m.KeepVersions, ("s", "label"), "KeepVersions.versions"),
    ],
)
def test_list_that_is_too_long_is_refused_before_it_is_read(cls, before, field):
    """So the end of the header, which is missing here, is never come to."""
    header = header_of(cls, *before, VERSIONS * LONG)[:-1]

    with pytest.raises(ProtocolError, match=rf"^{field} has the length {LONG}; at most"):
        decode_request(header)


def test_request_of_too_many_values_is_refused():
    """Lists in lists hold no more than one may, all together."""
    nested = [["x"] * 1000 for _ in range(1 + limits.REQUEST_VALUES_MAX // 1000)]

    with pytest.raises(ProtocolError, match=f"more than {limits.REQUEST_VALUES_MAX} values"):
        decode_request(header_of(m.Register, "s", nested, []))


def test_request_of_too_many_fields_is_refused_before_they_are_read():
    """Ten million of them fit into a header, and its end is never come to here."""
    header = header_of(m.Survey, (), (), (), False, m.START, False)
    count = limits.HEADER_BYTES_MAX - 100
    header = b"\xdd" + count.to_bytes(4, "big") + header[1:] + b"\xc0" * LONG

    with pytest.raises(ProtocolError, match=f"Survey has 6 fields, {count - 2} came"):
        decode_request(header)


def test_long_header_with_a_code_that_no_request_has_is_refused_unread():
    """Neither an answer's code nor another type in its place lets the rest be read."""
    for code in (CODES[m.Sessions], 32, "x" * 60):
        with pytest.raises(ProtocolError, match="no request with it is so long"):
            decode_request(header_of(None, ("x",) * LONG, code=code)[:-1])


@pytest.mark.parametrize(
    "damage",
    [
        lambda header: header[:-9],
        lambda header: header + b"x",
        lambda header: header[:1] + b"\x06" + header[2:],
        lambda header: b"\x92" + header[1:],
        lambda header: b"\x91" + header[1:],
        lambda header: header[:3] + b"\xc1" + header[4:],
        lambda header: b"\xdf" + header[1:],
    ],
    ids=["cut", "longer", "old", "two", "one", "no type", "a map"],
)
def test_damaged_long_request_is_refused_by_either_way_of_reading(damage):
    """Whatever is wrong with it, nothing but `ProtocolError` leaves."""
    header, _ = encode_frame(m.Explain(VERSIONS * limits.ITEMS_MAX))

    for decode in (decode_request, decode_frame):
        with pytest.raises(ProtocolError):
            decode(damage(header))


@pytest.mark.parametrize("length", [0, 15, 16, 65_535, 65_536])
def test_list_length_is_what_msgpack_writes(length):
    """Of every size of list; of anything else, and past the end, it is none."""
    assert list_length(b"\x01" + msgpack.packb([1] * length), 1) == length
    assert [list_length(msgpack.packb(value), 0) for value in (7, "text", b"bytes", None)] == [
        0
    ] * 4
    assert list_length(b"\x90", 1) == 0
