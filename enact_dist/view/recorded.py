"""A recording as a source: of each version it knows where it lies in the file.

The file is read through once.  From then on only the versions that a page asks for are read.
"""

from __future__ import annotations

import copy
from array import array
from bisect import bisect_right
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import ProtocolError
from enact_dist.recording.causes import RecordedLineage
from enact_dist.recording.reading import MessagePlace, Recording
from enact_dist.view.catalogue import ListedState, SlotCatalogue
from enact_dist.view.drawing.scene import ShownDatum, shown_of
from enact_dist.view.feed import drawable
from enact_dist.view.source import FoundData
from enact_dist.view.timeline import Timeline

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.recording.exact import Recorded
    from enact_dist.recording.reading import RecordedCommit
    from enact_dist.view.source import Histories
    from enact_dist.world.lineage import CauseTree, EffectTree

NULL: Final = -1
"""Stands for the size of a null version."""
_COLUMNS: Final = 6
_SIZE: Final = 2


class PlacedVersion(NamedTuple):
    """A version of a recording, without its datum.

    Attributes:
        at_ns: When it was committed.
        state: Its version and stamp.
        size: Bytes of its datum, or `NULL`.
        place: Where it lies.
    """

    at_ns: int
    state: tuple[int, int]
    size: int
    place: MessagePlace


class RecordedHistory:
    """All versions of a slot in a recording, 56 bytes each."""

    def __init__(self) -> None:
        self._moments, self._columns = array("q"), array("q")

    def __iter__(self) -> Iterator[PlacedVersion]:
        return map(self._version, range(len(self._moments)))

    def _version(self, number: int) -> PlacedVersion:
        begin = _COLUMNS * number
        version, stamp_ns, size, *place = self._columns[begin : begin + _COLUMNS]
        return PlacedVersion(self._moments[number], (version, stamp_ns), size, MessagePlace(*place))

    def add(self, at_ns: int, recorded: Recorded, place: MessagePlace) -> None:
        """Take the next version."""
        size = recorded.datum.size if recorded.datum is not None else NULL
        self._columns.extend((*recorded.state, size, *place))
        self._moments.append(max(at_ns, self._moments[-1]) if self._moments else at_ns)

    def at(self, at_ns: int) -> PlacedVersion | None:
        """Return the version of a moment, None before the first one."""
        number = bisect_right(self._moments, at_ns)
        return self._version(number - 1) if number else None

    def is_set(self, at_ns: int) -> bool:
        """Whether there was a datum at a moment."""
        number = bisect_right(self._moments, at_ns)
        return number > 0 and self._columns[_COLUMNS * (number - 1) + _SIZE] != NULL

    def turns(self) -> Iterator[int]:
        """Yield the moments at which there began or ceased to be one."""
        was_set = False
        for at_ns, size in zip(self._moments, self._columns[_SIZE::_COLUMNS], strict=True):
            if (size != NULL) != was_set:
                was_set = not was_set
                yield at_ns

    def last_set(self) -> PlacedVersion | None:
        """Return the last version that is not null."""
        versions = map(self._version, reversed(range(len(self._moments))))
        return next((one for one in versions if one.size != NULL), None)


class RecordedCatalogue(SlotCatalogue):
    """All slots of a recording that ever had a datum, with their histories."""

    def __init__(self) -> None:
        super().__init__()
        self.histories: dict[Slot, RecordedHistory] = {}
        self._turns: list[int] = []
        self._listed: tuple[tuple[str, int], list[Slot]] = ("", 0), []

    def add(self, commit: RecordedCommit, at_ns: int) -> None:
        """Take the next commit.

        Raises:
            ProtocolError: Numbers in it are beyond those of any shard.
        """
        for one, place in zip(commit.versions, commit.places, strict=True):
            try:
                self.histories.setdefault(one.slot, RecordedHistory()).add(at_ns, one, place)
            except OverflowError as error:
                raise ProtocolError(f"{one.slot} has the state {one.state}: {error}") from error

    def end(self) -> None:
        """List the slots: all commits have been taken."""
        self._turns = sorted({at_ns for each in self.histories.values() for at_ns in each.turns()})
        for slot, history in self.histories.items():
            last = history.last_set()
            state = ListedState(*last.state, null=False) if last else ListedState(0, 0, null=True)
            self.note(slot, state, gap=0, now_s=0.0)

    def slots(self, world: str, at_ns: int = 0) -> list[Slot]:
        """Return the data of a world context that were set at a moment; 0: at any."""
        known = super().slots(world)
        if not at_ns:
            return known
        key, (listed, found) = (world, bisect_right(self._turns, at_ns)), self._listed
        if key != listed:
            found = [slot for slot in known if self.histories[slot].is_set(at_ns)]
            self._listed = key, found
        return found


class RecordingSource:
    """A recording.

    Args:
        path: The file; it is read through once.

    Attributes:
        name: Of the file.
        timeline: All its moments.
        catalogue: All its slots.

    Raises:
        ConfigError: The file cannot be read, or is no recording of this project.
        ProtocolError: It holds what this version cannot read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._recording = Recording(path)
        self.name = self._recording.path.name
        self._lineage = RecordedLineage(self._recording.path)
        self.catalogue = RecordedCatalogue()
        stamps: set[int] = set()
        for commit in self._recording.commits():
            at_ns = self._moment(commit)
            self.catalogue.add(commit, at_ns)
            stamps.add(at_ns)
        self.catalogue.end()
        ordered = tuple(sorted(stamps))
        begin_ns = ordered[0] if ordered else 0
        self.timeline = Timeline(ordered, begin_ns, begin_ns)
        self.catalogue.newest_ns = self.timeline.newest_ns

    def of_page(self) -> RecordingSource:
        """Return the recording with a file of its own: no page reads it for another."""
        source = copy.copy(self)
        source._recording = Recording(self._recording.path)  # noqa: SLF001 - of the same class
        return source

    @property
    def away(self) -> dict[str, str]:
        """Nothing: there are no shards to ask."""
        return {}

    def _moment(self, commit: RecordedCommit) -> int:
        """Return when a commit was; of what was there before, when the recording began."""
        begin_ns = int(self._recording.facts.get("begin_ns", "0") or 0)
        newest_ns = max(one.stamp_ns for one in commit.versions)
        return newest_ns if commit.number else max(newest_ns, begin_ns)

    def size(self, slot: Slot) -> int | None:
        """Return the bytes of the last datum of a slot, None if it had none."""
        history = self.catalogue.histories.get(slot)
        last = history.last_set() if history is not None else None
        return last.size if last is not None else None

    def data_at(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded] = {}
    ) -> FoundData:
        """Return data as of a moment; `before` holds versions that need not be read again.

        Raises:
            ConfigError: The file cannot be read any more.
            ProtocolError: It has been changed.
        """
        found: dict[Slot, Recorded] = {}
        places = []
        for slot in slots:
            history, known = self.catalogue.histories.get(slot), before.get(slot)
            version = history.at(at_ns) if history is not None else None
            if version is None:
                continue
            if known is not None and known.state == version.state:
                found[slot] = known
            else:
                places.append(version.place)
        found |= {one.slot: one for one in self._recording.versions_at(places)}
        return FoundData(found, ())

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return every moment of the recording, as if the first of these slots had them all."""
        return {slot: list(enumerate(self.timeline.stamps_ns, 1)) for slot in slots[:1]}

    def samples(self, slot: Slot, most: int, bytes_max: int) -> list[tuple[int, Datum]]:
        """Return stamps and data of a slot, spread over the recording.

        Raises:
            ConfigError: The file cannot be read any more.
            ProtocolError: It has been changed.
        """
        small = [v for v in self.catalogue.histories.get(slot, ()) if NULL < v.size <= bytes_max]
        places = [version.place for version in small[:: max(1, -(-len(small) // most))]]
        # Not the file of the page, which another thread reads.
        found = Recording(self._recording.path).versions_at(places)
        return [(one.stamp_ns, one.datum) for one in found if one.datum is not None]

    def tree_of(self, way: str, recorded: Recorded, depth: int) -> CauseTree | EffectTree:
        """Return the causes (``why``) or the effects (``impact``) of a version.

        Raises:
            ProtocolError: The recording holds what this version cannot read.
        """
        return self._lineage.tree_of(way, recorded, depth)


class RecordingFeed:
    """What pages ask of the present, of a recording, which has none.

    Attributes:
        catalogue: All slots.
        problem: "".
        passed_over: 0.
        held_back: 0.
        moment_ns: The end of the recording.
    """

    problem = ""
    passed_over = held_back = 0

    def __init__(self, source: RecordingSource, shows_of: Callable[[str], Shows]) -> None:
        self.catalogue: SlotCatalogue = source.catalogue
        self.shows_of = shows_of
        self.moment_ns = source.timeline.newest_ns
        self._kinds: dict[str, frozenset[str]] = {}
        unknown = [s for s in self.catalogue.first_of_aspects() if not shows_of(s.aspect).kinds]
        for slot in unknown:
            last = source.catalogue.histories[slot].last_set()
            assert last is not None  # nothing else is listed
            recorded = source.data_at([slot], last.at_ns).data[slot]
            try:
                drawables = shown_of(recorded, shows_of(slot.aspect)).drawables
            except ProtocolError:
                continue
            self._kinds[slot.aspect] = frozenset(drawables)

    def wish(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Do nothing: all data are in the file."""

    def shown(self, slots: Iterable[Slot]) -> dict[Slot, ShownDatum]:
        """Return nothing: a recording has no present."""
        return {}

    def in_scene(self, slots: Iterable[Slot]) -> list[Slot]:
        """Return the slots that the scene can show."""
        return drawable(slots, self._kinds_of)

    def _kinds_of(self, aspect: str) -> frozenset[str]:
        return frozenset(self.shows_of(aspect).kinds) or self._kinds.get(aspect, frozenset())
