"""Above which versions slots start: none is ever used twice, whatever was forgotten before.

A context that was dropped and an aspect that was forgotten are gone with all their slots.  What is
made under the name again starts above all that there was; so does a slot of a context and an aspect
of which both were, above the higher one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.records import AspectForgotten, WorldDropped


class Bases:
    """The versions above which the slots of contexts, or of aspects, start by their names."""

    __slots__ = ("_by_entity", "_by_name")

    def __init__(self, records: Iterable[WorldDropped] | Iterable[AspectForgotten]) -> None:
        self._by_name: dict[str, int] = {}
        self._by_entity: dict[str, dict[str, int]] = {}
        for record in records:
            self.set(record.name, record.version_base, dict(record.entity_bases))

    def set(self, name: str, base: int, by_entity: dict[str, int] | None = None) -> None:
        """Let slots of a name start above `base`, those of entities from elsewhere by theirs."""
        self._by_name[name] = base
        self._by_entity[name] = by_entity or {}

    def of_name(self, name: str) -> int:
        """Return the base of a name."""
        return self._by_name.get(name, 0)

    def of(self, name: str, entity: str) -> int:
        """Return the base of the slots that an entity has under a name."""
        base = self._by_name.get(name, 0)
        return self._by_entity[name].get(entity, base) if base else 0
