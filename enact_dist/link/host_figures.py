"""The figures of a running shard (`link.daemon.counters`), and a watch that logs its stalls.

Figures are read without the host's mutex, so that reading never delays the shard; one figure may be
slightly older than the next.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from enact_dist.core.shard.inspection import counted
from enact_dist.core.state.clock import Latencies

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.shard.state import ShardState
    from enact_dist.link.lease import AnswerGate
    from enact_dist.link.memory.payload_handler import PayloadHandler
    from enact_dist.link.store.thread import StoreThread


STALL_S: Final = 1.0
"""A batch that takes longer on disk, or a timer without a turn for longer, is logged."""

_log = logging.getLogger("enact.shard")


def figures_of(
    state: ShardState,
    payloads: PayloadHandler,
    gate: AnswerGate | None,
    *,
    parked: int,
    now_ns: int,
) -> dict[str, float]:
    """Return counters and current values, by name."""
    tenures = list(state.tenures.by_lock.values())
    kept = len(state.tenures.kept.by_number)
    granted = sum(tenure.token is not None for tenure in tenures)
    return {
        **counted(state),
        **payloads.figures(),
        **(gate.figures() if gate is not None else {}),
        "ready": state.grants,
        "epoch": state.epoch,
        "uptime_seconds": (now_ns - state.born_ns) / 1e9,
        "sessions": len(state.sessions.by_id),
        "slots": state.slots.count,
        "slot_bytes": state.slots.bytes,
        "locks_held": granted - kept,
        "locks_kept": kept,
        "locks_waiting": len(tenures) - granted,
        "requests_parked": parked,
    }


def latencies_of(state: ShardState, store: StoreThread | None) -> dict[str, Latencies]:
    """Return latencies, by name."""
    return {
        "store_write_seconds": store.latencies if store is not None else Latencies(),
        "lock_wait_seconds": state.tenures.waited,
    }


class Stalls:
    """Logs when a shard or its disk stalls: its clients only see silence.  For the timer alone."""

    def __init__(self, shard: str, count: Callable[[str], None]) -> None:
        self._shard = shard
        self._count = count
        self._looked_s: float | None = None
        self._writing_since_s: float | None = None

    def look(self, writing_since_s: float | None, now_s: float) -> None:
        """Log each stall once when it is noticed and once when it is over.

        Args:
            writing_since_s: Start of the batch being written; None if there is none.
            now_s: The time now, on the same clock; to be called at least ten times a second.
        """
        looked_s, self._looked_s = self._looked_s, now_s
        if looked_s is not None and now_s - looked_s >= STALL_S:
            _log.warning(
                "shard %s did not run for %.1f s: its process was stopped, or other processes used"
                " the processors",
                self._shard,
                now_s - looked_s,
            )
        stalled_s = self._writing_since_s
        if stalled_s is not None and writing_since_s != stalled_s:
            self._writing_since_s = None
            _log.warning(
                "the store of shard %s writes again after %.1f s", self._shard, now_s - stalled_s
            )
        elif (
            stalled_s is None and writing_since_s is not None and now_s - writing_since_s >= STALL_S
        ):
            self._writing_since_s = writing_since_s
            self._count("disk_stalls")
            _log.warning(
                "the store of shard %s has written nothing for %.1f s: commits and new clients"
                " wait",
                self._shard,
                now_s - writing_since_s,
            )
