"""Tracks which rows of a store hold the states of slots, and what several rows share.

Several rows may name one large body or cause: a fork shares the bytes of its source, a commit makes
several states.  Each is kept until the last of these rows is deleted.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.datum import LockId, Slot
    from enact_dist.core.records import SlotRecord
    from enact_dist.link.blobs import Blob
    from enact_dist.link.store_rows import Key


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

    def take_out(self, goes: Callable[[Slot], bool]) -> Iterator[Key]:
        """Yield the rows of all states of slots being deleted, and drop them."""
        for slot in [slot for slot in self.newest if goes(slot)]:
            yield self.newest.pop(slot).key
        for slot in [slot for slot in self.history if goes(slot)]:
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
