"""Moments as a command line names them, and as it prints them.

======================  ===========================================================
written                 meaning
======================  ===========================================================
-30s -500ms -2h -1d     so long ago, by this host's clock (ms, s, min, h, d)
2026-11-21T10:00:00     that time, of this host's zone where none is written
1763719200.25           seconds since 1970
1763719200250000000     a stamp: nanoseconds since 1970
17637…@left             a position, as `enact world history` prints it
======================  ===========================================================
"""

from __future__ import annotations

import argparse
import re
import time
from datetime import datetime
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum import Position

if TYPE_CHECKING:
    from enact_dist.access.arguments import When

MOMENT_HELP: Final = (
    "a moment: -30s (so long ago; ms, s, min, h, d), 2026-11-21T10:00:00 (this host's zone, unless"
    " it ends with one: Z, +01:00), seconds since 1970, or a position as printed by world history"
)
_SECONDS: Final = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_AGO: Final = re.compile(r"-(\d+(?:\.\d+)?)(ms|s|min|h|d)\Z")
_SPAN: Final = re.compile(r"(\d+(?:\.\d+)?)(ms|s|min|h|d)?\Z")
_POSITION: Final = re.compile(r"(\d+)@(\S+)\Z")
_STAMP_DIGITS_MIN: Final = 16
"""A whole number of so many digits is a stamp; as seconds it would lie 30 million years ahead."""


def moment(text: str) -> When:
    """Read a moment; an `argparse` type."""
    text = text.strip()
    ago = _AGO.match(text)
    if ago:
        at_s = time.time() - float(ago[1]) * _SECONDS[ago[2]]
        if at_s < 0.0:
            raise argparse.ArgumentTypeError(f"{text!r} lies before 1970; give {MOMENT_HELP}")
        return at_s
    position = _POSITION.match(text)
    if position:
        return Position(int(position[1]), position[2])
    if text.isdecimal() and len(text) >= _STAMP_DIGITS_MIN:
        return Position(int(text), "")
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.fromisoformat(text).astimezone()
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no moment; give {MOMENT_HELP}") from None


def span(text: str) -> float:
    """Read a time such as 10min, or a number of seconds, 0 included; an `argparse` type."""
    found = _SPAN.match(text.strip())
    if not found:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no time; give seconds, or a number and ms, s, min, h or d, such as 10min"
        )
    return float(found[1]) * _SECONDS[found[2] or "s"]


def shown_position(position: Position) -> str:
    """Return a position as `moment` reads it."""
    return f"{position.stamp_ns}@{position.shard}"
