"""The lease of a shard in a database by this host's clock, and the gate through which answers go.

`core.failover.lease` decides.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.core.failover.lease import Lease, Silence, kept_ns
from enact_dist.core.protocol.messages import NO_ROOM, Commit, Prepare, Refused
from enact_dist.errors import StoreError
from enact_dist.link.clock import boottime_ns
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.shard.state import ShardState

DATABASE_BODY_BYTES_MAX: Final = 256 << 20
"""Largest body of a datum that a database takes."""
_log = logging.getLogger("enact.shard")


def _now_s() -> float:
    return boottime_ns() / 1e9


class ShardTakenError(StoreError):
    """Another process has the shard: this one must end and answer nothing more."""


class HostLease:
    """A `Lease` by a clock of this host, which goes on while it is suspended.  Thread-safe.

    Attributes:
        usable_s: How long it holds after a write was sent.
    """

    def __init__(self, lease_s: float, now_s: Callable[[], float] = _now_s) -> None:
        self.lease = Lease(round(lease_s * 1e9))
        self.usable_s = kept_ns(self.lease.lease_ns) / 1e9
        self._now_s = now_s

    @property
    def holds(self) -> bool:
        """Whether no other process can serve the shard yet."""
        return self.lease.holds(self.now_ns())

    @property
    def left_s(self) -> float:
        """How long it still holds; below 0: it has ended."""
        return self.lease.until_ns / 1e9 - self._now_s()

    def now_s(self) -> float:
        """Return the time, to be taken before a write is sent."""
        return self._now_s()

    def now_ns(self) -> int:
        """Return the time in ns."""
        return int(self._now_s() * 1e9)

    def confirmed(self, sent_s: float) -> None:
        """Take note that a write which was sent at `sent_s` is confirmed."""
        # Two threads may do this at once: the lesser time does no harm.
        self.lease.confirmed(int(sent_s * 1e9))


class Holding(Protocol):
    """A shard that this process holds for as long as it renews its lease."""

    @property
    def lease(self) -> HostLease:
        """How long this process may answer."""

    @property
    def copies(self) -> int:
        """How many standbys of the database confirm each commit; -1: not visible."""

    @property
    def waits_s(self) -> float:
        """How long the database has not taken now what it was sent, seconds."""

    def on_failure(self, failed: Callable[[Exception], None]) -> None:
        """Call `failed`, once, when the lease cannot be renewed any more."""

    def on_move(self, moves: Callable[[str], None]) -> None:
        """Call `moves`, once, with the standby that the shard is asked to go to."""

    def end_soon(self) -> None:
        """Wait for no database from now on; from any thread."""


class HeldStore(Protocol):
    """A store, of which only this is asked."""

    @property
    def holding(self) -> Holding | None:
        """For how long this process holds the shard; None: until its end."""


class AnswerGate:
    """Lets answers out while the lease holds, see `Silence`; logs and counts when it does not.

    Not thread-safe, but for `end_soon`.
    """

    def __init__(self, holding: Holding, count: Callable[[str], None]) -> None:
        self.end_soon, self.on_move = holding.end_soon, holding.on_move
        self._holding = holding
        self._lease = holding.lease
        self._count = count
        self._silence = Silence(holding.lease.lease)

    @property
    def holds(self) -> bool:
        """Whether answers go out."""
        return self._lease.holds

    def figures(self) -> dict[str, float]:
        """Return current values, by name."""
        since_ns = self._silence.since_ns
        silent_s = (self._lease.now_ns() - since_ns) / 1e9 if since_ns else 0.0
        return {
            "store_copies": self._holding.copies,
            "lease_left_s": max(0.0, self._lease.left_s),
            "store_stalled_s": max(silent_s, self._holding.waits_s),
        }

    def rounded(self) -> dict[str, int]:
        """Return `figures` as counters, which are whole numbers."""
        return {name: round(value) for name, value in self.figures().items()}

    @classmethod
    def of(
        cls,
        store: HeldStore | None,
        count: Callable[[str], None],
        failed: Callable[[Exception], None],
    ) -> AnswerGate | None:
        """Return the gate of a store's lease; None: it needs none, for it is held to its end.

        `failed` is called once, when the lease cannot be renewed any more.
        """
        holding = store.holding if store is not None else None
        if holding is None:
            return None
        holding.on_failure(failed)
        return cls(holding, count)

    def too_large(self, commit: Commit | Prepare, state: ShardState) -> Refused | None:
        """Return why a commit is refused whose data no database keeps, None if it is not."""
        for slot, datum in commit.writes:
            if datum is None or datum.size <= DATABASE_BODY_BYTES_MAX:
                continue
            entry = state.catalogue.aspects.get(slot.aspect)
            if entry is not None and entry.durability != Durability.VOLATILE.value:
                self._count("data_too_large")
                return Refused(
                    NO_ROOM,
                    f"{datum.size} bytes for {slot} are more than a database keeps of one datum"
                    f" ({DATABASE_BODY_BYTES_MAX}): make the aspect {slot.aspect} volatile, or keep"
                    " its shard in a folder",
                )
        return None

    def passing(self, effects: Sequence[Effect]) -> Sequence[Effect]:
        """Return the effects to perform now, those kept back before them."""
        was_silent = self._silence.since_ns
        passing = self._silence.passing(effects, self._lease.now_ns())
        if was_silent and not self._silence.since_ns:
            _log.warning(
                "the lease is renewed: %d answers that waited go out", len(passing) - len(effects)
            )
        elif self._silence.since_ns and not was_silent:
            self._count("silences")
            _log.warning(
                "the database has confirmed nothing for %.1f s, so another daemon may take the"
                " shard over: answers wait",
                self._lease.usable_s - self._lease.left_s,
            )
        return passing
