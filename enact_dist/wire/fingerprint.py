"""The fingerprint of a datum type: equal in two processes exactly if they mean the same data.

Structural: names of dataclasses and fields and the shapes below them, as text, so that an error
can show both sides.
"""

from __future__ import annotations

from typing import Any

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


def fingerprint(datum_type: Any) -> str:
    """Return the structure of a datum type as text, for example ``Surface{vertices_m:ndarray}``.

    Raises:
        DatumTypeError: The type cannot be a datum.
    """
    return _text(shape_of(datum_type))


def _text(shape: Shape) -> str:
    match shape:
        case Plain(kind):
            return "any" if kind is object else kind.__name__
        case ArrayOf(dtype):
            return "ndarray" if dtype is None else f"ndarray[{dtype.name}]"
        case ListOf(each):
            return f"list[{_text(each)}]"
        case DictOf(key, each):
            return f"dict[{key.__name__},{_text(each)}]"
        case TupleOf(parts, repeated):
            return f"tuple[{','.join(map(_text, parts))}{',…' if repeated else ''}]"
        case OptionalOf(inner):
            return f"{_text(inner)}?"
        case RecordOf(kind, fields):
            inside = ",".join(f"{name}:{_text(part)}" for name, part in fields)
            return f"{kind.__name__}{{{inside}}}"
        case CodecOf(codec):
            return f"<{codec.name}>"
