"""Characters that a text of the protocol has none of, and how a text from anywhere is shown.

A line break in a name forges a line of the log, an escape sequence clears the screen of a person
who
lists the actors, and a mark that turns the direction of writing shows one name as another.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, Final

from enact_dist.errors import ProtocolError

_UNSAFE: Final = "\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069"
"""Control characters, breaks of lines and paragraphs, and marks of the direction of writing."""
_unsafe: Final = re.compile(f"[{_UNSAFE}]")
_unsafe_in_lines: Final = re.compile(f"(?![\n\t])[{_UNSAFE}]")


def refuse_unsafe(values: Iterable[Any]) -> None:
    """Refuse texts, however deep in tuples, that hold an unsafe character.

    Raises:
        ProtocolError: One does; it says which character.
    """
    for value in values:
        kind = type(value)
        if kind is str:
            if not value.isprintable():
                found = _unsafe.search(value)
                if found is not None:
                    raise ProtocolError(
                        f"a text came with the character U+{ord(found[0]):04X} in it,"
                        f" {value[:60]!r}; no name and no reason may have it"
                    )
        elif kind is tuple and value:
            refuse_unsafe(value)


def is_safe(text: str) -> bool:
    """Say whether a text may travel."""
    return text.isprintable() or _unsafe.search(text) is None


def shown(text: str, *, lines: bool = False) -> str:
    r"""Return a text as people may see it: unsafe characters as ``\x1b`` or ``\u202e``.

    With `lines` it may have several lines, and tabs.
    """
    if text.isprintable():
        return text
    return (_unsafe_in_lines if lines else _unsafe).sub(lambda found: repr(found[0])[1:-1], text)


def shown_json(text: str) -> str:
    r"""Return a JSON text whose strings hold no unsafe character as such, but ``\u001b``."""
    if text.isprintable():
        return text
    return _unsafe_in_lines.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
