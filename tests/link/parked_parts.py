"""A question that a shard does not answer before its time, of the session of a carrier."""

from __future__ import annotations

import os
from typing import Any

from enact_dist.core.protocol.messages import AwaitStamp, Hello, Welcome


def parked(carrier: Any, wait_s: float, *, ttl_s: float = 60.0) -> AwaitStamp:
    """Say hello to shard `s0` as the carrier's session; return what it will park."""
    session = getattr(carrier, "_behind", carrier)._session
    hello = Hello(session, 0, int(ttl_s * 1e9), "parked", "host", os.getpid(), True)
    welcome = None
    while not isinstance(welcome, Welcome):
        welcome = carrier.request("s0", hello, timeout_s=30)
    return AwaitStamp(2**62, int(wait_s * 1e9), session, welcome.epoch)
