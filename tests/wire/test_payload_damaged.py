"""Damaged data: refused by name, at small cost; arrays of a petabyte exist only as claims."""

from __future__ import annotations

import contextlib
import random
import reprlib
import tracemalloc
from dataclasses import dataclass

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from wire_samples import damaged

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import DatumTypeError, ProtocolError
from enact_dist.wire.payload import decode_datum, decode_untyped, encode_datum
from enact_dist.wire.tree_writer import ARRAY, BYTES, CODEC, RECORD, TEXT, TREE, TUPLE, reference

BODY = bytes(range(256)) * 4


@dataclass(frozen=True)
class Scan:
    points_m: np.ndarray
    weights: NDArray[np.float32] | None
    labels: list[str]
    scores: dict[int, float]
    box: tuple[float, ...]
    note: str


SCAN = Scan(
    np.zeros(3, dtype=[("xyz", "<f4", (3,)), ("when", "<M8[us]")]),
    np.asfortranarray(np.ones((2, 3), np.float32)),
    ["a", "b" * 300],
    {1: 0.5, -7: 2.5},
    (1.0, 2.0),
    "note",
)
SOURCES = [
    (SCAN, Scan),
    (5, int),
    ({"a": [1, "x" * 300, b"y" * 300, np.arange(5)]}, dict),
    (list(range(2000)), list),
]


NESTED: list = []
for _ in range(490):
    NESTED = [NESTED]


def datum_of(tree, body=BODY):
    return Datum(b"\x01" + msgpack.packb(tree), body, len(body))


def refused(datum, datum_type=object):
    with pytest.raises(ProtocolError):
        decode_datum(datum, datum_type)
    with pytest.raises(ProtocolError):
        decode_untyped(datum)


def test_damage_raises_nothing_but_the_two_errors():
    """4000 data with one damage each are read, refused as damaged, or as of another type."""
    generator = random.Random(20261121)
    sent = [(encode_datum(value, datum_type), datum_type) for value, datum_type in SOURCES]

    refusals = 0
    for number in range(4000):
        datum, datum_type = sent[number % len(sent)]
        encoding, body = datum.encoding, datum.body
        if body and generator.random() < 0.3:
            body = damaged(body, generator)
        else:
            encoding = damaged(encoding, generator)
        changed = Datum(encoding, body, generator.choice((len(body), datum.size)))
        try:
            decode_datum(changed, datum_type)
        except (ProtocolError, DatumTypeError):
            refusals += 1
        try:
            decode_untyped(changed)
        except ProtocolError:
            refusals += 1

    assert refusals > 1000, "damage must mostly be found"


@settings(max_examples=500)
@given(st.binary(max_size=100), st.binary(max_size=30))
def test_random_bytes_raise_nothing_but_the_two_errors(encoding, body):
    """Random encodings are refused, as damaged or as of another type."""
    for start in (b"", b"\x01"):
        datum = Datum(start + encoding, body, len(body))
        for datum_type in (Scan, list, np.ndarray):
            try:
                decode_datum(datum, datum_type)
            except (ProtocolError, DatumTypeError):
                continue


@settings(max_examples=300)
@given(
    st.integers(0, 9),
    st.recursive(
        st.none() | st.integers(-5, 200) | st.sampled_from(["<f4", "O", "C", "V0", "M8", "i4,f4"]),
        lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=15,
    ),
)
def test_random_extensions_raise_nothing_but_the_two_errors(code, content):
    """Whatever stands in an extension, only the two errors leave."""
    node = msgpack.ExtType(code, msgpack.packb(content))
    for datum_type in (Scan, list, np.ndarray):
        try:
            decode_datum(datum_of(node), datum_type)
        except (ProtocolError, DatumTypeError):
            continue


@pytest.mark.parametrize(
    "content",
    [
        ("<f8", [1 << 40], "C", 0, 1 << 43),
        ("<f8", [1 << 40], "C", 0, 8),
        ("<f8", [1], "C", 0, 16),
        ("<f8", [0], "C", 0, 8),
        ("i4,f4", [1], "C", 0, 8),
        ("float64", [1], "C", 0, 8),
        (">f8\n", [1], "C", 0, 8),
        ("<f8", [1 << 61, 16], "C", 0, 0),
        ("<f8", [1 << 62, 0], "C", 0, 0),
        ("<f8", [0, (1 << 62) - 1], "C", 0, 0),
        ("<f8", [-1], "C", 0, 8),
        ("<f8", [-1, -1], "C", 0, 8),
        ("<f8", [1.0], "C", 0, 8),
        ("<f8", [True], "C", 0, 8),
        ("<f8", 1, "C", 0, 8),
        ("<f8", [1] * 33, "C", 0, 8),
        ("<f8", [1], "A", 0, 8),
        ("<f8", [1], NESTED, 0, 8),
        ("<f8", [NESTED], "C", 0, 8),
        (NESTED, [1], "C", 0, 8),
        ({"itemsize": NESTED, "fields": []}, [1], "C", 0, 8),
        ("<f8", [1], None, 0, 8),
        ("<f8", [1], "C", -8, 8),
        ("<f8", [1], "C", 1020, 8),
        ("<f8", [1], "C", 0, -8),
        ("<f8", [1], "C", 0.0, 8),
        ("<f8", [1], "C", 0),
        ("|O", [1], "C", 0, 8),
        ("O", [1], "C", 0, 8),
        ("object", [1], "C", 0, 8),
        ("i4,O", [1], "C", 0, 12),
        ("V0", [1 << 40], "C", 0, 0),
        ("S0", [3], "C", 0, 0),
        ("S9999999999", [0], "C", 0, 0),
        ("<M8[parsec]", [1], "C", 0, 8),
        ("nonsense", [1], "C", 0, 8),
        ("", [1], "C", 0, 8),
        (None, [1], "C", 0, 8),
        (["<f8"], [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [["a", "|O", 0]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [["a", "<f8", 1]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [["a", "<f8", -8]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [["a", "<f4", 0], ["a", "<f4", 4]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [["a", "<f8"]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": [[1, "<f8", 0]]}, [1], "C", 0, 8),
        ({"itemsize": 8, "fields": "abc"}, [1], "C", 0, 8),
        ({"itemsize": 1 << 40, "fields": []}, [0], "C", 0, 0),
        ({"itemsize": -8, "fields": []}, [1], "C", 0, 8),
        ({"fields": []}, [1], "C", 0, 8),
        ({"shape": [1 << 40], "item": "<f8"}, [1], "C", 0, 8),
        ({"shape": [1 << 20] * 9, "item": "<f8"}, [0], "C", 0, 0),
        ({"shape": [2], "item": {"shape": "2", "item": "<f8"}}, [1], "C", 0, 8),
    ],
    ids=reprlib.repr,
)  # fmt: skip
def test_array_that_does_not_fit_its_bytes_is_refused(content):
    """dtype, shape and bytes must agree before anything is allocated."""
    tracemalloc.start()
    try:
        refused(datum_of(reference(ARRAY, *content)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 4 << 20


@pytest.mark.parametrize(
    "node",
    [
        msgpack.ExtType(0, b""),
        msgpack.ExtType(8, msgpack.packb([1])),
        msgpack.ExtType(TEXT, msgpack.packb({})),
        msgpack.ExtType(TEXT, b"\xff"),
        msgpack.Timestamp(0),
        reference(TEXT, 0, 1025),
        reference(TEXT, 1 << 62, 1),
        reference(TEXT, 200, 10),
        reference(BYTES, 5, -1),
        reference(BYTES, 5),
        reference(BYTES, "0", 5),
        reference(RECORD, "Scan", ["a"], []),
        reference(RECORD, "Scan", [1], [1]),
        reference(RECORD, b"Scan", ["a"], [1]),
        reference(RECORD, "Scan"),
        reference(CODEC, "path"),
        reference(CODEC, 1, "a"),
        {(1, 2): 3, (4,): reference(TREE, 0, 1)},
        [reference(TREE, 3, 1)],
        reference(TREE, 0, 2000),
        reference(TREE, 100, 50),
    ],
    ids=repr,
)
def test_part_of_no_known_form_is_refused(node):
    """Codes, contents and places that no writer makes are named."""
    refused(datum_of(node))


def test_parts_cannot_be_copied_out_over_and_over():
    """A short tree that refers to one large text many times costs no more than the body."""
    body = b"x" * 1_000_000
    tree = [reference(TEXT, 0, len(body))] * 200

    tracemalloc.start()
    try:
        refused(datum_of(tree, body))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 3 * len(body)


@pytest.mark.parametrize("wrap", [TUPLE, CODEC, RECORD, "list", "dict"])
def test_nesting_without_end_is_refused(wrap):
    """Extensions in extensions, lists in lists: the depth ends before any stack does."""
    tree: object = 1
    for _ in range(900):
        if wrap == "list":
            tree = [tree]
        elif wrap == "dict":
            tree = {"a": tree}
        else:
            content = {TUPLE: [tree], CODEC: ["path", tree], RECORD: ["a", ["f"], [tree]]}[wrap]
            tree = reference(wrap, *content)
    raw = msgpack.packb(tree)
    datum = Datum(b"\x01" + msgpack.packb(reference(TREE, 0, len(raw))), raw, len(raw))

    if wrap in ("list", "dict"):
        # msgpack itself bounds these; the values are read where Python's stack allows it.
        with contextlib.suppress(ProtocolError, DatumTypeError):
            decode_datum(datum, list)
        with contextlib.suppress(ProtocolError):
            decode_untyped(datum)
    else:
        for datum_type in (list, object):
            with pytest.raises(ProtocolError, match="nested deeper"):
                decode_datum(datum, datum_type)


@pytest.mark.parametrize("wrap", ["list", "dict", TUPLE, RECORD])
def test_nesting_that_no_writer_makes_is_refused(wrap):
    """The reader counts the depth as the writer does: what is read can be written again."""
    wrapped = {
        "list": lambda node: [node],
        "dict": lambda node: {"a": node},
        TUPLE: lambda node: reference(TUPLE, node),
        RECORD: lambda node: reference(RECORD, "a", ["f"], [node]),
    }[wrap]
    trees: list[object] = [1]
    for _ in range(33):
        trees.append(wrapped(trees[-1]))

    decode_untyped(datum_of(trees[32], b""))
    with pytest.raises(ProtocolError, match="nested deeper than 32"):
        decode_untyped(datum_of(trees[33], b""))


def test_value_at_the_greatest_depth_is_read_and_one_deeper_is_not():
    """Lists in a plain list: 32 come back, 33 are refused by both sides."""
    deep: list = []
    for _ in range(31):
        deep = [deep]

    assert decode_datum(encode_datum(deep, list), list) == deep
    with pytest.raises(DatumTypeError, match="nested deeper"):
        encode_datum([deep], list)
    with pytest.raises(ProtocolError, match="nested deeper"):
        decode_datum(datum_of([deep], b""), list)


def test_dict_with_keys_of_both_kinds_is_refused():
    """A writer takes keys all str or all int, so a reader takes nothing else."""
    mixed = datum_of({1: 2, "a": 3}, b"")

    for datum_type in (dict, object):
        with pytest.raises((ProtocolError, DatumTypeError), match="keys"):
            decode_datum(mixed, datum_type)
    with pytest.raises(ProtocolError, match="keys"):
        decode_untyped(mixed)


@pytest.mark.parametrize(
    "datum",
    [
        Datum(b"", b"", 0),
        Datum(b"\x01", b"", 0),
        Datum(b"\x02\x05", b"", 0),
        Datum(b"\x01\x05\x05", b"", 0),
        Datum(b"\x01\x05", b"", 1),
        Datum(b"\x01\x05", b"x", 0),
        Datum(b"\x01\xda\x20\x00" + b"x" * 8192, b"", 0),
        Datum(b"\x01\xc1", b"", 0),
    ],
    ids=["empty", "no tree", "version 2", "two trees", "too short", "too long", "long", "0xc1"],
)
def test_datum_out_of_order_is_refused(datum):
    """Version, one tree, and as many bytes as it says: nothing else is a datum."""
    refused(datum, int)


def test_datum_of_a_later_version_names_both_versions():
    """Data written by a later release say so."""
    with pytest.raises(ProtocolError, match=r"version 2; this side reads 1.*release"):
        decode_datum(Datum(b"\x02\x05", b"", 0), int)
