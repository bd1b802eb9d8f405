"""What a client knows of the shards' catalogues: world contexts and aspects, shard by shard.

A shard that keeps nothing on disk forgets its catalogue when it restarts; `forget` then makes the
client register anew what it needs there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.messages import AspectEntry, Registered, Welcome

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.messages import Answer


class KnownCatalogue:
    """The newest catalogue of each shard that was greeted."""

    def __init__(self) -> None:
        self._aspects: dict[str, dict[str, AspectEntry]] = {}
        self._worlds: dict[str, tuple[str, ...]] = {}

    def learn(self, shard: str, answer: Answer) -> None:
        """Take a catalogue from an answer that carries one."""
        if isinstance(answer, Welcome | Registered):
            self._worlds[shard] = answer.worlds
            self._aspects[shard] = {entry.name: entry for entry in answer.aspects}

    def forget(self, shard: str) -> None:
        """Forget the aspects of a shard, which does not know what it was said to know."""
        self._aspects.pop(shard, None)

    def worlds(self) -> tuple[str, ...]:
        """Return the world contexts that every greeted shard knows."""
        known = [set(worlds) for worlds in list(self._worlds.values())]
        return tuple(sorted(set.intersection(*known))) if known else ()

    def aspects(self) -> dict[str, AspectEntry]:
        """Return the registered aspects of all greeted shards by name."""
        merged: dict[str, AspectEntry] = {}
        for aspects in list(self._aspects.values()):
            merged.update(aspects)
        return merged

    def lacks(self, shard: str, worlds: Iterable[str], aspects: Iterable[AspectEntry]) -> bool:
        """Whether the shard must be asked before these can be used there."""
        known = self._aspects.get(shard, {})
        return not all(_agrees(known.get(entry.name), entry) for entry in aspects) or not set(
            worlds
        ) <= set(self._worlds.get(shard, ()))


def _agrees(known: AspectEntry | None, wanted: AspectEntry) -> bool:
    return (
        known is not None
        and known.fingerprint == wanted.fingerprint
        and wanted.durability in ("", known.durability)
        and wanted.retention <= known.retention
    )
