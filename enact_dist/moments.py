"""Moments of the past: their text forms and timestamps.

Time is that of the shards' commits, a hybrid logical clock in nanoseconds since 1970.  What a
`Position` says is exact; a `datetime` or a number of seconds is a reading of some wall clock, which
the shards' clocks follow.
"""

from __future__ import annotations

import math
import time
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

from enact_dist.core.datum import Position
from enact_dist.errors import MisuseError

When = Position | datetime | float
"""A moment: where a commit stands, an aware `datetime`, or seconds since 1970."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_STAMP_NS_MAX: Final = (1 << 63) - 1


class Moment(NamedTuple):
    """What a `PastContext` shows.

    Attributes:
        at_ns: All commits stamped up to this; 0 where data are asked by when they were captured.
        captured_ns: The capture stamp of the data, 0 where it does not matter.
        nearest: Whether one captured at another time will do, the nearest.
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
        latest_ns = stamp_ns  # of a commit that there is; its shard knows better
    else:
        stamp_ns = _wall_ns(when)
        latest_ns = max(seen_ns, time.time_ns())
    if stamp_ns <= 0:
        raise MisuseError(
            f"{_shown(when)} lies before 1970, when nothing was known; so long ago is"
            " time.time() - 30, on a command line -30s"
        )
    if stamp_ns > latest_ns or stamp_ns > _STAMP_NS_MAX:
        ahead_s = (stamp_ns - latest_ns) // 1_000_000 / 1000 if stamp_ns <= _STAMP_NS_MAX else 0.0
        far = f"{ahead_s:.3g} s" if ahead_s else "centuries"
        raise MisuseError(
            f"{_shown(when)} lies {far} in the future, of which nothing is known; a moment is"
            " given in seconds since 1970, as an aware datetime or as the Position of a commit"
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
