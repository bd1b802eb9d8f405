"""A shard daemon whose wall clock is wrong: `enact …` with another clock put in its place.

``python -m enact_dist.verify.chaos.daemon OFFSET_S shard run NAME --cell FILE``; nothing of the
machine is set, and the product has no option for it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from enact_dist.cli import main
from enact_dist.link import host
from enact_dist.link.clock import SystemClock

MODULE: Final = "enact_dist.verify.chaos.daemon"


def shifted_clock(offset_ns: int) -> type[SystemClock]:
    """Return a class of clocks whose wall clock is `offset_ns` ahead."""

    class ShiftedClock(SystemClock):
        __slots__ = ()

        def wall_ns(self) -> int:
            return super().wall_ns() + offset_ns

    return ShiftedClock


def run(words: Sequence[str]) -> int:
    """Run `enact` with `words[1:]` and a wall clock that is `words[0]` seconds ahead."""
    host.__dict__["SystemClock"] = shifted_clock(int(float(words[0]) * 1e9))
    return main.main(words[1:])


if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
