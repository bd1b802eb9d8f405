"""What a datum type looks like: the one reading of Python annotations, for all of `wire`.

===========================================  =========================================
annotation                                   shape
===========================================  =========================================
`int` `float` `bool` `str` `bytes`           `Plain`
`list`, `dict`, `object`                     `Plain` (any plain values, nested)
`list[X]`, `dict[str, X]`, `dict[int, X]`    `ListOf`, `DictOf`
`tuple[X, ...]`, `tuple[X, Y]`               `TupleOf`
`X | None`                                   `OptionalOf`
`numpy.ndarray`, `NDArray[…]`                `ArrayOf`
a frozen dataclass                           `RecordOf`
a type with a registered codec               `CodecOf`
===========================================  =========================================
"""

from __future__ import annotations

import dataclasses
import types
import typing
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from enact_dist.errors import DatumTypeError
from enact_dist.wire import codecs
from enact_dist.wire.codecs import Codec
from enact_dist.wire.limits import DEPTH_MAX


@dataclass(frozen=True, slots=True)
class Plain:
    """One of the types that msgpack knows; `object` stands for any of them."""

    kind: type


@dataclass(frozen=True, slots=True)
class ArrayOf:
    """A numpy array; `dtype` None takes any."""

    dtype: np.dtype[Any] | None


@dataclass(frozen=True, slots=True)
class ListOf:
    """A list of one shape."""

    each: Shape


@dataclass(frozen=True, slots=True)
class DictOf:
    """A dict with keys `str` or `int`."""

    key: type
    each: Shape


@dataclass(frozen=True, slots=True)
class TupleOf:
    """A tuple: of any length of one shape, or of these shapes in order."""

    parts: tuple[Shape, ...]
    repeated: bool


@dataclass(frozen=True, slots=True)
class OptionalOf:
    """A shape or None."""

    inner: Shape


@dataclass(frozen=True, slots=True)
class RecordOf:
    """A frozen dataclass with its fields in order; `defaults` names those that have one."""

    kind: type
    fields: tuple[tuple[str, Shape], ...]
    defaults: frozenset[str]


@dataclass(frozen=True, slots=True)
class CodecOf:
    """A type with a registered codec."""

    codec: Codec


Shape = Plain | ArrayOf | ListOf | DictOf | TupleOf | OptionalOf | RecordOf | CodecOf

_PLAIN: Final = (int, float, bool, str, bytes, list, dict, object)
_known: dict[Any, Shape] = {}
codecs.changed.append(_known.clear)


def shape_of(datum_type: Any) -> Shape:
    """Return the shape of a datum type; computed once per type.

    Raises:
        DatumTypeError: The type cannot be a datum; the message says which part and why.
    """
    try:
        known = _known.get(datum_type)
    except TypeError:
        raise DatumTypeError(f"{datum_type!r} is no type") from None
    if known is None:
        known = _known[datum_type] = _shape(datum_type, _name(datum_type), ())
    return known


def _shape(hint: Any, where: str, around: tuple[type[Any], ...]) -> Shape:
    """Return the shape of an annotation found at `where`, inside these dataclasses."""
    if len(around) > DEPTH_MAX:
        raise DatumTypeError(f"{where} is nested deeper than {DEPTH_MAX}")
    codec = codecs.by_type.get(hint)
    if codec is not None:
        return CodecOf(codec)
    if hint is Any:
        return Plain(object)
    if isinstance(hint, type) and hint in _PLAIN:
        return Plain(hint)
    if hint is np.ndarray:
        return ArrayOf(None)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _record(hint, where, around)
    return _generic(hint, where, around)


def _generic(hint: Any, where: str, around: tuple[type[Any], ...]) -> Shape:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is np.ndarray:
        return ArrayOf(_dtype_of(arguments))
    if origin is list:
        return ListOf(_shape(arguments[0], f"{where}[]", around))
    if origin is dict:
        if arguments[0] not in (str, int):
            raise DatumTypeError(
                f"{where}: keys of a dict are str or int, not {_name(arguments[0])}"
            )
        return DictOf(arguments[0], _shape(arguments[1], f"{where}[]", around))
    if origin is tuple:
        repeated = len(arguments) == 2 and arguments[1] is Ellipsis
        parts = arguments[:1] if repeated else arguments
        return TupleOf(tuple(_shape(part, f"{where}[]", around) for part in parts), repeated)
    if origin in (types.UnionType, typing.Union):
        others = [part for part in arguments if part is not types.NoneType]
        if len(others) == 1 and len(arguments) == 2 and around:
            return OptionalOf(_shape(others[0], where, around))
    raise DatumTypeError(
        f"{where}: {_name(hint)} cannot be {'part of ' if around else ''}a datum; use int, float,"
        " bool, str, bytes, list, dict, tuple[X, ...], numpy.ndarray, frozen dataclasses of these"
        " (there also X | None), or register_codec()"
    )


def _record(kind: type[Any], where: str, around: tuple[type[Any], ...]) -> RecordOf:
    if kind in around:
        raise DatumTypeError(
            f"{where}: {kind.__qualname__} contains itself; refer to others by entity name"
        )
    if not kind.__dataclass_params__.frozen:
        raise DatumTypeError(
            f"{where}: dataclass {kind.__qualname__} is not frozen; data are immutable values:"
            " write @dataclass(frozen=True)"
        )
    try:
        hints = typing.get_type_hints(kind)
    except (NameError, TypeError) as error:
        raise DatumTypeError(f"{where}: an annotation cannot be resolved: {error}") from error
    around = (*around, kind)
    return RecordOf(
        kind,
        tuple(
            (field.name, _shape(hints[field.name], f"{where}.{field.name}", around))
            for field in dataclasses.fields(kind)
        ),
        frozenset(field.name for field in dataclasses.fields(kind) if _has_default(field)),
    )


def _has_default(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def _dtype_of(arguments: tuple[Any, ...]) -> np.dtype[Any] | None:
    """Return the dtype that `NDArray[np.float64]` names, or None where it leaves it open."""
    inner = typing.get_args(arguments[1]) if len(arguments) > 1 else ()
    if not inner or not isinstance(inner[0], type) or not issubclass(inner[0], np.generic):
        return None
    if inner[0] in _ABSTRACT:
        return None
    return np.dtype(inner[0])


_ABSTRACT: Final = (
    np.generic,
    np.number,
    np.integer,
    np.signedinteger,
    np.unsignedinteger,
    np.inexact,
    np.floating,
    np.complexfloating,
    np.flexible,
    np.character,
)


def _name(hint: Any) -> str:
    return getattr(hint, "__qualname__", None) or repr(hint)


def text_of(shape: Shape, *, mark: str = "") -> str:
    """Return the structure as text, for example ``Surface{vertices_m:ndarray,colour:str?}``.

    `mark` stands after each field that has a default.
    """
    part_of = partial(text_of, mark=mark)
    match shape:
        case Plain(kind):
            return "any" if kind is object else kind.__name__
        case ArrayOf(dtype):
            return "ndarray" if dtype is None else f"ndarray[{dtype.name}]"
        case ListOf(each):
            return f"list[{part_of(each)}]"
        case DictOf(key, each):
            return f"dict[{key.__name__},{part_of(each)}]"
        case TupleOf(parts, repeated):
            return f"tuple[{','.join(map(part_of, parts))}{',...' if repeated else ''}]"
        case OptionalOf(inner):
            return f"{part_of(inner)}?"
        case RecordOf(kind, fields, defaults):
            marks = {name: mark if name in defaults else "" for name, _ in fields}
            inside = ",".join(f"{name}:{part_of(part)}{marks[name]}" for name, part in fields)
            return f"{kind.__name__}{{{inside}}}"
        case CodecOf(codec):
            return f"<{codec.name}>"
