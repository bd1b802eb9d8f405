"""How far two data are apart, and how far apart they may be.

A *comparator* is anything that takes two data of an aspect and returns a `Difference`; an aspect
names its own with ``Aspect(…, compare=…)``.  `Tolerance` compares plain values, arrays, frozen
dataclasses, lists and dicts, part by part; `EXACT` allows no difference and is the default
comparator.

======================  ==========================================================================
data                    their distance
======================  ==========================================================================
int, float              |left - right|; allowed up to max(absolute, relative x the larger magnitude)
bool, str, bytes, None  0 if equal, else infinite
array                   the largest of its elements; another shape or dtype is infinite
frozen dataclass        the largest of its fields
list, tuple             the largest of its elements; another length is infinite
dict                    the largest of its values; a key of one side only is infinite
======================  ==========================================================================

NaN stands for *not known*: it equals NaN, and is infinitely far from every number.  An infinity
equals itself only.  The largest is the one that exceeds its tolerance most, not the one of the
largest number, since fields differ in their units.

Laws: a datum does not differ from itself; distance and verdict are symmetric; for two data
of different types only that is reported.  The symmetric form of the tolerance is that of PEP 485
(`math.isclose`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Final, Protocol, TypeVar

import numpy as np

T_contra = TypeVar("T_contra", contravariant=True)

BLOCK_ELEMENTS: Final = 1 << 17
"""Elements of an array that are compared in one step: a few MB of memory, whatever its size."""
FIGURES_MIN: Final = 4
"""Digits of a distance that are shown if they are enough."""
FIGURES_MAX: Final = 17
"""Digits that tell any two numbers apart."""
SHOWN_MAX: Final = 40
"""Characters of a value that a difference quotes."""
_EXACT_KINDS: Final = "bSUVmMO"
"""Kinds of dtype that are equal or not; all others are numbers."""


@dataclass(frozen=True, slots=True)
class Difference:
    """What a comparator found.

    Attributes:
        distance: How far the data are apart, in `unit`, at their worst part; infinite if no
            number can express it.
        tolerance: The tolerance there, in `unit`.
        crossed: Whether the distance exceeds the tolerance.
        unit: "mm", "m", …; empty if the data name it themselves, or have none.
        where: The worst part: ``.vertices_m[17, 2]``, ``['place/3'].verdict``; empty for the whole.
        what: The values on either side, as a text.
    """

    distance: float
    tolerance: float = 0.0
    crossed: bool = False
    unit: str = ""
    where: str = ""
    what: str = ""

    @property
    def excess(self) -> float:
        """The distance as a multiple of the tolerance: above 1 if it is crossed."""
        if self.tolerance:
            return self.distance / self.tolerance
        return math.inf if self.distance else 0.0

    def __str__(self) -> str:
        """Return one line: how far, where, what."""
        if not self.distance:
            return "equal"
        place = f" at {self.where}" if self.where else ""
        what = f": {self.what}" if self.what else ""
        if math.isinf(self.distance):
            return f"differ{place}{what}"
        unit = f" {self.unit}" if self.unit else ""
        distance, tolerance = self._figures()
        allowed = f" ({tolerance}{unit} allowed)" if self.tolerance else ""
        return f"{distance}{unit} apart{allowed}{place}{what}"

    def _figures(self) -> tuple[str, str]:
        """Return distance and tolerance with enough digits to show an excess."""
        for digits in range(FIGURES_MIN, FIGURES_MAX + 1):
            distance, tolerance = f"{self.distance:.{digits}g}", f"{self.tolerance:.{digits}g}"
            if distance != tolerance or not self.crossed:
                break
        return distance, tolerance


EQUAL: Final = Difference(0.0)


class Comparator(Protocol[T_contra]):
    """Computes how far two data of an aspect are apart; pure, called once for each pair."""

    def __call__(self, left: T_contra, right: T_contra, /) -> Difference:
        """Return the difference; neither datum is null."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """A comparator of plain values, arrays, dataclasses, lists and dicts, part by part.

    ::

        Tolerance(absolute=0.5, unit="mm")
        Tolerance(fields={"shift_mm": Tolerance(absolute=2.0, unit="mm"), "captured_ns": None})

    Args:
        absolute: How far numbers may be apart, in the unit of the data.
        relative: How far, as a part of the larger magnitude, from 0 to below 1.
        unit: Name of that unit, for display only.
        fields: Comparators for fields of these names, in dataclasses and structured arrays at any
            depth; None excludes a field.

    Raises:
        ValueError: A tolerance is negative or not finite, or `relative` is 1 or more.
    """

    absolute: float = 0.0
    relative: float = 0.0
    unit: str = ""
    fields: Mapping[str, Comparator[Any] | None] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if not 0.0 <= self.absolute < math.inf or not 0.0 <= self.relative < 1.0:
            raise ValueError(
                f"a tolerance is absolute from 0 on and relative from 0 to below 1, not {self!r}"
            )

    def __call__(self, left: object, right: object, /) -> Difference:
        """Return the difference of two data of the same type."""
        return self._compared(left, right, "")

    def _compared(self, left: Any, right: Any, where: str) -> Difference:
        if left is right:
            return EQUAL
        if _kind(left) != _kind(right):
            return self._apart(f"{_kind(left)} against {_kind(right)}", where)
        if isinstance(left, np.ndarray | np.generic):
            return self._arrays(np.asarray(left), np.asarray(right), where)
        if is_dataclass(left):
            return self._records(
                {each.name: getattr(left, each.name) for each in fields(left)},
                {each.name: getattr(right, each.name) for each in fields(right)},
                where,
            )
        if isinstance(left, dict):
            if "__type__" in left:  # a dataclass whose class is not known here
                return self._records(left, right, where)
            return self._dicts(left, right, where)
        if isinstance(left, list | tuple):
            return self._lists(left, right, where)
        if isinstance(left, int | float) and not isinstance(left, bool):
            return self._numbers(left, right, where)
        if left == right:
            return EQUAL
        return self._apart(f"{_shown(left)} against {_shown(right)}", where)

    def _apart(self, what: str, where: str) -> Difference:
        """Return the difference of parts without a numeric distance."""
        return Difference(math.inf, self.absolute, True, self.unit, where, what)

    def _numbers(self, left: float, right: float, where: str) -> Difference:
        both_nan = math.isnan(left) and math.isnan(right)
        if left == right or both_nan:
            return EQUAL
        finite = math.isfinite(left) and math.isfinite(right)
        distance = abs(left - right) if finite else math.inf
        largest = self.relative * max(abs(left), abs(right)) if finite else 0.0
        allowed = max(self.absolute, largest)
        what = f"{left!r} against {right!r}"
        return Difference(
            float(distance), float(allowed), distance > allowed, self.unit, where, what
        )

    def _records(self, left: Mapping[str, Any], right: Mapping[str, Any], where: str) -> Difference:
        if left.keys() != right.keys():
            return self._apart(_keys_apart(left, right), where)
        parts = [self._field(name, left[name], right[name], where) for name in left]
        return worst(parts)

    def _field(self, name: str, left: Any, right: Any, where: str) -> Difference:
        place = f"{where}.{name}"
        if name not in self.fields:
            return self._compared(left, right, place)
        other = self.fields[name]
        if other is None:
            return EQUAL
        found = other(left, right)
        return replace(found, where=f"{place}{found.where}") if found.excess else found

    def _dicts(self, left: dict[Any, Any], right: dict[Any, Any], where: str) -> Difference:
        parts = [
            self._compared(left[key], right[key], f"{where}[{key!r:.{SHOWN_MAX}}]")
            for key in sorted(left.keys() & right.keys(), key=str)
        ]
        if left.keys() != right.keys():
            parts.append(self._apart(_keys_apart(left, right), where))
        return worst(parts)

    def _lists(self, left: Any, right: Any, where: str) -> Difference:
        if len(left) != len(right):
            return self._apart(f"{len(left)} elements against {len(right)}", where)
        return worst(
            [
                self._compared(one, other, f"{where}[{index}]")
                for index, (one, other) in enumerate(zip(left, right, strict=True))
            ]
        )

    def _arrays(
        self, left: np.ndarray[Any, Any], right: np.ndarray[Any, Any], where: str
    ) -> Difference:
        if left.shape != right.shape:
            return self._apart(f"shape {left.shape} against {right.shape}", where)
        dtypes = left.dtype.newbyteorder("="), right.dtype.newbyteorder("=")
        if dtypes[0] != dtypes[1]:
            return self._apart(f"dtype {dtypes[0]} against {dtypes[1]}", where)
        if dtypes[0].names is not None:
            names = dtypes[0].names
            return worst([self._field(name, left[name], right[name], where) for name in names])
        found = EQUAL
        for start, one, other in _blocks(left, right):
            if dtypes[0].kind in _EXACT_KINDS:
                part = self._worst_of(one, other, start, _unequal(one, other), np.float64(0.0))
            else:
                distance = _distances(one, other)
                part = self._worst_of(one, other, start, distance, self._allowed(one, other))
            found = worst([found, part])
        if not found.distance:
            return EQUAL
        index = np.unravel_index(int(found.where), left.shape)
        place = f"[{', '.join(str(int(each)) for each in index)}]" if left.shape else ""
        return replace(found, where=where + place)

    def _allowed(self, left: np.ndarray[Any, Any], right: np.ndarray[Any, Any]) -> Any:
        """Return how far each element may be off: one number, or one for each."""
        if not self.relative:
            return np.float64(self.absolute)
        magnitude = np.maximum(np.abs(_wide(left)), np.abs(_wide(right)))
        finite = np.where(np.isfinite(magnitude), magnitude, 0.0)
        return np.maximum(self.absolute, self.relative * finite)

    def _worst_of(
        self,
        left: np.ndarray[Any, Any],
        right: np.ndarray[Any, Any],
        start: int,
        distance: np.ndarray[Any, Any],
        allowed: Any,
    ) -> Difference:
        """Return the worst element of a block; `where` is its number in the whole array."""
        crossed = distance > allowed
        at = np.flatnonzero(crossed if crossed.any() else distance)
        if not at.size:
            return EQUAL
        allowed = np.broadcast_to(allowed, distance.shape)
        with np.errstate(divide="ignore", over="ignore"):
            excess = distance[at] / allowed[at]
        at = at[excess == excess.max()]
        index = int(at[np.argmax(distance[at])])
        what = f"{_shown(left[index])} against {_shown(right[index])}"
        return Difference(
            float(distance[index]),
            float(allowed[index]),
            bool(crossed[index]),
            self.unit,
            str(start + index),
            what,
        )


EXACT: Final = Tolerance()
"""Allows no difference; the comparator of an aspect that names none."""


def worst(parts: Iterable[Difference]) -> Difference:
    """Return the difference that exceeds its tolerance most, the first of several; `EQUAL` of none.

    Of two without a tolerance it is the one with the larger distance.
    """
    return max(parts, key=lambda part: (part.crossed, part.excess, part.distance), default=EQUAL)


def _kind(value: object) -> str:
    """Return the name of a value's type as users know it."""
    if isinstance(value, dict) and "__type__" in value:
        return str(value["__type__"])
    if isinstance(value, np.generic):
        return f"numpy {value.dtype}"
    return "None" if value is None else type(value).__qualname__


def _shown(value: object) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    text = repr(value)
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}…"


def _keys_apart(left: Mapping[Any, Any], right: Mapping[Any, Any]) -> str:
    """Return which keys, or fields, only one side has."""
    texts = []
    for side, others, name in ((left, right, "left"), (right, left, "right")):
        alone = sorted((key for key in side if key not in others), key=str)
        if alone:
            more = f" and {len(alone) - 3} more" if len(alone) > 3 else ""
            texts.append(f"only {name}: {', '.join(map(_shown, alone[:3]))}{more}")
    return "; ".join(texts)


# ---------------------------------------------------------------- blocks of arrays

_Array = np.ndarray[Any, Any]


def _blocks(left: _Array, right: _Array) -> Iterator[tuple[int, _Array, _Array]]:
    """Yield those flat parts of two arrays of one shape that differ, each with its start index."""
    one, other = _flat(left), _flat(right)
    for start in range(0, left.size, BLOCK_ELEMENTS):
        parts = one[start : start + BLOCK_ELEMENTS], other[start : start + BLOCK_ELEMENTS]
        if not np.array_equal(*parts):
            yield start, _native(parts[0]), _native(parts[1])


def _flat(array: _Array) -> Any:
    """Return what can be cut into flat parts in C order, without a copy of the whole."""
    return array.reshape(-1) if array.flags.c_contiguous else array.flat


def _native(array: _Array) -> _Array:
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _unequal(left: _Array, right: _Array) -> _Array:
    """Return 0 where elements are equal, else infinity; not-a-time equals itself."""
    if left.dtype.kind in "mM":
        left, right = left.view(np.int64), right.view(np.int64)
    return np.where(left == right, 0.0, np.inf)


def _distances(left: _Array, right: _Array) -> _Array:
    """Return how far elements are apart, (N,) float64."""
    if left.dtype.kind in "iu":
        # Integers wrap, so the larger less the smaller is exact as the unsigned of its size.
        apart = np.where(left > right, left - right, right - left)
        return apart.view(f"u{apart.itemsize}").astype(np.float64)
    left, right = _wide(left), _wide(right)
    same = (left == right) | (np.isnan(left) & np.isnan(right))
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(left - right)
    apart = np.where(np.isfinite(left) & np.isfinite(right), apart, np.inf)
    return np.where(same, 0.0, apart).astype(np.float64)


def _wide(array: _Array) -> _Array:
    """Return numbers in a dtype in which their differences do not overflow easily."""
    return array.astype(np.result_type(array.dtype, np.float64), copy=False)
