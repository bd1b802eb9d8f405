"""What a client knows of the shards' catalogues: world contexts and aspects, by shard.

A shard without a folder loses its catalogue when it restarts; `forget` then makes the client
register its needs there again.  A shard with a folder may also have purged an aspect, or registered
it with another type since (`enact shard forget`), and on any shard a newer type may have succeeded
the known one; `lapses` counts these events.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.datum_types import newest, same_type, successions, type_conflict
from enact_dist.core.protocol.messages import AspectEntry, Registered, Welcome, WorldEntry
from enact_dist.core.state.clock import is_older
from enact_dist.core.state.retention import covers
from enact_dist.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Container, Iterable

    from enact_dist.core.protocol.messages import PlacementMap, Request
    from enact_dist.link.carrier import Carrier
    from enact_dist.link.client.duplicate_daemons import Doubts

PAUSE_NS: Final = 1_000_000_000
"""Pause after a failure: each attempt may open a session."""

_log = logging.getLogger("enact.link")


class FurtherShards:
    """Follows the placement of one session.  Thread-safe.

    It runs after each answer, which stays valid, so it raises nothing: a caller that got an error
    for its commit would write twice.

    Args:
        carrier: Connects to the shards.
        linked: The placement whose shards are connected already.
        now_ns: The session's clock.
        count: Called with the name of a counter.
        doubts: Receives the endpoints in a placement; None: there can be no doubt.

    Attributes:
        linked: The placement whose shards are connected now.
        doubted: The shards that `check` may refuse.
    """

    def __init__(
        self,
        carrier: Carrier,
        linked: PlacementMap,
        now_ns: Callable[[], int],
        count: Callable[[str], None],
        doubts: Doubts | None = None,
    ) -> None:
        self._carrier, self.linked = carrier, linked
        self._doubts = doubts
        self.doubted: Collection[str] = doubts.doubted if doubts is not None else ()
        self._now_ns, self._count = now_ns, count
        self._mutex = threading.Lock()
        self._not_before_ns: int | None = None

    def follow(self, placement: PlacementMap) -> None:
        """Connect to the shards of a placement that was just received.

        After a failure it tries again after a pause; if another thread is connecting, the next
        answer triggers another look.
        """
        if placement is self.linked or not self._mutex.acquire(blocking=False):
            return
        try:
            if self._not_before_ns is not None and self._now_ns() < self._not_before_ns:
                return
            if placement != self.linked:
                self._hear(placement)
                self._carrier.add_endpoints(placement.shards)
            self.linked, self._not_before_ns = placement, None
        except ConfigError as error:  # an endpoint that can never be reached is logged once
            self.linked, self._not_before_ns = placement, None
            self._count("connects_failed")
            _log.error("not every shard of the cell can be reached: %s", error)
        except Exception as error:  # noqa: BLE001 - the answer that brought us here stands
            self._not_before_ns = self._now_ns() + PAUSE_NS
            self._count("connects_failed")
            _log.warning("not every shard of the cell is connected, trying again: %s", error)
        finally:
            self._mutex.release()

    def _hear(self, placement: PlacementMap) -> None:
        for text in self._doubts.hear(placement.shards) if self._doubts is not None else ():
            self._count("shards_doubted")
            _log.error("%s", text)

    def check(self, calls: Iterable[tuple[str, Request]]) -> None:
        """Raise if a shard that is to be called is served by several daemons.

        Raises:
            LinkError: More than one daemon serves the shard; the message names them.
        """
        for shard, _ in calls:
            text = self._doubts.about(shard) if self._doubts is not None else ""
            if text:
                raise LinkError(text)


CATALOGUES: Final = (Welcome, Registered)
"""The answers that carry a catalogue."""


class KnownCatalogue:
    """The newest catalogue of each shard that was greeted.

    One thread at a time changes it, any thread may read: published objects are complete.

    Attributes:
        lapses: How often a shard had lost an aspect or had it with another type.
        state: A placement, and the aspects found settled on all its shards; another object after
            each change of a catalogue.
    """

    def __init__(self) -> None:
        self.lapses = 0
        self._epochs: dict[str, int] = {}
        self._successions: dict[str, int] = {}
        self._aspects: dict[str, dict[str, AspectEntry]] = {}
        self._wanted: dict[str, AspectEntry] = {}
        self._worlds: dict[str, dict[str, WorldEntry]] = {}
        self.state: tuple[PlacementMap | None, set[AspectEntry]] = (None, set())

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
        fewer = epoch == known and changes < self._successions.get(shard, 0)
        if fewer or is_older(epoch, known):
            return  # older than the known state
        self._successions[shard] = changes
        if isinstance(answer, Welcome):
            self._epochs[shard] = epoch
        worlds = {name: WorldEntry(name) for name in answer.worlds}
        self._worlds[shard] = worlds | {entry.name: entry for entry in answer.forks}
        before = self._aspects.get(shard, {})
        now = self._aspects[shard] = {entry.name: entry for entry in answer.aspects}
        self.state = (None, set())  # afterwards, so that no thread uses the old state
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
        self.state = (None, set())
        self.lapses += 1

    def settled(self, aspects: Iterable[AspectEntry], placement: PlacementMap) -> bool:
        """Whether these aspects can be used without asking any shard of a placement.

        The result is cached until a catalogue changes, because every lock asks.
        """
        settled_for, settled = self.state
        if placement is not settled_for:
            settled = set()
            self.state = (placement, settled)
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
