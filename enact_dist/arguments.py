"""Checks of arguments: a call refuses a wrong argument at once, by its name.

Entities, aspects and names differ only by their types: a call with an aspect in place of an entity
would look for an entity of that name and find none.
"""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Real
from typing import Any, TypeVar

from enact_dist.errors import MisuseError
from enact_dist.terms import Aspect, Context, Entities, Entity, wrong_argument
from enact_dist.wire.limits import REASON_CHARACTERS_MAX
from enact_dist.wire.texts import is_safe, shown

T = TypeVar("T")


def check_argument(call: str, name: str, found: object, *wanted: type[Any]) -> None:
    """Raise `TypeError` unless an argument is of one of the wanted types.

    Args:
        call: The call as it is written: ``history(entity, aspect)``.
        name: The argument's name.
        found: What was given.
        wanted: The types.
    """
    if not isinstance(found, wanted):
        raise wrong_argument(call, name, found, *wanted)


def check_seconds(name: str, found: object) -> None:
    """Raise `MisuseError` unless an argument is a number of seconds, 0 or more."""
    if isinstance(found, Real):
        if float(found) >= 0.0:
            return
        raise MisuseError(f"{name} is {found!r}; it must be 0 or more seconds")
    remedy = f"; write float({found!r})" if isinstance(found, str) else ""
    raise MisuseError(f"{name} is {found!r}; it must be a number of seconds{remedy}")


def check_reason(name: str, found: str) -> None:
    """Raise `MisuseError` unless a text may stand in the audit and in one line of a table."""
    if len(found) > REASON_CHARACTERS_MAX:
        raise MisuseError(
            f"{name} has {len(found)} characters; at most {REASON_CHARACTERS_MAX} are kept"
        )
    if not is_safe(found):
        raise MisuseError(
            f"{name} is {shown(found[:60])!r}; it may hold no line breaks and no other control"
            " characters"
        )


def check_pattern(call: str, name: str, found: object) -> None:
    """Raise `TypeError` unless an argument is a pattern of entities, or one entity."""
    check_argument(call, name, found, Entities, Entity, str)


def check_viewable(call: str, found: object) -> None:
    """Raise `TypeError` unless an argument is a world context of a cell, present or past."""
    if not isinstance(found, Context) or getattr(found, "session", None) is None:
        raise TypeError(
            f"{call}: other is {found!r}, which is no world context of a cell;"
            " take cell.world(name), or world.at(moment)"
        )


def checked_each(call: str, name: str, found: Iterable[T], *wanted: type[Any]) -> tuple[T, ...]:
    """Return a collection that holds only things of the wanted types.

    Raises:
        TypeError: It is none, or holds something else.
    """
    if isinstance(found, str | Aspect) or not isinstance(found, Iterable):
        kinds = " or ".join(kind.__name__ for kind in wanted)
        raise TypeError(f"{call}: {name} is {found!r}, which is no list of {kinds}")
    each = tuple(found)
    for one in each:
        check_argument(call, f"one of {name}", one, *wanted)
    return each
