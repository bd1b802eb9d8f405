"""Messages ↔ frames: a msgpack header, and beside it the bodies of the data as they are.

A frame's header is the array ``[version, code, field, …]`` with the fields of the message in the
order of its class; a NamedTuple is the array of its fields.  A datum is ``[encoding, offset,
size, stamp_ns]``, and its body stands in the payload at `offset`, a multiple of 64; bodies follow
one another in the order of the header, without gaps but for that padding.

Readers and writers are made once, at import, from the annotations in `core.messages`.
Rules to keep: a code is never used again for another message; what is received is checked whole
(every type, every length, nothing left over) before a message exists; only `ProtocolError` leaves.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from functools import partial
from itertools import product
from operator import attrgetter
from typing import Any, Final, get_args, get_origin, get_type_hints

import msgpack

from enact_dist.core import messages as m
from enact_dist.core.datum import Datum
from enact_dist.errors import ProtocolError
from enact_dist.wire.limits import (
    ALIGNMENT,
    BODY_BYTES_MAX,
    ENCODING_BYTES_MAX,
    ENTRIES_MAX,
    FRAME_VERSION,
    HEADER_BYTES_MAX,
    INTEGER_MAX,
    ITEMS_MAX,
    NAME_CHARACTERS_MAX,
    PAYLOAD_BYTES_MAX,
    REPORT_BYTES_MAX,
    SMALL_BODY_BYTES,
    TEXT_BYTES_MAX,
)

CODES: Final[dict[type[Any], int]] = {
    # Requests from 1, answers from 33, notices from 97: all fit into one byte of msgpack.
    m.Hello: 1,
    m.Register: 2,
    m.Acquire: 3,
    m.TakeView: 4,
    m.Fetch: 5,
    m.KeepAlive: 6,
    m.Commit: 7,
    m.Outcome: 8,
    m.Validate: 9,
    m.Release: 10,
    m.Goodbye: 11,
    m.AwaitStamp: 12,
    m.Survey: 13,
    m.ListLocks: 14,
    m.ListSessions: 15,
    m.Break: 16,
    m.Welcome: 33,
    m.Registered: 34,
    m.Granted: 35,
    m.Waiting: 36,
    m.Stale: 37,
    m.Viewed: 38,
    m.Slice: 39,
    m.Gone: 40,
    m.Alive: 41,
    m.Committed: 42,
    m.Fenced: 43,
    m.OutcomeIs: 44,
    m.Valid: 45,
    m.Released: 46,
    m.Reached: 47,
    m.Surveyed: 48,
    m.Locks: 49,
    m.Sessions: 50,
    m.Broken: 51,
    m.EpochChanged: 52,
    m.WrongShard: 53,
    m.Refused: 54,
    m.Changed: 55,
    m.Notice: 97,
}

_NAMES: Final = frozenset(
    {"context", "entity", "aspect", "name", "shard", "session", "actor", "host", "pattern"}
)
_ENCODING_BYTES_MAX: Final = ENCODING_BYTES_MAX + 64
"""The tree and the version before it."""
_LENGTHS_MAX: Final = {
    **dict.fromkeys(_NAMES, NAME_CHARACTERS_MAX),
    "items": ITEMS_MAX,
    "writes": ITEMS_MAX,
    "report": REPORT_BYTES_MAX,
    "encoding": _ENCODING_BYTES_MAX,
}
_LONGEST: Final = {str: TEXT_BYTES_MAX, bytes: TEXT_BYTES_MAX, tuple: ENTRIES_MAX}
_SCALARS: Final = frozenset({int, str, bytes, bool})
_PADDING: Final = bytes(ALIGNMENT)
_unpack = partial(
    msgpack.unpackb,
    use_list=False,
    max_str_len=TEXT_BYTES_MAX,
    max_bin_len=TEXT_BYTES_MAX,
    max_array_len=ENTRIES_MAX,
    max_map_len=0,
    max_ext_len=0,
)


def encode_frame(message: m.Message) -> tuple[bytes, bytes | None]:
    """Return the header and the payload of a message; no payload where no datum has a body.

    Raises:
        ProtocolError: A value cannot travel, or the message is over a limit.
    """
    code, values_of, writers = _writers[type(message)]
    values = values_of(message)
    bodies = None
    try:
        if writers:
            bodies = _Bodies()
            parts = list(values)
            for index, write in writers:
                parts[index] = write(parts[index], bodies)
            values = tuple(parts)
        header: bytes = msgpack.packb((FRAME_VERSION, code, *values))
    except (TypeError, ValueError, OverflowError) as error:
        raise ProtocolError(f"{type(message).__name__} cannot be sent: {error}") from error
    if len(header) > HEADER_BYTES_MAX:
        raise ProtocolError(
            f"{type(message).__name__} has a header of {len(header)} bytes; at most"
            f" {HEADER_BYTES_MAX}; ask for less at once"
        )
    return header, bodies.joined() if bodies is not None and bodies.parts else None


def decode_frame(header: bytes, payload: bytes | memoryview = b"") -> m.Message:
    """Return the message of a frame.

    Bodies from 64 KiB up are views on `payload`, smaller ones are copied out of it.

    Raises:
        ProtocolError: Whatever is wrong with the frame; it is checked whole.
    """
    if len(header) > HEADER_BYTES_MAX or len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(
            f"a frame of {len(header)} + {len(payload)} bytes came; at most {HEADER_BYTES_MAX} +"
            f" {PAYLOAD_BYTES_MAX}"
        )
    _check_version(header)
    try:
        values = _unpack(header)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ProtocolError(f"a frame cannot be read: {error or type(error).__name__}") from error
    code = values[1] if len(values) > 1 else None
    read = _readers.get(code) if type(code) is int else None
    if read is None:
        raise ProtocolError(f"a frame has the unknown code {code!r:.40}; is the peer newer?")
    bodies = _Payload(payload)
    message: m.Message = read(values[2:], bodies)
    if bodies.end != len(payload):
        raise ProtocolError(
            f"{type(message).__name__} came with {len(payload)} bytes of data, {bodies.end} belong"
            " to it"
        )
    return message


def _check_version(header: bytes) -> None:
    """Look at the version alone: what follows may mean anything in another version."""
    first = header[0] if header else 0
    # An array of up to 15, up to 65535, or more elements; the version follows its length.
    start = 1 if 0x92 <= first <= 0x9F else {0xDC: 3, 0xDD: 5}.get(first, 0)
    if not start or len(header) <= start:
        raise ProtocolError(f"{header[:16]!r} begins no frame")
    if header[start] != FRAME_VERSION:
        raise ProtocolError(
            f"a frame of version {header[start]} came; this side speaks {FRAME_VERSION}; run the"
            " same release of enact-dist on all hosts"
        )


# ---------------------------------------------------------------- bodies


class _Bodies:
    """Collects the bodies of a frame that is written."""

    __slots__ = ("end", "parts")

    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self.end = 0

    def add(self, datum: Datum) -> tuple[bytes, int, int, int]:
        """Take a datum's body and return what stands for the datum in the header."""
        size = datum.size
        if not 0 <= size <= BODY_BYTES_MAX or len(datum.body) != size:
            raise ValueError(f"a datum of {size} bytes has a body of {len(datum.body)}")
        if not size:
            return datum.encoding, 0, 0, datum.stamp_ns
        offset = -(-self.end // ALIGNMENT) * ALIGNMENT
        if offset > self.end:
            self.parts.append(_PADDING[: offset - self.end])
        self.end = offset + size
        if self.end > PAYLOAD_BYTES_MAX:
            raise ValueError(f"its data have over {PAYLOAD_BYTES_MAX} bytes; send fewer at once")
        self.parts.append(datum.body)
        return datum.encoding, offset, size, datum.stamp_ns

    def joined(self) -> bytes:
        """Return the payload; a single body is not copied."""
        if len(self.parts) == 1:
            return bytes(self.parts[0])
        return b"".join(self.parts)


class _Payload:
    """Hands out the bodies of a frame that is read, in order and each once."""

    __slots__ = ("_payload", "end")

    def __init__(self, payload: bytes | memoryview) -> None:
        self._payload = payload
        self.end = 0

    def take(self, raw: tuple[Any, ...]) -> Datum:
        """Return the datum that `raw` of the header stands for."""
        if tuple(map(type, raw)) != (bytes, int, int, int):
            raise ProtocolError(f"a datum came as {_shown(raw)}")
        encoding, offset, size, stamp_ns = raw
        if len(encoding) > _ENCODING_BYTES_MAX or not 0 <= stamp_ns <= INTEGER_MAX:
            raise ProtocolError(f"a datum has {len(encoding)} bytes of encoding, stamp {stamp_ns}")
        if size == 0 == offset:
            return Datum(encoding, b"", 0, stamp_ns)
        expected = -(-self.end // ALIGNMENT) * ALIGNMENT
        end = offset + size
        if offset != expected or not 0 < size <= BODY_BYTES_MAX or end > len(self._payload):
            raise ProtocolError(
                f"a datum is said to have {size} bytes at {offset}; expected at {expected}, and"
                f" {len(self._payload)} bytes came in all"
            )
        self.end = end
        return Datum(encoding, self._slice(offset, end), size, stamp_ns)

    def _slice(self, start: int, end: int) -> bytes | memoryview:
        payload = self._payload
        if start == 0 and end == len(payload):
            # A writable buffer could still change under its reader.
            return payload if type(payload) is bytes else memoryview(payload).toreadonly()
        part = memoryview(payload)[start:end]
        return bytes(part) if end - start < SMALL_BODY_BYTES else part.toreadonly()


# ---------------------------------------------------------------- made from the annotations

_Write = Callable[[Any, _Bodies], Any]
_Read = Callable[[Any, _Payload], Any]


def _writer_of(kind: Any) -> _Write | None:
    """Return what prepares a value of an annotation for msgpack; None where nothing is to do."""
    kind = _without_none(kind)
    if kind is Datum:
        return lambda datum, bodies: None if datum is None else bodies.add(datum)
    if get_origin(kind) is tuple:
        write_one = _writer_of(get_args(kind)[0])
        if write_one is None:
            return None
        return lambda values, bodies: [write_one(value, bodies) for value in values]
    if kind in _SCALARS:
        return None
    writers = _writers_of(kind)
    if not writers:
        return None

    def write(value: Any, bodies: _Bodies) -> list[Any]:
        parts = list(value)
        for index, write_part in writers:
            parts[index] = write_part(parts[index], bodies)
        return parts

    return write


def _writers_of(cls: type[Any]) -> list[tuple[int, _Write]]:
    writers = [_writer_of(kind) for _, kind in _annotated(cls)]
    return [(index, write) for index, write in enumerate(writers) if write is not None]


def _reader_of(kind: Any, length_max: int) -> _Read | None:
    """Return what checks and builds a value of an annotation; None where its type says it all."""
    if (inner := _without_none(kind)) is not kind:
        read_inner = _reader_of(inner, length_max)
        assert read_inner is not None, "only parts that are read may be None"
        return lambda raw, bodies: None if raw is None else read_inner(raw, bodies)
    if kind is Datum:
        return lambda raw, bodies: bodies.take(raw)
    if get_origin(kind) is tuple:
        return _reader_of_each(get_args(kind)[0])
    return None if kind in _SCALARS else _reader_of_class(kind)


def _reader_of_each(kind: Any) -> _Read:
    if kind not in _SCALARS:
        read_one = _reader_of_class(kind)
        return lambda raw, bodies: tuple([read_one(one, bodies) for one in raw])
    length_max = _LONGEST.get(kind)
    alone = {kind}

    def read(raw: tuple[Any, ...], _bodies: _Payload) -> tuple[Any, ...]:
        if raw and set(map(type, raw)) != alone:
            raise ProtocolError(f"a list of {kind.__name__} came as {_shown(raw)}")
        if kind is int and raw and max(raw) > INTEGER_MAX:
            raise ProtocolError(f"{max(raw)} is over {INTEGER_MAX}")
        assert length_max is None or all(len(one) <= length_max for one in raw)
        return raw

    return read


def _reader_of_class(cls: type[Any]) -> _Read:
    """Return what builds a message or a part of one from its array."""
    annotated = _annotated(cls)
    signatures = frozenset(product(*(_raw_types(kind) for _, kind in annotated)))
    integers = tuple(index for index, (_, kind) in enumerate(annotated) if kind is int)
    lengths, readers = [], []
    for index, (name, kind) in enumerate(annotated):
        (raw_type, *optional) = _raw_types(kind)
        length_max = _LENGTHS_MAX.get(name, _LONGEST.get(raw_type, 0))
        if length_max and not optional:
            lengths.append((index, length_max))
        if (read_part := _reader_of(kind, length_max)) is not None:
            readers.append((index, read_part))
    build = _builder(cls)

    def read(raw: Any, bodies: _Payload) -> Any:
        if type(raw) is not tuple or tuple(map(type, raw)) not in signatures:
            raise ProtocolError(_mismatch(cls, raw))
        for index in integers:
            if raw[index] > INTEGER_MAX:
                raise ProtocolError(f"{cls.__name__}: {raw[index]} is over {INTEGER_MAX}")
        for index, length_max in lengths:
            if len(raw[index]) > length_max:
                raise ProtocolError(
                    f"{cls.__name__}.{annotated[index][0]} has length {len(raw[index])}; at most"
                    f" {length_max}"
                )
        if not readers:
            return build(raw)
        parts = list(raw)
        for index, read_part in readers:
            parts[index] = read_part(parts[index], bodies)
        return build(parts)

    return read


def _builder(cls: type[Any]) -> Callable[[Sequence[Any]], Any]:
    if issubclass(cls, tuple):
        return partial(tuple.__new__, cls)
    return lambda parts: cls(*parts)


def _annotated(cls: type[Any]) -> list[tuple[str, Any]]:
    """Return the fields of a message class and their types, in the order of the wire."""
    hints = get_type_hints(cls)
    names = [field.name for field in fields_of(cls)] if is_dataclass(cls) else list(cls._fields)
    return [(name, hints[name]) for name in names]


def _without_none(kind: Any) -> Any:
    if get_origin(kind) not in (types.UnionType, typing.Union):
        return kind
    (inner,) = (one for one in get_args(kind) if one is not type(None))
    return inner


def _raw_types(kind: Any) -> tuple[type[Any], ...]:
    """Return the Python types that msgpack may give for an annotation, the usual one first."""
    inner = _without_none(kind)
    raw = inner if inner in _SCALARS else tuple
    return (raw,) if inner is kind else (raw, type(None))


def _mismatch(cls: type[Any], raw: Any) -> str:
    """Say what is wrong with the array that came for `cls`."""
    if type(raw) is not tuple:
        return f"{cls.__name__} came as {_shown(raw)} instead of a list"
    annotated = _annotated(cls)
    if len(raw) != len(annotated):
        return f"{cls.__name__} has {len(annotated)} fields, {len(raw)} came"
    for (name, kind), one in zip(annotated, raw, strict=True):
        if type(one) not in _raw_types(kind):
            asked = getattr(kind, "__name__", str(kind))
            return f"{cls.__name__}.{name}: asked {asked}, found {_shown(one)}"
    raise AssertionError("called for an array that fits")


def _shown(raw: Any) -> str:
    return (
        f"{type(raw).__name__} {str(raw)[:60]!r}" if type(raw) in _SCALARS else type(raw).__name__
    )


def _values_of(cls: type[Any]) -> Callable[[Any], tuple[Any, ...]]:
    names = [field.name for field in fields_of(cls)]
    if not names:
        return lambda _message: ()
    if len(names) == 1:
        only = attrgetter(names[0])
        return lambda message: (only(message),)
    return attrgetter(*names)


_writers: Final = {cls: (code, _values_of(cls), _writers_of(cls)) for cls, code in CODES.items()}
_readers: Final = {code: _reader_of_class(cls) for cls, code in CODES.items()}
assert len(_readers) == len(CODES), "a code is used twice"
_uncoded = set(get_args(m.Message)) ^ set(CODES)
assert not _uncoded, f"no message, or one without a code: {_uncoded}"
