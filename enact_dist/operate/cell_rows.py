"""The rows that tell how a cell works: its shards, counters, actors and slots, with their rates.

`operate.cell_rates` makes them of looks at a cell; `enact top` shows them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from enact_dist.world.listings import LockInfo


@dataclass(frozen=True, slots=True)
class ShardRates:
    """One shard.  Rates are None before there are two looks at it.

    Attributes:
        state: "open", "waits for older leases", "drains", or "AWAY".
        away_s: Since how long it does not answer; 0 if it does.
        problem: Why it is not reachable, if that is known.
        epoch: Changes with every start.
        uptime_s: Time since that start.
        commits_hz: Commits applied per second.
        written_bytes_s: Bytes of data in these, per second.
        fetched_bytes_s: Bytes of data that clients fetched, per second.
        locks_hz: Locks granted per second.
        lock_waits_hz: Locks per second that had to wait.
        lock_wait_p50_ms: The longest median wait among the actors that use this shard.
        lock_wait_p99_ms: The longest 99th percentile among them.
        locks_held: Locks granted now, those that are only kept included.
        locks_waiting: Locks awaited now.
        shared_bytes: Large data in shared memory.
        shared_bytes_max: The limit of these; 0: it has no shared folder.
        leases: How many named sessions have how much of their lease left; by bounds.
        slots: Slots stored, null ones included.
        data_bytes: Size of the newest data.
    """

    name: str
    endpoint: str
    state: str
    away_s: float = 0.0
    problem: str = ""
    epoch: int = 0
    uptime_s: float = 0.0
    commits_hz: float | None = None
    written_bytes_s: float | None = None
    fetched_bytes_s: float | None = None
    locks_hz: float | None = None
    lock_waits_hz: float | None = None
    lock_wait_p50_ms: float = 0.0
    lock_wait_p99_ms: float = 0.0
    locks_held: int = 0
    locks_waiting: int = 0
    shared_bytes: int = 0
    shared_bytes_max: int = 0
    sessions: int = 0
    leases: dict[str, int] = field(default_factory=dict)
    slots: int = 0
    data_bytes: int = 0


@dataclass(frozen=True, slots=True)
class CounterRates:
    """One counter of a shard that has moved since the first look.

    Attributes:
        hz: How much it moves per second now; None before there are two looks.
        moved: By how much it has moved since the first look.
        meaning: What it counts.
        remedy: What to do if it grows; empty if growth is normal.
    """

    shard: str
    name: str
    hz: float | None
    moved: int
    total: int
    meaning: str
    remedy: str


@dataclass(frozen=True, slots=True)
class ActorRates:
    """One actor, as it reports itself.

    Attributes:
        state: As it reports; "silent" if its lease is over, "connected" if it reports nothing,
            "away" if all shards that know it are: then all else is what was last known.
        runs_hz: Updates per second, over its last 5 s; None of one that is silent or away.
        update_p50_ms: Median of its newest 512 updates, the wait for the lock left out.
        update_p99_ms: 99th percentile of the same.
        lock_wait_p99_ms: 99th percentile of its newest 512 waits for a lock.
        wrote_age_s: Age of the newest datum that it may write, at the newest look at slots; None:
            there is none.
        updates: Updates that committed.
        missed: Ticks of a source that never ran.
        incomplete: Sets of data that never ran.
        failures: Updates that ended with an exception.
        refused: Attempts that ended outside the actor's code.
        restarts: How often it began anew since the first look.
        lease_left_s: Rest of its session's lease.
        locks: Locks that its session holds or awaits.
    """

    name: str
    host: str
    pid: int
    state: str
    runs_hz: float | None = None
    update_p50_ms: float = 0.0
    update_p99_ms: float = 0.0
    lock_wait_p99_ms: float = 0.0
    wrote_age_s: float | None = None
    updates: int = 0
    missed: int = 0
    incomplete: int = 0
    failures: int = 0
    refused: int = 0
    restarts: int = 0
    lease_left_s: float = 0.0
    locks: int = 0
    last_error: str = ""


@dataclass(frozen=True, slots=True)
class DatumRates:
    """One slot.

    Attributes:
        version: Of the newest datum.
        hz: Versions per second; None before there are two looks at it.
        size_bytes: Size of the newest datum's body.
        bytes_s: Bytes per second, if all its versions are of that size; None as `hz`.
        age_s: Time from the newest commit to the look that showed it.
        null_reason: Why it is null; empty if it is not.
        shard: The shard that stores it.
        away: Whether that shard was away at that look; then all else is what was last known.
    """

    world: str
    entity: str
    aspect: str
    version: int
    hz: float | None
    size_bytes: int
    bytes_s: float | None
    age_s: float
    null_reason: str
    shard: str
    away: bool = False


@dataclass(frozen=True, slots=True)
class CellRates:
    """A cell between two looks.

    Attributes:
        unix_s: When the second one was taken, seconds since 1970.
        seconds: How long after the first one; 0 if there was none.
        took_s: How long the second one took, its slots left out.
        shards: All shards, those away too.
        counters: The counters that have moved, those with a remedy first.
        locks: Locks held, awaited and kept.
        data: The slots, as of the newest look that asked for them; those of a shard that did not
            list them then as of the one before.
        data_unix_s: When that look was taken; 0: none asked for them.
        events: What happened to shards and actors since the first look: when (seconds since 1970),
            and what.
    """

    unix_s: float
    seconds: float
    took_s: float
    shards: tuple[ShardRates, ...]
    counters: tuple[CounterRates, ...]
    actors: tuple[ActorRates, ...]
    locks: tuple[LockInfo, ...]
    data: tuple[DatumRates, ...]
    data_unix_s: float
    events: tuple[tuple[float, str], ...]

    @property
    def away(self) -> tuple[ShardRates, ...]:
        """The shards that do not answer."""
        return tuple(shard for shard in self.shards if shard.away_s)
