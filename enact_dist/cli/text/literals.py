"""Data as people write them on a command line: JSON literals and files, read by their type.

Written data are checked against the fingerprint that the aspect was registered with, so a text
never replaces a number by accident.  Records and values of a codec can be shown, not written:
their Python type is not known here.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from enact_dist.access.session import unknown_aspect
from enact_dist.config.table import path_of
from enact_dist.errors import ConfigError, DatumTypeError, MisuseError

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import AspectEntry

NOTHING: Final = object()
"""What `read` returns for the literal ``null``: the datum is to be deleted."""

SHOWN_MAX: Final = 60
"""Characters of a wrong literal that its error repeats."""
_ARRAY_OF: Final[Any] = NDArray
_TAKEN_BY: Final = {"b": "b", "i": "iuf", "u": "iuf", "f": "iuf", "c": "iuf"}
"""Kinds of numpy's dtypes, each with those kinds whose values it may have."""
_PLAIN: Final[Mapping[str, Any]] = {
    "int": int,
    "float": float,
    "bool": bool,
    "str": str,
    "bytes": bytes,
    "list": list,
    "dict": dict,
    "any": Any,
}


def type_to_put(aspect: str, known: Mapping[str, AspectEntry], text: str, *, new: bool) -> Any:
    """Return the datum type with which an aspect can be written.

    Args:
        aspect: Name of the aspect.
        known: The registered aspects by name.
        text: The value as the command line has it.
        new: Whether an unknown aspect may be registered by the value's type.

    Raises:
        MisuseError: The aspect is unknown, or cannot be written from a command line.
    """
    if aspect in known and (fingerprint := known[aspect].fingerprint):
        return type_of(aspect, fingerprint)
    if not new:
        named = (name for name, entry in known.items() if entry.fingerprint)
        error = unknown_aspect(aspect, named)
        raise MisuseError(f"{error}; --new registers it by the value's type")
    value = read(text, object)
    if value is NOTHING:
        raise MisuseError(f"null does not tell the type of the new aspect {aspect!r}")
    return np.ndarray if isinstance(value, np.ndarray) else type(value)


def type_of(aspect: str, fingerprint: str) -> Any:
    """Return the type of plain values that a fingerprint names.

    Raises:
        MisuseError: It names a record or a codec.
    """
    if "{" in fingerprint or "<" in fingerprint:
        raise MisuseError(
            f"the aspect {aspect!r} holds {fingerprint}, whose Python type is not known here;"
            " write it from Python: lock[Write(world, entity, aspect)] = … (see docs/data.md)"
        )
    return _parsed(fingerprint)


def _parsed(fingerprint: str) -> Any:
    outer, bracket, inner = fingerprint.removesuffix("]").partition("[")
    if outer == "ndarray":
        return _ARRAY_OF[np.dtype(inner).type] if bracket else np.ndarray
    if not bracket:
        return _PLAIN[outer]
    parts = [part for part in _split(inner) if part]
    arguments = tuple(... if part == "..." else _parsed(part) for part in parts)
    match outer:
        case "list":
            return list.__class_getitem__(arguments[0])
        case "dict":
            return dict.__class_getitem__(arguments)
        case _:
            return tuple.__class_getitem__(arguments)


def _split(text: str) -> Iterator[str]:
    """Yield the parts of a comma list; commas inside brackets do not count."""
    start = depth = 0
    for index, character in enumerate(text):
        depth += (character == "[") - (character == "]")
        if character == "," and not depth:
            yield text[start:index]
            start = index + 1
    yield text[start:]


def read(text: str, datum_type: Any) -> Any:
    """Return the value of a JSON literal or ``@FILE``; `NOTHING` for ``null``.

    Raises:
        ConfigError: The literal or the file cannot be read.
        DatumTypeError: It cannot be a value of `datum_type`.
    """
    if text.startswith("@"):
        return _read_file(path_of(text[1:]), datum_type)
    return _fitted(_json(text, text), datum_type)


def _json(text: str, shown: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:  # also a number of thousands of digits
        shown = shown if len(shown) <= SHOWN_MAX else f"{shown[:SHOWN_MAX]}…"
        quoted = "" if re.search(r"[\"\[{\d]", text) else f"; a text needs quotes: '\"{shown}\"'"
        raise ConfigError(f"{shown} is no JSON literal: {error}{quoted}") from error


def _read_file(path: Path, datum_type: Any) -> Any:
    try:
        if path.suffix == ".npy":
            array: object = np.load(path, allow_pickle=False)
            if not isinstance(array, np.ndarray):
                raise ValueError("it is an archive (.npz); extract one array and save that as .npy")
            return array
        if path.suffix == ".json":
            return _fitted(_json(path.read_text(encoding="utf-8"), str(path)), datum_type)
        return path.read_text(encoding="utf-8") if datum_type is str else path.read_bytes()
    except (OSError, ValueError, EOFError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error


def _fitted(value: object, datum_type: Any) -> Any:
    """Return a JSON value as the nearest value of a type; other values stay unchanged.

    JSON has one kind of number, no tuples and only text as keys; everything else must match, and
    is refused with its place when it is encoded.
    """
    if value is None:
        return NOTHING
    origin, arguments = getattr(datum_type, "__origin__", None), _arguments(datum_type)
    if datum_type is float and type(value) is int and abs(value) <= sys.float_info.max:
        return float(value)
    if datum_type is np.ndarray or origin is np.ndarray:
        return _array(value, datum_type)
    if origin is list and isinstance(value, list):
        return [_fitted(each, arguments[0]) for each in value]
    if origin is tuple and isinstance(value, list):
        kinds = arguments[:1] * len(value) if arguments[-1:] == (...,) else arguments
        return tuple(_fitted(each, kind) for each, kind in zip(value, kinds, strict=False))
    if origin is dict and isinstance(value, dict):
        key_type, each_type = arguments
        return {_key(key, key_type): _fitted(each, each_type) for key, each in value.items()}
    return value


def _arguments(datum_type: Any) -> tuple[Any, ...]:
    return tuple(getattr(datum_type, "__args__", ()))


def _key(key: str, key_type: Any) -> object:
    try:
        return int(key) if key_type is int else key
    except ValueError:
        raise DatumTypeError(f"key {key!r}: asked int, found str") from None


def _array(value: object, datum_type: Any) -> NDArray[Any]:
    """Return a JSON value as an array; where the type names a dtype, of that one."""
    asked = "an array of numbers (of at most 64 bits)"
    try:
        array = np.asarray(value)
        if datum_type is not np.ndarray and array.dtype != object:
            dtype = np.dtype(_arguments(_arguments(datum_type)[1])[0])
            asked = f"an array of {dtype.name}"
            array = _converted(array, dtype)
    except (ValueError, OverflowError) as error:
        raise DatumTypeError(f"asked {asked}, found {str(value)[:60]}: {error}") from error
    if array.dtype == object:
        raise DatumTypeError(f"asked {asked}, found {str(value)[:60]}")
    return array


def _converted(array: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return an array of JSON values with another dtype, unless that changes one of them.

    Raises:
        ValueError: It does: a text would become a number, 1.5 a 1, or 300 a 44.
    """
    taken = _TAKEN_BY.get(dtype.kind, "")
    if not taken:
        return array.astype(dtype)
    if array.size and array.dtype.kind not in taken:
        raise ValueError(f"{array.flat[0].item()!r} is no {dtype.name}")
    with np.errstate(all="ignore"):  # what comes out is looked at instead
        converted = array.astype(dtype)
    is_rounded = dtype.kind in "fc"  # which may not make an infinity of it
    changed = np.isfinite(converted) != np.isfinite(array) if is_rounded else converted != array
    if changed.any():
        raise ValueError(f"{array[changed].item(0)!r} is no {dtype.name}")
    return converted
