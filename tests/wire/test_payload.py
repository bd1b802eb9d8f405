"""Data: every datum type comes back equal and of its types, arrays read-only and without a copy."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from numpy.typing import NDArray

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import DatumTypeError
from enact_dist.wire.codecs import register_codec
from enact_dist.wire.limits import ALIGNMENT, ENCODING_BYTES_MAX, LEAF_BYTES_MAX
from enact_dist.wire.payload import decode_datum, decode_untyped, encode_datum


@dataclass(frozen=True)
class Pose:
    world_from_body: NDArray[np.float64]
    valid: bool = True


@dataclass(frozen=True)
class Surface:
    vertices_m: np.ndarray
    triangles: np.ndarray
    pose: Pose
    name: str = ""
    scale: float = 1.0
    colours: NDArray[np.uint8] | None = None
    tags: list[str] = field(default_factory=list)
    parts: dict[str, Pose] = field(default_factory=dict)
    poses: tuple[Pose, ...] = ()
    extent: tuple[float, int] = (0.0, 0)
    loose: list = field(default_factory=list)


class Colour(enum.Enum):
    RED = 1


class Celsius(float):
    pass


register_codec(PurePosixPath, "path", encode=str, decode=PurePosixPath)
register_codec(complex, "complex", encode=lambda z: [z.real, z.imag], decode=lambda p: complex(*p))


def round_trip(value, datum_type):
    return decode_datum(encode_datum(value, datum_type), datum_type)


def same(one, other):
    """Say whether two values are equal, of the same types, and arrays equal in every bit."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        alike = (one.dtype, one.shape) == (other.dtype, other.shape)
        return alike and one.tobytes() == other.tobytes()
    if isinstance(one, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if hasattr(one, "__dataclass_fields__"):
        names = one.__dataclass_fields__
        return all(same(getattr(one, name), getattr(other, name)) for name in names)
    return one == other


# ---------------------------------------------------------------- strategies

INTEGERS = st.integers(-(2**63), 2**64 - 1)
SCALARS = (
    INTEGERS
    | st.floats()
    | st.booleans()
    | st.text(max_size=40)
    | st.binary(max_size=40)
    | st.sampled_from(["x" * 256, "x" * 257, "ü" * 128, "ü" * 129, "名" * 3000])
    | st.sampled_from([b"x" * 256, b"x" * 257, bytes(range(256)) * 20])
)
DTYPES = nps.scalar_dtypes() | nps.array_dtypes(allow_subarrays=True, max_size=3)
ARRAYS = DTYPES.flatmap(
    lambda dtype: nps.arrays(
        dtype, nps.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)
    )
)
PLAIN = st.recursive(
    SCALARS | ARRAYS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text(max_size=5), inner, max_size=3)
        | st.dictionaries(INTEGERS, inner, max_size=3)
    ),
    max_leaves=8,
)
POSES = st.builds(Pose, nps.arrays(np.float64, (4, 4)), st.booleans())
SURFACES = st.builds(
    Surface,
    ARRAYS,
    ARRAYS,
    POSES,
    st.text(max_size=300),
    st.floats(),
    st.none() | nps.arrays(np.uint8, (2, 3)),
    st.lists(st.text(max_size=5), max_size=3),
    st.dictionaries(st.text(max_size=5), POSES, max_size=2),
    st.lists(POSES, max_size=2).map(tuple),
    st.tuples(st.floats(), INTEGERS),
    st.lists(PLAIN, max_size=3),
)


# ---------------------------------------------------------------- round trips


@given(SCALARS)
def test_scalar_comes_back_equal(value):
    """int, float, bool, str and bytes of any length come back equal and of the same type."""
    assert same(round_trip(value, type(value)), value)


@given(PLAIN)
def test_plain_value_comes_back_equal(value):
    """Lists and dicts of anything plain, nested, come back equal, keys in order."""
    assert same(round_trip(value, type(value)), value)


@given(ARRAYS)
def test_array_comes_back_equal_in_every_bit(array):
    """Every dtype (big-endian, structured, datetime, text) and shape (0-d, empty) is carried."""
    decoded = round_trip(array, np.ndarray)

    assert same(decoded, array)
    assert not decoded.flags.writeable


@settings(max_examples=40)
@given(SURFACES)
def test_dataclass_comes_back_equal(surface):
    """Nested frozen dataclasses with all kinds of fields come back equal and of their classes."""
    assert same(round_trip(surface, Surface), surface)


@pytest.mark.parametrize(
    "array",
    [
        np.asfortranarray(np.arange(12.0).reshape(3, 4)),
        np.arange(24, dtype=">i2").reshape(2, 3, 4).transpose(2, 0, 1),
        np.arange(20)[::-2],
        np.arange(20, dtype="<c8")[3:15:4],
        np.broadcast_to(np.float32(2.5), (3, 2)),
        np.array(7, dtype="<M8[25s]"),
        np.array(["NaT", "2026-11-21"], dtype="M8[ns]"),
        np.array(["", "größe"], dtype=">U7"),
        np.zeros((0, 3), order="F"),
        np.zeros((2, 0), dtype="V7"),
        np.array([(1, 2.0, "a")], dtype=np.dtype("i1,f8,U3", align=True)),
        np.zeros(3, dtype=[("depth_m", ">f4", (2, 3)), ("inner", [("a", "u1"), ("b", "?")])]),
        np.zeros(2, dtype={"names": ["b"], "formats": ["i2"], "offsets": [3], "itemsize": 9}),
        np.zeros(2, dtype=[(("a title", "name"), "i4")]),
        np.arange(3, dtype=np.longdouble),
    ],
    ids=lambda array: f"{array.dtype.str}{array.shape}{'F' if array.flags.fnc else ''}",
)
def test_array_comes_back_equal_from_any_layout(array):
    """Memory order and strides of the writer do not matter; Fortran order is kept."""
    decoded = round_trip(array, np.ndarray)

    assert decoded.dtype == array.dtype
    assert decoded.dtype.isalignedstruct == array.dtype.isalignedstruct or array.dtype.fields
    np.testing.assert_array_equal(decoded, array)
    assert decoded.flags.fnc == array.flags.fnc


def test_array_of_a_mapped_file_is_a_datum(tmp_path):
    """A memory map is an array like any other, and comes back as one."""
    mapped = np.memmap(tmp_path / "cloud", dtype=np.float32, shape=(4, 3), mode="w+")

    assert type(round_trip(mapped, np.ndarray)) is np.ndarray


# ---------------------------------------------------------------- laws of arrays and bodies


def test_array_cannot_be_changed_after_decoding():
    """A change in place raises at once, and write access cannot be taken back."""
    for body in (bytes, bytearray, lambda raw: memoryview(bytearray(raw))):
        sent = encode_datum(np.arange(3), np.ndarray)
        array = decode_datum(Datum(sent.encoding, body(sent.body), sent.size), np.ndarray)

        with pytest.raises(ValueError, match="assignment destination is read-only"):
            array[0] = 1
        with pytest.raises(ValueError, match="WRITEABLE"):
            array.flags.writeable = True


def test_array_is_a_view_of_the_body():
    """Decoding copies no array: it lies in the body's own memory, at a multiple of 64."""
    surface = Surface(np.ones(3, np.uint8), np.ones((100, 3)), Pose(np.eye(4)))
    datum = encode_datum(surface, Surface)

    decoded = decode_datum(datum, Surface)

    whole = np.frombuffer(datum.body, np.uint8)
    start = whole.__array_interface__["data"][0]
    for array in (decoded.vertices_m, decoded.triangles, decoded.pose.world_from_body):
        assert np.shares_memory(array, whole)
        assert (array.__array_interface__["data"][0] - start) % ALIGNMENT == 0


def test_datum_is_a_copy_of_its_value():
    """Changing the arrays afterwards does not reach the datum."""
    array = np.zeros(1000)
    datum = encode_datum(array, np.ndarray)

    array[:] = 1.0

    assert not decode_datum(datum, np.ndarray).any()


def test_datum_size_is_the_length_of_its_body():
    """Scalars have none; a body ends with its last part, without padding."""
    assert encode_datum(5, int) == Datum(b"\x01\x05", b"", 0)
    assert encode_datum([np.ones(1), np.ones(1)], list).size == 64 + 8


def test_datum_moves_long_text_and_bytes_into_the_body():
    """Up to 256 bytes stay in the tree; longer ones are referred to."""
    assert encode_datum("x" * LEAF_BYTES_MAX, str).size == 0
    assert encode_datum("x" * (LEAF_BYTES_MAX + 1), str).body == b"x" * (LEAF_BYTES_MAX + 1)
    assert encode_datum("ü" * (LEAF_BYTES_MAX // 2), str).size == 0
    assert encode_datum("ü" * (LEAF_BYTES_MAX // 2 + 1), str).size == LEAF_BYTES_MAX + 2
    assert encode_datum(b"x" * (LEAF_BYTES_MAX + 1), bytes).size == LEAF_BYTES_MAX + 1


@pytest.mark.parametrize("length", [1360, 1364, 1365, 1400, 100_000])
def test_datum_moves_a_long_tree_into_the_body(length):
    """An encoding never exceeds 4 KiB and its version, and long lists come back whole."""
    values = [1000 + index % 7 for index in range(length)]

    datum = encode_datum(values, list)

    assert len(datum.encoding) <= ENCODING_BYTES_MAX + 1
    assert bool(datum.size) == (len(msgpack.packb(values)) > ENCODING_BYTES_MAX)
    assert decode_datum(datum, list) == values
    assert decode_untyped(datum) == values


def test_datum_encoding_follows_its_documentation():
    """The documented bytes of a dataclass with an array, so that another language can read it."""
    datum = encode_datum(Pose(np.eye(4)), Pose)

    version, record = list(msgpack.Unpacker(_stream(datum.encoding)))
    name, fields, (array, valid) = msgpack.unpackb(record.data)
    assert (version, record.code, name, fields, valid) == (
        1, 4, "Pose", ["world_from_body", "valid"], True,
    )  # fmt: skip
    assert array.code == 1
    assert msgpack.unpackb(array.data) == ["<f8", [4, 4], "C", 0, 128]


def _stream(raw):
    import io

    return io.BytesIO(raw)


# ---------------------------------------------------------------- without the Python type


def test_untyped_shows_dataclasses_and_codecs_as_dicts():
    """A reader without the classes sees names, fields and arrays."""
    surface = Surface(
        np.ones(2), np.ones(3), Pose(np.eye(4), valid=False), poses=(Pose(np.eye(1)),)
    )

    seen = decode_untyped(encode_datum(surface, Surface))
    path = decode_untyped(encode_datum(PurePosixPath("/a/b"), PurePosixPath))

    assert seen["__type__"] == "Surface"
    assert seen["pose"]["__type__"] == "Pose"
    assert seen["pose"]["valid"] is False
    assert same(seen["poses"][0]["world_from_body"], np.eye(1))
    assert seen["colours"] is None
    assert seen["tags"] == []
    assert path == {"__type__": "path", "value": "/a/b"}


@given(PLAIN)
def test_untyped_plain_value_is_the_value(value):
    """Plain values need no type to be read."""
    assert same(decode_untyped(encode_datum(value, type(value))), value)


# ---------------------------------------------------------------- what is accepted for what


@pytest.mark.parametrize(
    ("value", "datum_type", "kept"),
    [
        (np.float64(1.5), float, 1.5),
        (np.float32(1.5), float, 1.5),
        (3, float, 3.0),
        (np.int16(3), int, 3),
        (np.bool_(True), bool, True),
        ([np.float64(1.5), np.int8(2)], list, [1.5, 2]),
        ([1, 2.5], list[float], [1.0, 2.5]),
        (PurePosixPath("/a"), PurePosixPath, PurePosixPath("/a")),
        ({"a": [1j]}, dict[str, list[complex]], {"a": [1j]}),
        ((), tuple[int, ...], ()),
        ({1: "a"}, dict[int, str], {1: "a"}),
        ({}, dict, {}),
    ],
)  # fmt: skip
def test_value_is_accepted_as(value, datum_type, kept):
    """Numpy's scalars and ints for floats become Python's own; codecs work inside containers."""
    assert same(round_trip(value, datum_type), kept)


@pytest.mark.parametrize(
    ("value", "datum_type", "message"),
    [
        (True, int, r"int: asked int, found bool True"),
        (1, bool, r"bool: asked bool, found int 1"),
        (1.0, int, r"asked int, found float 1\.0"),
        (2**64, int, r"asked an int of at most 64 bits, found int 18446744073709551616"),
        (-(2**63) - 1, int, "at most 64 bits"),
        ([2**64], list, "at most 64 bits"),
        ({2**64: 1}, dict, "at most 64 bits"),
        (2**53 + 1, float, "a float holds exactly"),
        (10**400, float, "a float holds exactly|asked float"),
        (None, int, "found NoneType None"),
        (None, dict, "asked dict, found NoneType"),
        ([1, None], list, r"list\[1\]: None is no datum: .*del lock\[request\].*X \| None"),
        ((1, 2), list, r"asked list, found tuple \(1, 2\)"),
        ([(1, 2)], list, r"list\[0\]: .*found tuple \(1, 2\); tuples need an annotation"),
        ([Colour.RED], list, r"an enum needs register_codec\(\)"),
        ([Pose(np.eye(4))], list, r"annotate the container, as in list\[Pose\]"),
        ({"a": {"b": [1, object()]}}, dict, r"dict\['a'\]\['b'\]\[1\]: asked a plain value"),
        ({1.5: 2}, dict, "keys all str or all int"),
        ({1: 2, "a": 3}, dict, "keys all str or all int"),
        ({True: 2}, dict, "keys all str or all int"),
        ({"a": 1}, dict[int, int], "asked keys of int, found str 'a'"),
        (bytearray(b"x"), bytes, "found bytearray"),
        (Celsius(1.5), float, "found .*Celsius"),
        ("\ud800", str, "lone surrogate at 0"),
        ("\ud800" * 300, str, "lone surrogate"),
        ({"\ud800": 1}, dict, "lone surrogate"),
        ([1.0], np.ndarray, r"ndarray: asked numpy.ndarray, found list \[1.0\]"),
        (np.array([None]), np.ndarray, "holds Python objects"),
        (np.empty(3, "V0"), np.ndarray, r"ndarray: 3 items of dtype \|V0, which has no size"),
        ([np.empty((), np.dtype([]))], list, r"list\[0\]: 1 items of dtype \[\], which has no size"),
        (np.ma.array([1]), np.ndarray, "found numpy.ma.MaskedArray"),
        (np.zeros(1, {"names": ["a"], "formats": ["i4"], "titles": [7]}), np.ndarray,
         "a title that is no text: 7"),
        (np.zeros(3, np.float32), NDArray[np.float64],
         r"^ndarray\[float64\]: asked ndarray\[float64\], found dtype float32; .*astype\('float64'\)"),
        (np.longdouble(1), float, "asked float, found numpy.longdouble"),
        ((1.0,), tuple[float, int], "asked a tuple of 2, found tuple"),
        ((1.0, "a"), tuple[float, int], r"\[1\]: asked int, found str 'a'"),
        (Surface([[0.0]], np.eye(3), Pose(np.eye(4))), Surface,
         r"Surface\.vertices_m: asked numpy\.ndarray, found list"),
        (Surface(np.eye(3), np.eye(3), Pose(np.eye(4)), parts={"a": Pose(1)}), Surface,
         r"Surface\.parts\['a'\]\.world_from_body: asked numpy\.ndarray, found int 1"),
        (Surface(np.eye(3), np.eye(3), Pose(np.eye(4)), poses=(Pose(np.eye(4)), 3)), Surface,
         r"Surface\.poses\[1\]: asked Pose, found int 3"),
    ],
)  # fmt: skip
def test_value_is_refused_with_path_asked_and_found(value, datum_type, message):
    """A value that would not come back as it is names its place, what was asked and found."""
    with pytest.raises(DatumTypeError, match=message):
        encode_datum(value, datum_type)


def test_value_that_contains_itself_is_refused():
    """A cycle ends at the depth limit."""
    cycle: list = []
    cycle.append(cycle)

    with pytest.raises(DatumTypeError, match="nested deeper than 32"):
        encode_datum(cycle, list)


def test_refusal_of_a_huge_value_is_short():
    """A message never holds the datum."""
    with pytest.raises(DatumTypeError) as caught:
        encode_datum(list(range(1_000_000)), dict)

    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("stamp_ns", [-1, 1 << 63, 1.5, True, None])
def test_stamp_is_refused_outside_its_range(stamp_ns):
    """A stamp is an int of nanoseconds since 1970 that a store can keep."""
    for value, datum_type in ((1, int), ("a", str)):
        with pytest.raises(DatumTypeError, match="stamp_ns"):
            encode_datum(value, datum_type, stamp_ns=stamp_ns)


def test_stamp_travels_with_the_datum():
    """The stamp of the capture is part of the datum, not of its encoding."""
    assert encode_datum("a", str, stamp_ns=77).stamp_ns == 77


# ---------------------------------------------------------------- other types at the reader


@pytest.mark.parametrize(
    ("written", "datum_type", "message"),
    [
        (5, str, "str: asked str, the datum holds int"),
        (True, int, "int: asked int, the datum holds bool"),
        ("a", np.ndarray, "asked numpy.ndarray, the datum holds str"),
        ([1], dict, "asked dict, the datum holds list"),
        ([1], Pose, r"asked Pose\(world_from_body, valid\), the datum holds list"),
        ({"a": 1}, dict[int, int], "keys of int"),
        ([1, "a"], list[int], r"\[1\]: asked int, the datum holds str"),
        (np.zeros(2, np.int8), NDArray[np.float64], r"ndarray\[float64\], the datum holds int8"),
        ([1], tuple[int, ...], "asked tuple, the datum holds list"),
        ("a", PurePosixPath, "asked codec path, the datum holds str"),
    ],
)
def test_datum_of_another_type_is_refused(written, datum_type, message):
    """Reading with the wrong type never converts."""
    with pytest.raises(DatumTypeError, match=message):
        decode_datum(encode_datum(written, type(written)), datum_type)


def test_datum_of_a_changed_dataclass_is_refused_with_both_sides():
    """Fields added or renamed since it was written are shown."""
    sent = encode_datum(Pose(np.eye(4)), Pose)

    @dataclass(frozen=True)
    class Pose2:
        matrix: np.ndarray

    @dataclass(frozen=True)
    class Other:
        world_from_body: np.ndarray
        valid: bool

    with pytest.raises(DatumTypeError, match=r"asked Other\(world_from_body, valid\), .* Pose\("):
        decode_datum(sent, Other)
    Pose2.__name__ = Pose2.__qualname__ = "Pose"
    with pytest.raises(
        DatumTypeError, match=r"asked Pose\(matrix\), .* holds Pose\(world_from_body, valid\)"
    ):
        decode_datum(sent, Pose2)
