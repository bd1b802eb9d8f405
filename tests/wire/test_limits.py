"""Each limit: what is exactly at it passes, one more is refused by name."""

from __future__ import annotations

import msgpack
import numpy as np
import pytest

from enact_dist.core.protocol import messages as m
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.errors import DatumTypeError, ProtocolError
from enact_dist.wire import limits
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.payload import decode_datum, encode_datum

LOCK = LockId("a1b2c3", 3, 17)
SLOT = Slot("online", "tray/package/3", "surface")
EMPTY = Datum(b"\x01\x00", b"", 0)
ITEM = m.Item(1, *SLOT)
WRITE = m.WriteItem(SLOT, EMPTY)


def sent(message):
    header, payload = encode_frame(message)
    return decode_frame(header, payload or b"")


def acquire(**changes):
    fields = {"lock": LOCK, "epoch": 0, "map_version": 0, "count": 0, "items": (ITEM,)}
    times = {"wait_ns": 0, "hold_ns": 0, "seen_stamp_ns": 0}
    return m.Acquire(**fields | times | changes)


def commit(*writes, expects=()):
    return m.Commit(LOCK, Token(1, 1), writes, 0, expects)


NAME = "n" * limits.NAME_CHARACTERS_MAX
TEXT = "t" * limits.TEXT_BYTES_MAX
WIDE = "ü" * (limits.TEXT_BYTES_MAX // 2)
REPORT = b"r" * limits.REPORT_FIELD_BYTES_MAX
ENCODING = b"e" * (limits.ENCODING_BYTES_MAX + 1)


@pytest.mark.parametrize(
    ("at", "over"),
    [
        (acquire(items=(ITEM,) * limits.ITEMS_MAX), acquire(items=(ITEM,) * (limits.ITEMS_MAX + 1))),
        (commit(*(WRITE,) * limits.ITEMS_MAX), commit(*(WRITE,) * (limits.ITEMS_MAX + 1))),
        (acquire(items=(ITEM._replace(context=NAME),)),
         acquire(items=(ITEM._replace(context=NAME + "n"),))),
        (acquire(items=(ITEM._replace(entity=NAME),)),
         acquire(items=(ITEM._replace(entity=NAME + "n"),))),
        (acquire(items=(ITEM._replace(aspect=NAME),)),
         acquire(items=(ITEM._replace(aspect=NAME + "n"),))),
        (m.Goodbye(NAME), m.Goodbye(NAME + "n")),
        (m.Outcome(LockId(NAME, 1, 1)), m.Outcome(LockId(NAME + "n", 1, 1))),
        (m.Refused("code", TEXT), m.Refused("code", TEXT + "t")),
        (m.Refused("code", WIDE), m.Refused("code", WIDE + "ü")),
        (m.KeepAlive("s", 0, 0, (), REPORT), m.KeepAlive("s", 0, 0, (), REPORT + b"r")),
        (m.Break(limits.INTEGER_MAX, ""), m.Break(limits.INTEGER_MAX + 1, "")),
        (commit(WRITE._replace(datum=Datum(ENCODING, b"", 0))),
         commit(WRITE._replace(datum=Datum(ENCODING + b"e", b"", 0)))),
        (commit(WRITE._replace(datum=Datum(b"", b"", 0, limits.INTEGER_MAX))),
         commit(WRITE._replace(datum=Datum(b"", b"", 0, limits.INTEGER_MAX + 1)))),
        (m.Registered(("a",) * limits.ENTRIES_MAX, ()),
         m.Registered(("a",) * (limits.ENTRIES_MAX + 1), ())),
        (m.Survey(("a",) * limits.ITEMS_MAX, (), ()), m.Survey(("a",) * (limits.ITEMS_MAX + 1), (), ())),
    ],
    ids=["items", "writes", "context", "entity", "aspect", "session", "lock session", "text",
         "wide text", "report", "integer", "encoding", "stamp", "entries", "contexts"],
)  # fmt: skip
def test_message_at_its_limit_passes_and_one_over_is_refused(at, over):
    """The limit itself is allowed; beyond it ProtocolError names what was too much."""
    assert sent(at) == at
    with pytest.raises(ProtocolError):
        sent(over)


def test_integers_of_lists_are_limited_too():
    """No integer of a frame exceeds what a store's column holds."""
    holder = m.Holder(LOCK, 1, "a", "h", 1, True, "w", 0, 0, 0, (), (limits.INTEGER_MAX,))

    assert sent(m.Locks(1, (holder,))).holders == (holder,)
    with pytest.raises(ProtocolError):
        sent(m.Locks(1, (holder._replace(waits_for=(1 << 63,)),)))


def test_header_is_limited_on_both_sides():
    """A header over 16 MiB is neither sent nor read."""
    slots = tuple(str(index).zfill(8) + "x" * 190 for index in range(90_000))

    with pytest.raises(ProtocolError, match=r"header of .* bytes; at most"):
        encode_frame(m.Survey(slots, (), ()))
    with pytest.raises(ProtocolError, match="at most"):
        decode_frame(bytes([0x93, 1, 1]) + bytes(limits.HEADER_BYTES_MAX), b"")


def test_array_that_only_looks_too_large_is_refused_without_a_copy():
    """One line that stands for a terabyte: its copy would take the memory of the machine."""
    broad = np.broadcast_to(np.uint8(0), (1 << 20, 1 << 20))

    with pytest.raises(DatumTypeError, match=r"list\[0\]: it has 1099511627776 bytes; at most 10"):
        encode_datum([broad], list)


def test_body_is_limited_on_both_sides():
    """A datum over 1 GiB is refused before a byte of it is copied."""
    zeros = np.zeros(limits.BODY_BYTES_MAX + 1, np.uint8)  # pages that are never touched

    with pytest.raises(DatumTypeError, match="1073741825 bytes; at most 1073741824; split"):
        encode_datum(zeros, np.ndarray)
    with pytest.raises(ProtocolError, match="at most 1073741824"):
        encode_frame(commit(WRITE._replace(datum=Datum(b"", memoryview(zeros), zeros.size))))
    with pytest.raises(ProtocolError):
        decode_datum(Datum(b"\x01\x00", memoryview(zeros), zeros.size), int)


def test_payload_is_limited_on_both_sides():
    """Several data in one message together stay below one largest body and its padding."""
    zeros = np.zeros(limits.PAYLOAD_BYTES_MAX + 1, np.uint8)
    half = memoryview(zeros)[: limits.PAYLOAD_BYTES_MAX // 2 + 1]
    header, _ = encode_frame(m.Goodbye("s"))

    with pytest.raises(ProtocolError, match="in one message; write fewer"):
        encode_frame(commit(*[WRITE._replace(datum=Datum(b"", half, len(half)))] * 2))
    with pytest.raises(ProtocolError, match="at most"):
        decode_frame(header, memoryview(zeros))


def test_tree_is_limited():
    """What is long beside its arrays is told to become an array."""
    with pytest.raises(DatumTypeError, match="put long lists into arrays"):
        encode_datum([False] * (limits.TREE_BYTES_MAX + 1), list)


def test_tree_is_limited_for_the_reader():
    """A tree that no writer makes is not even read."""
    raw = bytes(limits.TREE_BYTES_MAX + 1)
    tree = msgpack.ExtType(7, msgpack.packb([0, len(raw)]))

    with pytest.raises(ProtocolError, match="a tree of 16777217 bytes; at most"):
        decode_datum(Datum(b"\x01" + msgpack.packb(tree), raw, len(raw)), list)


def test_depth_is_limited():
    """32 lists in each other pass; 33 do not."""
    value: object = 1
    for _ in range(limits.DEPTH_MAX):
        value = [value]

    assert decode_datum(encode_datum(value, list), list) == value
    for deeper in ([value], {"a": value}):
        with pytest.raises(DatumTypeError, match="nested deeper than 32"):
            encode_datum(deeper, type(deeper))


def test_dimensions_are_limited():
    """32 dimensions pass; 33, which only newer numpy has, do not."""
    array = np.zeros((1,) * limits.DIMENSIONS_MAX)

    assert decode_datum(encode_datum(array, np.ndarray), np.ndarray).shape == array.shape
    if hasattr(np, "bitwise_count"):  # numpy 2
        with pytest.raises(DatumTypeError, match="33 dimensions; at most 32"):
            encode_datum(array[None], np.ndarray)


def test_fields_of_a_structure_are_limited():
    """1024 fields pass; 1025 do not, nested ones counted."""
    names = [f"f{index}" for index in range(limits.FIELDS_MAX)]
    at = np.zeros(1, [(name, "u1") for name in names])
    over = np.zeros(1, [("inner", at.dtype)])

    assert decode_datum(encode_datum(at, np.ndarray), np.ndarray).dtype == at.dtype
    with pytest.raises(DatumTypeError, match="over 1024 fields"):
        encode_datum(over, np.ndarray)
