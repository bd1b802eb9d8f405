"""How long a daemon may answer for its shard, what a lost connection did, and when a standby acts.

The fence of the database keeps a daemon that has lost its shard from writing.  Its answers come
from memory, so it must fall silent by itself, before another daemon can serve.  Rules that a change
must keep (each has a wrong edit in `tests/sim/test_takeover.py`):

- A lease counts from the *send time* of a batch or renewal that is confirmed, by a clock of the
  holder's host that goes on while it is suspended, less the drift of two clocks.  A standby counts
  more, by a clock of its own.
- Whatever a connection had under way when it broke may stand or not.  The row of the shard says
  which; that a batch stands is believed only after a later commit is confirmed, since a row that
  only the primary had can be lost with it.
- A standby counts anew after an outage of its own, and longer: the holder must find the database,
  too.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Final, NamedTuple

from enact_dist.core.protocol.records import Effect, LogEvent, Persist

DRIFT_PPM: Final = 20_000
"""How much two clocks may differ: the holder counts less, a standby counts more."""
OUTAGE_NS: Final = 3_000_000_000
"""How much longer a standby waits after it had lost the database itself."""


_STAY: Final = frozenset((Persist, LogEvent))
"""Effects that reach no client and no other shard."""


class HolderRow(NamedTuple):
    """The row of a shard in the database.

    Attributes:
        epoch: Of the daemon that has the shard.
        batch: Number of its last batch.
        beat: Another one after each write and renewal, never used again.
        holder: The process that has it; "": it has given the shard back.
    """

    epoch: int
    batch: int
    beat: int
    holder: str


class Lease:
    """How long this process may answer for its shard.

    Attributes:
        until_ns: When it ends, on that clock.
    """

    __slots__ = ("lease_ns", "until_ns")

    def __init__(self, lease_ns: int) -> None:
        self.lease_ns = lease_ns
        self.until_ns = 0

    def confirmed(self, sent_ns: int) -> None:
        """Take note that what was sent at `sent_ns` is confirmed."""
        self.until_ns = max(self.until_ns, sent_ns + kept_ns(self.lease_ns))

    def holds(self, now_ns: int) -> bool:
        """Whether no other process can serve the shard yet."""
        return now_ns < self.until_ns


class Silence:
    """Keeps back effects that leave the process while its lease has ended.

    Once it is renewed in the same epoch they go out, in order: no other process can have written.

    Attributes:
        since_ns: When it began; 0: there is none.
    """

    __slots__ = ("_kept", "_lease", "since_ns")

    def __init__(self, lease: Lease) -> None:
        self._lease = lease
        self._kept: list[Effect] = []
        self.since_ns = 0

    def passing(self, effects: Sequence[Effect], now_ns: int) -> Sequence[Effect]:
        """Return the effects to perform now, those kept back before them."""
        if self._lease.holds(now_ns):
            if not self.since_ns:
                return effects
            kept, self._kept, self.since_ns = self._kept, [], 0
            return [*kept, *effects]
        self.since_ns = self.since_ns or now_ns
        self._kept += [effect for effect in effects if type(effect) not in _STAY]
        return [effect for effect in effects if type(effect) in _STAY]


def kept_ns(lease_ns: int) -> int:
    """Return how long the holder itself counts a lease."""
    return lease_ns - lease_ns * DRIFT_PPM // 1_000_000


def waited_ns(lease_ns: int) -> int:
    """Return how long a standby waits for the end of a lease."""
    return lease_ns + lease_ns * DRIFT_PPM // 1_000_000


class BrokenBatch(enum.Enum):
    """What became of a batch whose connection broke."""

    STANDS = enum.auto()
    """It is there: believe it after the next confirmed commit."""
    MISSING = enum.auto()
    """Send the same batch again."""
    TAKEN = enum.auto()
    """Another process has the shard: end, and write nothing."""


def after_break(found: tuple[int, int], *, epoch: int, batch: int) -> BrokenBatch:
    """Say what became of a batch, by the epoch and batch that a new connection shows."""
    if found == (epoch, batch):
        return BrokenBatch.STANDS
    return BrokenBatch.MISSING if found == (epoch, batch - 1) else BrokenBatch.TAKEN


class Standby:
    """Decides by what is seen of a shard's row whether a standby may take the shard.

    Args:
        lease_ns: The lease of its holder.

    Attributes:
        alive: Whether the holder was seen to write since the last outage.
    """

    __slots__ = ("_lease_ns", "_seen", "_since_ns", "_wait_ns", "alive")

    def __init__(self, lease_ns: int) -> None:
        self._lease_ns = lease_ns
        self._wait_ns = waited_ns(lease_ns)
        self._seen: tuple[int, int] | None = None
        self._since_ns = 0
        self.alive = False

    def was_away(self) -> None:
        """Count anew, and longer until the holder is seen: the database did not answer."""
        self._seen = None
        self._wait_ns = waited_ns(self._lease_ns + OUTAGE_NS)

    def stood_still(self, for_ns: int) -> None:
        """Leave out a time in which the database kept a look waiting, and so the holder's beats.

        As after an outage the holder has longer until it is seen, but the wait does not begin anew:
        a database that is slow for good would keep the shard of a dead holder.
        """
        self._since_ns += for_ns
        self._wait_ns = waited_ns(self._lease_ns + OUTAGE_NS)

    def is_free(self, row: HolderRow, now_ns: int) -> bool:
        """Whether no process can answer for the shard, as of a look that ended at `now_ns`."""
        if self._seen != (row.epoch, row.beat):
            self.alive = self._seen is not None
            if self.alive:
                self._wait_ns = waited_ns(self._lease_ns)
            self._seen, self._since_ns = (row.epoch, row.beat), now_ns
        return not row.holder or now_ns - self._since_ns > self._wait_ns
