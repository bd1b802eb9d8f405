"""Causes and effects of the versions of a recording, as far as it names them.

The first question reads the file once more; from then on, what is known of all its versions, but
not their data, stays in memory.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Final, TypeVar

from enact_dist.core.protocol.datum import LockId
from enact_dist.core.protocol.messages import Cause, DatumRead, SlotState, VersionEntry
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

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.recording.exact import Recorded

T = TypeVar("T")
NO_LOCK: Final = LockId("", 0, 0)


class RecordedSearch(Search):
    """What a recording knows of versions.

    Args:
        path: The file; it is read through.

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
        for commit in Recording(path).commits():
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
