"""Where the shards of a cell are expected, by this shard and by those that talk to it.

Two daemons under one shard's name, from two folders, are two shards: what one client reads another
never wrote.  No shard sees that from its own file alone.  Shards therefore tell each other where
they expect each shard whenever one comes into reach of another, and pass on what is new to them.
At a place that a shard did not know it has the link ask which daemon serves there (`Compare`).  Two
daemons are an alarm until one of them is gone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import ListPlaces, Places, ShardEntry
from enact_dist.core.protocol.records import Call, Compare, LogEvent, Reply

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.protocol.records import Effect, Served, ShardReturned
    from enact_dist.core.shard.state import ShardState

PLACES_MAX: Final = 8
"""So many places that this shard's own cell.toml does not name are remembered of each shard."""
PLACE_CHARACTERS_MAX: Final = 256


class PlaceHandler:
    """The places of all shards of the cell."""

    def __init__(self, state: ShardState) -> None:
        self._state = state
        self._expected = {entry.name: entry.endpoints for entry in state.settings.placement.shards}
        self._heard: dict[str, list[str]] = {}

    def on_list_places(self, message: ListPlaces, reply_to: int) -> Iterator[Effect]:
        """Say where this shard expects each shard; take what another shard says."""
        yield Reply(reply_to, Places(self._all()))
        if message.shard:
            yield from self._hear(message.shards)

    def on_called(self, answer: Places) -> Iterator[Effect]:
        """Take where another shard expects each shard."""
        yield from self._hear(answer.shards)

    def on_shard_returned(self, message: ShardReturned) -> Iterator[Effect]:
        """Compare places with a shard that has come into reach."""
        yield Call(message.shard, self._ours())

    def on_served(self, message: Served, _: int) -> Iterator[Effect]:
        """Take which daemons serve a shard: more than one are an alarm."""
        shard, doubled = message.shard, self._state.doubled
        before = doubled.get(shard)
        if len(message.starts) > 1:
            doubled[shard] = message.starts
            if before != message.starts:
                self._state.count("namesakes_found")
                yield LogEvent("shard.namesakes", message.text, grave=True)
        elif before is not None:
            del doubled[shard]
            count = "one daemon answers" if message.starts else "no daemon answers"
            text = f"{count} for shard {shard} now; another one may be stopped or cut off"
            yield LogEvent("shard.alone", text)

    def _all(self) -> tuple[ShardEntry, ...]:
        """Return the places of this shard's own file, then those that others have named."""
        heard = (ShardEntry(shard, tuple(places)) for shard, places in self._heard.items())
        return (*self._state.settings.placement.shards, *heard)

    def _ours(self) -> ListPlaces:
        return ListPlaces(self._state.settings.name, self._all())

    def _hear(self, shards: Iterable[ShardEntry]) -> Iterator[Effect]:
        named = {}
        news = False
        for shard, places in shards:
            expected = self._expected.get(shard)
            if not expected or not places:
                continue
            heard = self._heard.get(shard, [])
            new = [place for place in places if place not in expected and place not in heard]
            new = [place for place in new if len(place) <= PLACE_CHARACTERS_MAX]
            heard = [*heard, *new][:PLACES_MAX]
            if heard:
                news = news or heard != self._heard.get(shard)
                self._heard[shard] = heard
                named[shard] = (*expected, *heard)
        for shard, places in named.items():
            yield Compare(shard, places)
        if news:
            for other in sorted(self._state.peers):
                yield Call(other, self._ours())
