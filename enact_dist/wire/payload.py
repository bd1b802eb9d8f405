"""Data to bytes and back: a tree of plain values in the encoding, their buffers in the body.

`enact_dist/docs/protocol.md` describes the format.  Laws: what is encoded decodes equal, of the
same types; arrays come back as read-only views of the body; a datum is a copy of its value, made
once.
"""

from __future__ import annotations

import typing
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Final

import msgpack
import numpy as np

from enact_dist.core.protocol.datum import Datum, message
from enact_dist.errors import DatumTypeError, ProtocolError
from enact_dist.wire.limits import (
    BODY_BYTES_MAX,
    DATUM_VERSION,
    ENCODING_BYTES_MAX,
    INTEGER_MAX,
    TREE_BYTES_MAX,
)
from enact_dist.wire.shapes import shape_of, text_of
from enact_dist.wire.tree_reader import TreeReader, build, untyped
from enact_dist.wire.tree_writer import (
    INT_MAX,
    INT_MIN,
    TREE,
    MisfitError,
    TreeWriter,
    reference,
    too_large,
)

JOINED_BYTES_MIN: Final = 1 << 20
"""From here on data are copied while other threads run."""

INT_ENCODING_BYTES: Final = 10
"""The version, and a msgpack int of up to 9 bytes."""

_VERSION = bytes([DATUM_VERSION])
_pack_int = msgpack.Packer().pack
"""As that of `frames`."""


@message
class Encoded:
    """A value on its way into a datum: its bytes still lie where they were.

    Attributes:
        parts: Buffers, which make up the body one after another.
        size: Length of the body in bytes.
    """

    encoding: bytes
    parts: list[Any]
    size: int
    stamp_ns: int

    def datum(self) -> Datum:
        """Return the datum, with a copy of the bytes."""
        body = joined(self.parts, self.size) if self.parts else b""
        return Datum(self.encoding, body, self.size, self.stamp_ns)

    def over(self, body: memoryview, file: str) -> Datum:
        """Return the datum whose bytes were copied, or will be made, elsewhere."""
        return Datum(self.encoding, body, self.size, self.stamp_ns, file)

    def put_texts(self, memory: memoryview) -> None:
        """Copy all but the arrays to where they belong in the body."""
        offset = 0
        for part in self.parts:
            if type(part) is bytes:
                memory[offset : offset + len(part)] = part
            offset += len(part)


def encode_datum(value: object, datum_type: Any, *, stamp_ns: int = 0) -> Datum:
    """Return the datum of `value`; later changes of the value do not affect it.

    Args:
        value: A value of `datum_type`.
        datum_type: The aspect's type.
        stamp_ns: When it was captured, nanoseconds since 1970; 0 where that has no meaning.

    Raises:
        DatumTypeError: The value is not of the type, or the type is not allowed for data; the
            message
            names the part.
    """
    return encode_parts(value, datum_type, stamp_ns=stamp_ns).datum()


def encode_parts(value: object, datum_type: Any, *, stamp_ns: int = 0) -> Encoded:
    """Return the parts of the datum of `value`, without a copy.

    Args:
        value: A value of `datum_type`, not to be changed before its bytes are copied.
        datum_type: The aspect's type.
        stamp_ns: As in `encode_datum`.

    Raises:
        DatumTypeError: As `encode_datum`.
    """
    if type(stamp_ns) is not int or not 0 <= stamp_ns <= INTEGER_MAX:
        raise DatumTypeError(
            f"stamp_ns: asked nanoseconds since 1970 as an int, found {stamp_ns!r:.40}"
        )
    if datum_type is int and type(value) is int and INT_MIN <= value <= INT_MAX:
        # The commonest datum: a third of the time of the general way.
        return Encoded(_VERSION + _pack_int(value), [], 0, stamp_ns)
    writer = TreeWriter()
    encoding = _write(writer, value, datum_type)
    return Encoded(encoding, writer.parts, writer.length, stamp_ns)


def joined(parts: Sequence[bytes | memoryview], size: int) -> bytes | memoryview:
    """Return a copy of the parts, one after another, read-only.

    `bytes.join` would let all other threads of the process wait: 0.1 s and more for 100 MB.
    """
    if size < JOINED_BYTES_MIN:
        return b"".join(parts)
    body, offset = np.empty(size, np.uint8), 0
    for part in parts:
        body[offset : offset + len(part)] = np.frombuffer(part, np.uint8)
        offset += len(part)
    return body.data.toreadonly()


def _write(writer: TreeWriter, value: object, datum_type: Any) -> bytes:
    """Return the encoding of a value; the writer then has the parts of its body."""
    shape = shape_of(datum_type)
    root = _name(datum_type)
    try:
        tree: bytes = msgpack.packb(writer.node(value, shape))
    except MisfitError as misfit:
        raise DatumTypeError(misfit.at(root)) from misfit.__cause__
    if len(tree) > ENCODING_BYTES_MAX:
        if len(tree) > TREE_BYTES_MAX:
            raise DatumTypeError(
                f"{root}: beside its arrays it has {len(tree)} bytes; at most {TREE_BYTES_MAX};"
                " put long lists into arrays"
            )
        tree = msgpack.packb(reference(TREE, *writer.add(tree)))
    if writer.length > BODY_BYTES_MAX:
        raise DatumTypeError(too_large(writer.length).at(root))
    return _VERSION + tree


def decode_datum(datum: Datum, datum_type: Any) -> Any:
    """Return the value of a datum; arrays in it are read-only views of its body.

    Raises:
        DatumTypeError: It is a value of another type.
        ProtocolError: Its bytes are damaged, or of a later version.
    """
    if datum_type is int:
        number = _int_of(datum)
        if number is not None:
            return number
    node = TreeReader(datum).tree()
    shape = shape_of(datum_type)
    try:
        return build(node, shape, _name(datum_type))
    except RecursionError as error:
        raise ProtocolError("a datum is nested too deeply") from error


def _int_of(datum: Datum) -> int | None:
    """Return the value of a datum that is an int, the commonest type; None if not, or damaged."""
    encoding = datum.encoding
    if len(encoding) > INT_ENCODING_BYTES or encoding[:1] != _VERSION or datum.size or datum.body:
        return None
    try:
        node = msgpack.unpackb(encoding[1:])
    except (ValueError, TypeError, msgpack.UnpackException):
        return None
    return node if type(node) is int else None


def decode_to_fill(
    encoding: bytes, memory: memoryview, datum_type: Any
) -> tuple[Any, tuple[np.ndarray[Any, Any], ...]]:
    """Return a value whose arrays lie over writable memory, and these arrays, to be filled.

    Raises:
        DatumTypeError: It is a value of another type.
    """
    datum = Datum(encoding, memory, len(memory))
    node = TreeReader(datum, writable=True).tree()
    value = build(node, shape_of(datum_type), _name(datum_type))
    arrays = tuple(_arrays_in(value))
    for array in arrays:
        array.flags.writeable = True
    return value, arrays


def _arrays_in(value: object) -> Iterator[np.ndarray[Any, Any]]:
    """Yield the arrays of a value, those of nested dataclasses and containers, too."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _arrays_in(each)
    elif isinstance(value, dict):
        yield from _arrays_in(list(value.values()))
    elif is_dataclass(value):
        yield from _arrays_in([getattr(value, field.name) for field in fields(value)])


def decode_untyped(datum: Datum) -> object:
    """Return a datum's value without its Python type: dataclasses and codecs come as dicts.

    Such a dict has the name of the dataclass or codec under ``"__type__"``; what a codec made
    stands under ``"value"``.

    Raises:
        ProtocolError: Its bytes are damaged, or of a later version.
    """
    node = TreeReader(datum).tree()
    try:
        result: object = untyped(node)
    except RecursionError as error:
        raise ProtocolError("a datum is nested too deeply") from error
    return result


def _name(datum_type: Any) -> str:
    if typing.get_origin(datum_type) is np.ndarray:
        return text_of(shape_of(datum_type))  # Python's own text of it has 80 characters
    return datum_type.__qualname__ if isinstance(datum_type, type) else str(datum_type)
