"""The stored form of a type: a msgpack list whose fields follow the annotations of the type.

A `Slot`, `LockId` or `Position` takes one field for each of its own; any other tuple is one field.
Reading is strict: anything other than what is written here is damage, not a default.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Sequence
from operator import attrgetter
from types import UnionType
from typing import (
    Any,
    Final,
    Generic,
    NamedTuple,
    NoReturn,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import msgpack

from enact_dist.core.protocol.datum import LockId, Position, Slot

T = TypeVar("T")
_SPREAD: Final = (Slot, LockId, Position)
_AS_THEY_ARE: Final = (str, int, bytes, bool, type(None))


class DamagedRowError(Exception):
    """A row differs from what a store writes; the message says how."""


def pack(value: object) -> bytes:
    """Return a value in its stored form."""
    packed: bytes = msgpack.packb(value, use_bin_type=True)
    return packed


def unpack(packed: bytes) -> list[Any]:
    """Return a stored list.

    Raises:
        DamagedRowError: It is none; what msgpack cannot read raises its own errors.
    """
    fields = msgpack.unpackb(packed)
    _expect(fields, (list,))
    return list(fields)


class RowLayout(Generic[T]):
    """How the values of one type are stored.

    Args:
        of: A dataclass, named tuple or `tuple[...]` of fixed length.
        without: An attribute that is not stored: read as its default, or () if others follow.
        open_end: Whether the last field may be missing; an empty tuple there is not written.

    Attributes:
        kinds: The types that msgpack shows for each field.
        fields: Returns the fields of a value, to be packed.
    """

    def __init__(self, of: type[T], *, without: str = "", open_end: bool = False) -> None:
        self._make: Callable[..., T] = of
        self._get: Callable[[Any], Any] = tuple
        if get_origin(of) is tuple:
            hints = {str(at): hint for at, hint in enumerate(get_args(of))}
            self._make = lambda *fields: fields  # type: ignore[assignment]  # the tuple itself
        else:
            hints = get_type_hints(of)
            if without or not issubclass(of, tuple):
                self._get = attrgetter(*(name for name in hints if name != without))
        self._gap = [*hints].index(without) if without else len(hints)
        hints.pop(without, None)
        parts = [_part(hint) for hint in hints.values()]
        self.kinds = [kinds for part in parts for kinds in part.kinds]
        self._least = len(self.kinds) - open_end
        self._drops_end = open_end and get_origin([*hints.values()][-1]) is tuple
        writers = [
            (at, part.write)
            for at, part in enumerate(parts)
            if part.write is not None or len(part.kinds) > 1
        ]
        self._writers = writers[::-1]
        self.fields: Callable[[T], list[Any]] = self._fields_of
        if self._get is tuple and writers == [(0, None)]:
            self.fields = _led  # most values: entries of causes, reads and writes
        self._readers = [
            (at, at + len(part.kinds), part.read)
            for at, part in enumerate(parts)
            if part.read is not None
        ]

    @property
    def length(self) -> int:
        """How many fields there are at most."""
        return len(self.kinds)

    @property
    def is_plain(self) -> bool:
        """Whether the values are packed as they are."""
        return not self._writers and not self._drops_end

    def _fields_of(self, value: T) -> list[Any]:
        fields = [*self._get(value)]
        if self._drops_end and not fields[-1]:
            fields.pop()
        for at, write in self._writers:
            if write is None:
                fields[at : at + 1] = fields[at]
            else:
                fields[at] = write(fields[at])
        return fields

    def read(self, fields: list[Any]) -> T:
        """Return the value with these fields, which are used up.

        Raises:
            DamagedRowError: They are not those of a value.
        """
        count = len(fields)
        if not self._least <= count <= len(self.kinds) or not all(
            map(isinstance, fields, self.kinds)
        ):
            self._refuse(fields)
        if self._drops_end and count == len(self.kinds) and not fields[-1]:
            raise DamagedRowError(f"entries were expected at the end of {reprlib.repr(fields)}")
        for at, end, read in self._readers:
            if found := fields[at:end]:
                fields[at:end] = (read(*found),)
        if self._gap < len(fields):
            fields.insert(self._gap, ())
        return self._make(*fields)

    def _refuse(self, fields: list[Any]) -> NoReturn:
        for found, kinds in zip(fields, self.kinds, strict=False):
            _expect(found, kinds)
        problem = f"has more than {len(self.kinds)} fields"
        if len(fields) < self._least:
            problem = f"lacks field {len(fields) + 1}"
        raise DamagedRowError(f"{reprlib.repr(fields)} {problem}")


def _led(value: Any) -> list[Any]:
    """Return the fields of a tuple whose first part has several."""
    return [*value[0], *value[1:]]


class _Part(NamedTuple):
    """How one attribute is stored.

    Attributes:
        kinds: The types that msgpack shows for each of its fields.
        write: Returns the field of its value; None: the value is the field, or has the fields.
        read: Returns the value of its fields; None: the field is the value.
    """

    kinds: list[tuple[type, ...]]
    write: Callable[[Any], Any] | None = None
    read: Callable[..., Any] | None = None


def _part(hint: Any, *, spread: bool = True) -> _Part:
    if hint in _AS_THEY_ARE:
        return _Part([(hint,)])
    if spread and hint in _SPREAD:
        return _Part(RowLayout(hint).kinds, None, hint)
    if isinstance(hint, UnionType):
        return _choice(get_args(hint))
    if get_origin(hint) is tuple and get_args(hint)[-1] is ...:
        return _series(_part(get_args(hint)[0], spread=False))
    layout = RowLayout(hint)
    return _Part([(list,)], None if layout.is_plain else layout.fields, layout.read)


def _series(one: _Part) -> _Part:
    """Return how a tuple of any length is stored."""
    write, read, (kinds,) = one.write, one.read, one.kinds

    def read_all(found: list[Any]) -> tuple[Any, ...]:
        for field in found:
            _expect(field, kinds)
        return tuple(found if read is None else map(read, found))

    if write is None:
        return _Part([(list,)], None, read_all)
    return _Part([(list,)], lambda values: [write(value) for value in values], read_all)


def _choice(hints: Sequence[Any]) -> _Part:
    """Return how a value of one of several types is stored; the lengths tell lists apart."""
    layouts = {hint: RowLayout(hint) for hint in hints if hint not in _AS_THEY_ARE}
    by_length = {layout.length: layout for layout in layouts.values()}
    longest = by_length[max(by_length)]

    def write(value: Any) -> Any:
        layout = layouts.get(type(value))
        return value if layout is None else layout.fields(value)

    def read(found: Any) -> Any:
        return by_length.get(len(found), longest).read(found) if type(found) is list else found

    kinds = tuple(list if hint in layouts else hint for hint in hints)
    return _Part([kinds], write, read)


def _expect(found: object, kinds: tuple[type, ...]) -> None:
    if not isinstance(found, kinds):
        names = " or ".join("a list" if kind is list else kind.__name__ for kind in kinds)
        raise DamagedRowError(f"{names} was expected, found {reprlib.repr(found)}")
