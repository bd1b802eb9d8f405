"""A recording as a source: its moments in order, one state of all slots at a time.

Only the state of one moment is in memory.  To go back, the file is read again from its begin.
"""

from __future__ import annotations

import copy
import threading
from typing import TYPE_CHECKING

from enact_dist.errors import ProtocolError
from enact_dist.recording.causes import RecordedLineage
from enact_dist.recording.reading import Recording
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


class RecordingSource:
    """A recording.

    Args:
        path: The file; it is read through once.

    Attributes:
        name: Of the file.
        timeline: All its moments.
        catalogue: All its slots, as they are at its end.
        sizes: The bytes of the newest version of each.

    Raises:
        ConfigError: The file cannot be read, or is no recording of this project.
        ProtocolError: It holds what this version cannot read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._begin(Recording(path))
        self.name = self._recording.path.name
        self._lineage = RecordedLineage(self._recording.path)
        self.catalogue = SlotCatalogue()
        self.sizes: dict[Slot, int] = {}
        stamps: set[int] = set()
        for commit in self._recording.commits():
            for one in commit.versions:
                state = ListedState(one.version, one.stamp_ns, one.datum is None, one.captured_ns)
                self.catalogue.note(one.slot, state, gap=0, now_s=one.stamp_ns / 1e9)
                self.sizes[one.slot] = one.datum.size if one.datum is not None else 0
                stamps.add(self._moment(commit))
        ordered = tuple(sorted(stamps))
        begin_ns = ordered[0] if ordered else 0
        self.timeline = Timeline(ordered, begin_ns, begin_ns)
        self.catalogue.newest_ns = self.timeline.newest_ns

    def _begin(self, recording: Recording) -> None:
        self._recording = recording
        self._guard = threading.Lock()
        self._state: dict[Slot, Recorded] = {}
        self._commits: Iterator[RecordedCommit] = iter(())
        self._ahead: RecordedCommit | None = None
        self._at_ns = -1

    def of_page(self) -> RecordingSource:
        """Return the recording with a moment of its own: no page reads the file for another."""
        source = copy.copy(self)
        source._begin(Recording(self._recording.path))  # noqa: SLF001 - of the same class
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

    def data_at(
        self, slots: Sequence[Slot], at_ns: int, before: Mapping[Slot, Recorded] = {}
    ) -> FoundData:
        """Return data as of a moment, all of them from the file.

        Raises:
            ProtocolError: The recording holds what this version cannot read.
        """
        with self._guard:
            self._go_to(at_ns)
            return FoundData({s: self._state[s] for s in slots if s in self._state}, ())

    def _go_to(self, at_ns: int) -> None:
        if at_ns < self._at_ns or self._at_ns < 0:
            self._state, self._commits = {}, self._recording.commits()
            self._ahead = next(self._commits, None)
        while self._ahead is not None and self._moment(self._ahead) <= at_ns:
            self._state |= {one.slot: one for one in self._ahead.versions}
            self._ahead = next(self._commits, None)
        self._at_ns = at_ns

    def histories(self, slots: Sequence[Slot]) -> Histories:
        """Return every moment of the recording as if each of these slots had it."""
        return {slot: list(enumerate(self.timeline.stamps_ns, 1)) for slot in slots}

    def samples(self, slot: Slot, most: int, bytes_max: int) -> list[tuple[int, Datum]]:
        """Return stamps and data of a slot, spread over the recording; the file is read once more.

        Raises:
            ProtocolError: The recording holds what this version cannot read.
        """
        found: list[tuple[int, Datum]] = []
        seen, every = 0, 1
        for commit in Recording(self._recording.path).commits():
            for one in commit.versions:
                if one.slot != slot or one.datum is None or one.datum.size > bytes_max:
                    continue
                if seen % every == 0:
                    found.append((one.stamp_ns, one.datum))
                seen += 1
                if len(found) > most:
                    found, every = found[::2], 2 * every
        return found

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
        self.catalogue, self.shows_of = source.catalogue, shows_of
        self.moment_ns = source.timeline.newest_ns
        self._kinds: dict[str, frozenset[str]] = {}
        unknown = [s for s in self.catalogue.first_of_aspects() if not shows_of(s.aspect).kinds]
        for slot, recorded in source.data_at(unknown, self.moment_ns).data.items():
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
