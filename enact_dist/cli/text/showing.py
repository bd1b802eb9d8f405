"""Data as people read them on a command line: lines, JSON, files; arrays are summarised."""

from __future__ import annotations

import json
import math
import unicodedata
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from enact_dist.config.table import path_of
from enact_dist.errors import ConfigError, StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

TEXT_SHOWN_MAX: Final = 400
"""Characters of a text that are printed; the rest is counted."""
_HIDDEN: Final = frozenset(("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"))
"""Unicode's bidirectional classes of characters that turn the text beside them round."""
VALUES_SHOWN_MAX: Final = 16
"""Arrays up to this many elements are printed whole."""


def lines(datum: object, name: str = "", indent: str = "") -> Iterator[str]:
    """Yield a datum as lines for people; arrays are summarised."""
    head = f"{indent}{name}: " if name else indent
    if isinstance(datum, dict):
        title = visible(str(datum.get("__type__", "")))
        fields = {key: value for key, value in datum.items() if key != "__type__"}
        below = indent
        if name or title:
            yield f"{head}{title}" if title else f"{indent}{name}:"
            below = indent + "  "
        if not fields:
            yield f"{below}{{}}"
        for key, value in fields.items():
            yield from lines(value, visible(str(key)), below)
    elif isinstance(datum, list | tuple) and any(_is_long(each) for each in datum):
        yield f"{head}{len(datum)} elements"
        for index, value in enumerate(datum):
            yield from lines(value, f"[{index}]", indent + "  ")
    else:
        yield head + summary(datum)


def one_line(datum: object) -> str:
    """Return a datum as one line, as YAML writes it: ``Part {x_mm: 1.5, y_mm: 2.0}``."""
    if isinstance(datum, dict):
        named = {key: value for key, value in datum.items() if key != "__type__"}
        fields = ", ".join(
            f"{visible(str(key))}: {one_line(value)}" for key, value in named.items()
        )
        return f"{visible(str(datum.get('__type__', '')))} {{{fields}}}".lstrip()
    if isinstance(datum, list | tuple) and any(_is_long(each) for each in datum):
        return f"[{', '.join(map(one_line, datum))}]"
    return summary(datum)


def _is_long(value: object) -> bool:
    return isinstance(value, dict | list | tuple | np.ndarray)


def summary(value: object) -> str:
    """Return one line about a value that is no dict."""
    if isinstance(value, np.ndarray):
        return _array_summary(value)
    if isinstance(value, bytes):
        return f"{len(value)} bytes {value[:16].hex(' ')}{' …' if len(value) > 16 else ''}"
    text = visible(value) if isinstance(value, str) else repr(value)
    more = len(text) - TEXT_SHOWN_MAX
    return text if more <= 0 else f"{text[:TEXT_SHOWN_MAX]}… ({more} more characters)"


def visible(text: str) -> str:
    """Return a text with its control characters as escapes, but for tabs and ends of lines.

    The writer of a datum must not be able to clear a reader's screen.
    """
    if text.isprintable():
        return text
    return "".join(
        ascii(each)[1:-1] if _steers(each) and each not in "\n\t" else each for each in text
    )


def _steers(character: str) -> bool:
    is_control = unicodedata.category(character) in {"Cc", "Cs"}
    return is_control or unicodedata.bidirectional(character) in _HIDDEN


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
    """Return a datum as JSON can carry it; arrays as their description with summary values.

    JSON has no NaN and no infinity: these are the texts "NaN", "Infinity" and "-Infinity".
    """
    if isinstance(datum, dict):
        return {str(key): plain(value) for key, value in datum.items()}
    if isinstance(datum, list | tuple):
        return [plain(value) for value in datum]
    if isinstance(datum, np.ndarray):
        return _array_facts(datum)
    if isinstance(datum, bytes):
        return {"bytes": len(datum), "hex": datum[:64].hex()}
    if isinstance(datum, float) and not math.isfinite(datum):
        return "NaN" if math.isnan(datum) else "Infinity" if datum > 0 else "-Infinity"
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
        StoreError: The disk refuses; the file is not there, or not whole.
    """
    path = path_of(name)
    try:
        return _saved(datum, path)
    except OSError as error:  # that of numpy names no file, and a full disk by two numbers
        text = f"cannot write {path}: {error.strerror or error}"
        raise StoreError(text, path=str(path)) from error


def _saved(datum: object, path: Path) -> str:
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
        text = json.dumps(_whole(datum), default=str, ensure_ascii=False, indent=2)
        path.write_text(text, encoding="utf-8")
        return f"{path}: {path.stat().st_size} bytes"
    raise ConfigError(f"{path}: the ending says how to save: .npz, .npy or .json")


def has_arrays(datum: object) -> bool:
    """Say whether an array is some part of a datum."""
    return next(_arrays(datum, ""), None) is not None


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
