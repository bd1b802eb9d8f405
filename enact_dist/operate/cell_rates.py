"""Rates of a cell from two looks at it; `enact top` shows them.

A rate is the difference of two figures of a shard, divided by the time that passed on that shard's
own clock between them.  So a look that came late, or a shard that stood still, makes no rate
wrong.  A shard that has restarted counts from its start.

`Looks` is pure: no clock and no connection.  It also notes what two looks alone do not show: since
when a shard is away, how often an actor has restarted, and which counters have moved since the
first look.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from enact_dist.core.protocol.messages import Survey
from enact_dist.core.state.clock import state_of
from enact_dist.link.daemon.counters import OF_A_SHARD
from enact_dist.operate.cell_rows import (
    ActorRates,
    CellRates,
    CounterRates,
    DatumRates,
    ShardRates,
)
from enact_dist.patterns import pattern_matches
from enact_dist.world.look import look_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import ActorInfo, ShardInfo
    from enact_dist.world.look import Look

LEASES_S: Final = (0.0, 0.5, 1.0)
"""Bounds between which sessions are counted by the rest of their lease."""
LEASE_NAMES: Final = ("over", "to 0.5 s", "to 1 s", "longer")
EVENTS_MAX: Final = 100
"""Newest events that are remembered."""
SHARE_OF_TIME: Final = 0.1
"""Looks take at most this part of the time, so that they do not delay a large cell."""


def pause_s(every_s: float, took_s: float) -> float:
    """Return how long to wait before the next look, after one that took so long."""
    return max(every_s - took_s, took_s / SHARE_OF_TIME - took_s, 0.0)


class CellLooks:
    """Looks at a cell again and again; at its slots only as often as they cost little.

    Args:
        cell: The cell; an observer will do.
        entities: The slots of which entities are looked at, as a pattern.
        worlds: Those of which world contexts; none: of all.
    """

    def __init__(self, cell: Cell, entities: str = "**", worlds: Iterable[str] = ()) -> None:
        self._cell = cell
        self._survey = Survey(tuple(worlds), (entities,), ())
        self._looks = Looks()
        self._slots_due_s = 0.0

    def take(self, *, slots: bool = False) -> CellRates:
        """Take a look, at the slots if they are due or asked for; return the rates since then."""
        due = slots or time.monotonic() >= self._slots_due_s
        look = look_at(self._cell, self._survey if due else None)
        if due:
            wait_s = look.slots_took_s / SHARE_OF_TIME
            self._slots_due_s = time.monotonic() + wait_s
        return self._looks.add(look)


class Looks:
    """Looks at one cell, one after another: what they show together."""

    def __init__(self) -> None:
        self._last: Look | None = None
        self._slots: Mapping[Slot, SlotInfo] = {}
        self._slots_of: dict[str, ShardInfo] = {}
        self._written = _Written(())
        self._slots_unix_s = 0.0
        self._unlisted: Mapping[str, str] = {}
        self._rows: tuple[DatumRates, ...] = ()
        self._shards: dict[str, ShardInfo] = {}
        self._first: dict[str, tuple[int, Mapping[str, int]]] = {}
        self._away_unix_s: dict[str, float] = {}
        self._infos: tuple[ActorInfo, ...] = ()
        self._sessions: dict[str, str] = {}
        self._restarts: dict[str, int] = {}
        self._events: deque[tuple[float, str]] = deque(maxlen=EVENTS_MAX)

    def add(self, look: Look) -> CellRates:
        """Take the next look; return the rates since the one before."""
        spans_s = {
            shard.name: _span_s(self._shards.get(shard.name), shard)
            for shard in look.shards
            if shard.reachable
        }
        self._note_slots(look)
        for shard in look.shards:
            self._note_shard(shard, look.unix_s)
        self._note_actors(look)
        unheard = self._unheard(look)
        actors = [*self._actors(look.actors), *self._actors(unheard, "away")]
        rates = CellRates(
            look.unix_s,
            look.unix_s - self._last.unix_s if self._last is not None else 0.0,
            look.took_s,
            tuple(self._shard(shard, look, spans_s.get(shard.name)) for shard in look.shards),
            tuple(sorted(self._counters(look, spans_s), key=lambda one: not one.remedy)),
            tuple(actors),
            look.locks,
            self._rows,
            self._slots_unix_s,
            tuple(self._events),
        )
        self._shards.update({shard.name: shard for shard in look.shards if shard.reachable})
        self._last, self._infos = look, (*look.actors, *unheard)
        return rates

    # ---------------------------------------------------------------- what happens

    def _note_shard(self, shard: ShardInfo, unix_s: float) -> None:
        name, before = shard.name, self._shards.get(shard.name)
        if not shard.reachable:
            if name not in self._away_unix_s:
                self._away_unix_s[name] = unix_s
                why = f": {shard.problem}" if shard.problem else ""
                self._events.append((unix_s, f"shard {name} is away{why}"))
            return
        restarted = ", restarted" if before is not None and before.epoch != shard.epoch else ""
        if name in self._away_unix_s:
            away_s = unix_s - self._away_unix_s.pop(name)
            self._events.append((unix_s, f"shard {name} is back after {away_s:.1f} s{restarted}"))
        elif restarted:
            self._events.append((unix_s, f"shard {name} has restarted"))
        if restarted or name not in self._first:
            counts = {} if restarted else shard.counters
            self._first[name] = shard.epoch, counts

    def _note_slots(self, look: Look) -> None:
        """Compare the slots with those of the look before that asked for them, if this one did."""
        if look.slots is None:
            return
        for name, why in look.unlisted.items():
            if name not in self._unlisted:
                text = f"shard {name} does not list its slots, so the last known are shown: {why}"
                self._events.append((look.unix_s, text))
        self._unlisted = look.unlisted
        shards = {
            shard.name: shard
            for shard in look.shards
            if shard.reachable and shard.name not in look.unlisted
        }
        before = self._slots_of
        spans_s = {  # a restarted shard goes on with its old versions, made before its uptime
            name: _span_s(before[name], one)
            for name, one in shards.items()
            if name in before and before[name].epoch == one.epoch
        }
        away = {shard.name for shard in look.shards if not shard.reachable}
        kept = {
            slot: info
            for slot, info in self._slots.items()
            if info.shard in away.union(look.unlisted) and slot not in look.slots
        }
        rows = [
            replace(one, hz=None, bytes_s=None, away=True) if one.shard in away else one
            for one in self._rows
            if (one.world, one.entity, one.aspect) in kept
        ]
        self._rows = (*rows, *self._data(look, look.slots, spans_s))
        self._slots = {**kept, **look.slots}
        self._written, self._slots_unix_s = _Written(self._rows), look.unix_s
        self._slots_of.update(shards)

    def _note_actors(self, look: Look) -> None:
        for info in look.actors:
            for report in info.rows():
                name = str(report["name"])
                before = self._sessions.get(name)
                if info.namesakes or info.silent or before == info.session:
                    continue  # two of one name are no restart, and the old one is no new one
                self._sessions[name] = info.session
                if before is not None:
                    self._restarts[name] = self._restarts.get(name, 0) + 1
                    where = f"process {info.pid} on {info.host}"
                    self._events.append((look.unix_s, f"actor {name} has restarted, {where}"))

    # ---------------------------------------------------------------- rows

    def _shard(self, shard: ShardInfo, look: Look, span_s: float | None) -> ShardRates:
        if not shard.reachable:
            away_s = max(look.unix_s - self._away_unix_s[shard.name], 0.001)
            return ShardRates(shard.name, shard.endpoint, "AWAY", away_s, shard.problem)
        users = [info for info in look.actors if shard.name in info.shards]
        reports = [report for info in users if not info.silent for report in info.rows()]
        locks = [lock for lock in look.locks if lock.shard == shard.name]
        count = shard.counters.get

        def hz(name: str) -> float | None:
            return self._hz(shard, name, span_s)

        return ShardRates(
            shard.name,
            shard.endpoint,
            state_of(grants=shard.open, draining=bool(count("draining"))),
            epoch=shard.epoch,
            uptime_s=shard.uptime_s,
            commits_hz=hz("commits"),
            written_bytes_s=hz("bytes_written"),
            fetched_bytes_s=hz("bytes_fetched"),
            locks_hz=hz("locks_granted"),
            lock_waits_hz=hz("lock_waits"),
            lock_wait_p50_ms=_largest(reports, "lock_wait_p50_ms"),
            lock_wait_p99_ms=_largest(reports, "lock_wait_p99_ms"),
            locks_held=sum(lock.granted for lock in locks),
            locks_waiting=sum(not lock.granted for lock in locks),
            shared_bytes=count("payload_bytes", 0),
            shared_bytes_max=count("payload_bytes_max", 0),
            sessions=shard.sessions,
            leases=_leases(info.lease_left_s for info in users),
            slots=shard.slots,
            data_bytes=shard.size_bytes,
        )

    def _hz(self, shard: ShardInfo, name: str, span_s: float | None) -> float | None:
        if not span_s:
            return None
        before = self._shards[shard.name]
        counted = before.counters.get(name, 0) if before.epoch == shard.epoch else 0
        return (shard.counters.get(name, 0) - counted) / span_s

    def _counters(self, look: Look, spans_s: Mapping[str, float | None]) -> Iterator[CounterRates]:
        for shard in look.shards:
            if not shard.reachable:
                continue
            _, first = self._first[shard.name]
            for name, total in shard.counters.items():
                known = OF_A_SHARD.get(name)
                moved = total - first.get(name, 0)
                if moved and known is not None and known.kind == "counter":
                    hz = self._hz(shard, name, spans_s[shard.name])
                    yield CounterRates(
                        shard.name, name, hz, moved, total, known.meaning, known.remedy
                    )

    def _unheard(self, look: Look) -> list[ActorInfo]:
        """Return the sessions that no other shard knows than those which are away."""
        away = {shard.name for shard in look.shards if not shard.reachable}
        heard = {info.session for info in look.actors}
        return [
            info
            for info in self._infos
            if info.session not in heard and info.shards and away.issuperset(info.shards)
        ]

    def _actors(self, infos: Iterable[ActorInfo], lost: str = "") -> Iterator[ActorRates]:
        for info in infos:
            reports, state = info.rows(), lost or ("silent" if info.silent else "")
            session: dict[str, Any] = {
                "host": info.host,
                "pid": info.pid,
                "lease_left_s": info.lease_left_s,
                "locks": info.locks,
            }
            if not reports:
                yield ActorRates(info.actor, state=state or "connected", **session)
            for report in reports:
                name = str(report["name"])
                yield ActorRates(
                    name,
                    state=state or str(report.get("state", "")),
                    runs_hz=None if state else _number(report, "rate_hz"),
                    wrote_age_s=self._written.age_s(report.get("writes")),
                    restarts=self._restarts.get(name, 0),
                    last_error=str(report.get("last_error", "")),
                    **_figures(report),
                    **session,
                )

    def _data(
        self, look: Look, slots: Mapping[Slot, SlotInfo], spans_s: Mapping[str, float | None]
    ) -> Iterator[DatumRates]:
        for slot, info in sorted(slots.items()):
            old, span_s, hz = self._slots.get(slot), spans_s.get(info.shard), None
            if old is not None and span_s:
                hz = max(info.version - old.version, 0) / span_s
            yield DatumRates(
                *slot,
                info.version,
                hz,
                info.size_bytes,
                None if hz is None else hz * info.size_bytes,
                max(0.0, look.unix_s - info.position.stamp_ns / 1e9),
                info.null_reason,
                info.shard,
            )


_TIMES_MS: Final = ("update_p50_ms", "update_p99_ms", "lock_wait_p99_ms")
_COUNTS: Final = ("updates", "missed", "incomplete", "failures", "refused")


def _figures(report: Mapping[str, Any]) -> dict[str, Any]:
    times_ms = {name: _number(report, name) for name in _TIMES_MS}
    return times_ms | {name: int(_number(report, name)) for name in _COUNTS}


def _span_s(before: ShardInfo | None, now: ShardInfo) -> float | None:
    """Return the time between two answers of a shard by its own clock; None if there is one."""
    if before is None:
        return None
    if before.epoch != now.epoch:
        return now.uptime_s
    return max(now.uptime_s - before.uptime_s, 0.0)


def _leases(left_s: Iterable[float]) -> dict[str, int]:
    counts = dict.fromkeys(LEASE_NAMES, 0)
    for one in left_s:
        counts[LEASE_NAMES[sum(one >= bound_s for bound_s in LEASES_S)]] += 1
    return counts


def _number(report: Mapping[str, Any], name: str) -> float:
    found = report.get(name, 0.0)
    return float(found) if isinstance(found, (int, float)) else 0.0


def _largest(reports: Iterable[Mapping[str, Any]], name: str) -> float:
    return max((_number(report, name) for report in reports), default=0.0)


class _Written:
    """The newest commit of each aspect's slots, found by what an actor declares to write."""

    def __init__(self, rows: Iterable[DatumRates]) -> None:
        self._ages_s: dict[tuple[str, str], dict[str, float]] = {}
        for row in rows:
            if not row.null_reason:
                self._ages_s.setdefault((row.world, row.aspect), {})[row.entity] = row.age_s

    def age_s(self, writes: object) -> float | None:
        """Return the age of the newest datum of ``world:entities/aspect``; None: of none."""
        found: list[float] = []
        for text in writes if isinstance(writes, (list, tuple)) else ():
            world, _, slot = str(text).partition(":")
            pattern, _, aspect = slot.rpartition("/")
            ages_s = self._ages_s.get((world, aspect), {})
            if "*" in pattern:
                found += (s for entity, s in ages_s.items() if pattern_matches(pattern, entity))
            elif pattern in ages_s:
                found.append(ages_s[pattern])
        return min(found, default=None)
