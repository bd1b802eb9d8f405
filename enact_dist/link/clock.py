"""This host's clocks, in integer nanoseconds; the only module that reads them.

==============  ==========================================  ====================================
clock           runs while the host is suspended            used for
==============  ==========================================  ====================================
`monotonic_ns`  no: leases end later, which is safe         the shard's deadlines
`boottime_ns`   yes: a client believes less, which is safe  a client's own view of its leases
`wall_ns`       yes, and is set by people                   timestamps only, never leases
==============  ==========================================  ====================================

Times of two hosts are never compared; messages carry only durations.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Protocol

monotonic_ns = time.monotonic_ns
"""Return the time since an arbitrary start that stops during suspend."""
wall_ns = time.time_ns
"""Return the time since 1970-01-01 UTC by this host's clock."""
if hasattr(time, "CLOCK_BOOTTIME"):
    boottime_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME)
    """Return the time since boot, suspend included (Linux; elsewhere `monotonic_ns`)."""
else:
    boottime_ns = partial(time.monotonic_ns)


class Clock(Protocol):
    """The two clocks of a shard; a test may replace them."""

    def monotonic_ns(self) -> int:
        """Return a time that never decreases."""

    def wall_ns(self) -> int:
        """Return the time since 1970, for timestamps."""


class SystemClock:
    """The clocks of this host."""

    __slots__ = ()

    monotonic_ns = staticmethod(monotonic_ns)
    wall_ns = staticmethod(wall_ns)
