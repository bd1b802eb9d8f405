"""The catalogue of one shard: its world contexts, its aspects and how much history these retain."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.datum_types import successions, type_conflict, with_type_of
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
        successions: How often the type of some aspect has been succeeded by a newer one.
    """

    __slots__ = ("_configured", "aspects", "policies", "successions", "worlds")

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
        self.successions = 0
        for world in worlds:
            # That it is a fork is known of a context which is also named elsewhere.
            if world.source or world.name not in self.worlds:
                self.worlds[world.name] = world
        for entry in recovered:
            self._set(self._with_configured(entry))

    def _set(self, entry: AspectEntry) -> None:
        before = self.aspects.get(entry.name)
        self.successions += len(entry.older) - (len(before.older) if before is not None else 0)
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
            wanted = wanted._replace(older=(), reads=False)
            self._set(wanted)
            return wanted, True
        wrong = type_conflict(known, wanted)
        if wrong:
            return wrong
        if entry.durability and known.durability != wanted.durability:
            return (
                f"aspect {entry.name!r} is registered as {known.durability}, and was now asked as"
                f" {wanted.durability}; state one durability in cell.toml or in Aspect(…)"
            )
        now = with_type_of(known, wanted)
        if not covers(known, wanted):
            now = with_larger(now, wanted)
        if now == known:
            return known, False
        self._set(now)
        return now, True

    def put_back(self, aspects: Mapping[str, AspectEntry]) -> None:
        """Undo registrations that came to nothing."""
        for name in [name for name in self.aspects if name not in aspects]:
            del self.aspects[name], self.policies[name]
        for entry in aspects.values():
            self._set(entry)
        self.successions = successions(self.aspects.values())

    def newer_type(self, aspect: str, known_successions: int) -> AspectEntry | None:
        """Return the entry of an aspect that a client may know with an older type.

        Args:
            aspect: Name of the aspect.
            known_successions: How many successions of types, of all aspects, the client knows.
        """
        if known_successions == self.successions:
            return None
        entry = self.aspects.get(aspect)
        return entry if entry is not None and entry.older else None

    def forks(self) -> tuple[WorldEntry, ...]:
        """Return the world contexts that are forks."""
        return tuple(world for world in self.worlds.values() if world.source)

    def durability(self, aspect: str) -> Durability:
        """Return what a commit of this (registered) aspect survives."""
        return _DURABILITIES[self.aspects[aspect].durability]


_DURABILITIES: Final = {durability.value: durability for durability in Durability}
