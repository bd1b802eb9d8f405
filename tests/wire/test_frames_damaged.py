"""Frames that nobody should send: each is refused with ProtocolError, at small cost, no other way."""

from __future__ import annotations

import random
import tracemalloc
from itertools import product

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire_samples import CLASSES, damaged, sample

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.errors import ProtocolError
from enact_dist.wire import limits
from enact_dist.wire.frames import CODES, decode_frame, encode_frame

VERSION = limits.FRAME_VERSION
UNUSED = max(code for code in CODES.values() if code < 32) + 1
LOCK = LockId("a1b2c3", 3, 17)
SLOT = Slot("online", "tray/package/3", "surface")


def header_of(code, *fields, version=VERSION):
    return msgpack.packb([version, code, *fields])


def commit_of(*writes):
    """Return the header of a commit with these writes, whatever they are."""
    return header_of(7, list(LOCK), [1, 1], list(writes), 0, [], [], [], 0, False, 0)


def accepted(header, payload):
    """Return whether a frame is read; what is read must be sendable and come back equal."""
    try:
        message = decode_frame(header, payload)
    except ProtocolError:
        return False
    assert decode_frame(*(part or b"" for part in encode_frame(message))) == message
    return True


def test_frame_damage_is_refused_or_another_valid_message():
    """5000 frames with one damage each raise ProtocolError, or are a frame in good order."""
    generator = random.Random(20261121)
    messages = [sample(cls, generator) for cls in CLASSES for _ in range(5)]
    frames = [encode_frame(message) for message in messages]

    read = 0
    for number in range(5000):
        header, payload = frames[number % len(frames)]
        if payload and generator.random() < 0.2:
            payload = damaged(payload, generator)
        else:
            header = damaged(header, generator)
        read += accepted(header, payload or b"")

    assert 0 < read < 4000, "damage must reach the reader and mostly be found"


@settings(max_examples=500)
@given(st.binary(max_size=200), st.binary(max_size=80))
def test_frame_of_random_bytes_is_refused(header, payload):
    """Random bytes are no message, and raise nothing but ProtocolError."""
    accepted(header, payload)


@settings(max_examples=300)
@given(
    st.sampled_from(sorted(CODES.values())),
    st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.text(max_size=5)
        | st.binary(max_size=5) | st.floats(),
        lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=2), inner),
        max_leaves=20,
    ),
)  # fmt: skip
def test_frame_of_random_fields_is_refused_or_in_order(code, fields):
    """Any msgpack under a known code either is that message or raises ProtocolError."""
    fields = fields if isinstance(fields, list) else [fields]

    accepted(header_of(code, *fields), b"")


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_frame_cut_anywhere_is_refused(cls):
    """No beginning of a header, and no header with a byte more, is a frame."""
    header, payload = encode_frame(sample(cls, random.Random(7)))

    for length in range(len(header)):
        with pytest.raises(ProtocolError):
            decode_frame(header[:length], payload or b"")
    with pytest.raises(ProtocolError):
        decode_frame(header + b"\x00", payload or b"")


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_frame_with_a_field_of_another_type_is_refused(cls):
    """Each field replaced by a value of each other type is named in the refusal."""
    header, payload = encode_frame(sample(cls, random.Random(8)))
    fields = msgpack.unpackb(header)

    for index in range(2, len(fields)):
        for other in (None, True, 1.5, "text", b"bytes", 7, [1.5], {}):
            changed = [*fields[:index], other, *fields[index + 1 :]]
            accepted(msgpack.packb(changed), payload or b"")
        with pytest.raises(ProtocolError, match=cls.__name__):
            decode_frame(
                msgpack.packb([*fields[:index], 1.5, *fields[index + 1 :]]), payload or b""
            )


@pytest.mark.parametrize("entry", [1, None, 1.5, b"a", True, ["a"]])
def test_frame_with_a_list_of_other_types_is_refused(entry):
    """The entries of a list are checked too: texts here, integers in a holder's list."""
    waits_for = "a" if entry == 1 and entry is not True else entry
    holder = [list(LOCK), 1, "a", "h", 1, True, "w", 0, 0, 0, [], [7, waits_for], ""]

    with pytest.raises(ProtocolError, match="a list of str"):
        decode_frame(header_of(13, ["online", entry], [], [], False, [0, [], 0, 0], False))
    with pytest.raises(ProtocolError, match="a list of int"):
        decode_frame(header_of(49, 1, [holder], [0, [], 0, 0]))


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_frame_with_a_field_more_or_less_is_refused(cls):
    """The number of fields is part of the version."""
    header, payload = encode_frame(sample(cls, random.Random(9)))
    fields = msgpack.unpackb(header)

    with pytest.raises(ProtocolError, match="fields"):
        decode_frame(msgpack.packb([*fields, 0]), payload or b"")
    if len(fields) > 2:
        with pytest.raises(ProtocolError):
            decode_frame(msgpack.packb(fields[:-1]), payload or b"")


def test_frame_of_another_version_names_both_versions():
    """The reader of the error learns which side to upgrade, whatever else has changed."""
    for other, rest in product((VERSION - 1, VERSION + 1), ([3, 1], [{"a": 1}], [])):
        said = rf"version {other} came; this side speaks {VERSION}.*release"
        with pytest.raises(ProtocolError, match=said):
            decode_frame(msgpack.packb([other, *rest, 0]))


@pytest.mark.parametrize("code", [0, 32, 96, 127, 255, 1 << 40, -1, "3", None, 1.0, True])
def test_frame_of_unknown_code_is_refused(code):
    """A code that this version does not know is named."""
    with pytest.raises(ProtocolError, match="unknown code"):
        decode_frame(header_of(code, "s"))


def test_frame_with_data_that_nobody_claims_is_refused():
    """Bytes beside or between the bodies cannot hide."""
    plain, _ = encode_frame(m.Goodbye("s"))
    two = tuple(m.WriteItem(SLOT, Datum(b"", body, 3)) for body in (b"abc", b"def"))
    header, payload = encode_frame(m.Commit(LOCK, Token(1, 1), two, 0))

    with pytest.raises(ProtocolError, match="1 bytes of data, 0"):
        decode_frame(plain, b"x")
    with pytest.raises(ProtocolError, match="belong"):
        decode_frame(header, payload + b"x")
    with pytest.raises(ProtocolError, match="not zero"):
        decode_frame(header, payload[:10] + b"x" + payload[11:])


@pytest.mark.parametrize(
    ("offset", "size"),
    [(0, 101), (64, 36), (1, 99), (-64, 100), (0, -1), (0, 1 << 62), (1 << 62, 1 << 62), (64, 0)],
)
def test_frame_with_a_body_elsewhere_is_refused(offset, size):
    """A body is exactly where the next one must be; claims beyond the payload take no memory."""
    write = [list(SLOT), [b"\x01\x00", offset, size, 0, ""]]

    with pytest.raises(ProtocolError):
        decode_frame(commit_of(write), b"x" * 100)


def test_frame_bodies_cannot_overlap():
    """Two data never share bytes: a small payload cannot stand for a large one."""
    write = [list(SLOT), [b"\x01\x00", 0, 100, 0, ""]]

    with pytest.raises(ProtocolError, match="expected at 128"):
        decode_frame(commit_of(write, write), b"x" * 100)


@pytest.mark.parametrize("mark", [b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"])
def test_frame_that_claims_gigabytes_takes_no_memory(mark):
    """A length of 4 GiB in a frame of a few bytes is refused before anything is allocated."""
    tracemalloc.start()
    try:
        for depth in (1, 40):
            nested = bytes([0x92, VERSION]) + b"\x91" * depth + mark + b"\xff\xff\xff\xff" + b"\x01"
            with pytest.raises(ProtocolError):
                decode_frame(nested)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 1 << 20


@pytest.mark.parametrize("filler", [b"\x91\xc0", b"\xa2ab", b"\x90", b"\xcb" + b"\x11" * 8])
def test_frame_takes_memory_in_proportion_to_its_bytes(filler):
    """A header of many small parts costs at most some tens of bytes per byte."""
    count = 1 << 17
    header = bytes([0x93, VERSION, 2]) + b"\xdd" + count.to_bytes(4, "big") + filler * count

    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError):
            decode_frame(header)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 40 * len(header)


@pytest.mark.parametrize("depth", [100, 400, 500, 900, 1000])
def test_frame_with_a_nested_part_is_refused_whatever_is_shown_of_it(depth):
    """In the place of the code, of a datum, of any field: the refusal must not choke on it."""
    nested: object = 1
    for _ in range(depth):
        nested = [nested]
    lock = list(LOCK)

    for header in (
        header_of(nested, 1),
        header_of(7, lock, [1, 1], [[list(SLOT), nested]], 0, [], []),
        header_of(10, nested),
        header_of(11, nested),
    ):
        with pytest.raises(ProtocolError):
            decode_frame(header)


def test_frame_nested_without_end_is_refused():
    """A hundred thousand brackets end in ProtocolError, not in the interpreter's stack."""
    for mark in (b"\x91", b"\xdc\x00\x01"):
        with pytest.raises(ProtocolError):
            decode_frame(bytes([0x92, VERSION]) + mark * 100_000)


@pytest.mark.parametrize(
    ("file", "offset", "size"),
    [
        ("../a1-1", 0, 100),
        ("a1-1/x", 0, 100),
        ("a1-1\n", 0, 100),
        ("a1-g", 0, 100),
        ("-1", 0, 100),
        ("a1-1", 64, 100),
        ("a1-1", 0, 0),
        ("a1-1", 0, -1),
        ("a1-1", 0, (1 << 30) + 1),
    ],
)
def test_frame_with_a_payload_that_cannot_be_is_refused(file, offset, size):
    """The name becomes the name of a file, and the size the length of a map."""
    write = [list(SLOT), [b"\x01\x00", offset, size, 0, file]]

    with pytest.raises(ProtocolError, match=r"payload|character"):
        decode_frame(commit_of(write))


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (m.Survey((), ("a",) * 4097, ()), "Survey.patterns"),
        (m.Survey(("a",) * 4097, (), ()), "Survey.contexts"),
        (m.ListHistory((), (), ("a",) * 4097), "ListHistory.aspects"),
        (m.Explain((m.SlotVersion(SLOT, 1),) * 4097), "Explain.versions"),
        (m.FindEffects((m.DatumRead(SLOT, 1, 1),) * 4097), "FindEffects.reads"),
        (m.KeepVersions("s", "label", (m.SlotVersion(SLOT, 1),) * 20_000), "KeepVersions.versions"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_question_about_too_many_at_once_is_refused_before_its_parts_are_read(message, field):
    """To read 100,000 parts took 0.6 s, for which a shard took no other request over Zenoh."""
    header, _ = encode_frame(message)

    with pytest.raises(ProtocolError, match=field):
        decode_frame(header)
