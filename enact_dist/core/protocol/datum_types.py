"""Which datum types of one aspect go together, decided by their fingerprints.

A type *succeeds* another if it is that type with further fields, each of which has a default;
the fields of nested dataclasses count, too.  Rules a change must keep:

- An aspect has one type at a time: the newest that a client has registered in order to write.
- A client that only reads may have an older type, or one that succeeds the registered type; its
  reading registers no type.
- A client that writes an older type would drop the further fields: the shard refuses it.
- A fingerprint marks a field that has a default with ``=``.  The marks do not tell two types apart.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.parts import AspectEntry

TYPES_MAX: Final = 16
"""Most types that an aspect may have had, one after the other."""
DEFAULT_MARK: Final = "="
"""Stands after a field of a fingerprint that has a default."""
DEPTH_MAX: Final = 100
_SIGNS: Final = "[]{},:?="
_CLOSING: Final = {"[": "]", "{": "}"}


class _Type(NamedTuple):
    """A type: its name, its bracket and the parts in it, and whether it may be `None`.

    Of a dataclass (``{``) the parts are fields, else they have no name.
    """

    name: str
    bracket: str = ""
    parts: tuple[_Part, ...] = ()
    optional: bool = False


class _Part(NamedTuple):
    field: str
    type: _Type
    default: bool = False


# ---------------------------------------------------------------- what goes with what


def same_type(one: str, other: str) -> bool:
    """Whether two fingerprints name the same type."""
    return one == other or one.replace(DEFAULT_MARK, "") == other.replace(DEFAULT_MARK, "")


def succeeds(newer: str, older: str) -> bool:
    """Whether one type is another one with further fields, which all have defaults."""
    one, other = _parsed(newer), _parsed(older)
    return (
        one is not None and other is not None and not same_type(newer, older) and _has(one, other)
    )


def type_conflict(known: AspectEntry, wanted: AspectEntry) -> str:
    """Return why a client cannot use an aspect with the type that it wants; "" if it can."""
    here, asked = known.fingerprint, wanted.fingerprint
    if same_type(here, asked):
        return ""
    before = succeeds(here, asked)
    if wanted.reads and (before or succeeds(asked, here)):
        return ""
    if before:
        return (
            f"aspect {known.name!r} has the datum type {here}, and was now asked, to write it,"
            f" with the older type {asked}, which lacks fields; a client of the older type may"
            " read the aspect, and needs the newer type to write it: bring its program up to date"
        )
    if succeeds(asked, here):
        if len(known.older) + 1 < TYPES_MAX:
            return ""
        return (
            f"aspect {known.name!r} has had {TYPES_MAX} datum types; its type is {here}, and was"
            f" now asked to become {asked}; use another name, or give up its data for the new type:"
            f" stop the cell and call `enact shard forget {known.name}`"
        )
    return (
        f"aspect {known.name!r} is registered with datum type {here}, and was now asked with"
        f" {asked}; use the registered type, add to it nothing but fields with defaults, use"
        " another name, or give up its data for the new type: stop the cell and call `enact shard"
        f" forget {known.name}`"
    )


def with_type_of(known: AspectEntry, wanted: AspectEntry) -> AspectEntry:
    """Return an entry with the type that holds after a registration without a conflict."""
    here, asked = known.fingerprint, wanted.fingerprint
    if wanted.reads:
        return known
    if same_type(here, asked):
        marked = asked.count(DEFAULT_MARK) > here.count(DEFAULT_MARK)
        return known._replace(fingerprint=asked) if marked else known
    return known._replace(fingerprint=asked, older=(*known.older, here))


def newest(one: AspectEntry, other: AspectEntry) -> AspectEntry | None:
    """Return the entry of the newer type of two; None if neither succeeds the other."""
    if same_type(one.fingerprint, other.fingerprint):
        return with_type_of(one, other)
    if succeeds(other.fingerprint, one.fingerprint):
        return other
    return one if succeeds(one.fingerprint, other.fingerprint) else None


def successions(entries: Iterable[AspectEntry]) -> int:
    """Return how often the type of any of these aspects has changed."""
    return sum(len(entry.older) for entry in entries)


# ---------------------------------------------------------------- fingerprints


def _has(newer: _Type, older: _Type) -> bool:
    """Whether a type is another one, perhaps with further fields."""
    if newer == older:
        return True
    alike = (newer.name, newer.bracket, newer.optional) == (
        older.name,
        older.bracket,
        older.optional,
    )
    if not alike:
        return False
    if newer.bracket != "{":
        return len(newer.parts) == len(older.parts) and all(
            _has(one.type, other.type) for one, other in zip(newer.parts, older.parts, strict=True)
        )
    left = list(reversed(older.parts))
    for part in newer.parts:
        if left and left[-1].field == part.field:
            if not _has(part.type, left.pop().type):
                return False
        elif not part.default:
            return False
    return not left


def _parsed(text: str) -> _Type | None:
    """Return the type that a fingerprint names; None if it is cut short or invalid."""
    if "\0" in text:
        return None
    for sign in _SIGNS:
        text = text.replace(sign, f"\0{sign}\0")
    tokens = [token for token in text.split("\0") if token]
    try:
        found, at = _type(tokens, 0, 0)
    except (IndexError, ValueError):
        return None
    return found if at == len(tokens) else None


def _type(tokens: list[str], at: int, depth: int) -> tuple[_Type, int]:
    name = tokens[at]
    if name in _SIGNS or depth > DEPTH_MAX:
        raise ValueError(name)
    at += 1
    bracket, parts = "", []
    if at < len(tokens) and tokens[at] in _CLOSING:
        bracket, closing = tokens[at], _CLOSING[tokens[at]]
        at += 1
        while tokens[at] != closing:
            part, at = _part(tokens, at, depth + 1, named=bracket == "{")
            parts.append(part)
            if tokens[at] == ",":
                at += 1
        at += 1
    optional = at < len(tokens) and tokens[at] == "?"
    return _Type(name, bracket, tuple(parts), optional), at + optional


def _part(tokens: list[str], at: int, depth: int, *, named: bool) -> tuple[_Part, int]:
    field = ""
    if named:
        field, colon = tokens[at], tokens[at + 1]
        if colon != ":":
            raise ValueError(colon)
        at += 2
    found, at = _type(tokens, at, depth)
    default = named and tokens[at] == DEFAULT_MARK
    return _Part(field, found, default), at + default
