"""How long a daemon may answer for its shard, what a lost connection did, and when a standby acts.

The fence of the database keeps a daemon that has lost its shard from writing.  Its answers come
from memory, so it must fall silent by itself, before another daemon can serve.  Rules that a change
must keep (each has a wrong edit in `tests/sim/test_takeover.py`):

- A lease counts from the *send time* of a batch or renewal that is confirmed, by the holder's own
  monotonic clock, less the drift of two clocks.  A standby counts more, by its own.
- Whatever a connection had under way when it broke may stand or not.  The row of the shard says
  which; that a batch stands is believed only after a later commit is confirmed, since a row that
  only the primary had can be lost with it.
- A standby counts anew after an outage of its own, and longer: the holder must find the database,
  too.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.records import Persist, Story

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.protocol.records import Effect

DRIFT_PPM: Final = 20_000
"""How much two monotonic clocks may differ: the holder counts less, a standby counts more."""
OUTAGE_NS: Final = 3_000_000_000
"""How much longer a standby waits after it had lost the database itself."""


_STAY: Final = frozenset((Persist, Story))
"""Effects that reach no client and no other shard."""


class ShardRow(NamedTuple):
    """The row of a shard in the database.

    Attributes:
        epoch: Of the daemon that has the shard.
        batch: Number of its last batch.
        beat: Counts its writes and renewals.
        holder: The process that has it; "": it has given the shard back.
    """

    epoch: int
    batch: int
    beat: int
    holder: str


class Lease:
    """How long this process may answer for its shard.

    Attributes:
        until_ns: When it ends, on this host's monotonic clock.
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


class BrokenBatch(enum.Enum):
    """What became of a batch whose connection broke."""

    STANDS = enum.auto()
    """It is there: believe it after the next confirmed commit."""
    MISSING = enum.auto()
    """Send the same batch again."""
    TAKEN = enum.auto()
    """Another process has the shard: end, and write nothing."""


def after_break(row: ShardRow, *, epoch: int, batch: int) -> BrokenBatch:
    """Say what became of a batch, by the row that a new connection shows."""
    if row.epoch == epoch and row.batch == batch:
        return BrokenBatch.STANDS
    if row.epoch == epoch and row.batch == batch - 1:
        return BrokenBatch.MISSING
    return BrokenBatch.TAKEN


class Standby:
    """Decides when a daemon that stands by takes its shard over.

    Args:
        lease_ns: The lease of the cell.
    """

    __slots__ = ("_connected_before", "_due_ns", "_lease_ns", "_more_ns", "_seen")

    def __init__(self, lease_ns: int) -> None:
        self._lease_ns = lease_ns
        self._seen: tuple[int, int] | None = None
        self._due_ns = self._more_ns = 0
        self._connected_before = False

    def connected(self) -> None:
        """Take note of a new connection: the time without one proves nothing about the holder."""
        self._more_ns = OUTAGE_NS if self._connected_before else 0
        self._connected_before = True
        self._seen = None

    def saw(self, row: ShardRow, now_ns: int) -> bool:
        """Take note of the row; say whether to take the shard over, naming this row."""
        if row.holder == "":
            return True
        if (row.epoch, row.beat) != self._seen:
            if self._seen is not None:
                self._more_ns = 0
            self._seen = row.epoch, row.beat
            waits_ns = self._lease_ns + self._lease_ns * DRIFT_PPM // 1_000_000 + self._more_ns
            self._due_ns = now_ns + waits_ns
        return now_ns >= self._due_ns
