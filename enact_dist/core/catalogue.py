"""The catalogue of one shard: its world contexts, its aspects and how much history these retain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.history import Policy
from enact_dist.core.retaining import covers, limits_of, with_larger
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.core.messages import AspectEntry, WorldEntry


class Catalogue:
    """World contexts and aspects that this shard knows.

    Attributes:
        policies: How much of its history each aspect retains.
    """

    __slots__ = ("_configured", "aspects", "policies", "worlds")

    def __init__(
        self,
        *,
        configured: Iterable[AspectEntry],
        recovered: Iterable[AspectEntry],
        worlds: Iterable[WorldEntry],
    ) -> None:
        self._configured = {entry.name: entry for entry in configured}
        self.aspects: dict[str, AspectEntry] = {}
        self.policies: dict[str, Policy] = {}
        self.worlds: dict[str, WorldEntry] = {}
        for world in worlds:
            # That it is a fork is known of a context which is also named elsewhere.
            if world.source or world.name not in self.worlds:
                self.worlds[world.name] = world
        for entry in recovered:
            self._set(self._with_configured(entry))

    def _set(self, entry: AspectEntry) -> None:
        self.aspects[entry.name] = entry
        stored = entry.durability != Durability.VOLATILE.value
        self.policies[entry.name] = Policy(limits_of(entry), stored)

    def _with_configured(self, entry: AspectEntry) -> AspectEntry:
        """Let the cell's configuration decide the durability, and the larger retention count."""
        configured = self._configured.get(entry.name)
        durability = configured.durability if configured else ""
        durability = durability or entry.durability or Durability.DURABLE.value
        entry = entry._replace(durability=durability)
        return with_larger(entry, configured) if configured else entry

    def register(self, entry: AspectEntry) -> tuple[AspectEntry, bool] | str:
        """Register an aspect; return its entry and whether it changed, or why it is refused."""
        wanted = self._with_configured(entry)
        known = self.aspects.get(entry.name)
        if known is None:
            self._set(wanted)
            return wanted, True
        wrong = other_type(known, wanted)
        if wrong:
            return wrong
        if entry.durability and known.durability != wanted.durability:
            return (
                f"aspect {entry.name!r} is registered as {known.durability}, and was now asked as"
                f" {wanted.durability}; state one durability in cell.toml or in Aspect(…)"
            )
        if covers(known, wanted):
            return known, False
        larger = with_larger(known, wanted)
        self._set(larger)
        return larger, True

    def put_back(self, aspects: Mapping[str, AspectEntry]) -> None:
        """Undo registrations that came to nothing."""
        for name in [name for name in self.aspects if name not in aspects]:
            del self.aspects[name], self.policies[name]
        for entry in aspects.values():
            self._set(entry)

    def forks(self) -> tuple[WorldEntry, ...]:
        """Return the world contexts that are forks."""
        return tuple(world for world in self.worlds.values() if world.source)

    def durability(self, aspect: str) -> Durability:
        """Return what a commit of this (registered) aspect survives."""
        return _DURABILITIES[self.aspects[aspect].durability]


def other_type(known: AspectEntry, wanted: AspectEntry) -> str:
    """Return that an aspect is of another type than is `wanted`; nothing where it is of that."""
    if known.fingerprint == wanted.fingerprint:
        return ""
    return (
        f"aspect {known.name!r} is registered with datum type {known.fingerprint}, and was"
        f" now asked with {wanted.fingerprint}; use the registered type or another name, or give up"
        f" its data for the new type: stop the cell and call `enact shard forget {known.name}`"
    )


_DURABILITIES: Final = {durability.value: durability for durability in Durability}
