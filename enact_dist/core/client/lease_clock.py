"""How long a client may believe in its locks: from sending times only, never from clocks compared.

Each message of a session bears a counter, and the client remembers when it sent which.  An answer
says the highest counter that had arrived, so the shard's lease began to run *after* that one was
sent: ``until = sent(count_seen) + TTL``, less the drift that two clocks may have.  Using the time
of arrival, or of the newest message sent, would believe too long.
"""

from __future__ import annotations

from array import array
from typing import Final

from enact_dist.core.state.sessions import DRIFT_PER_CENT

SENDINGS_KEPT: Final = 512
"""Sending times remembered; older ones give no belief, which is safe."""
_SAFE_PER_CENT: Final = 100 - 2 * DRIFT_PER_CENT


def shortened_ns(duration_ns: int) -> int:
    """Return a duration of the shard's clock as this host's clock may safely count it."""
    return duration_ns * _SAFE_PER_CENT // 100


class Sendings:
    """The session's message counter and when each message was sent (CLOCK_BOOTTIME, ns)."""

    __slots__ = ("_sent", "count")

    def __init__(self) -> None:
        self.count = 0
        # Taken whole: a client that has just started does not grow with what it sends.
        self._sent = array("q", bytes(8 * SENDINGS_KEPT))

    def next(self, now_ns: int) -> int:
        """Return the counter for a message that is sent now."""
        self.count = count = self.count + 1
        self._sent[count % SENDINGS_KEPT] = now_ns
        return count

    def believe_until_ns(self, count_seen: int, duration_ns: int) -> int:
        """Return until when something granted for `duration_ns` may be believed in (0: not)."""
        count = self.count
        if not 0 < count_seen <= count < count_seen + SENDINGS_KEPT:
            return 0
        return self._sent[count_seen % SENDINGS_KEPT] + duration_ns * _SAFE_PER_CENT // 100
