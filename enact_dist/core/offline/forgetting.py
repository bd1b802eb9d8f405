"""Plans the purge of aspects: what the shards of a stopped cell have of them, and which records go.

The input is everything that the shards have stored.  Rules that a change must keep:

- A shard purges a whole aspect in one batch: its registration, all its slots in all contexts
  with their history, and what labels keep of them.
- Versions are never used twice: on every shard those of an aspect start above all that any shard
  had, and its timestamps after all that it has.
- A commit over shards that names the aspect and is undecided must not be touched.
- An interrupted run is completed on shards without its record: one with the record has purged the
  aspect and may have served since; one that was restored from a backup has neither.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from enact_dist.core.protocol.records import AspectForgotten, KeptRecord, WorldDropped

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from enact_dist.core.protocol.records import PreparedRecord, Record, Recovered, SlotRecord


class Going(NamedTuple):
    """What one shard has of one aspect.

    Attributes:
        type: Fingerprint of its registered type, "" if it is not registered.
        slots: How many slots of it there are.
        versions: How many states these have, replaced ones included.
        size: Bytes of their data.
        kept: How many of these versions are pinned by labels.
        labels: These labels.
    """

    shard: str
    aspect: str
    type: str
    slots: int
    versions: int
    size: int
    kept: int
    labels: tuple[str, ...]


@dataclass(slots=True)
class PurgePlan:
    """The plan of a purge.

    Attributes:
        known: All aspects that some shard has, or has had.
        going: All data of the purged aspects, of every shard.
        records: The records that each shard stores; none if there is nothing to do.
        names: The purged aspects.
        at_ns: The timestamp from which on each aspect with any work is purged.
        done: Aspects of an interrupted run that every shard has already purged.
        obstacles: Why nothing may be done, for people; the rest is then meaningless.
    """

    known: frozenset[str] = frozenset()
    going: list[Going] = field(default_factory=list)
    records: dict[str, tuple[Record, ...]] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    at_ns: dict[str, int] = field(default_factory=dict)
    done: tuple[str, ...] = ()
    obstacles: list[str] = field(default_factory=list)


def planned(
    stores: Mapping[str, Recovered],
    aspects: Iterable[str],
    *,
    now_ns: int,
    begun: Mapping[str, int] | None = None,
) -> PurgePlan:
    """Return the plan to purge aspects.

    Args:
        stores: What each shard has stored.
        aspects: Names of the aspects.
        now_ns: The wall clock.
        begun: Aspects of an interrupted run, each with the timestamp of its purge.
    """
    begun = begun or {}
    has = {
        shard: {name for name, at_ns in begun.items() if _has_purged(stored, name, at_ns)}
        for shard, stored in stores.items()
    }
    done = tuple(name for name in begun if all(name in here for here in has.values()))
    names = tuple(name for name in dict.fromkeys([*aspects, *begun]) if name not in done)
    known = frozenset(name for stored in stores.values() for name in _known(stored))
    plan = PurgePlan(known, names=names, done=done)
    left = {shard: [name for name in names if name not in has[shard]] for shard in stores}
    for shard, stored in stores.items():
        plan.obstacles += _undecided(shard, stored, frozenset(left[shard]), stores.keys())
        plan.going += [found for name in left[shard] if (found := _going(shard, stored, name))]
    gone = {found.aspect for found in plan.going} | (begun.keys() - set(done))
    ends = {name: _end(stores.values(), name, now_ns) for name in names if name in gone}
    plan.at_ns = {name: end.at_ns for name, end in ends.items()}
    for shard, stored in stores.items():
        here = [name for name in left[shard] if name in ends]
        if here:
            plan.records[shard] = (
                *(ends[name] for name in here),
                *_labels_without(stored, set(here)),
            )
    return plan


def _has_purged(stored: Recovered, aspect: str, at_ns: int) -> bool:
    """Return whether a shard has purged an aspect, at a timestamp or later."""
    return any(record.name == aspect and record.at_ns >= at_ns for record in stored.forgotten)


def _known(stored: Recovered) -> Iterator[str]:
    yield from (entry.name for entry in stored.aspects)
    yield from (record.slot.aspect for record in stored.slots)
    yield from (record.name for record in stored.forgotten)


def _states(stored: Recovered, aspect: str) -> list[SlotRecord]:
    return [state for state in _all_states(stored) if state.slot.aspect == aspect]


def _going(shard: str, stored: Recovered, aspect: str) -> Going | None:
    """Return what a shard has of an aspect; None: nothing."""
    entry = next((entry for entry in stored.aspects if entry.name == aspect), None)
    states = _states(stored, aspect)
    kept = [
        record.label
        for record in stored.kept
        for version in record.versions
        if version.slot.aspect == aspect
    ]
    if entry is None and not states and not kept:
        return None
    return Going(
        shard,
        aspect,
        entry.fingerprint if entry is not None else "",
        len({state.slot for state in states}),
        len(states),
        sum(state.datum.size for state in states if state.datum is not None),
        len(kept),
        tuple(sorted(set(kept))),
    )


def _end(stores: Iterable[Recovered], aspect: str, now_ns: int) -> AspectForgotten:
    """Return the record by which every shard purges an aspect: later than any before it."""
    base, at_ns = 0, now_ns
    for stored in stores:
        before = [record for record in stored.forgotten if record.name == aspect]
        for record in before:
            base = max(base, record.version_base, *(base for _, base, _ in record.entity_bases))
            at_ns = max(at_ns, record.at_ns + 1)
        base = max([base, *(state.version for state in _states(stored, aspect))])
        at_ns = max([at_ns, *(record.stamp_ns + 1 for record in stored.slots)])
    return AspectForgotten(aspect, base, at_ns)


def _labels_without(stored: Recovered, aspects: set[str]) -> Iterator[KeptRecord]:
    """Yield the labels that pin versions of these aspects, with only their other versions."""
    for record in stored.kept:
        left = tuple(one for one in record.versions if one.slot.aspect not in aspects)
        if len(left) < len(record.versions):
            yield KeptRecord(record.label, left)


# ---------------------------------------------------------------- without data


def unused_aspects(stores: Mapping[str, Recovered]) -> tuple[str, ...]:
    """Return the registered aspects of which no shard has any state."""
    used = {record.slot.aspect for stored in stores.values() for record in _all_states(stored)} | {
        aspect for stored in stores.values() for one in stored.prepared for aspect in _named_by(one)
    }
    names = (entry.name for stored in stores.values() for entry in stored.aspects)
    return tuple(name for name in dict.fromkeys(names) if name not in used)


def unused_worlds(stores: Mapping[str, Recovered], named: Collection[str]) -> tuple[str, ...]:
    """Return the world contexts without any state, except forks and those `named`."""
    used = {record.slot.context for stored in stores.values() for record in _all_states(stored)}
    for stored in stores.values():
        used |= {world.name for world in stored.worlds if world.source}
        used |= {item.context for one in stored.prepared for item in one.items}
    names = (world.name for stored in stores.values() for world in stored.worlds)
    return tuple(name for name in dict.fromkeys(names) if name not in used and name not in named)


def world_drops(
    stores: Mapping[str, Recovered], worlds: Collection[str]
) -> dict[str, tuple[Record, ...]]:
    """Return the records by which each shard drops world contexts without data."""
    drops: dict[str, tuple[Record, ...]] = {}
    for shard, stored in stores.items():
        before = {record.name: record for record in stored.dropped}
        here = [world.name for world in stored.worlds if world.name in set(worlds)]
        if here:
            drops[shard] = tuple(before.get(name, WorldDropped(name, 0)) for name in here)
    return drops


def _all_states(stored: Recovered) -> Iterator[SlotRecord]:
    yield from stored.slots
    yield from stored.history


# ---------------------------------------------------------------- obstacles


def _undecided(
    shard: str, stored: Recovered, aspects: frozenset[str], shards: Iterable[str]
) -> Iterator[str]:
    """Yield the undecided commits over shards that name, or may name, one of these aspects."""
    remedy = (
        "start all shards of the cell, wait until `enact lock ls` shows it no more (or end it with"
        " `enact lock resolve`), and stop them"
    )
    for promise in stored.prepared:
        named = sorted(_named_by(promise) & aspects)
        if named:
            yield (
                f"the commit of lock {promise.lock} is prepared on {shard}, decided on"
                f" {promise.primary}, and names {', '.join(named)}: {remedy}"
            )
    for decision in stored.decisions:
        away = sorted(set(decision.participants) - set(shards))
        if away:
            yield (
                f"{shard} has decided the commit of lock {decision.lock}, and {', '.join(away)},"
                f" of whose data nothing is known here, may not have heard of it: {remedy}"
            )


def _named_by(promise: PreparedRecord) -> set[str]:
    slots = [item.aspect for item in promise.items]
    slots += [write.slot.aspect for write in promise.writes]
    return set(slots)
