"""Finds the entities that a stopped cell's placement puts on other shards, and plans their move.

The input is everything that the shards have stored.  Rules that a change must keep:

- An entity moves whole: all its slots in all contexts, with history, labels and causes, in one
  batch of its new shard; then one batch of the old shard deletes it.  After an interruption between
  the two it is on both, and the next plan only deletes it on the old one.
- Before the first entity moves, every shard learns what all must know: contexts, forks, aspects,
  and the version floors of dropped contexts and purged aspects.
- If something would be lost there is no plan, only a list of obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from enact_dist.core.protocol.datum_types import newest
from enact_dist.core.protocol.messages import SlotVersion
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import (
    AspectForgotten,
    AspectRecord,
    BasesMoved,
    EntitiesMoved,
    KeptRecord,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.core.state.retention import covers, with_larger

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import AspectEntry, PlacementMap
    from enact_dist.core.protocol.records import Record, Recovered

    Gone = WorldDropped | AspectForgotten

NAMED_MAX: Final = 5
"""Number of obstructing entities that a message names."""


class Move(NamedTuple):
    """The move of one entity.

    Attributes:
        source: The shard that deletes it.
        target: The shard that it belongs to.
        states: How many states of its slots there are, replaced ones included.
        size: Bytes of their data.
        copied: Whether `target` has it already.
    """

    entity: str
    source: str
    target: str
    states: int
    size: int
    copied: bool


class _Start(NamedTuple):
    """Where slots of a dropped context or purged aspect start again.

    Attributes:
        base: Their versions are above this one.
        at_ns: Nothing is known of an aspect up to this timestamp.
    """

    base: int
    at_ns: int = 0


@dataclass(slots=True)
class MovePlan:
    """What a rebalance does.

    Attributes:
        first: Records that each shard needs before anything moves; only shards that lack some.
        moves: The entities, in order of their names.
        obstacles: Why nothing may be done, for people; the rest is then meaningless.
    """

    first: dict[str, tuple[Record, ...]] = field(default_factory=dict)
    moves: list[Move] = field(default_factory=list)
    obstacles: list[str] = field(default_factory=list)


class Shards:
    """The content of a stopped cell's shards, by entity.

    Args:
        stores: What each shard has stored, including shards that leave the cell.
        placement: The new placement of entities.
        under_way: Whether a rebalance was interrupted; only then may an entity be on two shards.
    """

    def __init__(
        self, stores: Mapping[str, Recovered], placement: PlacementMap, *, under_way: bool
    ) -> None:
        self._stores = stores
        self._placement = placement
        self._under_way = under_way
        self._states: dict[str, dict[str, dict[Slot, list[SlotRecord]]]] = {}
        self._kept: dict[str, dict[str, set[SlotVersion]]] = {}
        for name, stored in stores.items():
            self._kept[name] = {record.label: set(record.versions) for record in stored.kept}
            for record in (*stored.history, *stored.slots):
                holders = self._states.setdefault(record.slot.entity, {})
                holders.setdefault(name, {}).setdefault(record.slot, []).append(record)

    # ---------------------------------------------------------------- the plan

    def plan(self) -> MovePlan:
        """Return the plan, or the obstacles to one."""
        plan = MovePlan()
        plan.obstacles += self._undecided()
        for entity in sorted(self._states):
            self._plan_entity(entity, plan)
        worlds, aspects = self._worlds(plan.obstacles), self._aspects(plan.obstacles)
        if plan.obstacles:
            return plan
        dropped = self._gone(lambda stored: stored.dropped, lambda name: WorldDropped(name, 0))
        forgotten = self._gone(
            lambda stored: stored.forgotten, lambda name: AspectForgotten(name, 0, 0)
        )
        bases = self._bases(dropped, "context")
        for shard, found in self._bases(forgotten, "aspect").items():
            bases[shard] += found
        for shard in (entry.name for entry in self._placement.shards):
            stored = self._stores[shard]
            here = {record.name for record in stored.worlds}
            known = {entry.name: entry for entry in stored.aspects}
            records: list[Record] = [world for world in worlds if world.name not in here]
            records += [AspectRecord(entry) for entry in aspects if known.get(entry.name) != entry]
            known_gone: list[Gone] = [*stored.dropped, *stored.forgotten]
            records += [BasesMoved(base) for base in bases[shard] if base not in known_gone]
            if records:
                plan.first[shard] = tuple(records)
        return plan

    def _plan_entity(self, entity: str, plan: MovePlan) -> None:
        holders, owner = self._states[entity], shard_of(entity, self._placement)
        versions = {shard: _versions(slots) for shard, slots in holders.items()}
        if len({frozenset(found) for found in versions.values()}) > 1 or (
            len(holders) > 1 and not self._under_way
        ):
            plan.obstacles.append(
                f"the entity {entity} is on {' and '.join(sorted(holders))}, and it is unknown"
                " which of them is right; let the shard that should not have it begin with an empty"
                " folder, or a backup from before it had it"
            )
            return
        copied = owner in holders
        for source in sorted(holders.keys() - {owner}):
            states = [state for slot in holders[source].values() for state in slot]
            size = sum(state.datum.size for state in states if state.datum is not None)
            plan.moves.append(Move(entity, source, owner, len(states), size, copied))
            copied = True

    def _undecided(self) -> Iterator[str]:
        for name, stored in self._stores.items():
            count = len(stored.prepared) + len(stored.decisions)
            if count:
                yield (
                    f"{count} commits over shards are not settled on {name}: start all shards of"
                    " the cell as it was, wait until `enact lock ls` shows none, and stop them"
                )

    # ---------------------------------------------------------------- what all must know

    def _worlds(self, obstacles: list[str]) -> list[WorldRecord]:
        """Return the contexts of all shards; a fork must be complete."""
        worlds: dict[str, WorldRecord] = {}
        for name, stored in self._stores.items():
            for record in stored.worlds:
                known = worlds.setdefault(record.name, record)
                if known != record:
                    obstacles.append(
                        f"the world context {record.name} is another one on {name} than elsewhere:"
                        " drop it where the cell still runs as it was"
                    )
        for world in worlds.values():
            lacking = [name for name in self._stores if self._lacks_part(name, world)]
            if world.source and lacking:
                obstacles.append(
                    f"the fork {world.name} of {world.source} is not whole, {', '.join(lacking)}"
                    " lacks it: complete or drop it in the cell as it was"
                )
        return list(worlds.values())

    def _lacks_part(self, shard: str, world: WorldRecord) -> bool:
        """Return whether a shard lacks its part of a fork; a new shard has none."""
        stored = self._stores[shard]
        had_source = any(record.slot.context == world.source for record in stored.slots) or any(
            record.name in (world.source, world.name) for record in stored.dropped
        )
        return had_source and all(record.name != world.name for record in stored.worlds)

    def _aspects(self, obstacles: list[str]) -> list[AspectEntry]:
        """Return the aspects of all shards, each with its newest type and largest retention."""
        aspects: dict[str, AspectEntry] = {}
        first: dict[str, str] = {}
        for name, stored in self._stores.items():
            for entry in stored.aspects:
                known = aspects.setdefault(entry.name, entry)
                where = first.setdefault(entry.name, name)
                newer = newest(known, entry)
                if newer is None or known.durability != entry.durability:
                    obstacles.append(
                        f"the aspect {entry.name} is {known.fingerprint} {known.durability} on"
                        f" {where} and {entry.fingerprint} {entry.durability} on {name}:"
                        f" {self._one_type(entry.name, where, name)}"
                    )
                else:
                    aspects[entry.name] = newer
                    for one in (known, entry):
                        if not covers(newer, one):
                            aspects[entry.name] = with_larger(aspects[entry.name], one)
        return list(aspects.values())

    def _one_type(self, aspect: str, one: str, other: str) -> str:
        """Return the remedy for an aspect that differs between two shards."""
        at_ns = {
            shard: max(
                (r.at_ns for r in self._stores[shard].forgotten if r.name == aspect), default=0
            )
            for shard in (one, other)
        }
        old, new = sorted(at_ns, key=lambda shard: at_ns[shard])
        if at_ns[old] < at_ns[new]:
            return (
                f"{new} has forgotten it since, and {old} has it as it was, from a backup say; call"
                f" `enact shard forget {aspect} --shard {old}`"
            )
        return "start the cell as it was once, with the same cell.toml for all"

    def _gone(
        self, of: Callable[[Recovered], Iterable[Gone]], never: Callable[[str], Gone]
    ) -> Iterator[dict[str, Gone]]:
        """Yield what each shard knows of each context or aspect that is gone on any of them."""
        known = {shard: {g.name: g for g in of(stored)} for shard, stored in self._stores.items()}
        for name in sorted({name for here in known.values() for name in here}):
            yield {shard: here.get(name) or never(name) for shard, here in known.items()}

    def _bases(
        self, by_name: Iterable[dict[str, Gone]], part: Literal["context", "aspect"]
    ) -> dict[str, list[Gone]]:
        """Return where slots of what is gone start when it is made again: alike on all shards.

        Slots made since then started above the floor of their own shard and keep it.  The shard
        that has them before the move learns that, too: an interrupted run may leave them there.

        Args:
            by_name: What each shard knows of each context or aspect that is gone.
            part: The part of a slot that its name is.
        """
        bases: dict[str, list[Gone]] = {entry.name: [] for entry in self._placement.shards}
        for by_shard in by_name:
            known = next(iter(by_shard.values()))
            starts = {shard: _start_of(gone) for shard, gone in by_shard.items()}
            top = _Start(*map(max, zip(*starts.values(), strict=True)))
            moved = {
                shard: {entity: _Start(*start) for entity, *start in gone.entity_bases}
                for shard, gone in by_shard.items()
            }
            own: dict[str, dict[str, _Start]] = {shard: {} for shard in bases}
            for entity, holders in self._states.items():
                for shard, slots in holders.items():
                    start = moved[shard].get(entity, starts[shard])
                    if start != top and any(getattr(slot, part) == known.name for slot in slots):
                        for place in own.keys() & {shard, shard_of(entity, self._placement)}:
                            own[place][entity] = start
            for shard, found in bases.items():
                found.append(_with_starts(known, top, own[shard]))
        return bases

    # ---------------------------------------------------------------- records

    def brought(self, target: str, entities: Iterable[str], source: str) -> tuple[Record, ...]:
        """Return the records by which `target` gets these entities, and note that it has them."""
        records: list[Record] = []
        files: dict[int, SlotVersion] = {}
        for entity in entities:
            slots = self._states[entity][source]
            self._states[entity][target] = slots
            for slot in sorted(slots):
                records += _copied(slots[slot], files)
        moved = self._kept_of(source, entities)
        for label, versions in moved.items():
            here = self._kept[target].setdefault(label, set())
            here |= versions
            records.append(KeptRecord(label, tuple(sorted(here))))
        return tuple(records)

    def left(self, source: str, entities: tuple[str, ...]) -> tuple[Record, ...]:
        """Return the records by which `source` deletes these entities, and note that it has."""
        records: list[Record] = [EntitiesMoved(entities)]
        for label, versions in self._kept_of(source, entities).items():
            rest = self._kept[source][label] - versions
            self._kept[source][label] = rest
            records.append(KeptRecord(label, tuple(sorted(rest))))
        for entity in entities:
            del self._states[entity][source]
        return tuple(records)

    def _kept_of(self, shard: str, entities: Iterable[str]) -> dict[str, set[SlotVersion]]:
        names = frozenset(entities)
        found = {
            label: {version for version in versions if version.slot.entity in names}
            for label, versions in self._kept[shard].items()
        }
        return {label: versions for label, versions in found.items() if versions}


def strangers(stored: Recovered, shard: str, placement: PlacementMap) -> list[tuple[str, str]]:
    """Return the entities that a shard has or has prepared, and the other shard of each."""
    entities = dict.fromkeys(record.slot.entity for record in stored.slots)
    for promise in stored.prepared:
        entities.update((write.slot.entity, None) for write in promise.writes)
    found = ((entity, shard_of(entity, placement)) for entity in entities)
    return [(entity, owner) for entity, owner in found if owner != shard]


def _start_of(gone: Gone) -> _Start:
    return _Start(gone.version_base, gone.at_ns if isinstance(gone, AspectForgotten) else 0)


def _with_starts(gone: Gone, top: _Start, own: Mapping[str, _Start]) -> Gone:
    """Return a record of what is gone: where its slots start, and those of single entities."""
    entities = sorted(own.items())
    if isinstance(gone, WorldDropped):
        bases = tuple((name, start.base) for name, start in entities)
        return WorldDropped(gone.name, top.base, bases)
    return AspectForgotten(gone.name, *top, tuple((name, *start) for name, start in entities))


def _versions(slots: Mapping[Slot, list[SlotRecord]]) -> set[tuple[Slot, int, int]]:
    return {(s.slot, s.version, s.stamp_ns) for states in slots.values() for s in states}


def _copied(states: list[SlotRecord], files: dict[int, SlotVersion]) -> Iterator[SlotRecord]:
    """Yield the states of a slot, oldest first; repeated bytes name their first version."""
    for state in states:
        same_as = None
        if state.datum is not None:
            here = SlotVersion(state.slot, state.version)
            first = files.setdefault(id(state.datum.body), here)
            same_as = first if first is not here else None
        yield replace(state, history=state is not states[0], same_as=same_as)
