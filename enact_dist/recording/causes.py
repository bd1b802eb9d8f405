"""Causes and effects of the versions of a recording, as far as it names them.

The first question reads the file; from then on, what is known of all its versions, but not their
data, stays in memory.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.messages import Cause, DatumRead, SlotState, VersionEntry
from enact_dist.errors import MisuseError, UnknownWorldError
from enact_dist.recording.exact import Recorded
from enact_dist.recording.reading import Recording
from enact_dist.world.lineage import (
    UNRECORDED,
    CauseTree,
    EffectTree,
    Search,
    grown,
    in_order_made,
    in_order_read,
)

T = TypeVar("T")
NO_LOCK: Final = LockId("", 0, 0)
COMPARED_MAX: Final = 1000
"""Names examined for a similar one."""


class RecordedSearch(Search):
    """What a recording knows of versions.

    Args:
        path: The file; it is read through.

    Attributes:
        recording: The file.

    Raises:
        ConfigError: The file cannot be read any more.
        ProtocolError: It holds what this version cannot read.
    """

    missing = UNRECORDED

    def __init__(self, path: Path) -> None:
        self._known: dict[DatumRead, VersionEntry] = {}
        self._left_out: dict[object, int] = {}
        self._effects: dict[DatumRead, list[DatumRead]] = {}
        self._shards: dict[Slot, str] = {}
        self._now_ns = 0
        self._same: dict[Any, Any] = {}
        self.recording = Recording(path)
        for commit in self.recording.commits():
            for recorded in commit.versions:
                self._take(recorded)
        self._same.clear()

    def _once(self, value: T) -> T:
        """Return the object that equals a value: each name and version is in memory once."""
        found: T = self._same.setdefault(value, value)
        return found

    def _version(self, slot: Slot, version: int, stamp_ns: int) -> DatumRead:
        return self._once(DatumRead(self._once(slot), version, stamp_ns))

    def _take(self, recorded: Recorded) -> None:
        one = self._version(recorded.slot, *recorded.state)
        reads = tuple(self._version(*read) for read in recorded.reads)
        actor, host = self._once(recorded.actor), self._once(recorded.host)
        cause = Cause(
            NO_LOCK, recorded.kind, actor, host, recorded.pid, one.stamp_ns, recorded.held_ns,
            reads, recorded.left_out, (),
        )  # fmt: skip
        state = SlotState(
            *one, 0, None, False, False, self._once(recorded.null_reason), recorded.captured_ns
        )  # as a shard would answer, without the datum
        self._known[one] = VersionEntry(state, 0, (), cause)
        self._shards[one.slot] = self._once(recorded.shard)
        self._now_ns = max(self._now_ns, one.stamp_ns)
        for read in reads:
            self._effects.setdefault(read, []).append(one)

    def start(self, slot: Slot, version: int) -> DatumRead:
        """Return the version to begin with (0: the newest).

        Raises:
            UnknownWorldError: The recording has nothing of this world context.
            MisuseError: It has nothing of this slot, not this version, or names no causes.
        """
        path, worlds = self.recording.path, sorted({one.context for one in self._shards})
        if slot.context not in worlds:
            raise UnknownWorldError(
                f"{path} has no world context {slot.context!r}{suggestion(slot.context, worlds)}"
                f" (it has {', '.join(worlds) or 'none'})",
                known=tuple(worlds),
            )
        found = sorted(
            (one for one in self._known if one.slot == slot), key=lambda one: one.stamp_ns
        )
        if not found:
            names = (f"{one.entity}/{one.aspect}" for one in self._shards if one[0] == slot[0])
            near = suggestion(
                str(slot)[len(slot.context) + 1 :], itertools.islice(names, COMPARED_MAX)
            )
            raise MisuseError(
                f"{path} has no version of {slot}{near}; enact view {path} shows what it has"
            )
        chosen = [one for one in found if version in (0, one.version)]
        if not chosen:
            numbers = sorted(one.version for one in found)
            raise MisuseError(
                f"{path} does not have version {version} of {slot}; of the {len(found)} that it"
                f" has the oldest is {numbers[0]}, the newest {numbers[-1]}"
            )
        if self.recording.facts["format"] == "1":
            by = self.made(CauseTree, chosen[-1]).made_by
            raise MisuseError(
                f"{path} is a recording of format 1, which names no causes: of {slot}"
                f" v{chosen[-1].version} {by}; a new recording names them"
            )
        return chosen[-1]

    def lacks(self) -> Iterator[str]:
        """Yield what the file does not have, and what trees of it may lack because of that."""
        if missing := int(self.recording.end.get("missing", "0")):
            yield f"{missing} versions were missing when {self.recording.path} was recorded"
        if not self.recording.whole:
            yield (
                f"{self.recording.path} was cut off: {self.recording.missing_bytes} bytes after its"
                " last whole chunk were not used"
            )

    def shard_of(self, slot: Slot) -> str:
        """Return where a slot was committed; "" of one that was not recorded."""
        return self._shards.get(slot, "")

    def causes(self, level: Sequence[DatumRead]) -> dict[DatumRead, Sequence[DatumRead]]:
        """Return what each of these versions was made of."""
        self._left_out.update((one, self._cause(one).reads_left_out) for one in level)
        return {one: in_order_read(one, self._cause(one).reads) for one in level}

    def effects(self, level: Sequence[DatumRead]) -> dict[DatumRead, Sequence[DatumRead]]:
        """Return what was made from each of these versions."""
        return {one: in_order_made(self._effects.get(one, ())) for one in level}


class RecordedLineage:
    """Trees of the versions of a recording.  Any thread may ask.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._guard = path, threading.Lock()
        self._search: RecordedSearch | None = None

    def tree_of(self, way: str, recorded: Recorded, depth: int) -> CauseTree | EffectTree:
        """Return the causes (``why``) or the effects (``impact``) of a version.

        Raises:
            ConfigError: The file cannot be read any more.
            ProtocolError: It holds what this version cannot read.
        """
        with self._guard:
            self._search = search = self._search or RecordedSearch(self._path)
        root = DatumRead(recorded.slot, *recorded.state)
        if way == "why":
            return grown(CauseTree, search, root, depth)
        return grown(EffectTree, search, root, depth)
