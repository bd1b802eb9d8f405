"""An actor with its roles bound to the world contexts of a cell, and the locks it then takes.

A declared request names a role and maybe a pattern; a bound one names a world context and, where
the pattern stands for the triggering entity, that entity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.access.reads import slot_of
from enact_dist.access.session import bind, session_of
from enact_dist.access.sets import PendingSets
from enact_dist.actor.actor import (
    Actor,
    Declared,
    check_update,
    narrowed,
    same_data,
    stands_for_trigger,
)
from enact_dist.actor.lock import ActorLock, OnceLock
from enact_dist.errors import MisuseError
from enact_dist.link.client.calls import CALL_S
from enact_dist.terms import Aspect, Entities, Entity, View, refuse_duplicates

if TYPE_CHECKING:
    import threading
    from collections.abc import Mapping

    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import DatumRead
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext

ENTITIES_MAX: Final = 1024
"""Triggering entities for which the bound requests are kept."""


@dataclass(frozen=True, slots=True)
class Watched:
    """What one watch follows for an actor: one pattern of one world context.

    `triggers` are the aspects by name, each with the indices of the triggers that it feeds.
    """

    context: WorldContext
    entities: Entities
    aspects: tuple[Aspect[Any], ...]
    triggers: Mapping[str, tuple[int, ...]]


class Joined(NamedTuple):
    """Where an actor runs."""

    cell: Cell
    worlds: Mapping[str, WorldContext]


_JOINED: Final = "_enact_joined"
"""Attribute of a running actor, which may be a dataclass that is frozen or compares by value."""


def joined(actor: Actor) -> Joined:
    """Return where an actor runs, for operations outside its lock, such as a fork.

    A thread that holds a lock, as `update` does, can neither fork nor drop a world context; another
    thread has to do it.

    Raises:
        MisuseError: It does not run yet.
    """
    found: Joined | None = getattr(actor, _JOINED, None)
    if found is None:
        raise MisuseError(f"{type(actor).__name__} runs in no cell yet; ask in start or update")
    return found


class BoundActor:
    """An actor, its cell, and the world context of each role.

    Args:
        actor: The actor.
        cell: Where its world contexts are.
        worlds: Role → name of a world context; None binds each role to the context of its name.

    Raises:
        MisuseError: `update` is not defined, a role is unbound or unknown, its `only_entity` does
            not fit what it declares, or roles bound to one context make the actor write what
            triggers it or ask for a datum in two ways.
        UnknownWorldError: The cell has no world context of such a name.
    """

    __slots__ = ("_by_entity", "actor", "cell", "contexts", "declaration", "only")

    def __init__(self, actor: Actor, cell: Cell, worlds: Mapping[str, str] | None = None) -> None:
        if not isinstance(actor, Actor):
            raise MisuseError(f"{actor!r} is no actor that can run; make an instance of an Actor")
        check_update(type(actor))
        self.actor = actor
        self.cell = cell
        self.declaration = actor.declaration
        self.declaration.check_entity(actor.only_entity)
        self.only = actor.only_entity
        names = self._names(worlds)
        self.contexts = {role: cell.world(name) for role, name in names.items()}
        self._check(names)
        object.__setattr__(actor, _JOINED, Joined(cell, self.contexts))
        self._by_entity: dict[Entity | None, Mapping[Declared, Declared]] = {}

    def register(self) -> None:
        """Let the shards of its data look at the actor's aspects; with a trigger, all shards.

        Raises:
            DatumTypeError: A shard knows one of them with another type.
            ShardUnreachableError: A shard that is needed does not answer.
        """
        for context in list(self.contexts.values())[:1]:  # all are of one session
            if self.declaration.triggers:  # its watch needs all shards
                # Tried again while the actor is not stopped, so no try takes long.
                context.session.look_up(
                    (request.aspect for request in self.declaration.requests.values()),
                    timeout_s=CALL_S,
                )
            else:
                context.session.prepare(self._bound_for(self.only).values(), wait_s=0.0)

    def lock(
        self,
        entity: Entity | None,
        *,
        wait_s: float | None = None,
        stop: threading.Event | None = None,
        members: tuple[int, ...] = (),
        tick_ns: int = 0,
        after: tuple[DatumRead, ...] = (),
        shown: tuple[Reading, ...] = (),
    ) -> ActorLock:
        """Return the lock of one update, not yet taken.

        Args:
            entity: The triggering entity; None for a source or an actor that runs once, which then
                works on its `only_entity`, if it has one.
            wait_s: How long to wait for it; None: as long as the actor says.
            stop: Ends the waiting once it is set.
            members: Capture stamps of the set that triggered it, as `Trigger`; nothing without one.
            tick_ns: The tick of a source that it is for; 0 of anything else.
            after: What the actor has seen, for a lock that waits for news; see `trigger_slots`.
            shown: All data of the set, if notices have brought them and nothing else is asked for.
        """
        entity = entity or self.only
        return ActorLock(
            self._bound_for(entity),
            entity=entity,
            wait_s=self.actor.wait_s if wait_s is None else wait_s,
            hold_s=self.actor.hold_s,
            stop=stop,
            together=self.declaration.together,
            members=members,
            tick_ns=tick_ns,
            triggers=self.declaration.triggers,
            after=after,
            shown=shown,
        )

    @property
    def views_one_set(self) -> bool:
        """Whether it asks only for a set, whose data are of one world context and on one shard.

        Then the notices of one watch, noted whole and in order, show the set as one cut.
        """
        views = self.set_views()
        if not views or len(views) < len(self.declaration.requests) or len(self.contexts) > 1:
            return False
        return len(session_of(views).shards_of(views)) == 1

    def trigger_slots(self) -> tuple[Slot, ...]:
        """Return the slot of each trigger if a lock can wait at its shard for their news; else ().

        It can where the triggers are data of one entity and all data of the lock lie on one shard.
        """
        declaration, triggers = self.declaration, self.declaration.triggers
        if declaration.outcome is not None or declaration.together is not None:
            return ()
        if self.only is None and declaration.per_entity:
            return ()
        bound = self._bound_for(self.only)
        requests = tuple(bound.values())
        each = any(one.access.each for one in triggers)
        if each or not any(request.access.locks for request in requests):
            return ()
        if not session_of(requests).client.stands_alone(bind(requests).items):
            return ()
        slots = tuple(slot_of(bound[one]) for one in triggers)
        return slots if len({slot.entity for slot in slots}) == 1 else ()

    def writes(self) -> tuple[str, ...]:
        """Return what the actor may write, as ``world:entities/aspect``."""
        requests = [one for one in self.declaration.requests.values() if one.access.writes]
        contexts = [self.contexts[one.world.name].name for one in requests]
        named = [narrowed(one, self.only) for one in requests]
        return tuple(
            f"{context}:{one.entity}/{one.aspect.name}"
            for context, one in zip(contexts, named, strict=True)
        )

    def once_lock(
        self, entity: Entity, *, wait_s: float | None = None, stop: threading.Event | None = None
    ) -> OnceLock:
        """Return the lock in which a version is taken that is acted on once; as `lock`."""
        return OnceLock(
            self._bound_for(entity),
            entity=entity,
            wait_s=self.actor.wait_s if wait_s is None else wait_s,
            hold_s=self.actor.hold_s,
            stop=stop,
            triggers=self.declaration.triggers,
        )

    def check_usable(self) -> None:
        """Raise `MisuseError` if the cell was closed, or belongs to a parent process."""
        for context in self.contexts.values():
            context.session.client.check_usable()

    def set_views(self) -> tuple[View[Any], ...]:
        """Return the views of the actor's set, bound; none without a set."""
        together = self.declaration.together
        return tuple(
            View(self.contexts[view.world.name], view.entity, view.aspect)
            for view in (together.requests if together is not None else ())
        )

    def pending_sets(self) -> PendingSets | None:
        """Return an empty account of the sets that trigger the actor; None without a set."""
        together = self.declaration.together
        if together is None:
            return None
        return together.pending([str(slot_of(view)) for view in self.set_views()])

    def covers(self, entity: Entity) -> bool:
        """Return whether a change of `entity` can trigger an update of the actor."""
        return self.declaration.covers(entity) and self.only in (None, entity)

    def watched(self) -> tuple[Watched, ...]:
        """Return what must be watched to see every change of a trigger datum."""
        groups: dict[tuple[str, str], list[int]] = {}
        triggers = self.declaration.triggers
        for index, trigger in enumerate(triggers):
            context = self.contexts[trigger.world.name].name
            entities = self.only or trigger.entity
            groups.setdefault((context, str(entities)), []).append(index)
        watched = []
        for (_, pattern), indices in groups.items():
            aspects = {triggers[index].aspect.name: triggers[index].aspect for index in indices}
            watched.append(
                Watched(
                    self.contexts[triggers[indices[0]].world.name],
                    Entities(pattern),
                    tuple(aspects.values()),
                    {
                        name: tuple(i for i in indices if triggers[i].aspect.name == name)
                        for name in aspects
                    },
                )
            )
        return tuple(watched)

    def _bound_for(self, entity: Entity | None) -> Mapping[Declared, Declared]:
        """Return the bound form of each declared request; made once per entity."""
        found = self._by_entity.get(entity)
        if found is None:
            requests = self.declaration.requests.values()
            found = {declared: self._bound(declared, entity) for declared in requests}
            if len(self._by_entity) >= ENTITIES_MAX:
                self._by_entity.clear()
            self._by_entity[entity] = found
        return found

    def _bound(self, declared: Declared, entity: Entity | None) -> Declared:
        named: Entity | Entities = declared.entity
        if stands_for_trigger(declared):
            if entity is None:
                raise MisuseError(
                    f"{self.declaration.name_of(declared)} stands for the triggering entity, and"
                    " there is none"
                )
            named = entity
        return type(declared)(self.contexts[declared.world.name], named, declared.aspect)

    def _names(self, worlds: Mapping[str, str] | None) -> dict[str, str]:
        roles = self.declaration.roles
        if worlds is None:
            return {role: role for role in roles}
        name = self.declaration.actor
        for role in worlds:
            if role not in roles:
                raise MisuseError(f"{name} has no role {role!r}; it has {', '.join(roles)}")
        for role in roles:
            if role not in worlds:
                raise MisuseError(
                    f"role {role!r} of {name} is bound to no world context; bind it with --world"
                    f" {role}=NAME; the cell has {', '.join(self.cell.worlds()) or 'none'}"
                )
        return {role: worlds[role] for role in roles}

    def _check(self, names: Mapping[str, str]) -> None:
        """Check again what the class checked by role: two roles may be one world context."""
        declaration = self.declaration
        requests = declaration.requests.values()
        by_context = [
            type(request)(self.contexts[request.world.name], request.entity, request.aspect)
            for request in requests
        ]
        try:
            refuse_duplicates(by_context)
        except ValueError as error:
            raise MisuseError(f"{declaration.actor} bound to {dict(names)}: {error}") from None
        for trigger in declaration.triggers:
            for request in requests:
                same_world = names[request.world.name] == names[trigger.world.name]
                if request.access.writes and same_world and same_data(request, trigger):
                    raise MisuseError(
                        f"{declaration.name_of(request)} writes what"
                        f" {declaration.name_of(trigger)} triggers on, because both roles are"
                        f" bound to {names[trigger.world.name]}: each update would cause the next"
                        " one; bind them to different world contexts"
                    )
