"""The catalogue of one shard: its world contexts, its aspects and how much history these retain.

Every hello is answered with all of it, so it is bounded: whatever clients register, a `Welcome`
stays below 4 MiB.  A store may hold more, from a release that had no bound: then the shard serves
it, shows of it what has room, and takes nothing new until some of it has gone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final, NamedTuple, TypeVar

from enact_dist.core.protocol.datum_types import type_conflict, with_type_of
from enact_dist.core.protocol.messages import (
    NO_ROOM,
    OVERLOAD,
    AspectEntry,
    Refused,
    WorldEntry,
    WriteItem,
)
from enact_dist.core.protocol.pages import bytes_in_frame
from enact_dist.core.state.history import Policy
from enact_dist.core.state.retention import covers, limits_of, with_larger
from enact_dist.terms import Durability

E = TypeVar("E")
_STRICTNESS: Final = (Durability.VOLATILE, Durability.OS, Durability.DURABLE)


WORLDS_MAX: Final = 4096
"""World contexts of a shard.  Every `Welcome` lists all: without a bound it outgrows its frame."""
ASPECTS_MAX: Final = 4096
"""Aspects of a shard, bounded for the same reason."""
FINGERPRINT_CHARACTERS_MAX: Final = 4096
"""Twice as much as `wire.fingerprint` makes of any type."""
CATALOGUE_BYTES_MAX: Final = 3 << 20
"""Bytes of all world contexts and aspects in a `Welcome`, which has 1 MiB left for the rest."""
REMEDY: Final = (
    "`enact world drop` takes away world contexts, `enact shard forget` aspects, `enact shard"
    " forget --unused`, while the cell is stopped, all that have no data"
)


class CatalogueExcerpt(NamedTuple):
    """What a `Welcome` shows of a catalogue, and how much it leaves out."""

    worlds: tuple[str, ...]
    aspects: tuple[AspectEntry, ...]
    forks: tuple[WorldEntry, ...]
    left_out: int


class Catalogue:
    """World contexts and aspects that this shard knows.

    Attributes:
        worlds: The world contexts by name; changed by `add_world` and `drop_world` alone.
        policies: How much of its history each aspect retains.
        successions: How often the type of some aspect has been succeeded by a newer one.
    """

    __slots__ = (
        "_configured",
        "_forks",
        "_shown",
        "aspects",
        "bytes",
        "policies",
        "successions",
        "worlds",
    )

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
        self._forks: dict[str, WorldEntry] = {}
        self.successions = 0
        self.bytes = 0
        self._shown: CatalogueExcerpt | None = None
        for world in worlds:
            # That it is a fork is known of a context which is also named elsewhere.
            if world.source or world.name not in self.worlds:
                self.add_world(world)
        for entry in recovered:
            self._set(self._with_configured(entry))

    def _set(self, entry: AspectEntry) -> None:
        before = self.aspects.get(entry.name)
        self.successions += len(entry.older) - (len(before.older) if before is not None else 0)
        self.bytes += bytes_in_frame(entry) - (bytes_in_frame(before) if before is not None else 0)
        self._shown = None
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

    def register(
        self, entry: AspectEntry, *, alters: bool = True
    ) -> tuple[AspectEntry, bool] | str:
        """Register an aspect; return its entry and whether it changed, or why it is refused.

        Without `alters` it is only compared with what is registered.
        """
        wanted = self._with_configured(entry)
        known = self.aspects.get(entry.name)
        if known is None and not alters:
            return wanted, False
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
        if now == known or not alters:
            return known, False
        self._set(now)
        return now, True

    def add_world(self, world: WorldEntry) -> None:
        """Add a world context, or say that one is a fork."""
        self.drop_world(world.name)
        self.worlds[world.name] = world
        if world.source:
            self._forks[world.name] = world
        self.bytes += _world_bytes(world)

    def drop_world(self, name: str) -> None:
        """Take away a world context, if it is there."""
        world = self.worlds.pop(name, None)
        self._forks.pop(name, None)
        self.bytes -= _world_bytes(world) if world is not None else 0
        self._shown = None

    def entries(self, names: Iterable[str]) -> dict[str, AspectEntry | None]:
        """Return the entries of aspects as they are now, None for each that is not here."""
        return {name: self.aspects.get(name) for name in names}

    def refusal(
        self, worlds: int, before: Mapping[str, AspectEntry | None], size: int
    ) -> Refused | None:
        """Return why what was registered just now is too much, None where it is not.

        Args:
            worlds: How many world contexts are new.
            before: `entries` of the aspects that were registered, as they were.
            size: `bytes` as it was.
        """
        for what, count, new, most in (
            ("world contexts", len(self.worlds), worlds, WORLDS_MAX),
            ("aspects", len(self.aspects), list(before.values()).count(None), ASPECTS_MAX),
            ("bytes of both", self.bytes, self.bytes - size, CATALOGUE_BYTES_MAX),
        ):
            if new > 0 and count > most:
                return _too_much(f"{new} {what} to the {count - new} that are here; at most {most}")
        for name, known in before.items():
            entry = self.aspects.get(name)
            if entry is None:
                continue
            length = len(entry.fingerprint)
            changed = known is None or known.fingerprint != entry.fingerprint
            if changed and length > FINGERPRINT_CHARACTERS_MAX:
                return _too_much(
                    f"aspect {entry.name!r} with a fingerprint of {length} characters; at most"
                    f" {FINGERPRINT_CHARACTERS_MAX}"
                )
        return None

    def room_for_world(self, world: WorldEntry) -> Refused | None:
        """Return why a world context cannot be added, None where it can."""
        size = self.bytes + _world_bytes(world)
        if len(self.worlds) < WORLDS_MAX and size <= CATALOGUE_BYTES_MAX:
            return None
        return Refused(
            NO_ROOM,
            f"asked to add {world.name!r} to the {len(self.worlds)} world contexts that are here;"
            f" at most {WORLDS_MAX}, of {CATALOGUE_BYTES_MAX} bytes with all aspects; {REMEDY}",
        )

    def shown(self) -> CatalogueExcerpt:
        """Return what a `Welcome` has room for: normally the whole catalogue.

        If it is too large, the smallest entries: a few large entries fill it, or very many.
        """
        if self._shown is None:
            self._shown = self._now_shown()
        return self._shown

    @property
    def left_out(self) -> int:
        """How many entries a `Welcome` has no room for.

        Any thread may look, also while another one changes the catalogue: nothing is kept of it.
        """
        return (self._shown or self._now_shown()).left_out

    def _now_shown(self) -> CatalogueExcerpt:
        all_aspects = tuple(self.aspects.values())
        if self.bytes <= CATALOGUE_BYTES_MAX:
            # Rebuilt after each registration: no Python step per entry.
            return CatalogueExcerpt(tuple(self.worlds), all_aspects, tuple(self._forks.values()), 0)
        all_worlds, half = tuple(self.worlds.values()), CATALOGUE_BYTES_MAX // 2
        aspects = tuple(_that_fit(sorted(all_aspects, key=bytes_in_frame), bytes_in_frame, half))
        worlds = tuple(_that_fit(all_worlds, _world_bytes, half))
        return CatalogueExcerpt(
            tuple(world.name for world in worlds),
            aspects,
            tuple(world for world in worlds if world.source),
            len(all_worlds) + len(all_aspects) - len(worlds) - len(aspects),
        )

    def put_back(self, before: Mapping[str, AspectEntry | None]) -> None:
        """Undo registrations that came to nothing; `before` is `entries` of them, as they were."""
        for name, entry in before.items():
            known = self.aspects.get(name)
            if known is None or known is entry:
                continue
            if entry is not None:
                self._set(entry)
                continue
            del self.aspects[name], self.policies[name]
            self.bytes -= bytes_in_frame(known)
            self.successions -= len(known.older)
            self._shown = None

    def newer_type(self, aspect: str, known_successions: int) -> AspectEntry | None:
        """Return the entry of an aspect that a client may know with an older type."""
        if known_successions == self.successions:
            return None
        entry = self.aspects.get(aspect)
        return entry if entry is not None and entry.older else None

    def durability(self, aspect: str) -> Durability:
        """Return what a commit of this (registered) aspect survives."""
        return _DURABILITIES[self.aspects[aspect].durability]

    def strictest(self, writes: Iterable[WriteItem]) -> Durability:
        """Return what a commit of these must survive: the most that one of its data asks for."""
        strictest = Durability.VOLATILE
        for slot, _ in writes:
            durability = self.durability(slot.aspect)
            if durability is not strictest:
                strictest = max(strictest, durability, key=_STRICTNESS.index)
        return strictest


def _world_bytes(world: WorldEntry) -> int:
    return bytes_in_frame(world.name) + (bytes_in_frame(world) if world.source else 0)


def _that_fit(entries: Iterable[E], bytes_of: Callable[[E], int], most: int) -> Iterator[E]:
    """Yield the first entries, as many as have so many bytes."""
    for entry in entries:
        most -= bytes_of(entry)
        if most < 0:
            return
        yield entry


def _too_much(what: str) -> Refused:
    return Refused(OVERLOAD, f"asked to add {what}; {REMEDY}")


_DURABILITIES: Final = {durability.value: durability for durability in Durability}
