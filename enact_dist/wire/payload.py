"""Data to bytes and back: a tree of plain values, and arrays raw in one body.

::

    encoding = msgpack tree of the value              at most 4 KiB, travels with every grant
    body     = array | padding | array | long text …  one immutable block, never inside msgpack

In the tree, msgpack extension types stand for what msgpack does not know:

====  =======================================================  ==============================
code  content (msgpack)                                        means
====  =======================================================  ==============================
1     ``[dtype, shape, order, offset, length]``                array in the body
2     ``[offset, length]``                                     bytes in the body
3     ``[offset, length]``                                     text (UTF-8) in the body
4     ``[name, [field names], [nodes]]``                       dataclass
5     ``[codec name, node]``                                   value of a registered codec
6     ``[nodes]``                                              tuple
7     ``[offset, length]``                                     the tree itself, in the body
====  =======================================================  ==============================

`dtype` is numpy's text (``<f4``) or, for structured arrays, its list of fields; `order` is ``C`` or
``F``.  Arrays start at multiples of 64 bytes and come back as read-only views of the body, without
a copy.  A body is copied together once, when a datum is made: it is immutable from then on.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np

from enact_dist.core.datum import Datum
from enact_dist.errors import DatumTypeError, ProtocolError
from enact_dist.wire.limits import (
    BODY_BYTES_MAX,
    DEPTH_MAX,
    DIMENSIONS_MAX,
    ENCODING_BYTES_MAX,
    INLINE_BYTES_MAX,
    aligned,
)
from enact_dist.wire.shapes import (
    ArrayOf,
    CodecOf,
    DictOf,
    ListOf,
    OptionalOf,
    Plain,
    RecordOf,
    Shape,
    TupleOf,
    shape_of,
)

ARRAY, BYTES, TEXT, RECORD, CODEC, TUPLE, TREE = range(1, 8)
INT_MIN: Final = -(1 << 63)
INT_MAX: Final = (1 << 64) - 1


# ---------------------------------------------------------------- encode


def encode_datum(value: object, datum_type: Any, *, stamp_ns: int = 0) -> Datum:
    """Return the datum that stands for `value`; later changes of the value do not reach it.

    Args:
        value: A value of `datum_type`.
        datum_type: The aspect's type.
        stamp_ns: When it was captured, nanoseconds since 1970; 0 where that has no meaning.

    Raises:
        DatumTypeError: The value is not of the type; the message names the part.
    """
    if datum_type is int and type(value) is int and INT_MIN <= value <= INT_MAX:
        return Datum(msgpack.packb(value), b"", 0, stamp_ns)  # the commonest datum, in 1 µs
    writer = _Writer()
    shape = shape_of(datum_type)
    tree = writer.node(value, shape, getattr(datum_type, "__qualname__", repr(datum_type)), 0)
    encoding: bytes = msgpack.packb(tree)
    if len(encoding) > ENCODING_BYTES_MAX:
        encoding = msgpack.packb(_reference(TREE, *writer.add(encoding)))
    if writer.length > BODY_BYTES_MAX:
        raise DatumTypeError(f"a datum of {writer.length} bytes; at most {BODY_BYTES_MAX}")
    body = b"".join(writer.parts)
    return Datum(encoding, body, len(body), stamp_ns)


def check_datum(value: object, datum_type: Any) -> None:
    """Raise `DatumTypeError` if `value` is not of `datum_type`; the message names the part."""
    encode_datum(value, datum_type)


def _reference(code: int, *content: object) -> msgpack.ExtType:
    return msgpack.ExtType(code, msgpack.packb(content))


def _wrong(where: str, asked: str, value: object) -> DatumTypeError:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}…"  # noqa: PLR2004
    return DatumTypeError(f"{where}: asked {asked}, found {type(value).__name__} {shown}")


class _Writer:
    """Builds the tree and collects what goes into the body."""

    __slots__ = ("length", "parts")

    def __init__(self) -> None:
        self.parts: list[Any] = []
        self.length = 0

    def add(self, part: Any) -> tuple[int, int]:
        """Put a buffer into the body; return its offset and length."""
        size = part.nbytes if isinstance(part, np.ndarray) else len(part)
        start = aligned(self.length)
        if start > self.length:
            self.parts.append(bytes(start - self.length))
        self.parts.append(part)
        self.length = start + size
        return start, size

    def node(self, value: Any, shape: Shape, where: str, depth: int) -> object:
        """Return the tree's node for a value of a shape."""
        if depth > DEPTH_MAX:
            raise DatumTypeError(f"{where} is nested deeper than {DEPTH_MAX}")
        match shape:
            case Plain(kind):
                return self._plain(value, kind, where, depth)
            case ArrayOf(dtype):
                return self._array(value, dtype, where)
            case OptionalOf(inner):
                return None if value is None else self.node(value, inner, where, depth + 1)
            case RecordOf(kind, fields):
                return self._record(value, kind, fields, where, depth)
            case CodecOf(codec):
                if type(value) is not codec.datum_type:
                    raise _wrong(where, codec.datum_type.__qualname__, value)
                inner_node = self.node(codec.encode(value), Plain(object), where, depth + 1)
                return _reference(CODEC, codec.name, inner_node)
            case _:
                return self._container(value, shape, where, depth)

    def _container(
        self, value: Any, shape: ListOf | DictOf | TupleOf, where: str, depth: int
    ) -> object:
        if isinstance(shape, ListOf):
            if type(value) is not list:
                raise _wrong(where, "list", value)
            return [
                self.node(v, shape.each, f"{where}[{i}]", depth + 1) for i, v in enumerate(value)
            ]
        if isinstance(shape, DictOf):
            if type(value) is not dict:
                raise _wrong(where, "dict", value)
            for key in value:
                if type(key) is not shape.key:
                    raise _wrong(f"a key of {where}", shape.key.__name__, key)
            return {
                k: self.node(v, shape.each, f"{where}[{k!r}]", depth + 1) for k, v in value.items()
            }
        if type(value) is not tuple:
            raise _wrong(where, "tuple", value)
        shapes = shape.parts * len(value) if shape.repeated else shape.parts
        if len(shapes) != len(value):
            raise _wrong(where, f"a tuple of {len(shapes)}", value)
        nodes = [
            self.node(part, each, f"{where}[{index}]", depth + 1)
            for index, (part, each) in enumerate(zip(value, shapes, strict=True))
        ]
        return _reference(TUPLE, *nodes)

    def _plain(self, value: Any, kind: type, where: str, depth: int) -> object:
        if kind is object:
            return self._any(value, where, depth)
        if kind is float:
            if isinstance(value, float | np.floating) and not isinstance(value, np.longdouble):
                return float(value)
            raise _wrong(where, "float", value)
        if kind is int and isinstance(value, np.integer):
            value = int(value)
        if kind is bool and isinstance(value, np.bool_):
            value = bool(value)
        if type(value) is not kind:
            raise _wrong(where, kind.__name__, value)
        return self._any(value, where, depth)

    def _any(self, value: Any, where: str, depth: int) -> object:
        """Return the node of a plain value of whatever kind it is."""
        kind = type(value)
        if kind in (bool, float):
            return value
        if kind is int:
            if INT_MIN <= value <= INT_MAX:
                return value
            raise _wrong(where, "an int of 64 bits", value)
        if kind is str:
            raw = value.encode("utf-8", "surrogatepass") if len(value) >= INLINE_BYTES_MAX else b""
            return _reference(TEXT, *self.add(raw)) if raw else _encodable(value, where)
        if kind is bytes:
            return value if len(value) < INLINE_BYTES_MAX else _reference(BYTES, *self.add(value))
        if kind is list:
            return self.node(value, ListOf(Plain(object)), where, depth + 1)
        if kind is dict:
            keys = {type(key) for key in value}
            if keys - {str, int} or len(keys) > 1:
                raise _wrong(where, "a dict with keys all str or all int", value)
            return self.node(
                value, DictOf(keys.pop() if keys else str, Plain(object)), where, depth + 1
            )
        if isinstance(value, np.ndarray):
            return self._array(value, None, where)
        if value is None:
            raise DatumTypeError(
                f"{where} is None; null is written with `del lock[request]`, and None inside a"
                " datum needs a dataclass field annotated `X | None`"
            )
        return self.node(value, shape_of(kind), where, depth + 1)

    def _array(self, value: Any, dtype: np.dtype[Any] | None, where: str) -> object:
        if not isinstance(value, np.ndarray):
            raise _wrong(where, "numpy.ndarray", value)
        if value.dtype.hasobject or (value.size and not value.dtype.itemsize):
            raise DatumTypeError(f"{where}: an array of dtype {value.dtype} cannot travel")
        if dtype is not None and value.dtype != dtype:
            raise _wrong(where, f"an array of {dtype.name}", value.dtype.name)
        order = "C" if value.flags.c_contiguous or not value.flags.f_contiguous else "F"
        whole = np.ascontiguousarray(value if order == "C" else value.T)
        raw = whole.reshape(-1).view(np.uint8) if value.size else b""
        description = np.lib.format.dtype_to_descr(value.dtype)
        return _reference(ARRAY, description, list(value.shape), order, *self.add(raw))

    def _record(
        self, value: Any, kind: type, fields: tuple[tuple[str, Shape], ...], where: str, depth: int
    ) -> object:
        if type(value) is not kind:
            raise _wrong(where, kind.__qualname__, value)
        nodes = [
            self.node(getattr(value, name), shape, f"{where}.{name}", depth + 1)
            for name, shape in fields
        ]
        return _reference(RECORD, kind.__name__, [name for name, _ in fields], nodes)


def _encodable(value: str, where: str) -> str:
    try:
        value.encode()
    except UnicodeEncodeError:
        raise DatumTypeError(f"{where}: text with lone surrogates cannot travel") from None
    return value


# ---------------------------------------------------------------- decode


class _Record(NamedTuple):
    name: str
    fields: tuple[str, ...]
    nodes: tuple[Any, ...]


class _Coded(NamedTuple):
    name: str
    node: Any


class _Tuple(NamedTuple):
    nodes: tuple[Any, ...]


def decode_datum(datum: Datum, datum_type: Any) -> Any:
    """Return the value that a datum stands for; arrays in it are read-only views of its body.

    Raises:
        DatumTypeError: It is a value of another type.
        ProtocolError: Its bytes are damaged.
    """
    node = _Reader(datum).tree()
    if datum_type is int and type(node) is int:
        return node
    return _build(node, shape_of(datum_type), getattr(datum_type, "__qualname__", "datum"))


def decode_untyped(datum: Datum) -> object:
    """Return a datum's value without its Python type: dataclasses and codecs come as dicts.

    Such a dict has the type's name under ``"__type__"``.

    Raises:
        ProtocolError: Its bytes are damaged.
    """
    return _untyped(_Reader(datum).tree())


class _Reader:
    """Reads the tree of one datum; every reference is checked against the body."""

    __slots__ = ("_body", "_datum", "_depth")

    def __init__(self, datum: Datum) -> None:
        self._datum = datum
        self._body = memoryview(datum.body)
        self._depth = 0

    def tree(self) -> Any:
        return self._unpack(self._datum.encoding, outermost=True)

    def _unpack(self, raw: bytes | memoryview, *, outermost: bool = False) -> Any:
        self._depth += 1
        if self._depth > 2 * DEPTH_MAX + 2:
            raise ProtocolError(f"a datum nested deeper than {DEPTH_MAX}")
        try:
            node = msgpack.unpackb(
                raw, ext_hook=self._extension, strict_map_key=False, use_list=False
            )
        except (ValueError, TypeError, msgpack.UnpackException, RecursionError) as error:
            raise ProtocolError(f"the encoding of a datum is damaged: {error}") from None
        self._depth -= 1
        if isinstance(node, _Tree):
            if not outermost:
                raise ProtocolError("a tree inside a tree")
            return self._unpack(node.raw)
        return node

    def _extension(self, code: int, raw: bytes) -> Any:
        content = self._unpack(raw)
        if type(content) is not tuple:
            raise ProtocolError("an extension holds no array")
        try:
            match code, content:
                case 1, (description, shape, order, offset, length):
                    return self._array(description, shape, order, self._part(offset, length))
                case 2, (offset, length):
                    return bytes(self._part(offset, length))
                case 3, (offset, length):
                    return str(self._part(offset, length), "utf-8", "surrogatepass")
                case 4, (str(name), tuple(fields), tuple(nodes)) if len(fields) == len(nodes):
                    return _Record(name, fields, nodes)
                case 5, (str(name), node):
                    return _Coded(name, node)
                case 6, nodes:
                    return _Tuple(nodes)
                case 7, (offset, length):
                    return _Tree(self._part(offset, length))
        except (UnicodeDecodeError, ValueError, TypeError, SyntaxError, OverflowError) as error:
            raise ProtocolError(f"the encoding of a datum is damaged: {error}") from None
        raise ProtocolError(f"no part of a datum has code {code} and this content")

    def _part(self, offset: Any, length: Any) -> memoryview:
        if type(offset) is not int or type(length) is not int:
            raise ProtocolError("offset and length are integers")
        if not 0 <= offset <= offset + length <= len(self._body):
            raise ProtocolError(
                f"a part of {length} bytes at {offset} lies outside a body of {len(self._body)}"
            )
        return self._body[offset : offset + length]

    def _array(self, description: Any, shape: Any, order: Any, raw: memoryview) -> Any:
        if type(shape) is not tuple or len(shape) > DIMENSIONS_MAX or order not in ("C", "F"):
            raise ProtocolError("an array is dtype, shape, order C or F, offset and length")
        if not all(type(extent) is int and 0 <= extent for extent in shape):
            raise ProtocolError(f"{shape} is no shape")
        dtype = np.lib.format.descr_to_dtype(_listed(description))
        count = math.prod(shape)
        if dtype.hasobject or count * dtype.itemsize != len(raw) or (count and not dtype.itemsize):
            raise ProtocolError(f"{len(raw)} bytes are no {dtype} array of shape {shape}")
        if not count:
            array = np.empty(shape, dtype)
            array.flags.writeable = False
            return array
        array = np.frombuffer(raw, dtype, count).reshape(shape, order=order)
        array.flags.writeable = False
        return array


class _Tree(NamedTuple):
    raw: memoryview


def _listed(description: Any) -> Any:
    """Return numpy's description of a dtype as numpy wants it: lists of tuples."""
    if isinstance(description, str):
        return description
    if not isinstance(description, tuple):
        raise ProtocolError(f"{description!r} describes no dtype")
    if description and all(isinstance(field, tuple) for field in description):
        return [_field(field) for field in description]
    return _field(description)


def _field(field: Any) -> Any:
    """Return one (name, type[, shape]) of a structured dtype, or a (type, shape) subarray."""
    parts = []
    for index, part in enumerate(field):
        nested = isinstance(part, tuple) and any(isinstance(inner, tuple) for inner in part)
        typed = index == 1 and isinstance(part, tuple)
        parts.append(_listed(part) if nested and typed else part)
    return tuple(parts)


def _mismatch(where: str, asked: str, node: Any) -> DatumTypeError:
    return DatumTypeError(f"{where}: asked {asked}, the datum holds {_kind(node)}")


def _kind(node: Any) -> str:
    if isinstance(node, _Record | _Coded):
        return node.name
    return {_Tuple: "tuple", tuple: "list"}.get(type(node), type(node).__name__)


def _build(node: Any, shape: Shape, where: str) -> Any:
    """Return the value of a shape that a node stands for."""
    match shape:
        case Plain(kind):
            if kind is object:
                return _untyped(node)
            if type(node) is not (tuple if kind is list else kind):
                raise _mismatch(where, kind.__name__, node)
            return _untyped(node)
        case ArrayOf(dtype):
            if not isinstance(node, np.ndarray) or (dtype is not None and node.dtype != dtype):
                raise _mismatch(where, "numpy.ndarray", node)
            return node
        case OptionalOf(inner):
            return None if node is None else _build(node, inner, where)
        case RecordOf(kind, fields):
            if not isinstance(node, _Record) or node.fields != tuple(name for name, _ in fields):
                raise _mismatch(where, kind.__qualname__, node)
            values = {
                name: _build(part, each, f"{where}.{name}")
                for (name, each), part in zip(fields, node.nodes, strict=True)
            }
            return _remade(kind, values)
        case CodecOf(codec):
            if not isinstance(node, _Coded) or node.name != codec.name:
                raise _mismatch(where, codec.name, node)
            return codec.decode(_untyped(node.node))
        case ListOf(each):
            if type(node) is not tuple:
                raise _mismatch(where, "list", node)
            return [_build(part, each, f"{where}[]") for part in node]
        case DictOf(_, each):
            if type(node) is not dict:
                raise _mismatch(where, "dict", node)
            return {key: _build(part, each, f"{where}[{key!r}]") for key, part in node.items()}
        case TupleOf(parts, repeated):
            if not isinstance(node, _Tuple):
                raise _mismatch(where, "tuple", node)
            shapes = parts * len(node.nodes) if repeated else parts
            if len(shapes) != len(node.nodes):
                raise _mismatch(where, f"a tuple of {len(shapes)}", node)
            return tuple(
                _build(part, each, f"{where}[]")
                for part, each in zip(node.nodes, shapes, strict=True)
            )


def _remade(kind: type, values: dict[str, Any]) -> Any:
    """Return a dataclass with these fields, as it was: its own checks ran when it was made."""
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def _untyped(node: Any) -> Any:
    if isinstance(node, _Record):
        values = zip(node.fields, map(_untyped, node.nodes), strict=True)
        return {"__type__": node.name, **dict(values)}
    if isinstance(node, _Coded):
        return {"__type__": node.name, "value": _untyped(node.node)}
    if isinstance(node, _Tuple):
        return tuple(_untyped(part) for part in node.nodes)
    if type(node) is tuple:
        return [_untyped(part) for part in node]
    if type(node) is dict:
        return {key: _untyped(part) for key, part in node.items()}
    return node
