"""What a running shard shows of itself in figures; see `link.metrics`.

Taken without the host's mutex, so that who looks never delays the shard: one figure may be a
moment older than the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.inspection import counted
from enact_dist.core.latencies import Latencies

if TYPE_CHECKING:
    from enact_dist.core.shard_state import ShardState
    from enact_dist.link.payload_desk import PayloadDesk
    from enact_dist.link.store_thread import StoreThread


def figures_of(
    state: ShardState, payloads: PayloadDesk, *, parked: int, now_ns: int
) -> dict[str, float]:
    """Return the counters and what there is now, by name.

    Args:
        state: The shard's.
        payloads: Where its large data lie.
        parked: How many requests wait for their answers.
        now_ns: This host's monotonic clock.
    """
    tenures = list(state.tenures.by_lock.values())
    held = sum(tenure.token is not None for tenure in tenures)
    return {
        **counted(state),
        **payloads.figures(),
        "ready": state.grants,
        "epoch": state.epoch,
        "uptime_seconds": (now_ns - state.born_ns) / 1e9,
        "sessions": len(state.sessions.by_id),
        "slots": state.slots.count,
        "slot_bytes": state.slots.bytes,
        "locks_held": held,
        "locks_waiting": len(tenures) - held,
        "requests_parked": parked,
    }


def latencies_of(state: ShardState, store: StoreThread | None) -> dict[str, Latencies]:
    """Return how long things took, by name."""
    return {
        "store_write_seconds": store.latencies if store is not None else Latencies(),
        "lock_wait_seconds": state.tenures.waited,
    }
