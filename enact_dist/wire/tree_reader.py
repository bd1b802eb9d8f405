"""Trees to values: `TreeReader` checks the bytes, `build` checks that they are of the asked type.

Rules to keep: bytes that no writer makes raise `ProtocolError`, whole trees of another type
`DatumTypeError`, and nothing else leaves; memory taken is in proportion to the bytes that came
(parts of the body are copied out once each, arrays are views); no class is chosen by the bytes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Final, NamedTuple, NoReturn

import msgpack
import numpy as np

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import DatumTypeError, ProtocolError
from enact_dist.wire.arrays import DtypeError, array_over
from enact_dist.wire.limits import (
    BODY_BYTES_MAX,
    DATUM_VERSION,
    DEPTH_MAX,
    ENCODING_BYTES_MAX,
    TREE_BYTES_MAX,
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
    text_of,
)
from enact_dist.wire.tree_writer import ARRAY, BYTES, CODEC, RECORD, TEXT, TREE, TUPLE

_SCALARS: Final = frozenset({int, float, bool, str, bytes})
_KEYS: Final[tuple[set[type[Any]], ...]] = (set(), {str}, {int})
_EXTENSIONS_DEPTH_MAX: Final = DEPTH_MAX + 4
"""A tree in the body, a codec and an array in it add to the depth of the value itself."""


class RecordNode(NamedTuple):
    """A dataclass whose Python type is not known yet."""

    name: str
    fields: tuple[str, ...]
    nodes: tuple[Any, ...]


class CodedNode(NamedTuple):
    """What a codec made of a value."""

    name: str
    node: Any


class TupleNode(NamedTuple):
    """A tuple; lists come as Python's tuples."""

    nodes: tuple[Any, ...]


class _Tree(NamedTuple):
    raw: memoryview


class TreeReader:
    """Reads the tree of one datum; every reference is checked against the body."""

    __slots__ = ("_body", "_copied_left", "_datum", "_depth")

    def __init__(self, datum: Datum, *, writable: bool = False) -> None:
        self._datum = datum
        body = memoryview(datum.body)
        self._body = body if writable else body.toreadonly()
        self._copied_left = len(self._body)
        self._depth = 0

    def tree(self) -> Any:
        """Return the outermost node.

        Raises:
            ProtocolError: The datum is damaged, or written by a later version.
        """
        datum = self._datum
        if len(self._body) != datum.size or datum.size > BODY_BYTES_MAX:
            raise ProtocolError(f"a datum of {datum.size} bytes has {len(self._body)}")
        if not 2 <= len(datum.encoding) <= ENCODING_BYTES_MAX + 1:
            raise ProtocolError(f"a datum has an encoding of {len(datum.encoding)} bytes")
        if datum.encoding[0] != DATUM_VERSION:
            raise ProtocolError(
                f"a datum has an encoding of version {datum.encoding[0]}; this side reads"
                f" {DATUM_VERSION}; run the same release of enact-dist on all hosts"
            )
        node = self._unpack(datum.encoding[1:])
        if type(node) is _Tree:
            if len(node.raw) > TREE_BYTES_MAX:
                raise ProtocolError(f"a tree of {len(node.raw)} bytes; at most {TREE_BYTES_MAX}")
            node = self._unpack(node.raw)
        return node

    def _unpack(self, raw: bytes | memoryview) -> Any:
        try:
            return msgpack.unpackb(
                raw, ext_hook=self._extension, strict_map_key=False, use_list=False
            )
        except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
            raise ProtocolError(f"the encoding of a datum is damaged: {error}") from error

    def _extension(self, code: int, raw: bytes) -> Any:
        # msgpack calls back for extensions inside extensions, each with a large frame on C's stack:
        # without this limit, a datum of 900 nested tuples ends the process (measured).
        self._depth += 1
        if self._depth > _EXTENSIONS_DEPTH_MAX:
            raise ProtocolError(f"a datum is nested deeper than {DEPTH_MAX}")
        content = self._unpack(raw)
        self._depth -= 1
        read = self._readers.get(code)
        if read is None or type(content) is not tuple:
            raise ProtocolError(f"no part of a datum has code {code} and this content")
        return read(self, content)

    # ---------------------------------------------------------------- the extension types

    def _array(self, content: tuple[Any, ...]) -> Any:
        try:
            description, shape, order, offset, length = content
            return array_over(self._part(offset, length), description, shape, order)
        except (DtypeError, ValueError, TypeError) as error:
            raise ProtocolError(f"an array of a datum is damaged: {error}") from error

    def _bytes(self, content: tuple[Any, ...]) -> bytes:
        return bytes(self._copied(content))

    def _text(self, content: tuple[Any, ...]) -> str:
        try:
            return str(self._copied(content), "utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError(f"a text of a datum is damaged: {error}") from error

    def _record(self, content: tuple[Any, ...]) -> RecordNode:
        if (*map(type, content),) != (str, tuple, tuple):
            raise ProtocolError("a dataclass is [name, fields, nodes]")
        name, fields, nodes = content
        if len(fields) != len(nodes) or not set(map(type, fields)) <= {str}:
            raise ProtocolError(f"{name[:80]} has {len(fields)} fields and {len(nodes)} nodes")
        return RecordNode(name, fields, nodes)

    def _coded(self, content: tuple[Any, ...]) -> CodedNode:
        if len(content) != 2 or type(content[0]) is not str:
            raise ProtocolError("a value of a codec is [name, node]")
        return CodedNode(*content)

    def _tree(self, content: tuple[Any, ...]) -> _Tree:
        return _Tree(self._copied(content))

    def _copied(self, content: tuple[Any, ...]) -> memoryview:
        """Return a part that becomes a Python object of its size: all together fit in the body."""
        if len(content) != 2:
            raise ProtocolError("a reference is [offset, length]")
        part = self._part(*content)
        self._copied_left -= len(part)
        if self._copied_left < 0:
            raise ProtocolError("parts of a datum overlap")
        return part

    def _part(self, offset: Any, length: Any) -> memoryview:
        if type(offset) is not int or type(length) is not int:
            raise ProtocolError("offset and length are integers")
        if not 0 <= offset <= offset + length <= len(self._body):
            raise ProtocolError(
                f"a part of {length} bytes at {offset} lies outside a body of {len(self._body)}"
            )
        return self._body[offset : offset + length]

    _readers: ClassVar[dict[int, Callable[[TreeReader, tuple[Any, ...]], Any]]] = {
        ARRAY: _array,
        BYTES: _bytes,
        TEXT: _text,
        RECORD: _record,
        CODEC: _coded,
        TUPLE: lambda _reader, content: TupleNode(content),
        TREE: _tree,
    }


# ---------------------------------------------------------------- nodes to values


def build(node: Any, shape: Shape, where: str, depth: int = 0) -> Any:
    """Return the value of a shape that a node stands for; `where` names it in messages.

    `depth` counts what is around the node, as the writer counts it.

    Raises:
        DatumTypeError: The node is of another type.
        ProtocolError: It is of the type, and its dataclass or codec refuses it all the same, or it
            is nested too deeply.
    """
    return _BUILDERS[type(shape)](node, shape, where, depth)


def _build_plain(node: Any, shape: Plain, where: str, depth: int) -> Any:
    kind = shape.kind
    if kind is object:
        return untyped(node, depth)
    if type(node) is not (tuple if kind is list else kind):
        _refuse(where, kind.__name__, node)
    return node if kind in _SCALARS else _plain(node, where, depth)


def _plain(node: Any, where: str, depth: int) -> Any:
    """Return a list, dict or scalar that holds only plain values."""
    kind = type(node)
    if kind is tuple:
        _check_depth(depth)
        if set(map(type, node)) <= _SCALARS:
            return list(node)
        return [_plain(part, f"{where}[]", depth + 1) for part in node]
    if kind is dict:
        _check_depth(depth)
        if set(map(type, node)) not in _KEYS:
            _refuse(where, "dict with keys all str or all int", node)
        return {key: _plain(part, f"{where}[{key!r:.40}]", depth + 1) for key, part in node.items()}
    if kind in _SCALARS or kind is np.ndarray:
        return node
    return _refuse(where, "a plain value", node)


def _build_array(node: Any, shape: ArrayOf, where: str, _depth: int) -> Any:
    if type(node) is not np.ndarray:
        _refuse(where, "numpy.ndarray", node)
    if shape.dtype is not None and node.dtype.newbyteorder("=") != shape.dtype:
        raise DatumTypeError(f"{where}: asked {text_of(shape)}, the datum holds {node.dtype}")
    return node


def _build_list(node: Any, shape: ListOf, where: str, depth: int) -> Any:
    if type(node) is not tuple:
        _refuse(where, "list", node)
    _check_depth(depth)
    return _build_each(node, shape.each, where, depth)


def _build_each(nodes: tuple[Any, ...], shape: Shape, where: str, depth: int) -> list[Any]:
    alone = type(shape) is Plain and shape.kind in _SCALARS
    if alone and set(map(type, nodes)) <= {shape.kind}:  # type: ignore[union-attr]  # is Plain
        return list(nodes)
    return [build(part, shape, f"{where}[{index}]", depth + 1) for index, part in enumerate(nodes)]


def _build_dict(node: Any, shape: DictOf, where: str, depth: int) -> Any:
    if type(node) is not dict:
        _refuse(where, "dict", node)
    _check_depth(depth)
    if not set(map(type, node)) <= {shape.key}:
        _refuse(where, f"a dict with keys of {shape.key.__name__}", node)
    return {
        key: build(part, shape.each, f"{where}[{key!r:.40}]", depth + 1)
        for key, part in node.items()
    }


def _build_tuple(node: Any, shape: TupleOf, where: str, depth: int) -> Any:
    if type(node) is not TupleNode:
        _refuse(where, "tuple", node)
    _check_depth(depth)
    if shape.repeated:
        return tuple(_build_each(node.nodes, shape.parts[0], where, depth))
    if len(shape.parts) != len(node.nodes):
        raise DatumTypeError(
            f"{where}: asked a tuple of {len(shape.parts)}, the datum holds one of"
            f" {len(node.nodes)}"
        )
    parts = zip(node.nodes, shape.parts, strict=True)
    return tuple(
        [build(part, each, f"{where}[{i}]", depth + 1) for i, (part, each) in enumerate(parts)]
    )


def _build_optional(node: Any, shape: OptionalOf, where: str, depth: int) -> Any:
    return None if node is None else build(node, shape.inner, where, depth)


def _build_record(node: Any, shape: RecordOf, where: str, depth: int) -> Any:
    names = tuple(name for name, _ in shape.fields)
    if type(node) is not RecordNode or node.name != shape.kind.__name__:
        _refuse_record(where, names, shape, node)
    _check_depth(depth)
    if node.fields != names:
        return _build_other_record(node, shape, where, depth)
    made: Any = object.__new__(shape.kind)
    for (name, each), part in zip(shape.fields, node.nodes, strict=True):
        # As the value was: the checks of its own class ran when it was made.
        object.__setattr__(made, name, build(part, each, f"{where}.{name}", depth + 1))
    return made


def _build_other_record(node: RecordNode, shape: RecordOf, where: str, depth: int) -> Any:
    """Return the value for a node of an older or of a newer type (`core.protocol.datum_types`).

    An older type lacks fields, which get their defaults; fields that a newer one has are left out.
    """
    names = tuple(name for name, _ in shape.fields)
    found = dict(zip(node.fields, node.nodes, strict=True))
    lacking = set(names) - found.keys()
    shared = tuple(name for name in names if name in found)
    in_order = shared == tuple(name for name in node.fields if name in names)
    if not (in_order and lacking <= shape.defaults and (not lacking or shared == node.fields)):
        _refuse_record(where, names, shape, node)
    made: Any = object.__new__(shape.kind)
    for name, each in shape.fields:
        if name in found:
            value = build(found[name], each, f"{where}.{name}", depth + 1)
        else:
            value = _default(shape.kind, name, where)
        object.__setattr__(made, name, value)
    return made


def _default(kind: type, name: str, where: str) -> Any:
    """Return the default of a field, an array read-only as any that arrives."""
    field: dataclasses.Field[Any] = kind.__dataclass_fields__[name]  # type: ignore[attr-defined]
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        try:
            value = field.default_factory()
        except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
            raise DatumTypeError(
                f"{where}.{name}: the datum is of an older type without this field, and the"
                f" field's default cannot be made: {error!r}"
            ) from error
    if type(value) is np.ndarray:
        value = value.view()
        value.flags.writeable = False
    return value


def _refuse_record(where: str, names: tuple[str, ...], shape: RecordOf, node: Any) -> NoReturn:
    found = f"{node.name:.80}({', '.join(node.fields):.200})" if type(node) is RecordNode else ""
    _refuse(where, f"{shape.kind.__name__}({', '.join(names)})", node, found)


def _build_coded(node: Any, shape: CodecOf, where: str, depth: int) -> Any:
    codec = shape.codec
    if type(node) is not CodedNode or node.name != codec.name:
        _refuse(where, f"codec {codec.name}", node)
    plain = _plain(node.node, where, depth + 1)
    try:
        return codec.decode(plain)
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError) as error:
        raise ProtocolError(f"{where}: codec {codec.name} cannot decode: {error!r}") from error


_BUILDERS: Final[dict[type[Any], Callable[[Any, Any, str, int], Any]]] = {
    Plain: _build_plain,
    ArrayOf: _build_array,
    ListOf: _build_list,
    DictOf: _build_dict,
    TupleOf: _build_tuple,
    OptionalOf: _build_optional,
    RecordOf: _build_record,
    CodecOf: _build_coded,
}


def untyped(node: Any, depth: int = 0) -> Any:
    """Return a node as plain Python: dataclasses and coded values as dicts with `__type__`."""
    kind = type(node)
    if kind is np.ndarray or node is None or kind in _SCALARS:
        return node
    if kind is not CodedNode:
        _check_depth(depth)
    depth += 1
    if kind is tuple:
        return [untyped(part, depth) for part in node]
    if kind is dict:
        if set(map(type, node)) not in _KEYS:
            raise ProtocolError("a datum holds a dict with keys neither all str nor all int")
        return {key: untyped(part, depth) for key, part in node.items()}
    if kind is RecordNode:
        values = [untyped(part, depth) for part in node.nodes]
        return {"__type__": node.name, **dict(zip(node.fields, values, strict=True))}
    if kind is CodedNode:
        return {"__type__": node.name, "value": untyped(node.node, depth)}
    if kind is TupleNode:
        return tuple([untyped(part, depth) for part in node.nodes])
    raise ProtocolError(f"a datum holds a {kind.__name__}")


def _check_depth(depth: int) -> None:
    """Refuse what no writer nests so deeply."""
    if depth >= DEPTH_MAX:
        raise ProtocolError(f"a datum is nested deeper than {DEPTH_MAX}")


def _refuse(where: str, asked: str, node: Any, found: str = "") -> NoReturn:
    if not found:
        name = type(node).__name__
        found = {"tuple": "list", "TupleNode": "tuple", "NoneType": "None"}.get(name, name)
        found = f"{node.name:.80}" if type(node) in (RecordNode, CodedNode) else found
    raise DatumTypeError(f"{where}: asked {asked}, the datum holds {found}")
