"""One table of a configuration file, read key by key with types, lines and suggestions.

Every `take_…` names the key, what was asked and what was found.  `refuse_unknown` comes first:
a misspelt key must not end as a silent default.

Finds the line on which a key, table or array element of a TOML text stands.

`tomllib` gives values without positions; an error in a `cell.toml` must name the line.  The
locator walks a text that `tomllib` has already accepted, so it checks nothing: it only has to
know where strings, arrays, inline tables and comments begin and end.
"""

from __future__ import annotations

import bisect
import difflib
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

from enact_dist.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

Path = tuple[str | int, ...]
"""Where a value stands: keys of tables and indices of arrays, from the root."""

_BARE_KEY: Final = re.compile(r"[A-Za-z0-9_-]+")
_SPACE: Final = re.compile(r"[ \t]*")
_GAP: Final = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_PLAIN: Final = re.compile(r"[^,\]}\r\n#]*")
_STRINGS: Final = (
    re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}', re.DOTALL),
    re.compile(r"'''.*?'{3,5}", re.DOTALL),
    re.compile(r'"(?:[^"\\]|\\.)*"'),
    re.compile(r"'[^']*'"),
)


class LineLocator:
    """Lines of all keys, tables and array elements of one valid TOML text."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._starts = [0, *(match.end() for match in re.finditer("\n", text))]
        self._lines: dict[Path, int] = {}
        self._tables: dict[Path, int] = {}
        self._walk()

    def line(self, path: Path) -> int:
        """Return the line of `path`, from 1; that of its nearest parent where it has none."""
        while path and path not in self._lines:
            path = path[:-1]
        return self._lines.get(path, 1)

    def _note(self, path: Path, at: int) -> None:
        for length in range(1, len(path) + 1):
            self._lines.setdefault(path[:length], bisect.bisect_right(self._starts, at))

    def _walk(self) -> None:
        table: Path = ()
        at = self._skip(_GAP, 0)
        while at < len(self._text):
            at, table = self._statement(at, table)
            at = self._skip(_GAP, at)

    def _statement(self, at: int, table: Path) -> tuple[int, Path]:
        if self._text[at] != "[":
            return self._assignment(at, table), table
        is_array = self._text.startswith("[[", at)
        path, end = self._key(self._skip(_SPACE, at + (2 if is_array else 1)))
        path = self._resolved(path)
        if is_array:
            index = self._tables[path] = self._tables.get(path, -1) + 1
            path = (*path, index)
        self._note(path, at)
        return self._skip(_SPACE, end) + (2 if is_array else 1), path

    def _resolved(self, path: Path) -> Path:
        """Insert the current index behind every prefix that is an array of tables."""
        found: Path = ()
        for position, part in enumerate(path):
            found = (*found, part)
            if found in self._tables and position < len(path) - 1:
                found = (*found, self._tables[found])
        return found

    def _assignment(self, at: int, table: Path) -> int:
        path, end = self._key(at)
        self._note(table + path, at)
        return self._value(self._skip(_SPACE, self._skip(_SPACE, end) + 1), table + path)

    def _key(self, at: int) -> tuple[Path, int]:
        parts: list[str | int] = []
        while True:
            at = self._skip(_SPACE, at)
            bare = _BARE_KEY.match(self._text, at)
            end = bare.end() if bare else self._string_end(at)
            parts.append(self._text[at:end] if bare else _unquoted(self._text[at:end]))
            dot = self._skip(_SPACE, end)
            if not self._text.startswith(".", dot):
                return tuple(parts), end
            at = dot + 1

    def _value(self, at: int, path: Path) -> int:
        first = self._text[at]
        if first in "\"'":
            return self._string_end(at)
        if first == "[":
            return self._array(at, path)
        if first == "{":
            return self._inline_table(at, path)
        return self._skip(_PLAIN, at)

    def _array(self, at: int, path: Path) -> int:
        index, at = 0, self._skip(_GAP, at + 1)
        while self._text[at] != "]":
            self._note((*path, index), at)
            at = self._skip(_GAP, self._value(at, (*path, index)))
            if self._text[at] == ",":
                at = self._skip(_GAP, at + 1)
            index += 1
        return at + 1

    def _inline_table(self, at: int, path: Path) -> int:
        at = self._skip(_GAP, at + 1)
        while self._text[at] != "}":
            at = self._skip(_GAP, self._assignment(at, path))
            if self._text[at] == ",":
                at = self._skip(_GAP, at + 1)
        return at + 1

    def _string_end(self, at: int) -> int:
        for pattern in _STRINGS:
            match = pattern.match(self._text, at)
            if match:
                return match.end()
        raise AssertionError(f"no string at offset {at} of a text that tomllib accepted")

    def _skip(self, pattern: re.Pattern[str], at: int) -> int:
        match = pattern.match(self._text, at)
        return match.end() if match else at


def _unquoted(key: str) -> str:
    """Return a quoted key without quotes; escapes are read the way the names here need them."""
    body = key[1:-1]
    return body.replace('\\"', '"').replace("\\\\", "\\") if key.startswith('"') else body


T = TypeVar("T")

_TOML_NAMES: Final = {
    bool: "a boolean",
    int: "an integer",
    float: "a float",
    str: "a string",
    list: "an array",
    dict: "a table",
}


def suggestion(found: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` when one of `known` is close to `found`, else nothing."""
    close = difflib.get_close_matches(found, list(known), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def kind_name(value: object) -> str:
    """Return what TOML calls the type of `value`, with its article."""
    return _TOML_NAMES.get(type(value), "a date or time")


@dataclass(frozen=True, slots=True)
class Source:
    """Where a configuration comes from: for messages only."""

    path: str
    locator: LineLocator

    def refuse(self, where: Path, problem: str) -> NoReturn:
        """Raise `ConfigError` about the value at `where`."""
        line = self.locator.line(where)
        raise ConfigError(f"{self.path}, line {line}: {problem}", path=self.path, line=line)


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the file: its values, its place and the source they stand in."""

    values: Mapping[str, object]
    where: Path
    source: Source

    @property
    def title(self) -> str:
        """The table as the file writes it: ``[shards.left]``."""
        name = ".".join(str(part) for part in self.where if isinstance(part, str))
        return f"[{name}]" if name else "the file"

    def refuse(self, key: str, problem: str) -> NoReturn:
        """Raise `ConfigError` about `key` of this table, or about the table where it is absent."""
        where = (*self.where, key) if key in self.values else self.where
        self.source.refuse(where, problem)

    def refuse_unknown(self, *known: str) -> None:
        """Raise `ConfigError` for the first key that is none of `known`."""
        for key in self.values:
            if key not in known:
                self.refuse(
                    key,
                    f"unknown key {key!r} in {self.title}{suggestion(key, known)}"
                    f" (known here: {', '.join(sorted(known))})",
                )

    def take_str(self, key: str, default: str | None = None) -> str:
        """Return the non-empty string at `key`; without `default` the key is required."""
        value = self._take(key, str, default)
        if not value and value != default:
            self.refuse(key, f"{key!r} in {self.title} is an empty string")
        return value

    def take_float(self, key: str, default: float, *, low: float, high: float) -> float:
        """Return the number at `key`, `low` <= it <= `high`."""
        found = self.values.get(key, default)
        if isinstance(found, bool) or not isinstance(found, int | float):
            self.refuse(key, f"{key!r} in {self.title} is a number, not {_shown(found)}")
        if not low <= found <= high:
            self.refuse(
                key, f"{key!r} in {self.title} must lie between {low:g} and {high:g}, not {found!r}"
            )
        return float(found)

    def take_floats(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return the numbers of the array at `key`."""
        found = self.values.get(key, list(default))
        if not isinstance(found, list):
            self.refuse(key, f"{key!r} in {self.title} is an array of numbers, not {_shown(found)}")
        for index, item in enumerate(found):
            if isinstance(item, bool) or not isinstance(item, int | float):
                where = (*self.where, key, index)
                self.source.refuse(
                    where, f"{key!r} in {self.title} is an array of numbers, not {_shown(item)}"
                )
        return tuple(map(float, found))

    def take_bool(self, key: str, *, default: bool) -> bool:
        """Return the truth value at `key`."""
        return self._take(key, bool, default)

    def take_count(self, key: str) -> int | None:
        """Return the whole number above zero at `key`, None where it is absent."""
        found = self.values.get(key)
        if found is not None and (type(found) is not int or found < 1):
            self.refuse(
                key, f"{key!r} in {self.title} is a whole number above 0, not {_shown(found)}"
            )
        return found

    def take_strings(self, key: str, default: tuple[str, ...] = ()) -> tuple[str, ...]:
        """Return the strings at `key`; one bare string counts as a list of one."""
        found = self.values.get(key, list(default))
        items = [found] if isinstance(found, str) else found
        if not isinstance(items, list):
            self.refuse(key, f"{key!r} in {self.title} is an array of strings, not {_shown(found)}")
        for index, item in enumerate(items):
            if not isinstance(item, str) or not item:
                where = (*self.where, key, index)
                self.source.refuse(
                    where, f"{key!r} in {self.title} is an array of strings, not {_shown(item)}"
                )
        return tuple(items)

    def take_table(self, key: str) -> Table:
        """Return the table at `key`, an empty one when it is absent."""
        found = self.values.get(key, {})
        if not isinstance(found, dict):
            self.refuse(key, f"{key!r} in {self.title} is a table, not {_shown(found)}")
        return Table(found, (*self.where, key), self.source)

    def take_tables(self, key: str) -> Iterator[Table]:
        """Yield the tables of the array of tables at `key`."""
        found = self.values.get(key, [])
        if not isinstance(found, list):
            self.refuse(key, f"{key!r} is an array of tables ([[{key}]]), not {_shown(found)}")
        for index, item in enumerate(found):
            where = (*self.where, key, index)
            if not isinstance(item, dict):
                self.source.refuse(where, f"{key!r} holds tables ([[{key}]]), not {_shown(item)}")
            yield Table(item, where, self.source)

    def named_tables(self) -> Iterator[tuple[str, Table]]:
        """Yield name and table of each child of a table of tables, in the order of the file."""
        for name in self.values:
            yield name, self.take_table(name)

    def checked(self, key: str, make: Callable[[], T]) -> T:
        """Return `make()`; its `ValueError` becomes a `ConfigError` about `key`."""
        try:
            return make()
        except ValueError as error:
            self.refuse(key, str(error))

    def _take(self, key: str, kind: type[T], default: T | None) -> T:
        found = self.values.get(key, default)
        if found is None:
            self.refuse(key, f"{self.title} needs the key {key!r}")
        if not isinstance(found, kind):
            wanted = _TOML_NAMES[kind]
            self.refuse(key, f"{key!r} in {self.title} is {wanted}, not {_shown(found)}")
        return found


def _shown(value: object) -> str:
    text = repr(value)
    return f"{kind_name(value)} ({text if len(text) <= 60 else text[:59] + '…'})"
