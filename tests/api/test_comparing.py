"""What comparators promise: the same either way round, exact at the edge, NaN said once."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from enact_dist.comparing import BLOCK_ELEMENTS, EQUAL, EXACT, Difference, Tolerance, worst
from enact_dist.wire.payload import decode_datum, encode_datum

NAN, INF = math.nan, math.inf
numbers = st.floats(width=64) | st.integers(-(1 << 63), (1 << 63) - 1)
tolerances = st.builds(
    Tolerance,
    absolute=st.floats(0.0, 1e6),
    relative=st.floats(0.0, 0.99),
)
plain = st.recursive(
    st.booleans() | numbers | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=4)
    ),
    max_leaves=12,
)
dtypes = st.sampled_from(
    ["<f8", ">f4", "<f2", "<i8", "<u8", "|i1", "|u1", "|b1", "<c8", "<U3", "<M8[ns]"]
)
shapes = arrays.array_shapes(min_dims=0, max_dims=3, max_side=4)


@st.composite
def two_arrays(draw):
    """Two arrays of one shape and dtype, of which some elements agree."""
    dtype, shape = np.dtype(draw(dtypes)), draw(shapes)
    one = draw(arrays.arrays(dtype, shape))
    other = draw(arrays.arrays(dtype, shape))
    agree = draw(arrays.arrays(np.bool_, shape))
    return one, np.where(agree, one, other).astype(dtype)


@dataclass(frozen=True, slots=True, eq=False)
class Inner:
    shift_mm: float
    captured_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Outer:
    name: str
    inner: Inner
    points_m: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))


def verdict(found):
    return found.distance, found.crossed


# ---------------------------------------------------------------- laws


@given(tolerances, plain, plain)
def test_plain_values_compare_the_same_either_way_round(tolerance, left, right):
    """Distance and verdict do not depend on which side is called left."""
    assert verdict(tolerance(left, right)) == verdict(tolerance(right, left))


@given(tolerances, two_arrays())
def test_arrays_compare_the_same_either_way_round(tolerance, both):
    """So do arrays of any dtype, shape and byte order."""
    assert verdict(tolerance(*both)) == verdict(tolerance(*both[::-1]))


@given(tolerances, plain)
def test_a_value_does_not_differ_from_its_copy(tolerance, value):
    """A datum that has travelled is what it was, NaN included."""
    copy = decode_datum(encode_datum(value, object), object)
    assert verdict(tolerance(value, copy)) == (0.0, False)


@given(tolerances, two_arrays())
def test_an_array_does_not_differ_from_its_copy(tolerance, both):
    """NaN and not-a-time are equal to themselves."""
    found = tolerance(both[0], both[0].copy())
    assert (found.distance, found.crossed) == (0.0, False)


@given(two_arrays())
def test_exact_says_equal_only_of_equal_arrays(both):
    """`EXACT` is crossed as soon as one element differs."""
    one, other = both
    if one.dtype.kind in "fcM":
        same = np.array_equal(one, other, equal_nan=True)
    else:
        same = np.array_equal(one, other)
    assert EXACT(one, other).crossed is not same


@given(tolerances, st.floats(-1e300, 1e300), st.floats(-1e300, 1e300))
def test_numbers_are_judged_by_the_larger_tolerance(tolerance, left, right):
    """As `math.isclose` does, with both bounds inclusive."""
    close = math.isclose(left, right, rel_tol=tolerance.relative, abs_tol=tolerance.absolute)
    allowed = max(tolerance.absolute, tolerance.relative * max(abs(left), abs(right)))
    assert tolerance(left, right).crossed is (abs(left - right) > allowed)
    if abs(left - right) != allowed:
        assert tolerance(left, right).crossed is not close


@given(tolerances, arrays.arrays(np.float64, (2, 5)))
def test_an_array_is_judged_as_its_elements_are(tolerance, both):
    """The worst element decides, and is the one that is named."""
    left, right = both
    each = [tolerance(float(a), float(b)) for a, b in zip(left, right, strict=True)]
    found = tolerance(left, right)

    assert found.crossed is any(one.crossed for one in each)
    assert found.distance == worst(each).distance
    if found.distance:
        index = int(found.where.strip("[]"))
        assert each[index].distance == found.distance


@given(st.integers(-(1 << 63), (1 << 63) - 1), st.integers(-(1 << 63), (1 << 63) - 1))
def test_differences_of_integers_do_not_wrap(left, right):
    """The largest less the smallest is what it is, as plain numbers and in arrays."""
    distance = float(abs(left - right))
    assert EXACT(left, right).distance == distance
    assert EXACT(np.array([left]), np.array([right])).distance == distance


# ---------------------------------------------------------------- edges


@pytest.mark.parametrize("made", [float, np.float64, lambda x: np.array([x]), lambda x: [x]])
def test_distance_at_the_tolerance_is_within_it(made):
    """Exactly at the edge nothing is crossed; the next number beyond is."""
    edge = Tolerance(absolute=0.5)
    assert not edge(made(1.0), made(1.5)).crossed
    assert edge(made(1.0), made(math.nextafter(1.5, 2.0))).crossed
    assert not edge(made(1.0), made(math.nextafter(1.5, 1.0))).crossed


@pytest.mark.parametrize("made", [float, lambda x: np.array([x])])
@pytest.mark.parametrize(
    ("left", "right", "distance"),
    [
        (NAN, NAN, 0.0),
        (NAN, 1.0, INF),
        (INF, INF, 0.0),
        (INF, -INF, INF),
        (INF, 1e308, INF),
        (0.0, -0.0, 0.0),
    ],
)
def test_nan_and_infinity(made, left, right, distance):
    """NaN is *not known* and equals itself; infinities equal themselves; no tolerance hides either."""
    found = Tolerance(absolute=1e300, relative=0.9)(made(left), made(right))
    assert verdict(found) == (distance, distance > 0.0)


@pytest.mark.parametrize(
    ("left", "right", "what"),
    [
        (np.zeros(3), np.zeros((3, 1)), "shape (3,) against (3, 1)"),
        (np.zeros(3), np.zeros(3, np.float32), "dtype float64 against float32"),
        (1, 1.0, "int against float"),
        (True, 1, "bool against int"),
        (None, 0, "None against int"),
        ([1], [1, 2], "1 elements against 2"),
        ({"a": 1}, {"b": 1}, "only left: 'a'; only right: 'b'"),
        ("ok", "missing", "'ok' against 'missing'"),
    ],
)
def test_what_no_number_can_say_is_named(left, right, what):
    """Another shape, dtype, type, length, key or text differs whatever the tolerance."""
    found = Tolerance(absolute=1e9)(left, right)
    assert verdict(found) == (INF, True)
    assert found.what == what


def test_byte_order_is_no_difference():
    """The same numbers are the same, however they lie in memory."""
    one = np.arange(12, dtype=">i4").reshape(3, 4)
    assert EXACT(one, np.asfortranarray(one.astype("<i4"))) == EQUAL
    changed = np.asfortranarray(one.astype("<i4"))
    changed[2, 1] += 5
    assert (EXACT(one, changed).distance, EXACT(one, changed).where) == (5.0, "[2, 1]")


def test_worst_element_of_a_large_array_is_found_beyond_the_first_block():
    """Arrays are compared block by block, with the index in the whole."""
    one = np.zeros((3, BLOCK_ELEMENTS))
    other = one.copy()
    other[0, 7], other[2, 11] = 1.0, -3.0
    found = Tolerance(absolute=0.5, unit="mm")(one, other)
    assert (found.distance, found.where, found.unit) == (3.0, "[2, 11]", "mm")
    assert found.what == "0.0 against -3.0"
    assert str(found) == "3 mm apart (0.5 mm allowed) at [2, 11]: 0.0 against -3.0"


def test_dataclass_names_its_worst_field():
    """Fields are set against their own tolerances, so the largest number is not the worst."""
    tolerance = Tolerance(
        absolute=1.0,
        fields={"captured_ns": None, "shift_mm": Tolerance(absolute=0.1, unit="mm")},
    )
    left = Outer("a", Inner(0.0, 1), np.zeros((3, 3)))
    right = Outer("a", Inner(0.5, 999), np.full((3, 3), 1.5))

    found = tolerance(left, right)

    assert (found.where, found.distance, found.unit) == (".inner.shift_mm", 0.5, "mm")
    assert found.excess == pytest.approx(5.0)
    assert tolerance(left, Outer("b", left.inner)).where == ".name"
    assert tolerance(left, Outer("a", Inner(0.05, 2), np.ones((3, 3)))).crossed is False


def test_fields_are_found_without_their_class():
    """A record that came as a dict with its type's name is compared as one."""
    tolerance = Tolerance(fields={"captured_ns": None})
    left = {"__type__": "Inner", "shift_mm": 1.0, "captured_ns": 1}
    assert tolerance(left, {**left, "captured_ns": 2}) == EQUAL
    assert tolerance(left, {**left, "shift_mm": 2.0}).where == ".shift_mm"
    assert tolerance(left, {**left, "__type__": "Other"}).what == "Inner against Other"


def test_structured_arrays_are_compared_by_field():
    """Each field of a structured dtype has its place and its own comparator."""
    dtype = np.dtype([("x_m", "<f4"), ("label", "<U4"), ("time_ns", "<i8")])
    one = np.zeros(4, dtype)
    other = one.copy()
    other["time_ns"] = 5
    other["x_m"][2] = 0.25
    found = Tolerance(fields={"time_ns": None})(one, other)
    assert (found.where, found.distance) == (".x_m[2]", 0.25)


def test_bytes_without_a_meaning_are_equal_or_not():
    """Raw items of a dtype without fields have no distance."""
    one = np.array([b"abc", b"def"], "V3")
    other = np.array([b"abc", b"dex"], "V3")
    assert EXACT(one, one.copy()) == EQUAL
    assert (EXACT(one, other).where, EXACT(one, other).distance) == ("[1]", INF)


def test_dicts_are_compared_key_by_key():
    """The path tells which value it is."""
    found = EXACT({"a": [1, 2], "b": [3]}, {"a": [1, 5], "b": [3]})
    assert (found.where, found.distance, found.what) == ("['a'][1]", 3.0, "2 against 5")


def test_foreign_comparator_keeps_its_place():
    """Any callable of two data may stand for a field; its own path follows the field's."""

    def lengths(left, right):
        return Difference(
            abs(len(left) - len(right)), 1.0, abs(len(left) - len(right)) > 1, "m", "[0]"
        )

    found = Tolerance(fields={"points_m": lengths})(
        Outer("a", Inner(0.0, 0), np.zeros((3, 3))), Outer("a", Inner(0.0, 0), np.zeros((9, 3)))
    )
    assert (found.where, found.distance, found.unit, found.crossed) == (
        ".points_m[0]",
        6,
        "m",
        True,
    )


@pytest.mark.parametrize(
    "wrong", [{"absolute": -1.0}, {"absolute": NAN}, {"absolute": INF}, {"relative": 1.0}]
)
def test_tolerance_that_cannot_be_kept_to_is_refused(wrong):
    """Negative, unknown or boundless tolerances would hide every difference, or none."""
    with pytest.raises(ValueError, match="tolerance"):
        Tolerance(**wrong)
