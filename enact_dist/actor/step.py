"""One step of an actor again: what the commit of a version had read, and today's code.

::

    step = Step(cell, "online", "system", "deviation", version=12)
    result = step.run(DeviationDetection(), keep_as="")
    result.differences                       # how what it wrote then and writes now differ

The step runs in world contexts of its own, one for each that the actor is bound to.  They hold the
versions that the commit had read.  Everything else that the actor declares is as it was just before
that commit, as far as the history still knows it.  So a step needs no more of the past than its own
inputs; a fork of a whole context would need every slot of that moment.  No other world context is
written, and no actor is woken.
"""

from __future__ import annotations

import secrets
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.asking import ask_all, explained
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.access.reads import slot_of
from enact_dist.actor.actor import narrowed, stands_for_trigger
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.running.doing import own_lines, raised
from enact_dist.actor.triggers import tick_before
from enact_dist.compare.diff import Diff, diff_places
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import ListHistory, SlotVersion, Versions
from enact_dist.errors import EnactError, ForgottenError, MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Aspect, Entity, checked_name
from enact_dist.wire.limits import BODY_BYTES_MAX, ITEMS_MAX
from enact_dist.world.version_data import Wanted, found_of, set_encoded

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.actor.actor import Actor, Declared
    from enact_dist.core.protocol.datum import Datum
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.world.cell import Cell
    from enact_dist.world.lineage import CauseTree

WAIT_S: Final = 10.0
HOLD_S: Final = 60.0
NAMED_MAX: Final = 4
"""Versions that one sentence names."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """What came of a step that was run again.

    Attributes:
        version: The version whose commit was run again, as ``world:entity/aspect vN``.
        actor: Class of the actor.
        by: Who made that commit.
        entity: The entity that triggered it; empty if none did.
        contexts: The world contexts of the step by those that they stand for.
        kept: Whether these are still there.
        inputs: How many data the step was given.
        differences: By world context: how what the commit wrote (left) and what the step wrote
            (right) differ.
        error: What `update` raised, and where; empty if it did not.
        traceback: Its lines of the user's own files.
        remarks: What may make the step another one than it was.
    """

    version: str
    actor: str
    by: str
    entity: str
    contexts: dict[str, str]
    kept: bool
    inputs: int
    differences: tuple[Diff, ...] = ()
    error: str = ""
    traceback: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether a datum differs by more than its tolerance."""
        return any(self.differences)

    def to_json(self) -> dict[str, object]:
        """Return it in a form that JSON can carry."""
        names = ("version", "actor", "by", "entity", "contexts", "kept", "inputs", "error",
                 "traceback", "remarks")  # fmt: skip
        facts: dict[str, object] = {name: getattr(self, name) for name in names}
        return facts | {
            "differs": self.differs,
            "differences": [one.to_json() for one in self.differences],
        }


class Step:
    """The step of an actor that made a version.

    Args:
        cell: The cell; the connection must not only observe.
        world: Name of the version's world context.
        entity: Name of its entity.
        aspect: Name of its aspect.
        version: Its number; 0: the newest.

    Attributes:
        made: The version and what its commit had read, one step deep.

    Raises:
        NullDatumError: Nothing was ever set there.
        ForgottenError: The version itself is beyond retention.
        MisuseError: There is no such version yet, or it is not known which commit made it.
        UnknownWorldError: The cell has no world context of that name.
        ShardUnreachableError: A shard does not answer.
    """

    def __init__(self, cell: Cell, world: str, entity: str, aspect: str, version: int = 0) -> None:
        refuse_inside_lock("Step")
        self._cell = cell
        self.made: CauseTree = cell.why(world, entity, aspect, version, depth=1)
        self._session = cell.world(world).session
        made = self.made
        self.name = f"{made.slot} v{made.version}"
        if made.kind == "fork":
            source = ", ".join(f"{one.slot}@{one.version}" for one in made.children)
            raise MisuseError(f"{self.name} was made by a fork, not by an actor; replay {source}")
        asked = [SlotVersion(made.slot, made.version)]
        entries = [e for one in explained(self._session.client, asked) for e in one.entries]
        cause = entries[0].cause if entries else None
        if made.kind != "commit" or cause is None:
            raise MisuseError(f"{self.name} cannot be run again: {made.made_by}")
        self._cause = cause
        self._at_ns = made.position.stamp_ns

    def run(
        self,
        actor: Actor,
        worlds: Mapping[str, str] | None = None,
        *,
        keep_as: str = "",
        tolerances: Mapping[str, Aspect[Any]] | None = None,
    ) -> StepResult:
        """Run `update` once on what the commit had read; `start` and `stop` are called around it.

        Args:
            actor: The actor, made as it is to run.
            worlds: Role → name of a world context; None binds each role to the context of its name.
            keep_as: Name of the step's world context, which then stays.  Of several, each is called
                ``NAME-WORLD``.  Empty: they are dropped.
            tolerances: Aspects by name that are compared in another way than the actor's.

        Raises:
            ForgottenError: A version that the commit had read is beyond retention; names it.
            MisuseError: The actor does not write this version, cannot be bound, acts on a version
                only once, or the entity that triggered it is not clear; or the name is taken.
            EnactError: The lock, the commit or a shard refuses the step.
        """
        bound = BoundActor(actor, self._cell, worlds)
        self._refuse_other_actor(bound)
        entity = self._entity(bound)
        history = self._history(bound, entity)
        inputs, remarks = self._inputs(bound, entity, history)
        then = self._written(bound, history)
        names = self._names(bound, keep_as)
        result = StepResult(
            self.name,
            type(actor).__name__,
            self.made.made_by,
            entity.name if entity is not None else "",
            names,
            bool(keep_as),
            len(inputs),
            remarks=remarks,
        )
        with self._contexts(names, keep=bool(keep_as)):
            self._set(names, inputs)
            before = self._versions(names)
            roles = {role: names[context.name] for role, context in bound.contexts.items()}
            again = BoundActor(actor, self._cell, roles)
            failed = self._update(again, entity, _members(bound, inputs))
            if failed is not None:
                return replace(result, error=raised(failed), traceback=tuple(own_lines(failed)))
            after = self._versions(names)
            now = {slot for slot, state in after.items() if before.get(slot) != state}
            types = {one.aspect.name: one.aspect for one in bound.declaration.requests.values()}
            types |= tolerances or {}
            return replace(result, differences=self._compared(names, then, now, types))

    # ---------------------------------------------------------------- what the step was

    def _refuse_other_actor(self, bound: BoundActor) -> None:
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

    def _entity(self, bound: BoundActor) -> Entity | None:
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

    def _history(self, bound: BoundActor, entity: Entity | None) -> dict[Slot, list[VersionEntry]]:
        """Return the versions of the actor's slots that were current just before the commit."""
        found: dict[Slot, list[VersionEntry]] = {}
        for context, pattern, aspect in _named(bound, bound.declaration.requests.values(), entity):
            request = ListHistory((context,), (pattern,), (aspect,), max(self._at_ns - 1, 0))
            for _, answer in ask_all(self._session.client, Versions, request):
                for entry in answer.entries:
                    entries = found.setdefault(entry.state.slot, [])
                    if entry not in entries:
                        entries.append(entry)
        return found

    def _inputs(
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
            state = next((e.state for e in entries if self._current(e)), None)
            if state is None and min(e.state.version for e in entries) > 1:
                unknown.append(str(slot))
            if state is not None and not state.null_reason:
                shard = self._session.shard_of(slot)
                others.append(Wanted(state.stamp_ns, slot, state.version, shard))
        found = found_of(self._session, [*wanted, *others])
        forgotten += [f"{one.slot} v{one.version}" for one in wanted if one not in found]
        unknown += [str(one.slot) for one in others if one not in found]
        if forgotten:
            raise self._forgotten(forgotten)
        data = {one.slot: value.datum for one, value in found.items() if value.datum is not None}
        return data, tuple(self._remarks(reads, unknown))

    def _current(self, entry: VersionEntry) -> bool:
        """Whether a version was the newest one just before the commit."""
        begins = entry.state.stamp_ns < self._at_ns
        return begins and (not entry.until_ns or entry.until_ns >= self._at_ns)

    def _forgotten(self, forgotten: list[str]) -> ForgottenError:
        more = f" and {len(forgotten) - NAMED_MAX} more" if len(forgotten) > NAMED_MAX else ""
        slot = f"{self.made.entity}/{self.made.aspect}"
        return ForgottenError(
            f"{self.name} cannot be run again: {', '.join(forgotten[:NAMED_MAX])}{more}, which its"
            " commit had read, left the retention; to keep such versions, give the aspect a larger"
            " retention (Aspect(…, retention=…), or [aspects.NAME] of cell.toml), or pin them in"
            f" time: enact why {self.made.world} {slot} --pin LABEL"
        )

    def _remarks(self, reads: Mapping[Slot, CauseTree], unknown: list[str]) -> Iterator[str]:
        if unknown:
            named = ", ".join(sorted(unknown)[:NAMED_MAX])
            more = f" and {len(unknown) - NAMED_MAX} more" if len(unknown) > NAMED_MAX else ""
            yield f"null in the step, because their state of that time is forgotten: {named}{more}"
        others = [str(one.slot) for one in self.made.children if one.slot not in reads]
        if others:
            named = ", ".join(others[:NAMED_MAX])
            more = f" and {len(others) - NAMED_MAX} more" if len(others) > NAMED_MAX else ""
            yield f"read by the commit, and not declared by this actor: {named}{more}"
        if self.made.left_out:
            yield f"the commit read {self.made.left_out} more data than it names"

    def _written(self, bound: BoundActor, history: Mapping[Slot, list[VersionEntry]]) -> set[Slot]:
        """Return what the commit wrote in the world contexts of the actor, as far as known."""
        contexts = {context.name for context in bound.contexts.values()}
        slots = {version.slot for version in self._cause.writes}
        slots |= {
            slot
            for slot, entries in history.items()
            for entry in entries
            if entry.cause is not None and entry.cause.lock == self._cause.lock
        }
        return {slot for slot in slots | {self.made.slot} if slot.context in contexts}

    # ---------------------------------------------------------------- the step again

    def _names(self, bound: BoundActor, keep_as: str) -> dict[str, str]:
        """Return what the step's world contexts are called, by those that they stand for."""
        worlds = list(dict.fromkeys(context.name for context in bound.contexts.values()))
        base = keep_as or f"step-{secrets.token_hex(4)}"
        names = {world: base if len(worlds) == 1 else f"{base}-{world}" for world in worlds}
        there = self._cell.worlds()
        for name in names.values():
            try:
                checked_name("world context", name, slashes=False)
            except ValueError as error:
                raise MisuseError(str(error)) from None
            if name in there:
                raise MisuseError(
                    f"there is a world context {name!r}; take another name, or drop it: enact world"
                    f" drop {name}"
                )
        return names

    @contextmanager
    def _contexts(self, names: Mapping[str, str], *, keep: bool) -> Iterator[None]:
        """Make the step's world contexts; drop them at the end unless they are to be kept."""
        made: list[str] = []
        try:
            for name in names.values():
                made.append(name)
                self._cell.create_world(name)
            yield
        except BaseException:
            self._drop(made)
            raise
        if not keep:
            self._drop(made)

    def _drop(self, names: Iterable[str]) -> None:
        for name in names:
            if name in self._cell.worlds():
                self._cell.drop_world(name)

    def _set(self, names: Mapping[str, str], inputs: Mapping[Slot, Datum]) -> None:
        client = self._session.client
        client.greet()
        known = client.aspect_entries()
        used = {slot.aspect for slot in inputs}
        client.register(aspects=[known[name]._replace(reads=True) for name in sorted(used)])
        part: dict[Slot, Datum | None] = {}
        size = 0
        for slot, datum in inputs.items():
            if part and (len(part) >= ITEMS_MAX or size + datum.size > BODY_BYTES_MAX):
                set_encoded(client, part, wait_s=WAIT_S, hold_s=HOLD_S)
                part, size = {}, 0
            part[slot._replace(context=names[slot.context])] = datum
            size += datum.size
        if part:
            set_encoded(client, part, wait_s=WAIT_S, hold_s=HOLD_S)

    def _versions(self, names: Mapping[str, str]) -> dict[Slot, tuple[int, int]]:
        """Return version and stamp of what the step's contexts have, our own commits included."""
        for shard in self._session.client.shards():
            self._session.settle(shard)
        return {
            Slot(world, info.entity.name, info.aspect): (info.version, info.position.stamp_ns)
            for world, name in names.items()
            for info in self._cell.world(name).list_slots()
        }

    def _update(
        self, bound: BoundActor, entity: Entity | None, members: tuple[int, ...]
    ) -> BaseException | None:
        """Run the update in the step's contexts; return what it raised."""
        actor, failed = bound.actor, None
        every_s, tick_ns = actor.every_s, 0
        if every_s and not bound.declaration.triggers:
            tick_ns = self.made.stamp_ns or tick_before(self._at_ns, every_s)
        _called(actor, "start")
        try:
            with bound.lock(entity, tick_ns=tick_ns, members=members) as lock:
                try:
                    actor.update(lock)
                except (Exception, SystemExit) as error:
                    failed = error
                    raise
        except (Exception, SystemExit):
            if failed is None:
                raise
        finally:
            _called(actor, "stop")
        return failed

    def _compared(
        self,
        names: Mapping[str, str],
        then: set[Slot],
        now: set[Slot],
        types: Mapping[str, Aspect[Any]],
    ) -> tuple[Diff, ...]:
        found = []
        for world, name in names.items():
            slots = sorted(slot for slot in then | now if slot.context == world)
            if not slots:
                continue
            past = self._cell.world(world).at(self.made.position)
            places = [(slot.entity, slot.aspect) for slot in slots]
            known = {name: types.get(name) or Aspect(name, object) for _, name in places}
            diff = diff_places(past, self._cell.world(name), places, known)
            found.append(replace(diff, left=f"{world} then", right=f"{world} now"))
        return tuple(found)


def _called(actor: Actor, method: str) -> None:
    """Call `start` or `stop` of an actor.

    Raises:
        MisuseError: It raised something of its own.
    """
    try:
        getattr(actor, method)()
    except EnactError:
        raise
    except Exception as error:
        name = type(actor).__name__
        raise MisuseError(f"{method} of actor {name} failed: {raised(error)}") from error


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


def _members(bound: BoundActor, inputs: Mapping[Slot, Datum]) -> tuple[int, ...]:
    """Return the capture stamps of the set that triggered a step; 0 of what was missing."""
    data = [inputs.get(slot_of(view)) for view in bound.set_views()]
    return tuple(datum.stamp_ns if datum is not None else 0 for datum in data)
