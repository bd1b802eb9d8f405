"""What a cell tells people about its slots, locks, shards, actors and operators."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from enact_dist.core.datum import Position
from enact_dist.terms import Entity, NullReason

if TYPE_CHECKING:
    from enact_dist.core.messages import Holder, SlotState


@dataclass(frozen=True, slots=True)
class LockInfo:
    """One lock that is held or awaited at a shard; times in seconds.

    Attributes:
        number: What `Cell.break_lock` takes; unique within the shard's epoch.
        modes: "read", "write" or both.
        waits_for: Numbers of the locks in the way.
    """

    shard: str
    number: int
    lock_id: str
    actor: str
    host: str
    pid: int
    granted: bool
    modes: str
    age_s: float
    lease_left_s: float
    hold_left_s: float
    slots: tuple[str, ...]
    waits_for: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ShardInfo:
    """One shard of the cell; `reachable` False leaves everything else at zero.

    Attributes:
        reachable: Whether it answers, and this process may use the way to it.
        open: Whether it grants locks; False while it waits for older leases to end after a start,
            and while it ends.
        size_bytes: Of the newest data, each counted as in `SlotInfo`.
        clock_ahead_s: Its wall clock less ours, half a round trip taken off.
        round_trip_s: Of the call that asked.
        carrier: How this process's calls to it travel: "socket", or "zenoh" and why.
        counters: Its statistics by name.
        problem: Why it is not reachable, empty where it just does not answer.
    """

    name: str
    endpoint: str
    reachable: bool
    epoch: int = 0
    open: bool = False
    uptime_s: float = 0.0
    slots: int = 0
    size_bytes: int = 0
    sessions: int = 0
    locks: int = 0
    clock_ahead_s: float = 0.0
    round_trip_s: float = 0.0
    carrier: str = ""
    counters: dict[str, int] = field(default_factory=dict)
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ActorInfo:
    """One session of a named actor, as the shards see it.

    Attributes:
        report: The actor's own statistics; empty where it gives none.
    """

    actor: str
    host: str
    pid: int
    session: str
    shards: tuple[str, ...]
    lease_left_s: float
    locks: int
    report: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class AuditInfo:
    """An act of an operator at a shard, or what came of one.

    Attributes:
        stamp_s: When, by the shard's wall clock, seconds since 1970.
        kind: "broken" or "forced" (what was done), "confirmed" or "alarm" (what a lost shard said
            when it was back), "settled" (somebody has seen to all alarms before).
        text: Who or what, and the reason that was given.
    """

    shard: str
    stamp_s: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class SlotInfo:
    """One slot of a world context, without its datum.

    Attributes:
        size_bytes: Length of the datum's body: arrays, texts and bytes over 256 B, long lists; 0
            for all else.
        null_reason: Why it is null, or the empty string.
        shard: Where it lies.
    """

    entity: Entity
    aspect: str
    version: int
    position: Position
    size_bytes: int
    null_reason: str
    shard: str


def slot_info(shard: str, state: SlotState) -> SlotInfo:
    """Return a shard's description of a slot."""
    return SlotInfo(
        Entity(state.slot.entity),
        state.slot.aspect,
        state.version,
        Position(state.stamp_ns, shard),
        state.size,
        NullReason[state.null_reason].value if state.null_reason else "",
        shard,
    )


def lock_info(shard: str, holder: Holder) -> LockInfo:
    """Return a shard's description of a lock in seconds."""
    return LockInfo(
        shard,
        holder.number,
        str(holder.lock),
        holder.actor,
        holder.host,
        holder.pid,
        holder.granted,
        holder.modes,
        holder.age_ns / 1e9,
        holder.lease_left_ns / 1e9,
        holder.hold_left_ns / 1e9,
        holder.slots,
        holder.waits_for,
    )
