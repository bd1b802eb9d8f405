"""What a client knows of the shards' catalogues: world contexts and aspects, by shard.

A shard without a folder loses its catalogue when it restarts; `forget` then makes the client
register its needs there again.  A shard with a folder may also have purged an aspect, or registered
it with another type since (`enact shard forget`), and on any shard a newer type may have succeeded
the known one; `lapses` counts these events.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.datum_types import newest, same_type, successions, type_conflict
from enact_dist.core.messages import AspectEntry, Registered, Welcome, WorldEntry
from enact_dist.core.retaining import covers

if TYPE_CHECKING:
    from collections.abc import Container, Iterable

    from enact_dist.core.messages import PlacementMap

CATALOGUES: Final = (Welcome, Registered)
"""The answers that carry a catalogue."""


class KnownCatalogue:
    """The newest catalogue of each shard that was greeted.

    One thread at a time changes it, any thread may read: published objects are complete.

    Attributes:
        lapses: How often a shard had lost an aspect or had it with another type.
    """

    def __init__(self) -> None:
        self.lapses = 0
        self._epochs: dict[str, int] = {}
        self._successions: dict[str, int] = {}
        self._aspects: dict[str, dict[str, AspectEntry]] = {}
        self._wanted: dict[str, AspectEntry] = {}
        self._worlds: dict[str, dict[str, WorldEntry]] = {}
        self._settled: tuple[PlacementMap | None, set[AspectEntry]] = (None, set())

    def learn(self, shard: str, answer: Welcome | Registered, *, sent_in: int = 0) -> None:
        """Take the catalogue that an answer carries; ignore that of a past epoch.

        Args:
            shard: The answering shard.
            answer: Its answer.
            sent_in: The epoch in which the request was sent; only a welcome names the answer's
                epoch.
        """
        epoch = answer.epoch if isinstance(answer, Welcome) else sent_in
        known = self._epochs.get(shard, 0)
        changes = successions(answer.aspects)
        if epoch < known or (epoch == known and changes < self._successions.get(shard, 0)):
            return  # older than the known state
        self._successions[shard] = changes
        if isinstance(answer, Welcome):
            self._epochs[shard] = epoch
        worlds = {name: WorldEntry(name) for name in answer.worlds}
        self._worlds[shard] = worlds | {entry.name: entry for entry in answer.forks}
        before = self._aspects.get(shard, {})
        now = self._aspects[shard] = {entry.name: entry for entry in answer.aspects}
        self._settled = (None, set())  # afterwards, so that no thread uses the old state
        if not all(
            name in now and same_type(now[name].fingerprint, entry.fingerprint)
            for name, entry in before.items()
        ):
            self.lapses += 1

    def wants(self, aspects: Iterable[AspectEntry]) -> None:
        """Note the aspects that this client registers, for writing or only for reading."""
        for entry in aspects:
            if not entry.reads or entry.name not in self._wanted:
                self._wanted[entry.name] = entry

    def wanted(self, names: Container[str]) -> list[AspectEntry]:
        """Return what this client has registered, for registering it again where it was lost."""
        wanted = list(self._wanted.values())  # other threads add entries
        return [entry for entry in wanted if entry.name in names]

    def successions(self, shard: str) -> int:
        """Return how many successions of datum types the newest catalogue of a shard has."""
        return self._successions.get(shard, 0)

    def forget(self, shard: str) -> None:
        """Drop the aspects known of a shard, because its catalogue proved wrong."""
        self._aspects.pop(shard, None)
        self._settled = (None, set())
        self.lapses += 1

    def settled(self, aspects: Iterable[AspectEntry], placement: PlacementMap) -> bool:
        """Whether these aspects can be used without asking any shard of a placement.

        The result is cached until a catalogue changes, because every lock asks.
        """
        settled_for, settled = self._settled
        if placement is not settled_for:
            settled = set()
            self._settled = (placement, settled)
        for entry in aspects:
            if entry not in settled:
                if any(self.lacks(shard.name, (), (entry,)) for shard in placement.shards):
                    return False
                settled.add(entry)
        return True

    def worlds(self) -> dict[str, WorldEntry]:
        """Return the world contexts that every greeted shard knows as the same fork."""
        known = [set(worlds.values()) for worlds in list(self._worlds.values())]
        common = set.intersection(*known) if known else set()
        return {entry.name: entry for entry in sorted(common)}

    def worlds_at(self, name: str) -> dict[str, WorldEntry]:
        """Return the shards that know a world context, each with its entry."""
        known = list(self._worlds.items())
        return {shard: worlds[name] for shard, worlds in known if name in worlds}

    def aspects(self) -> dict[str, AspectEntry]:
        """Return the registered aspects of all greeted shards by name, with the newest types."""
        merged: dict[str, AspectEntry] = {}
        for aspects in list(self._aspects.values()):
            for name, entry in aspects.items():
                merged[name] = newest(merged.get(name, entry), entry) or entry
        return merged

    def lacks(self, shard: str, worlds: Iterable[str], aspects: Iterable[AspectEntry]) -> bool:
        """Whether the shard must be asked before these can be used on it."""
        known = self._aspects.get(shard, {})
        return not all(_agrees(known.get(entry.name), entry) for entry in aspects) or not set(
            worlds
        ) <= set(self._worlds.get(shard, {}))


def _agrees(known: AspectEntry | None, wanted: AspectEntry) -> bool:
    if known is None or type_conflict(known, wanted):
        return False
    return (
        (wanted.reads or same_type(known.fingerprint, wanted.fingerprint))
        and wanted.durability in ("", known.durability)
        and covers(known, wanted)
    )
