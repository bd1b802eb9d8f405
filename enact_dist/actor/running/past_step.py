"""The step of an actor as it was: the entity that triggered it, its inputs, what it wrote.

All of it follows from the cause of the version that the step made, and from the histories of the
slots that the actor declares.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.access.asking import ask_all, explained
from enact_dist.access.reads import slot_of
from enact_dist.actor.actor import Declared, narrowed, stands_for_trigger
from enact_dist.actor.triggers import tick_before
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import ListHistory, SlotVersion, VersionEntry, Versions
from enact_dist.errors import ForgottenError, MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Entity
from enact_dist.world.version_data import Wanted, found_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.actor.binding import BoundActor
    from enact_dist.world.cell import Cell
    from enact_dist.world.lineage import CauseTree

NAMED_MAX: Final = 4
"""Versions that one sentence names."""


class PastStep:
    """The step that made a version; arguments and errors are those of `Step`.

    Attributes:
        made: The version and what its commit had read, one step deep.
        name: The version, as ``world:entity/aspect vN``.
        session: The connection that asks.
    """

    def __init__(self, cell: Cell, world: str, entity: str, aspect: str, version: int = 0) -> None:
        self.made: CauseTree = cell.why(world, entity, aspect, version, depth=1)
        self.session = cell.world(world).session
        made = self.made
        self.name = f"{made.slot} v{made.version}"
        if made.kind == "fork":
            source = ", ".join(f"{one.slot}@{one.version}" for one in made.children)
            raise MisuseError(f"{self.name} was made by a fork, not by an actor; replay {source}")
        asked = [SlotVersion(made.slot, made.version)]
        entries = [e for one in explained(self.session.client, asked) for e in one.entries]
        cause = entries[0].cause if entries else None
        if made.kind != "commit" or cause is None:
            raise MisuseError(f"{self.name} cannot be run again: {made.made_by}")
        self._cause = cause
        self._at_ns = made.position.stamp_ns

    def refuse_other_actor(self, bound: BoundActor) -> None:
        """Raise `MisuseError` if an actor cannot have made the version, or must not run again."""
        name = bound.declaration.actor
        if bound.declaration.outcome is not None:
            raise MisuseError(
                f"{name} has once = True: it moves something, and acts on a version only once;"
                " such a step is not run again"
            )
        slot = self.made.slot
        writes = [one for one in bound.declaration.requests.values() if one.access.writes]
        if not any(_is_of(one, slot) for one in _named(bound, writes, bound.only)):
            raise MisuseError(
                f"{name} does not write {slot}; it writes {', '.join(bound.writes()) or 'nothing'}."
                f"  The version was made by {self.made.made_by}: name that actor, or bind roles to"
                " other world contexts"
            )

    def entity(self, bound: BoundActor) -> Entity | None:
        """Return the entity that triggered the step, by what the commit read and wrote."""
        declaration = bound.declaration
        if bound.only is not None or not declaration.triggers or declaration.together is not None:
            return bound.only
        if not declaration.per_entity:
            reads = [one for one in self.made.children if self._matches(bound, one.slot, each=True)]
            newest = max(reads, key=lambda one: one.position.stamp_ns, default=None)
            return newest.entity if newest is not None else None
        slots = [*(one.slot for one in self.made.children), self.made.slot]
        found = {Entity(slot.entity) for slot in slots if self._matches(bound, slot, each=False)}
        fitting = sorted(entity for entity in found if declaration.covers(entity))
        if len(fitting) != 1:
            raise MisuseError(
                f"which entity triggered {self.name} is not clear: it may be"
                f" {', '.join(map(str, fitting)) or 'any'}; name it (--entity, actor.only_entity)"
            )
        return fitting[0]

    @staticmethod
    def _matches(bound: BoundActor, slot: Slot, *, each: bool) -> bool:
        """Whether a slot is one of a trigger (`each`), or of a request that stands for one."""
        declaration = bound.declaration
        requests = declaration.triggers if each else declaration.requests.values()
        return any(
            _is_of((bound.contexts[one.world.name].name, str(one.entity), one.aspect.name), slot)
            for one in requests
            if each or stands_for_trigger(one)
        )

    def history(self, bound: BoundActor, entity: Entity | None) -> dict[Slot, list[VersionEntry]]:
        """Return the versions of the actor's slots that were current just before the commit."""
        found: dict[Slot, list[VersionEntry]] = {}
        for context, pattern, aspect in _named(bound, bound.declaration.requests.values(), entity):
            request = ListHistory((context,), (pattern,), (aspect,), max(self._at_ns - 1, 0))
            for _, answer in ask_all(self.session.client, Versions, request):
                for entry in answer.entries:
                    entries = found.setdefault(entry.state.slot, [])
                    if entry not in entries:
                        entries.append(entry)
        return found

    def inputs(
        self, bound: BoundActor, entity: Entity | None, history: Mapping[Slot, list[VersionEntry]]
    ) -> tuple[dict[Slot, Datum], tuple[str, ...]]:
        """Return the data that the step is given, and what may make it another one."""
        declared = list(_named(bound, bound.declaration.requests.values(), entity))
        reads = {
            one.slot: one
            for one in self.made.children
            if any(_is_of(each, one.slot) for each in declared)
        }
        forgotten = [f"{o.slot} v{o.version}" for o in reads.values() if o.kind == "forgotten"]
        wanted = [
            Wanted(one.position.stamp_ns, slot, one.version, one.position.shard)
            for slot, one in reads.items()
            if one.version and not one.null_reason and one.kind != "forgotten"
        ]
        others, unknown = list[Wanted](), list[str]()
        for slot, entries in history.items():
            if slot in reads:
                continue
            state = next((e.state for e in entries if _is_current(e, self._at_ns - 1)), None)
            if state is None and min(e.state.version for e in entries) > 1:
                unknown.append(str(slot))
            if state is not None and not state.null_reason:
                shard = self.session.shard_of(slot)
                others.append(Wanted(state.stamp_ns, slot, state.version, shard))
        found = found_of(self.session, [*wanted, *others])
        forgotten += [f"{one.slot} v{one.version}" for one in wanted if one not in found]
        unknown += [str(one.slot) for one in others if one not in found]
        if forgotten:
            raise self._forgotten(forgotten)
        data = {one.slot: value.datum for one, value in found.items() if value.datum is not None}
        return data, tuple(self._remarks(reads, unknown))

    def _forgotten(self, forgotten: list[str]) -> ForgottenError:
        slot = f"{self.made.entity}/{self.made.aspect}"
        return ForgottenError(
            f"{self.name} cannot be run again: {some(forgotten)}, which its commit had read, has"
            " left its retention; to keep such versions, give the aspect a larger"
            " retention (Aspect(…, retention=…), or [aspects.NAME] of cell.toml), or pin them in"
            f" time: enact why {self.made.world} {slot} --pin LABEL"
        )

    def _remarks(self, reads: Mapping[Slot, CauseTree], unknown: list[str]) -> Iterator[str]:
        if unknown:
            why = "because their state of that time is forgotten"
            yield f"null in the step, {why}: {some(unknown)}"
        others = [str(one.slot) for one in self.made.children if one.slot not in reads]
        if others:
            yield f"read by the commit, and not declared by this actor: {some(others)}"
        if self.made.left_out:
            yield f"the commit read {self.made.left_out} more data than it names"

    def tick_ns(self, every_s: float, *, in_phase: bool) -> int:
        """Return the tick of a source: the version's capture stamp if it may be one.

        A source may also put a stamp of its own, as the time of an exposure.  Then it is the newest
        tick before the commit.
        """
        captured_ns = self.made.stamp_ns
        if 0 < captured_ns <= self._at_ns and (
            not in_phase or tick_before(captured_ns, every_s) == captured_ns
        ):
            return captured_ns
        return tick_before(self._at_ns, every_s)

    def written(
        self, bound: BoundActor, history: Mapping[Slot, list[VersionEntry]]
    ) -> tuple[set[Slot], tuple[str, ...]]:
        """Return what the commit wrote in the world contexts of the actor, as far as known.

        Also a remark on what it wrote in others.
        """
        contexts = {context.name for context in bound.contexts.values()}
        slots = {version.slot for version in self._cause.writes}
        slots |= {
            slot
            for slot, entries in history.items()
            for entry in entries
            if entry.cause is not None and entry.cause.lock == self._cause.lock
        }
        others = [str(slot) for slot in slots if slot.context not in contexts]
        remark = (
            f"written by the commit, and not compared: {some(others)}, because this actor is not"
            " bound to that world context"
        )
        slots = {slot for slot in slots | {self.made.slot} if slot.context in contexts}
        return slots, (remark,) if others else ()

    def forgotten_since(self, slots: list[Slot]) -> set[Slot]:
        """Return the slots of one context whose version after the commit is not known any more."""
        request = ListHistory(
            tuple({slot.context for slot in slots}),
            tuple({slot.entity for slot in slots}),
            tuple({slot.aspect for slot in slots}),
            max(self._at_ns - 1, 0),
        )
        entries: dict[Slot, list[VersionEntry]] = {}
        for _, answer in ask_all(self.session.client, Versions, request) if slots else ():
            for entry in answer.entries:
                entries.setdefault(entry.state.slot, []).append(entry)
        return {
            slot
            for slot, known in entries.items()
            if min(entry.state.version for entry in known) > 1
            and not any(_is_current(entry, self._at_ns) for entry in known)
        }


def _is_current(entry: VersionEntry, at_ns: int) -> bool:
    """Whether a version was the newest one at a moment."""
    begun_ns, until_ns = entry.state.stamp_ns, entry.until_ns
    return begun_ns == at_ns or (begun_ns < at_ns and (not until_ns or until_ns > at_ns))


def some(names: list[str]) -> str:
    """Return the first names of many, and how many more there are."""
    more = f" and {len(names) - NAMED_MAX} more" if len(names) > NAMED_MAX else ""
    return ", ".join(sorted(names)[:NAMED_MAX]) + more


def _named(
    bound: BoundActor, requests: Iterable[Declared], entity: Entity | None
) -> Iterator[tuple[str, str, str]]:
    """Yield what requests of an actor name: world context, entity or pattern, aspect."""
    for one in requests:
        named = narrowed(one, entity)
        yield bound.contexts[one.world.name].name, str(named.entity), one.aspect.name


def _is_of(declared: tuple[str, str, str], slot: Slot) -> bool:
    """Whether a request of an actor names a slot."""
    context, pattern, aspect = declared
    same = (slot.context, slot.aspect) == (context, aspect)
    return same and pattern_matches(pattern, slot.entity)


def members_of(bound: BoundActor, inputs: Mapping[Slot, Datum]) -> tuple[int, ...]:
    """Return the capture stamps of the set that triggered a step; 0 of what was missing."""
    data = [inputs.get(slot_of(view)) for view in bound.set_views()]
    return tuple(datum.stamp_ns if datum is not None else 0 for datum in data)
