"""The figures of a running shard: counters, current values and latencies (`link.daemon.metrics`).

They are read without the host's mutex, so that reading never delays the shard; one figure may be
slightly older than the next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.shard.inspection import counted
from enact_dist.core.state.clock import Latencies

if TYPE_CHECKING:
    from enact_dist.core.shard.state import ShardState
    from enact_dist.link.memory.payload_desk import PayloadDesk
    from enact_dist.link.store.thread import StoreThread


def figures_of(
    state: ShardState, payloads: PayloadDesk, *, parked: int, now_ns: int
) -> dict[str, float]:
    """Return counters and current values, by name.

    Args:
        state: State of the shard.
        payloads: The shard's large data.
        parked: Number of parked requests.
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
    """Return latencies, by name."""
    return {
        "store_write_seconds": store.latencies if store is not None else Latencies(),
        "lock_wait_seconds": state.tenures.waited,
    }
