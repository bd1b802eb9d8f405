"""Data as people write and read them on a command line: JSON literals, files, summaries of arrays.

Written data are checked against the fingerprint that the aspect was registered with, so a text
never replaces a number by accident.  Records and values of a codec can be read, not written: their
Python type is not known here.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from enact_dist.errors import ConfigError, DatumTypeError, MisuseError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

NOTHING: Final = object()
"""What `read` returns for the literal ``null``: the datum is to be deleted."""

TEXT_SHOWN_MAX: Final = 400
"""Characters of a text that are printed; the rest is counted."""
VALUES_SHOWN_MAX: Final = 16
"""Arrays up to this many elements are printed whole."""

_PLAIN: Final[Mapping[str, type]] = {
    "int": int,
    "float": float,
    "bool": bool,
    "str": str,
    "bytes": bytes,
    "list": list,
    "dict": dict,
    "any": object,
}


# ---------------------------------------------------------------- reading a literal


def type_to_put(aspect: str, known: Mapping[str, tuple[str, str]], text: str, *, new: bool) -> Any:
    """Return the datum type with which an aspect can be written.

    Args:
        aspect: Name of the aspect.
        known: Registered aspects: name to (fingerprint, durability).
        text: The value as the command line has it.
        new: Whether an unknown aspect may be registered by the value's type.

    Raises:
        MisuseError: The aspect is unknown, or cannot be written from a command line.
    """
    fingerprint = known.get(aspect, ("", ""))[0]
    if fingerprint:
        return type_of(aspect, fingerprint)
    if not new:
        names = ", ".join(sorted(name for name, entry in known.items() if entry[0])) or "none"
        raise MisuseError(
            f"no aspect {aspect!r} is registered (known: {names}); --new registers it by the"
            " value's type"
        )
    value = read(text, object)
    if value is NOTHING:
        raise MisuseError(f"null does not say of which type the new aspect {aspect!r} is")
    return np.ndarray if isinstance(value, np.ndarray) else type(value)


def type_of(aspect: str, fingerprint: str) -> Any:
    """Return the type of plain values that a fingerprint names.

    Raises:
        MisuseError: It names a record or a codec.
    """
    if "{" in fingerprint or "<" in fingerprint:
        raise MisuseError(
            f"the aspect {aspect!r} holds {fingerprint}, whose Python type is not known here;"
            " write it from Python: lock[Write(world, entity, aspect)] = …"
        )
    return _parsed(fingerprint)


def _parsed(fingerprint: str) -> Any:
    if fingerprint.endswith("?"):
        return _parsed(fingerprint[:-1]) | None
    outer, bracket, inner = fingerprint.removesuffix("]").partition("[")
    if outer == "ndarray":
        return NDArray[np.dtype(inner).type] if bracket else np.ndarray
    if not bracket:
        return _PLAIN[outer]
    parts = [part for part in _split(inner) if part]
    arguments = tuple(... if part == "…" else _parsed(part) for part in parts)
    match outer:
        case "list":
            return list[arguments[0]]  # type: ignore[valid-type]
        case "dict":
            return dict[arguments]  # type: ignore[misc,valid-type]
        case _:
            return tuple[arguments]  # type: ignore[misc,valid-type]


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
    """Return the value that a JSON literal or ``@FILE`` stands for; `NOTHING` for ``null``.

    Raises:
        ConfigError: The literal or the file cannot be read.
        DatumTypeError: It cannot be a value of `datum_type`.
    """
    if text.startswith("@"):
        return _read_file(Path(text[1:]).expanduser(), datum_type)
    return _fitted(_json(text, text), datum_type)


def _json(text: str, shown: str) -> object:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        quoted = "" if re.search(r"[\"\[{]", text) else f"; a text needs quotes: '\"{text}\"'"
        raise ConfigError(f"{shown} is no JSON literal: {error}{quoted}") from error


def _read_file(path: Path, datum_type: Any) -> Any:
    try:
        if path.suffix == ".npy":
            array: object = np.load(path, allow_pickle=False)
            return array
        if path.suffix == ".json":
            return _fitted(_json(path.read_text(encoding="utf-8"), str(path)), datum_type)
        return path.read_text(encoding="utf-8") if datum_type is str else path.read_bytes()
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error


def _fitted(value: object, datum_type: Any) -> Any:
    """Return a JSON value as the nearest value of a type; what does not fit is left as it is.

    JSON has one kind of number, no tuples and only text as keys; everything else must match, and
    is refused with its place when it is encoded.
    """
    if value is None:
        return NOTHING
    origin, arguments = getattr(datum_type, "__origin__", None), _arguments(datum_type)
    if datum_type is float and type(value) is int:
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
    dtype = None
    if datum_type is not np.ndarray:
        dtype = np.dtype(_arguments(_arguments(datum_type)[1])[0])
    try:
        array = np.asarray(value, dtype=dtype)
    except ValueError as error:
        raise DatumTypeError(f"asked an array, found {str(value)[:60]}: {error}") from error
    if array.dtype == object:
        raise DatumTypeError(f"asked an array of numbers, found {str(value)[:60]}")
    return array


# ---------------------------------------------------------------- showing and saving


def lines(datum: object, name: str = "", indent: str = "") -> Iterator[str]:
    """Yield a datum as lines for people; arrays are summarised."""
    head = f"{indent}{name}: " if name else indent
    if isinstance(datum, dict):
        title = str(datum.get("__type__", "")) if "__type__" in datum else ""
        fields = {key: value for key, value in datum.items() if key != "__type__"}
        below = indent
        if name or title:
            yield f"{head}{title}" if title else f"{indent}{name}:"
            below = indent + "  "
        if not fields:
            yield f"{below}{{}}"
        for key, value in fields.items():
            yield from lines(value, str(key), below)
    elif isinstance(datum, list | tuple) and any(_is_long(each) for each in datum):
        yield f"{head}{len(datum)} elements"
        for index, value in enumerate(datum):
            yield from lines(value, f"[{index}]", indent + "  ")
    else:
        yield head + summary(datum)


def _is_long(value: object) -> bool:
    return isinstance(value, dict | list | tuple | np.ndarray)


def summary(value: object) -> str:
    """Return one line about a value that is no dict."""
    if isinstance(value, np.ndarray):
        return _array_summary(value)
    if isinstance(value, bytes):
        return f"{len(value)} bytes {value[:16].hex(' ')}{' …' if len(value) > 16 else ''}"
    text = value if isinstance(value, str) else repr(value)
    more = len(text) - TEXT_SHOWN_MAX
    return text if more <= 0 else f"{text[:TEXT_SHOWN_MAX]}… ({more} more characters)"


def _array_summary(array: NDArray[Any]) -> str:
    shape = " x ".join(map(str, array.shape)) or "scalar"
    text = f"array {shape} {array.dtype}"
    if array.size == 0:
        return f"{text}, empty"
    if array.size <= VALUES_SHOWN_MAX:
        return f"{text} {array.tolist()}"
    if array.dtype.kind in "iufb":
        finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
        text += f", {finite.min()} to {finite.max()}" if finite.size else ", none finite"
        lost = array.size - finite.size
        text += f", {lost} not finite" if lost else ""
    return text


def plain(datum: object) -> object:
    """Return a datum as JSON can carry it; arrays as their description with summary values."""
    if isinstance(datum, dict):
        return {str(key): plain(value) for key, value in datum.items()}
    if isinstance(datum, list | tuple):
        return [plain(value) for value in datum]
    if isinstance(datum, np.ndarray):
        return _array_facts(datum)
    if isinstance(datum, bytes):
        return {"bytes": len(datum), "hex": datum[:64].hex()}
    return datum


def _array_facts(array: NDArray[Any]) -> dict[str, object]:
    facts: dict[str, object] = {"dtype": str(array.dtype), "shape": list(array.shape)}
    if array.size <= VALUES_SHOWN_MAX:
        facts["values"] = plain(array.tolist())
    elif array.dtype.kind in "iufb":
        finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
        if finite.size:
            facts["min"], facts["max"] = finite.min().item(), finite.max().item()
        facts["finite"] = int(finite.size)
    return facts


def save(datum: object, name: str) -> str:
    """Write a datum to a file whose ending says how; return a line about what was written.

    Raises:
        ConfigError: The ending is unknown, or the datum has nothing that the format can hold.
    """
    path = Path(name).expanduser()
    arrays: dict[str, Any] = {key or "datum": array for key, array in _arrays(datum, "")}
    if path.suffix == ".npz":
        if not arrays:
            raise ConfigError(f"the datum holds no array for {path}; save it as .json")
        np.savez(path, **arrays)
        return f"{path}: {', '.join(f'{key} {array.shape}' for key, array in arrays.items())}"
    if path.suffix == ".npy":
        if not isinstance(datum, np.ndarray):
            raise ConfigError(f"the datum is no array; save its arrays as .npz, not {path}")
        np.save(path, datum, allow_pickle=False)
        return f"{path}: {_array_summary(datum)}"
    if path.suffix == ".json":
        path.write_text(json.dumps(_whole(datum), ensure_ascii=False, indent=2), encoding="utf-8")
        return f"{path}: {path.stat().st_size} bytes"
    raise ConfigError(f"{path}: the ending says how to save: .npz, .npy or .json")


def _arrays(datum: object, where: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield every array of a datum with its path in it."""
    if isinstance(datum, np.ndarray):
        yield where, datum
    elif isinstance(datum, dict):
        for key, value in datum.items():
            yield from _arrays(value, f"{where}.{key}" if where else str(key))
    elif isinstance(datum, list | tuple):
        for index, value in enumerate(datum):
            yield from _arrays(value, f"{where}.{index}" if where else str(index))


def _whole(datum: object) -> object:
    """Return a datum as JSON can carry it, with every element of every array."""
    if isinstance(datum, dict):
        return {str(key): _whole(value) for key, value in datum.items()}
    if isinstance(datum, list | tuple):
        return [_whole(value) for value in datum]
    if isinstance(datum, np.ndarray):
        return _whole(datum.tolist())
    return datum.hex() if isinstance(datum, bytes) else datum
