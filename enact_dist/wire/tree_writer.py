"""Values to the nodes of a tree, and their buffers to a body, as `docs/protocol.md` describes them.

Rules to keep: what is written reads back equal and of the same types, or it is refused here with
the path of the part; nothing is copied before the body is joined; the writer never calls user code
but a codec's `encode`.
"""

from __future__ import annotations

import enum
import reprlib
from collections.abc import Callable
from typing import Any, ClassVar, Final

import msgpack
import numpy as np

from enact_dist.wire.arrays import DtypeError, describe, raw_bytes
from enact_dist.wire.limits import (
    BODY_BYTES_MAX,
    DEPTH_MAX,
    DIMENSIONS_MAX,
    LEAF_BYTES_MAX,
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
    text_of,
)

ARRAY, BYTES, TEXT, RECORD, CODEC, TUPLE, TREE = range(1, 8)
"""Extension types of msgpack that a tree uses."""
INT_MIN: Final = -(1 << 63)
INT_MAX: Final = (1 << 64) - 1

_ALIKE: Final = ({float}, {bool}, {int})


class MisfitError(Exception):
    """A part that cannot be written; `steps` lead to it, innermost first."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text
        self.steps: list[str] = []

    def at(self, root: str) -> str:
        """Return the whole message, with the path from `root` to the part."""
        return f"{root}{''.join(reversed(self.steps))}: {self.text}"


def reference(code: int, *content: object) -> msgpack.ExtType:
    """Return the node of an extension type."""
    return msgpack.ExtType(code, msgpack.packb(content))


class TreeWriter:
    """Builds one tree and collects what goes into its body."""

    __slots__ = ("length", "parts")

    def __init__(self) -> None:
        self.parts: list[Any] = []
        self.length = 0

    def add(self, part: np.ndarray[Any, Any] | bytes) -> tuple[int, int]:
        """Put a buffer into the body; return its offset and its length in bytes."""
        size = len(part)
        if not size:
            return 0, 0
        start = aligned(self.length)
        if start > self.length:
            self.parts.append(bytes(start - self.length))
        self.parts.append(part)
        self.length = start + size
        return start, size

    def node(self, value: Any, shape: Shape, depth: int = 0) -> object:
        """Return the node of a value of a shape.

        Raises:
            MisfitError: The value is not of the shape.
        """
        return self._writers[type(shape)](self, value, shape, depth)

    # ---------------------------------------------------------------- plain values

    def _plain(self, value: Any, shape: Plain, depth: int) -> object:
        kind = shape.kind
        if kind is object or type(value) is kind:
            return self._any(value, depth)
        if kind is float and type(value) is int:
            return _as_float(value)
        if isinstance(value, np.generic):
            inner = _unboxed(value)
            if type(inner) is kind:
                return inner
        raise _misfit(kind.__name__, value)

    def _any(self, value: Any, depth: int) -> object:
        """Return the node of a plain value of whatever kind it is."""
        kind = type(value)
        if kind is float or kind is bool:
            return value
        if kind is int:
            if INT_MIN <= value <= INT_MAX:
                return value
            raise _misfit("an int of at most 64 bits", value)
        if kind is str:
            return self._text(value)
        if kind is bytes:
            return value if len(value) <= LEAF_BYTES_MAX else reference(BYTES, *self.add(value))
        if kind is list:
            return self._list(value, _EACH_PLAIN, depth)
        if kind is dict:
            keys = {type(key) for key in value} or {str}
            if keys not in ({str}, {int}):
                raise _misfit("a dict with keys all str or all int", value)
            return self._dict(value, DictOf(keys.pop(), _PLAIN), depth)
        if isinstance(value, np.ndarray):
            return self._array(value, _ARRAY, depth)
        if isinstance(value, np.generic) and type(inner := _unboxed(value)) in (int, float, bool):
            return inner
        raise _no_plain(value)

    def _text(self, value: str) -> object:
        if len(value) <= LEAF_BYTES_MAX and value.isascii():
            return value
        try:
            raw = value.encode()
        except UnicodeEncodeError as error:
            raise MisfitError(f"text with a lone surrogate at {error.start}") from None
        return value if len(raw) <= LEAF_BYTES_MAX else reference(TEXT, *self.add(raw))

    # ---------------------------------------------------------------- arrays and containers

    def _array(self, value: Any, shape: ArrayOf, _depth: int) -> object:
        if type(value) is not np.ndarray and type(value) is not np.memmap:
            raise _misfit("numpy.ndarray", value)
        if value.ndim > DIMENSIONS_MAX:
            raise MisfitError(f"an array of {value.ndim} dimensions; at most {DIMENSIONS_MAX}")
        dtype: np.dtype[Any] = value.dtype
        if shape.dtype is not None and dtype.newbyteorder("=") != shape.dtype:
            raise MisfitError(
                f"asked {text_of(shape)}, found dtype {dtype}; where nothing that matters is lost,"
                f" write array.astype({shape.dtype.name!r})"
            )
        if value.size and not dtype.itemsize:
            raise MisfitError(f"{value.size} items of dtype {dtype}, which has no size")
        if value.nbytes > BODY_BYTES_MAX:  # before a copy of what only looks that large
            raise too_large(value.nbytes)
        try:
            description = describe(dtype)
        except DtypeError as error:
            raise MisfitError(str(error)) from error
        order, raw = raw_bytes(value)
        return reference(ARRAY, description, value.shape, order, *self.add(raw))

    def _list(self, value: Any, shape: ListOf, depth: int) -> object:
        if type(value) is not list:
            raise _misfit("list", value)
        _check_depth(depth)
        kinds = set(map(type, value))
        if kinds in _ALIKE and shape.each in (_PLAIN, Plain(*kinds)):
            # Nothing in such a list needs a node of its own.
            if kinds == {int} and not INT_MIN <= min(value) <= max(value) <= INT_MAX:
                raise _misfit("ints of at most 64 bits", value)
            return value
        return self._each(value, shape.each, depth)

    def _each(self, values: Any, shape: Shape, depth: int) -> list[object]:
        nodes: list[object] = []
        try:
            # One by one into the list, so that its length tells where it ended.
            nodes.extend(self.node(value, shape, depth + 1) for value in values)
        except MisfitError as misfit:
            misfit.steps.append(f"[{len(nodes)}]")
            raise
        return nodes

    def _dict(self, value: Any, shape: DictOf, depth: int) -> object:
        if type(value) is not dict:
            raise _misfit("dict", value)
        _check_depth(depth)
        nodes: dict[object, object] = {}
        for key, inner in value.items():
            if type(key) is not shape.key:
                raise _misfit(f"keys of {shape.key.__name__}", key)
            try:
                # As a plain value a key is checked like any, and never becomes a reference.
                name = key if type(key) is str and key.isascii() else _key(key)
                nodes[name] = self.node(inner, shape.each, depth + 1)
            except MisfitError as misfit:
                misfit.steps.append(f"[{reprlib.repr(key)}]")
                raise
        return nodes

    def _tuple(self, value: Any, shape: TupleOf, depth: int) -> object:
        if type(value) is not tuple:
            raise _misfit("tuple", value)
        _check_depth(depth)
        if shape.repeated:
            return reference(TUPLE, *self._each(value, shape.parts[0], depth))
        if len(shape.parts) != len(value):
            raise _misfit(f"a tuple of {len(shape.parts)}", value)
        nodes: list[object] = []
        for part, each in zip(value, shape.parts, strict=True):
            try:
                nodes.append(self.node(part, each, depth + 1))
            except MisfitError as misfit:
                misfit.steps.append(f"[{len(nodes)}]")
                raise
        return reference(TUPLE, *nodes)

    def _optional(self, value: Any, shape: OptionalOf, depth: int) -> object:
        return None if value is None else self.node(value, shape.inner, depth)

    def _record(self, value: Any, shape: RecordOf, depth: int) -> object:
        if type(value) is not shape.kind:
            raise _misfit(shape.kind.__qualname__, value)
        _check_depth(depth)
        names, nodes = [], []
        for name, inner in shape.fields:
            try:
                nodes.append(self.node(getattr(value, name), inner, depth + 1))
            except MisfitError as misfit:
                misfit.steps.append(f".{name}")
                raise
            names.append(name)
        return reference(RECORD, shape.kind.__name__, names, nodes)

    def _codec(self, value: Any, shape: CodecOf, depth: int) -> object:
        codec = shape.codec
        if not isinstance(value, codec.datum_type):
            raise _misfit(codec.datum_type.__qualname__, value)
        try:
            return reference(CODEC, codec.name, self.node(codec.encode(value), _PLAIN, depth + 1))
        except MisfitError as misfit:
            misfit.steps.append(f" (as codec {codec.name} encodes it)")
            raise

    _writers: ClassVar[dict[type[Any], Callable[[TreeWriter, Any, Any, int], object]]] = {
        Plain: _plain,
        ArrayOf: _array,
        ListOf: _list,
        DictOf: _dict,
        TupleOf: _tuple,
        OptionalOf: _optional,
        RecordOf: _record,
        CodecOf: _codec,
    }


_PLAIN: Final = Plain(object)
_EACH_PLAIN: Final = ListOf(_PLAIN)
_ARRAY: Final = ArrayOf(None)


def _check_depth(depth: int) -> None:
    if depth >= DEPTH_MAX:
        raise MisfitError(f"nested deeper than {DEPTH_MAX}")


def _key(key: Any) -> object:
    if type(key) is int and not INT_MIN <= key <= INT_MAX:
        raise _misfit("a key of at most 64 bits", key)
    if type(key) is str:
        try:
            key.encode()
        except UnicodeEncodeError as error:
            raise MisfitError(f"a key with a lone surrogate at {error.start}") from None
    return key


def _as_float(value: int) -> float:
    """Return an int as the float it equals: type checkers let an int pass for a float."""
    try:
        number = float(value)
    except OverflowError:
        raise _misfit("float", value) from None
    if number != value:
        raise _misfit("float, or an int that a float holds exactly,", value)
    return number


def _unboxed(value: np.generic) -> object:
    """Return a numpy scalar as Python's own, which it equals; a long double is none."""
    return value if isinstance(value, np.longdouble | np.clongdouble) else value.item()


def too_large(size: int) -> MisfitError:
    """Return the error for a part, or a whole, of more bytes than a body may have."""
    return MisfitError(
        f"it has {size} bytes; at most {BODY_BYTES_MAX}; split it over several entities or aspects"
    )


def _misfit(asked: str, value: object) -> MisfitError:
    kind = type(value)
    name = kind.__qualname__ if kind.__module__ == "builtins" else _full_name(kind)
    return MisfitError(f"asked {asked}, found {name} {reprlib.repr(value)}")


def _full_name(kind: type[Any]) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _no_plain(value: object) -> MisfitError:
    """Say what to do about a value that no untyped list, dict or codec may hold."""
    if value is None:
        return MisfitError(
            "None is no datum: null is written with `del lock[request]`, and inside a datum None"
            " needs a field annotated `X | None`"
        )
    found = _misfit("a plain value (int, float, bool, str, bytes, list, dict, array)", value).text
    if type(value) is tuple:
        return MisfitError(f"{found}; tuples need an annotation such as tuple[float, ...]")
    if isinstance(value, enum.Enum):
        return MisfitError(f"{found}; an enum needs register_codec()")
    return MisfitError(f"{found}; annotate the container, as in list[{type(value).__name__}]")
