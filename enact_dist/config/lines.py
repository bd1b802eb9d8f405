"""Finds the line on which a key, table or array element of a TOML text stands.

`tomllib` gives values without positions; an error in a `cell.toml` must name the line.  The
locator walks a text that `tomllib` has already accepted, so it checks nothing: it only has to
know where strings, arrays, inline tables and comments begin and end.
"""

from __future__ import annotations

import bisect
import re
from typing import Final

Place = tuple[str | int, ...]
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
        self._lines: dict[Place, int] = {}
        self._tables: dict[Place, int] = {}
        self._walk()

    def line(self, path: Place) -> int:
        """Return the line of `path`, from 1; that of its nearest parent where it has none."""
        while path and path not in self._lines:
            path = path[:-1]
        return self._lines.get(path, 1)

    def _note(self, path: Place, at: int) -> None:
        for length in range(1, len(path) + 1):
            self._lines.setdefault(path[:length], bisect.bisect_right(self._starts, at))

    def _walk(self) -> None:
        table: Place = ()
        at = self._skip(_GAP, 0)
        while at < len(self._text):
            at, table = self._statement(at, table)
            at = self._skip(_GAP, at)

    def _statement(self, at: int, table: Place) -> tuple[int, Place]:
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

    def _resolved(self, path: Place) -> Place:
        """Insert the current index behind every prefix that is an array of tables."""
        found: Place = ()
        for position, part in enumerate(path):
            found = (*found, part)
            if found in self._tables and position < len(path) - 1:
                found = (*found, self._tables[found])
        return found

    def _assignment(self, at: int, table: Place) -> int:
        path, end = self._key(at)
        self._note(table + path, at)
        return self._value(self._skip(_SPACE, self._skip(_SPACE, end) + 1), table + path)

    def _key(self, at: int) -> tuple[Place, int]:
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

    def _value(self, at: int, path: Place) -> int:
        first = self._text[at]
        if first in "\"'":
            return self._string_end(at)
        if first == "[":
            return self._array(at, path)
        if first == "{":
            return self._inline_table(at, path)
        return self._skip(_PLAIN, at)

    def _array(self, at: int, path: Place) -> int:
        index, at = 0, self._skip(_GAP, at + 1)
        while self._text[at] != "]":
            self._note((*path, index), at)
            at = self._skip(_GAP, self._value(at, (*path, index)))
            if self._text[at] == ",":
                at = self._skip(_GAP, at + 1)
            index += 1
        return at + 1

    def _inline_table(self, at: int, path: Place) -> int:
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
