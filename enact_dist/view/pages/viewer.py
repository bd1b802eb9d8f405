"""What all pages share: a cell or a recording, its feed, and what they may ask."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.watch import Closing
from enact_dist.config.shows import GUESSED
from enact_dist.core.protocol.datum import Position
from enact_dist.errors import MisuseError, UnknownWorldError
from enact_dist.view.activity import Activity, CellActivity
from enact_dist.view.feed import Feed
from enact_dist.view.source import CellSource
from enact_dist.view.timeline import Timeline
from enact_dist.world.cell import Cell

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from enact_dist.compare.diff import Diff
    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.terms import Aspect
    from enact_dist.view.pages.comparing import Side
    from enact_dist.view.recorded import RecordingFeed, RecordingSource
    from enact_dist.world.lineage import Made

BYTES_S: Final = 150e6
RATE_HZ: Final = 10.0


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """How a cell or a recording is shown.

    Attributes:
        shows: What aspects are shown as; unnamed ones are guessed.
        world: The world context that a page begins with; "": the first.
        rate_hz: Most updates of a page per second.
        bytes_s: Most bytes that are fetched from the cell per second.
        aspects: Returns the aspects that have a comparator; all others are compared exactly.
        pin: Pins versions under a label.
    """

    shows: Mapping[str, Shows] = field(default_factory=dict)
    world: str = ""
    rate_hz: float = RATE_HZ
    bytes_s: float = BYTES_S
    aspects: Callable[[], Sequence[Aspect[Any]]] = tuple
    pin: Callable[[str, list[Made]], None] | None = None


class Viewer(Closing):
    """A cell, or a recording, as pages see it; also a context manager.

    Args:
        shown: An observer's connection, or a recording.
        settings: How it is shown.

    Raises:
        UnknownWorldError: It does not have the world context that pages are to begin with.
        ShardUnreachableError: A shard that may know that one does not answer.

    Attributes:
        feed: The present.
        source: The past.
        cell: The cell, None of a recording.
        timeline: All moments of a recording.
    """

    def __init__(self, shown: Cell | RecordingSource, settings: ViewSettings) -> None:
        self.shows, self.world = settings.shows, settings.world
        self.rate_hz, self._settings = settings.rate_hz, settings
        self.timeline = Timeline()
        self._activity: Activity | None = None
        self.feed: Feed | RecordingFeed
        self.source: CellSource | RecordingSource
        self.cell: CellSource | None = None
        if not isinstance(shown, Cell):
            from enact_dist.view.recorded import RecordingFeed

            known = shown.catalogue.worlds()
            if self.world and self.world not in known:
                raise UnknownWorldError(
                    f"{shown.name} has no world context {self.world!r} (it has {', '.join(known)})",
                    known=tuple(known),
                )
            self.name, self.source, self.timeline = shown.name, shown, shown.timeline
            self.feed = RecordingFeed(shown, self._shows_of)
            return
        if self.world:
            shown.world(self.world)
        self.name, self.source = shown.name, CellSource(shown)
        self.cell = self.source
        self.feed = Feed(
            self.source, self._shows_of, rate_hz=settings.rate_hz, bytes_s=settings.bytes_s
        )
        self.feed.catalogue.keep(self.source.session.client.worlds())
        self._activity = Activity(self.source, self.feed.catalogue)
        self.feed.start()
        self._activity.start()

    def _shows_of(self, aspect: str) -> Shows:
        return self.shows.get(aspect, GUESSED)

    def close(self) -> None:
        """End its threads; twice is harmless."""
        if self._activity is not None:
            self._activity.stop()
        if isinstance(self.feed, Feed):
            self.feed.stop()

    # ------------------------------------------------------------ for pages

    def list_for(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which data a page lists; None: the page has gone."""
        if self._activity is not None:
            self._activity.list(page, slots)

    def entry(self, slot: Slot) -> VersionEntry | None:
        """Return size and writer of a listed slot's newest version, as far as they are known."""
        return self._activity.entry(slot) if self._activity is not None else None

    def size(self, slot: Slot) -> int | None:
        """Return the bytes of a listed slot's newest datum, None if they are not known."""
        if isinstance(self.source, CellSource):
            entry = self.entry(slot)
            return entry.state.size if entry is not None else None
        return self.source.size(slot)

    def type_of(self, aspect: str) -> str:
        """Return the type of an aspect in a few words; "" if it is not known."""
        return self._activity.type_of(aspect) if self._activity is not None else ""

    def activity_now(self) -> CellActivity:
        """Return locks, actors and shards."""
        return self._activity.now if self._activity is not None else CellActivity()

    def compare(self, left: Side, right: Side) -> Diff:
        """Return how two world contexts differ, each as of a moment.

        Raises:
            EnactError: A moment is forgotten, a shard does not answer, or a comparator is missing.
        """
        if self.cell is None:
            raise MisuseError("a recording has no difference; replay it into a cell")
        cell = self.cell.cell
        first, second = (cell.world(side.world).at(_moment(side.at_ns)) for side in (left, right))
        compared = {aspect.name: aspect for aspect in self._settings.aspects()}
        names = self.cell.session.typed_aspects()
        return first.diff(second, "**", *(compared.get(name, name) for name in names))

    def pin(self, label: str, versions: list[Made]) -> None:
        """Pin versions: the one thing that a page changes, and only if a person asks for it.

        Raises:
            EnactError: They cannot be pinned.
        """
        if self._settings.pin is None:
            raise MisuseError("nothing can be pinned in what is shown here")
        self._settings.pin(label, versions)


def _moment(at_ns: int) -> Position:
    """Return a timestamp as `WorldContext.at` takes it; seconds as a float would round it."""
    return Position(at_ns, "")
