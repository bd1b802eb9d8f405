"""Tracks which rows of a store hold the states of slots, and what several rows share.

Several rows may name one large body or cause: a fork shares the bytes of its source, a commit makes
several states.  Each is kept until the last of these rows is deleted.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.records import SlotRecord
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.store.rows import Key, RowKind, key_of

OUTCOMES_KEPT_NS: Final = 24 * 3600 * 1_000_000_000
"""How long the outcomes of an ended session can be asked for."""


class Outcomes:
    """The lanes with a stored outcome, and when their sessions ended.

    Args:
        locks: Locks with stored outcomes.
        ended: When sessions ended, wall clock in ns.
    """

    __slots__ = ("_ended", "_lanes")

    def __init__(self, locks: Iterable[LockId], ended: Mapping[str, int]) -> None:
        # A plain dict would skip over all entries deleted at its front each time.
        self._ended = OrderedDict(sorted(ended.items(), key=lambda entry: entry[1]))
        self._lanes: dict[str, set[int]] = {}
        for lock in locks:
            self.add(lock)

    def add(self, lock: LockId) -> None:
        """Record that a lock's outcome is stored."""
        self._lanes.setdefault(lock.session, set()).add(lock.lane)

    def came_back(self, session: str) -> bool:
        """Record that a session lives; return whether it had ended."""
        return self._ended.pop(session, None) is not None

    def ended(self, session: str, wall_ns: int) -> None:
        """Record the end of a session."""
        self._ended[session] = wall_ns

    def expired(self, wall_ns: int) -> Iterator[Key]:
        """Yield the rows of sessions that ended long before `wall_ns`, and drop them."""
        while self._ended:
            session, ended_ns = next(iter(self._ended.items()))
            if ended_ns > wall_ns - OUTCOMES_KEPT_NS:
                return
            del self._ended[session]
            yield key_of(RowKind.ENDED, session)
            for lane in self._lanes.pop(session, ()):
                yield key_of(RowKind.OUTCOME, session, lane)


class State(NamedTuple):
    """The row of a slot's newest state."""

    key: Key
    version: int
    volatile: bool


class States:
    """The rows of slots' states and of prepared writes, by their subjects.

    Attributes:
        newest: The row of each slot's newest state.
        history: The rows of its retained older states, by version.
        prepared: The writes of each prepared lock, by their rows.
        blobs: The file that a row names, by row.
        causes: The row of a shared cause that a row names, by row.
    """

    __slots__ = ("_forced", "_rows", "blobs", "causes", "history", "newest", "prepared")

    def __init__(self) -> None:
        self.newest: dict[Slot, State] = {}
        self.history: dict[Slot, dict[int, Key]] = {}
        self.prepared: dict[LockId, dict[Key, SlotRecord]] = {}
        self.blobs: dict[Key, Blob] = {}
        self.causes: dict[Key, Key] = {}
        self._rows: Counter[str | Key] = Counter()
        self._forced: set[str] = set()

    def find(self, slot: Slot, version: int) -> Key | None:
        """Return the row of one version of a slot, None if it is not stored.

        Also None if there are two: versions start again after an aspect was volatile for a while.
        """
        newest = self.newest.get(slot)
        old = self.history.get(slot, {}).get(version)
        if newest is None or newest.version != version or newest.volatile:
            return old
        return newest.key if old is None else None

    def take_out(self, part: str, names: Collection[str]) -> Iterator[Key]:
        """Yield the rows of all states of slots whose `part` is one of `names`, and drop them."""
        for slot in [slot for slot in self.newest if getattr(slot, part) in names]:
            yield self.newest.pop(slot).key
        for slot in [slot for slot in self.history if getattr(slot, part) in names]:
            yield from self.history.pop(slot).values()

    def name_blob(self, key: Key, blob: Blob) -> None:
        """Record that a row names a file."""
        self.blobs[key] = blob
        self._rows[blob.name] += 1
        if blob.synced:
            self._forced.add(blob.name)

    def as_forced(self, blob: Blob) -> Blob:
        """Return the current state of a file: a later row may have forced it."""
        return blob._replace(synced=blob.name in self._forced)

    def unname_blob(self, blob: Blob) -> Blob | None:
        """Record that a deleted row named a file; return the file if no row does any more."""
        if not self._last(blob.name):
            return None
        blob = self.as_forced(blob)
        self._forced.discard(blob.name)
        return blob

    def name_cause(self, key: Key, cause: Key) -> None:
        """Record that a row names a shared cause."""
        self.causes[key] = cause
        self._rows[cause] += 1

    def unname_cause(self, cause: Key) -> bool:
        """Record that a deleted row named a cause; return whether no row does any more."""
        return self._last(cause)

    def _last(self, name: str | Key) -> bool:
        self._rows[name] -= 1
        if self._rows[name] > 0:
            return False
        del self._rows[name]
        return True
