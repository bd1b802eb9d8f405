"""Checks of arguments: a call refuses a wrong argument at once, by its name.

Entities, aspects and names differ only by their types: a call with an aspect instead of an entity
would look for an entity of that name and find none.

A moment is a timestamp of the shards' commits: of a hybrid logical clock, in nanoseconds since
1970.  A `Position` is exact; a `datetime` or a number of seconds is a reading of some wall clock,
which the shards' clocks follow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from numbers import Real
from typing import Any, Final, NamedTuple, TypeVar

from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import HOLD_NS_MAX
from enact_dist.errors import MisuseError
from enact_dist.terms import Aspect, Context, Entities, Entity, checked_name, wrong_argument
from enact_dist.wire.limits import REASON_CHARACTERS_MAX
from enact_dist.wire.texts import is_safe, shown

When = Position | datetime | float
"""A moment: the position of a commit, an aware `datetime`, or seconds since 1970."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_STAMP_NS_MAX: Final = (1 << 63) - 1


class Moment(NamedTuple):
    """What a `PastContext` shows.

    Attributes:
        at_ns: The timestamp up to which commits are shown; 0: data are chosen by capture stamp.
        captured_ns: The capture stamp of the data; 0: it does not matter.
        nearest: Whether the datum with the nearest capture stamp is taken if none matches.
    """

    at_ns: int
    captured_ns: int = 0
    nearest: bool = False


def stamp_of(when: When, *, seen_ns: int = 0) -> int:
    """Return the stamp of a moment, nanoseconds since 1970.

    Args:
        when: The moment.
        seen_ns: The largest stamp that is known to have passed.

    Raises:
        MisuseError: It is no moment, has no time zone, lies before 1970 or in the future.
    """
    if isinstance(when, Position):
        stamp_ns = when.stamp_ns
        latest_ns = stamp_ns  # the commit exists, so it is not in the future
    else:
        stamp_ns = _wall_ns(when)
        latest_ns = max(seen_ns, time.time_ns())
    if stamp_ns <= 0:
        raise MisuseError(
            f"{_shown(when)} lies before 1970, when nothing was known; 30 seconds ago is"
            " time.time() - 30, on a command line -30s"
        )
    if stamp_ns > latest_ns or stamp_ns > _STAMP_NS_MAX:
        ahead_s = (stamp_ns - latest_ns) // 1_000_000 / 1000 if stamp_ns <= _STAMP_NS_MAX else 0.0
        far = f"{ahead_s:.3g} s" if ahead_s else "centuries"
        raise MisuseError(
            f"{_shown(when)} lies {far} in the future, which is unknown; give a moment in seconds"
            " since 1970, as an aware datetime or as the Position of a commit"
        )
    return stamp_ns


def _shown(when: When) -> str:
    return when.isoformat(sep=" ") if isinstance(when, datetime) else repr(when)


def _wall_ns(when: datetime | float) -> int:
    if isinstance(when, datetime):
        if when.utcoffset() is None:
            raise MisuseError(
                f"{when!r} has no time zone, so it may mean any of 24 hours; write"
                " datetime.now(timezone.utc), or when.astimezone() for this host's zone"
            )
        return (when - _EPOCH) // timedelta(microseconds=1) * 1000
    if isinstance(when, bool) or not isinstance(when, int | float) or not math.isfinite(when):
        raise MisuseError(
            f"{when!r} is no moment; give a Position, an aware datetime or seconds since 1970"
        )
    seconds = math.floor(when)
    return seconds * 1_000_000_000 + round((when - seconds) * 1e9)


T = TypeVar("T")


def checked_as(kind: str, name: str, *, slashes: bool = False) -> str:
    """Return `name` if it may name a `kind`; else raise `MisuseError` with what is wrong."""
    try:
        return checked_name(kind, name, slashes=slashes)
    except ValueError as error:
        raise MisuseError(str(error)) from None


def check_argument(call: str, name: str, found: object, *wanted: type[Any]) -> None:
    """Raise `TypeError` unless an argument is of one of the wanted types."""
    if not isinstance(found, wanted):
        raise wrong_argument(call, name, found, *wanted)


def check_seconds(name: str, found: object) -> None:
    """Raise `MisuseError` unless an argument is a number of seconds, 0 or more."""
    if type(found) is float or isinstance(found, Real):
        if float(found) >= 0.0:
            return
        raise MisuseError(f"{name} is {found!r}; it must be 0 or more seconds")
    remedy = f"; write float({found!r})" if isinstance(found, str) else ""
    raise MisuseError(f"{name} is {found!r}; it must be a number of seconds{remedy}")


HOLD_S_MAX: Final = HOLD_NS_MAX / 1e9


def check_hold(name: str, found: object) -> None:
    """Raise `MisuseError` unless an argument is a hold limit: over 0, at most a day."""
    check_seconds(name, found)
    if not 0.0 < float(found) <= HOLD_S_MAX:  # type: ignore[arg-type]  # a number, as just seen
        raise MisuseError(f"{name} is {found!r}; it must lie in (0, {HOLD_S_MAX:g}] seconds")


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
