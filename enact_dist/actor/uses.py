"""What `actor.check` and `actor.graph` look at: actors of a cell and their requests.

From the same declarations follow the rights of each actor (`declared_rights`): to read what it
requests, and to write what it may write.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from enact_dist.actor.actor import Actor, Declared, narrowed, same_data, stands_for_trigger
from enact_dist.actor.running.commands import ACTOR, COMMANDS
from enact_dist.config.rights import AllowTable
from enact_dist.terms import Entity


@dataclass(frozen=True, slots=True)
class ActorDeclaration:
    """One actor of a cell: under which name it runs, its class, what its roles are bound to.

    `worlds` None binds each role to the world context of the same name, as running it does;
    `entity` is the only one that it works on, or None for no such limit; `every_s` replaces the
    period of its class.
    """

    name: str
    actor_class: type[Actor]
    worlds: Mapping[str, str] | None = None
    entity: Entity | None = None
    every_s: float | None = None

    @property
    def period_s(self) -> float | None:
        """Its period in seconds, if it is a source."""
        return self.every_s or self.actor_class.every_s

    @property
    def unsaid(self) -> bool:
        """Whether it works on one entity that the declaration does not name."""
        declaration = self.actor_class.declaration
        return self.entity is None and declaration.per_entity and not declaration.triggers

    def world_of(self, role: str) -> str | None:
        """Return the world context that a role is bound to."""
        return role if self.worlds is None else self.worlds.get(role)


@dataclass(frozen=True, slots=True)
class Use:
    """One declared request of one actor, its role bound."""

    actor: ActorDeclaration
    name: str
    request: Declared
    world: str

    @property
    def unsaid(self) -> bool:
        """Whether it is of one entity that the declaration does not name."""
        return self.actor.unsaid and stands_for_trigger(self.request)

    @property
    def named(self) -> Declared:
        """What the request can name in this actor."""
        return narrowed(self.request, self.actor.entity)

    @property
    def shared(self) -> bool:
        """Whether it is a write that others share on purpose."""
        return self.request in self.actor.actor_class.declaration.shared

    def meets(self, other: Use) -> bool:
        """Whether both could name one datum."""
        return self.world == other.world and same_data(self.named, other.named)

    def __str__(self) -> str:
        _, entity, aspect = self.named.address
        access = type(self.request).__name__
        return f"{self.actor.name}.{self.name} ({access} {self.world}/{entity} {aspect})"


def uses_of(actors: Iterable[ActorDeclaration]) -> Iterator[Use]:
    """Yield every declared request whose role is bound."""
    for actor in actors:
        for name, request in actor.actor_class.declaration.requests.items():
            world = actor.world_of(request.world.name)
            if world is not None:
                yield Use(actor, name, request, world)


def declared_rights(actors: Sequence[ActorDeclaration]) -> tuple[AllowTable, ...]:
    """Return what each actor may do by its declaration, and obey commands to it.

    A write gives the right to read, too, since a lock shows its data.
    """
    found: dict[str, tuple[set[str], set[str]]] = {}
    for use in uses_of(actors):
        reads, writes = found.setdefault(use.actor.name, (set(), set()))
        _, entity, aspect = use.named.address
        data = {f"{use.world}:{entity}/{aspect}"}
        commands = {f"{use.world}:{ACTOR}/{COMMANDS}"}
        reads |= data | commands
        writes |= commands | (data if use.named.access.writes else set())
    return tuple(
        AllowTable((name,), tuple(sorted(reads)), tuple(sorted(writes)))
        for name, (reads, writes) in found.items()
    )
