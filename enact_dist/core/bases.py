"""Above which versions slots start, and since when they are known, after something was forgotten.

A context that was dropped and an aspect that was forgotten are gone with all their slots.  What is
made under the name again starts above all earlier versions; so does a slot of a context and an
aspect
of which both were, above the higher one.  No version is ever used twice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from enact_dist.core.records import AspectForgotten, WorldDropped


class Bases:
    """The versions above which the slots of contexts, or of aspects, start by their names."""

    __slots__ = ("_by_entity", "_by_name")

    def __init__(self, records: Iterable[WorldDropped] | Iterable[AspectForgotten]) -> None:
        self._by_name: dict[str, int] = {}
        self._by_entity: dict[str, dict[str, int]] = {}
        for record in records:
            by_entity = {entity: base for entity, base, *_ in record.entity_bases}
            self.set(record.name, record.version_base, by_entity)

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


class AspectBases(Bases):
    """The same of aspects, and up to which stamps the contents of their slots are unknown."""

    __slots__ = ("_at_ns", "_at_ns_by_entity")

    def __init__(self, records: Collection[AspectForgotten]) -> None:
        super().__init__(records)
        self._at_ns = {record.name: record.at_ns for record in records}
        self._at_ns_by_entity = {
            record.name: {entity: at_ns for entity, _, at_ns in record.entity_bases}
            for record in records
        }

    def forgotten_ns(self, aspect: str, entity: str = "") -> int:
        """Return up to which stamp nothing is known of an aspect, or of an entity's (0: all is).

        Without an entity, of all that there may have been: any other one knows as much or more.
        """
        at_ns = self._at_ns.get(aspect, 0)
        return self._at_ns_by_entity[aspect].get(entity, at_ns) if at_ns else 0

    def last(self) -> tuple[int, str]:
        """Return the latest stamp up to which nothing is known of an aspect (0: all is), and it."""
        return max(((at_ns, name) for name, at_ns in self._at_ns.items()), default=(0, ""))
