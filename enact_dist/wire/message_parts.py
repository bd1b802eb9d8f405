"""Readers and writers of messages, made from the annotations of their classes at import.

A writer only prepares what msgpack does not know (data); everything else it packs as it is.
A reader compares the types of all fields of a part with the annotations in one step of C (that is
why the parts of messages are flat), then the lengths and the range of integers.

Rule to keep: no annotation is looked at while a message is read or written.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from functools import cache, partial
from itertools import product
from operator import attrgetter
from typing import Any, Final, TypeVar, cast, get_args, get_origin, get_type_hints

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import ProtocolError
from enact_dist.wire.bodies import BodyReader, BodyWriter
from enact_dist.wire.limits import (
    ENCODING_BYTES_MAX,
    INTEGER_MAX,
    ITEMS_MAX,
    KEPT_VERSIONS_MAX,
    NAME_CHARACTERS_MAX,
    REASON_CHARACTERS_MAX,
    REPORT_FIELD_BYTES_MAX,
)

Write = Callable[[Any, BodyWriter], Any]
Read = Callable[[Any, BodyReader], Any]

_NAMES: Final = (
    "context",
    "entity",
    "aspect",
    "name",
    "shard",
    "session",
    "actor",
    "host",
    "pattern",
)
LENGTHS_MAX: Final = {
    **dict.fromkeys(_NAMES, NAME_CHARACTERS_MAX),
    "reason": REASON_CHARACTERS_MAX,
    "settle": REASON_CHARACTERS_MAX,
    "items": ITEMS_MAX,
    "writes": ITEMS_MAX,
    "expects": ITEMS_MAX,
    "report": REPORT_FIELD_BYTES_MAX,
    "encoding": ENCODING_BYTES_MAX + 1,
}
"""Longest content of a field by its name; the version stands before the tree in `encoding`."""
LENGTHS_MAX_OF: Final = {
    **{
        (listing, field): ITEMS_MAX
        for listing in ("Survey", "ListHistory")
        for field in ("contexts", "patterns", "aspects")
    },
    ("FindEffects", "reads"): ITEMS_MAX,
    ("Explain", "versions"): ITEMS_MAX,
    ("KeepVersions", "versions"): KEPT_VERSIONS_MAX,
}
"""The same where answers have longer fields of that name: to read 100,000 parts takes 0.6 s, for
which a shard takes no other request over Zenoh."""
SCALARS: Final = frozenset({int, str, bytes, bool})
_Made = TypeVar("_Made")


def _once(make: Callable[[type[Any]], _Made]) -> Callable[[type[Any]], _Made]:
    """Call a function once for each class; all who ask share what it returns."""
    return cast("Callable[[type[Any]], _Made]", cache(make))


# ---------------------------------------------------------------- writers


def values_of(cls: type[Any]) -> Callable[[Any], tuple[Any, ...]]:
    """Return what takes the fields out of a message, in order."""
    names = [field.name for field in fields_of(cls)]
    if not names:
        return lambda _message: ()
    if len(names) == 1:
        only = attrgetter(names[0])
        return lambda message: (only(message),)
    return attrgetter(*names)


def writers_of(cls: type[Any]) -> list[tuple[int, Write]]:
    """Return the places of fields that hold data, and what prepares them for msgpack."""
    writers = [_writer_of(kind) for _, kind in annotated(cls)]
    return [(index, write) for index, write in enumerate(writers) if write is not None]


def _write_datum(datum: Datum | None, bodies: BodyWriter) -> Any:
    return None if datum is None else bodies.add(datum)


def _writer_of(kind: Any) -> Write | None:
    kind = without_none(kind)
    if kind is Datum:
        return _write_datum
    if get_origin(kind) is tuple:
        each = get_args(kind)[0]
        writers = [] if each in SCALARS else writers_of(each)
        return _writer_of_each(writers) if writers else None
    writers = [] if kind in SCALARS else writers_of(kind)
    return _writer_of_part(writers) if writers else None


def _writer_of_part(writers: list[tuple[int, Write]]) -> Write:
    def write(value: Any, bodies: BodyWriter) -> list[Any]:
        parts = list(value)
        for index, write_part in writers:
            parts[index] = write_part(parts[index], bodies)
        return parts

    return write


def _writer_of_each(writers: list[tuple[int, Write]]) -> Write:
    """Return what prepares a list of parts; those of a lock have one datum each."""
    (index, write_one), *more = writers
    write_part = _writer_of_part(writers)

    def write(values: Any, bodies: BodyWriter) -> list[Any]:
        return [write_part(value, bodies) for value in values]

    def write_data(values: Any, bodies: BodyWriter) -> list[Any]:
        written = []
        for value in values:
            parts = list(value)
            if parts[index] is not None:
                parts[index] = bodies.add(parts[index])
            written.append(parts)
        return written

    if write_one is _write_datum and not more:
        return write_data

    return write


# ---------------------------------------------------------------- readers


@_once
def reader_of(cls: type[Any]) -> Read:
    """Return what checks the array of a message, or of a part of one, and builds it."""
    fields = annotated(cls)
    signatures = frozenset(product(*(_raw_types(kind) for _, kind in fields)))
    integers = tuple(index for index, (_, kind) in enumerate(fields) if kind is int)
    lengths = lengths_of(cls)
    found = [(index, _reader_of_field(kind)) for index, (_, kind) in enumerate(fields)]
    readers = [(index, read_part) for index, read_part in found if read_part is not None]
    build: Callable[[Sequence[Any]], Any] = partial(tuple.__new__, cls)
    if not issubclass(cls, tuple):
        build = lambda parts: cls(*parts)  # noqa: E731  # one of two, and short

    def read(raw: Any, bodies: BodyReader) -> Any:
        # Of its length at once: one made of an iterator would end in the interpreter's free lists.
        if type(raw) is not tuple or (*map(type, raw),) not in signatures:
            raise ProtocolError(_mismatch(cls, raw))
        for index in integers:
            if raw[index] > INTEGER_MAX:
                raise ProtocolError(f"{_at(cls, index)} is {raw[index]}; at most {INTEGER_MAX}")
        for index, length_max in lengths:
            if len(raw[index]) > length_max:
                raise too_long(cls, index, len(raw[index]), length_max)
        if readers:
            raw = list(raw)
            for index, read_part in readers:
                raw[index] = read_part(raw[index], bodies)
        return build(raw)

    return read


def _reader_of_field(kind: Any) -> Read | None:
    """Return what reads a field further; None where its type says all."""
    inner = without_none(kind)
    if inner in SCALARS:
        assert inner is kind, "numbers and texts of a message are never None"
        return None
    if inner is Datum:
        read_inner: Read = _read_datum
    elif get_origin(inner) is tuple:
        read_inner = reader_of_each(get_args(inner)[0])
    else:
        read_inner = reader_of(inner)
    if inner is kind:
        return read_inner
    return lambda raw, bodies: None if raw is None else read_inner(raw, bodies)


def _read_datum(raw: Any, bodies: BodyReader) -> Datum:
    return bodies.take(raw)


def reader_of_each(kind: Any) -> Read:
    """Return what reads a list of scalars or parts whose length was checked."""
    if kind not in SCALARS:
        read_one = reader_of(kind)
        return lambda raw, bodies: tuple([read_one(one, bodies) for one in raw])
    allowed: tuple[set[type[Any]], ...] = (set(), {kind})

    def read(raw: tuple[Any, ...], _bodies: BodyReader) -> tuple[Any, ...]:
        if set(map(type, raw)) not in allowed:
            raise ProtocolError(f"a list of {kind.__name__} came with other types in it")
        if kind is int and raw and max(raw) > INTEGER_MAX:
            raise ProtocolError(f"a list has {max(raw)} in it; at most {INTEGER_MAX}")
        return raw

    return read


# ---------------------------------------------------------------- annotations


@_once
def annotated(cls: type[Any]) -> tuple[tuple[str, Any], ...]:
    """Return the fields of a message class and their types, in the order of the wire."""
    hints = get_type_hints(cls)
    names = [field.name for field in fields_of(cls)] if is_dataclass(cls) else list(cls._fields)
    return tuple((name, hints[name]) for name in names)


def without_none(kind: Any) -> Any:
    """Return `X` of an annotation `X | None`; any other unchanged."""
    if get_origin(kind) not in (types.UnionType, typing.Union):
        return kind
    (inner,) = (one for one in get_args(kind) if one is not type(None))
    return inner


def _raw_types(kind: Any) -> tuple[type[Any], ...]:
    """Return the Python types that msgpack may give for an annotation, the usual one first."""
    inner = without_none(kind)
    raw = inner if inner in SCALARS else tuple
    return (raw,) if inner is kind else (raw, type(None))


@_once
def lengths_of(cls: type[Any]) -> tuple[tuple[int, int], ...]:
    """Return the places and greatest lengths of fields that msgpack's own limits leave open."""
    lengths = []
    for index, (name, kind) in enumerate(annotated(cls)):
        raw_types = _raw_types(kind)
        is_part = raw_types[0] is tuple and get_origin(kind) is not tuple
        length_max = LENGTHS_MAX_OF.get((cls.__name__, name), LENGTHS_MAX.get(name))
        if length_max is not None and len(raw_types) == 1 and not is_part:
            lengths.append((index, length_max))
    return tuple(lengths)


def too_long(cls: type[Any], index: int, length: int, length_max: int) -> ProtocolError:
    """Return the error for a field that is longer than it may be."""
    return ProtocolError(f"{_at(cls, index)} has the length {length}; at most {length_max}")


def miscounted(cls: type[Any], count: int) -> ProtocolError:
    """Return the error for another number of fields than a class has."""
    return ProtocolError(f"{cls.__name__} has {len(annotated(cls))} fields, {count} came")


def _at(cls: type[Any], index: int) -> str:
    return f"{cls.__name__}.{annotated(cls)[index][0]}"


def _mismatch(cls: type[Any], raw: Any) -> str:
    """Say what is wrong with the array that came for `cls`."""
    if type(raw) is not tuple:
        return f"{cls.__name__} came as {_shown(raw)} instead of a list"
    fields = annotated(cls)
    if len(raw) != len(fields):
        return str(miscounted(cls, len(raw)))
    for (name, kind), one in zip(fields, raw, strict=True):
        if type(one) not in _raw_types(kind):
            asked = getattr(kind, "__name__", str(kind))
            return f"{cls.__name__}.{name}: asked {asked}, found {_shown(one)}"
    raise AssertionError("called for an array that fits")


def _shown(raw: Any) -> str:
    name = type(raw).__name__
    return f"{name} {str(raw)[:60]!r}" if type(raw) in SCALARS else name
