"""Follows slots of a cell and records every version of them, each commit whole, in order.

A watch tells of commits.  From when all shards show them they rest for `SETTLE_S`, so that all
notices have come and commits can be put in the order of their stamps; then their data are fetched
and handed to the thread that writes.  While that one has no room nothing is fetched: the data stay
with their shards, as long as their history keeps them.  What is not to be had any more is a gap:
counted, and written into the recording by name and reason.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import threading
import time
from typing import TYPE_CHECKING, Final

from enact_dist.access.asking import present_ns
from enact_dist.access.watch import Change, Watch
from enact_dist.config.shows import GUESSED, Shows
from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.errors import (
    ConfigError,
    LinkError,
    LockTimeoutError,
    PermissionDeniedError,
    UnknownWorldError,
)
from enact_dist.recording.disk import QUEUE_BYTES_MAX, DiskThread
from enact_dist.recording.exact import recorded_of
from enact_dist.recording.file import CHUNK_BYTES, CHUNK_S, RecordingFile
from enact_dist.recording.settling import END_S, Settling
from enact_dist.recording.summary import (
    DENIED,
    DISK_SLOW,
    DROPPED,
    FORGOTTEN,
    UNREACHABLE,
    UNSEEN,
    RecordingSummary,
)
from enact_dist.terms import Entities, NullReason
from enact_dist.world.version_data import Retained, Wanted, between, explained, found_of

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.core.protocol.messages import AspectEntry, VersionEntry
    from enact_dist.world.cell import Cell

SETTLE_S: Final = 0.25
"""How long a commit rests before it is recorded; with `settling.SHOWN_S` below the 2 s for which
all is remembered."""
POLL_S: Final = 0.05
HEARD_MAX: Final = 1000
"""Changes that are taken before some are recorded."""
BATCH_MAX: Final = 256
BATCH_BYTES_MAX: Final = 64 << 20
"""How many versions, and of how many bytes together, are fetched at once."""
UNLISTED_BYTES: Final = 1 << 20
"""What a version counts for whose size is not known before it is fetched."""
WANTED_MAX: Final = 1 << 18
"""Versions that wait to be fetched, 100 MB of names: more than shards list slots.  Beyond, the
oldest are given up, counted and named."""

FINISH_S: Final = 30.0
"""How long the end of a recording may take."""
GAP_SLOTS_MAX: Final = 1000
"""Slots that a summary names; the file names all."""


class Recorder:
    """Records chosen slots of a cell into a file.

    Args:
        cell: The cell.
        path: The file; it must not exist.
        worlds: Names of the world contexts; all that there are at the begin unless given.
        entities: Pattern of the entities.
        aspects: Names of the aspects; all unless given.
        shows: What the data of an aspect look like; what it does not name is guessed.
        pictures: False writes the exact messages only, for `replay` alone.
        compression: "none", "lz4" or "zstd", to which a picture beside its exact datum costs next
            to nothing: half the bytes of both, at 950 MB/s.
        chunk_bytes: Size from which a chunk ends.
        chunk_s: Age from which a chunk ends.
        queue_bytes: How much may wait for the disk.

    Raises:
        UnknownWorldError: The cell has no world context of a given name.
        ConfigError: There is nothing to record.
    """

    def __init__(
        self,
        cell: Cell,
        path: str | os.PathLike[str],
        *,
        worlds: Iterable[str] = (),
        entities: Entities | str = "**",
        aspects: Iterable[str] = (),
        shows: Mapping[str, Shows] | None = None,
        pictures: bool = True,
        compression: str = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
        chunk_s: float = CHUNK_S,
        queue_bytes: int = QUEUE_BYTES_MAX,
    ) -> None:
        self._cell, self._path = cell, path
        self._worlds = tuple(worlds) or cell.worlds()
        if not self._worlds:
            raise ConfigError(f"cell {cell.name!r} has no world context to record")
        self._session = [cell.world(name) for name in self._worlds][-1].session
        self._entities, self._only = Entities(str(entities)), tuple(aspects)
        self._shows, self._pictures = dict(shows or {}), pictures
        self._compression = compression
        self._chunk = (chunk_bytes, chunk_s)
        self._queue_bytes = queue_bytes
        self._aspects: dict[str, AspectEntry] = {}
        self._pending: list[Wanted] = []
        self._settling = Settling(self._session.client)
        self._settled_ns = self._stalled_ns = self._last_ns = 0
        self._begin_ns = 0
        self._initial: set[Wanted] = set()
        self._nulls: set[Wanted] = set()
        self._disk: DiskThread
        self.summary = RecordingSummary(str(path))

    def run(
        self,
        stop: threading.Event | None = None,
        *,
        seconds: float | None = None,
        tell: Callable[[RecordingSummary], None] = lambda _: None,
    ) -> RecordingSummary:
        """Record until `stop` is set or the time is over, and end the file whole.

        Args:
            stop: Ends the recording.
            seconds: How long to record; None: until `stop`.
            tell: Called with what is recorded so far, some 20 times per second.

        Raises:
            ConfigError: The file exists, or cannot be made.
            StoreError: The disk refuses; the file is good up to its last whole chunk.
            MisuseError: The cell was closed.
        """
        stop = stop or threading.Event()
        client = self._session.client
        with Watch(client, self._worlds, (str(self._entities),), self._only) as watch:
            self._begin_ns = present_ns(self._session.client)
            file = self._new_file()
            self._disk = DiskThread(file, bytes_max=self._queue_bytes)
            begun_s = time.monotonic()
            try:
                self._meet_aspects()
                self._begin(watch)
                while not stop.is_set():
                    self.summary.seconds = time.monotonic() - begun_s
                    if seconds is not None and self.summary.seconds >= seconds:
                        break
                    more = self._listen(watch, 0.0)
                    self._record_settled()
                    self._look_at(file)
                    tell(self.summary)
                    if not (more or self._settled()):
                        stop.wait(POLL_S)  # each commit would wake this thread otherwise
                self._finish(watch)
            finally:
                self.summary.seconds = time.monotonic() - begun_s
                try:
                    self._disk.close(self._end_facts())
                finally:
                    self._look_at(file)
        tell(self.summary)
        return self.summary

    def _new_file(self) -> RecordingFile:
        facts = {
            "cell": self._cell.name,
            "worlds": " ".join(self._worlds),
            "entities": str(self._entities),
            "aspects": " ".join(self._only),
            "begin_ns": str(self._begin_ns),
        }
        chunk_bytes, chunk_s = self._chunk
        return RecordingFile(
            self._path,
            facts,
            aspects=self._aspects.get,
            shows=(lambda name: self._shows.get(name, GUESSED)) if self._pictures else None,
            compression=self._compression,
            chunk_bytes=chunk_bytes,
            chunk_s=chunk_s,
        )

    def _look_at(self, file: RecordingFile) -> None:
        summary = self.summary
        summary.size_bytes, summary.chunks = file.size, file.chunks
        summary.counts = dict(file.counts)
        known = self._session.client.aspect_entries()
        summary.unknown_aspects = tuple(name for name in self._only if name not in known)

    def _end_facts(self) -> dict[str, str]:
        summary = self.summary
        return {
            "end_ns": str(time.time_ns()),
            "commits": str(summary.commits),
            "versions": str(summary.versions),
            "missing": str(summary.missing),
        }

    # ---------------------------------------------------------------- the summary

    def _begin(self, watch: Watch) -> None:
        """Take what is there; of each slot the newest version is what the recording begins with."""
        self._settling.wait_shown(self._begin_ns)
        self._listen_until_settled(watch)
        newest = {w.slot: w for w in self._pending if w.stamp_ns <= self._begin_ns}
        self._initial = set(newest.values())
        later = [w for w in self._pending if w.stamp_ns > self._begin_ns]
        self._pending = sorted(newest.values()) + later

    def _listen_until_settled(self, watch: Watch) -> None:
        """Listen for `SETTLE_S`, and once after it: until then this thread may have stood still."""
        ends_s = time.monotonic() + SETTLE_S
        over = False
        while not over:
            over = time.monotonic() >= ends_s
            self._listen(watch, POLL_S)

    def _listen(self, watch: Watch, wait_s: float) -> bool:
        """Take what the watch tells; return whether there is more.  Wait so long for the first."""
        for _ in range(HEARD_MAX):
            change = watch.next(wait_s)
            wait_s = 0.0
            if change is None:
                return False
            self._note(change)
        return True

    def _note(self, change: Change) -> None:
        stamp_ns, shard = change.position
        if not stamp_ns:
            return  # a volatile slot that ended with its shard: there is no version of that
        slot = Slot(change.world, change.entity.name, change.aspect)
        self._know(change.aspect)
        if change.gap:
            self._fill(slot, shard, change)
        wanted = Wanted(stamp_ns, slot, change.version, shard)
        if change.null:
            self._nulls.add(wanted)
        self._want(wanted)

    def _meet_aspects(self) -> None:
        """Ask all shards once more for what was asked for by name and is not known."""
        if not set(self._only) <= self._session.client.aspect_entries().keys():
            with contextlib.suppress(LinkError):  # of a shard that is away
                self._session.client.greet()

    def _know(self, aspect: str) -> None:
        """Learn of an aspect from the catalogue, before its first datum is written."""
        if aspect not in self._aspects:
            client = self._session.client
            if aspect not in client.aspect_entries():
                with contextlib.suppress(LinkError):  # of a shard that is away
                    client.greet()
            if aspect in client.aspect_entries():
                self._aspects[aspect] = client.aspect_entries()[aspect]

    def _fill(self, slot: Slot, shard: str, change: Change) -> None:
        """Search the history for versions without a notice."""
        first, last = change.version - change.gap, change.version - 1
        try:
            found = between(self._session, slot, shard, first, last) if first <= last else []
        except (LinkError, UnknownWorldError):
            found = []
        except PermissionDeniedError:  # its versions of before may be older than the recording
            return
        for wanted in found:
            self._want(wanted)
        if len(found) < change.gap:
            self._miss(slot, first, last, change.gap - len(found), UNSEEN, change.position.stamp_ns)

    def _want(self, wanted: Wanted) -> None:
        bisect.insort(self._pending, wanted)
        self._settling.told(wanted.stamp_ns)
        while len(self._pending) > WANTED_MAX:
            oldest = self._pending.pop(0)
            self._nulls.discard(oldest)
            self._miss_one(oldest, DISK_SLOW)

    def _miss_one(self, wanted: Wanted, reason: str) -> None:
        version = wanted.version
        self._miss(wanted.slot, version, version, 1, reason, wanted.stamp_ns)

    def _miss(
        self, slot: Slot, first: int, last: int, count: int, reason: str, stamp_ns: int
    ) -> None:
        """Count versions that cannot be recorded, and write down which."""
        gaps, slots = self.summary.gaps, self.summary.gap_slots
        gaps[reason] = gaps.get(reason, 0) + count
        if str(slot) in slots or len(slots) < GAP_SLOTS_MAX:
            slots[str(slot)] = slots.get(str(slot), 0) + count
        facts = {
            "world": slot.context,
            "entity": slot.entity,
            "aspect": slot.aspect,
            "first_version": first,
            "last_version": last,
            "missing": count,
            "reason": reason,
        }
        self._disk.put_gap(facts, max(stamp_ns, self._begin_ns))

    # ---------------------------------------------------------------- what is recorded

    def _settled(self) -> bool:
        """Whether commits have rested long enough to be recorded."""
        self._settled_ns = max(self._settled_ns, self._settling.settled_ns(SETTLE_S))
        return bool(self._pending) and self._pending[0].stamp_ns <= self._settled_ns

    def _record_settled(self) -> None:
        """Record one batch of what has settled, if the disk has room."""
        if not self._settled():
            return
        if not self._disk.wait_for_room(POLL_S):
            self._stalled_ns = max(self._stalled_ns, self._pending[-1].stamp_ns)
            return
        count = bisect.bisect_right(self._pending, self._settled_ns, key=_stamp)
        batch = self._pending[: min(count, BATCH_MAX)]
        rest = bisect.bisect_right(self._pending, batch[-1].stamp_ns, key=_stamp)
        self._record(self._pending[:rest])

    def _record(self, batch: list[Wanted]) -> None:
        """Fetch a prefix of what is pending, commits whole, and hand it to the disk."""
        try:
            entries = explained(self._session, batch)
            batch = _fitting(batch, entries)
            found = found_of(self._session, batch)
        except (LinkError, LockTimeoutError):
            self._session.client.check_usable()
            return  # a shard is away; its history will say what it still has
        except UnknownWorldError:
            self._give_up_dropped(batch)
            return
        except PermissionDeniedError:
            self._give_up_hidden(batch)
            return
        del self._pending[: len(batch)]
        self._nulls.difference_update(batch)
        for wanted in batch:
            if wanted not in found:
                stalled = wanted.stamp_ns <= self._stalled_ns
                self._miss_one(wanted, DISK_SLOW if stalled else FORGOTTEN)
        known = [w for w in batch if w in found]
        initial = [w for w in known if w in self._initial]
        if initial:
            self.summary.initial += len(initial)
            self._write(initial, 0, self._begin_ns, entries, found)
        self._write_commits([w for w in known if w not in self._initial], entries, found)

    def _write_commits(
        self,
        known: Sequence[Wanted],
        entries: Mapping[Wanted, VersionEntry],
        found: Mapping[Wanted, Retained],
    ) -> None:
        for group in _commits(known, entries):
            stamp_ns = group[0].stamp_ns
            self.summary.commits += 1
            self.summary.out_of_order += stamp_ns < self._last_ns
            self._last_ns = max(self._last_ns, stamp_ns)
            self._write(group, self.summary.commits, stamp_ns, entries, found)

    def _give_up_hidden(self, batch: list[Wanted]) -> None:
        """Record of data that this program may not read that they are missing."""
        for wanted in batch:
            try:
                explained(self._session, [wanted])
                found_of(self._session, [wanted])
            except (LinkError, LockTimeoutError, UnknownWorldError):
                continue
            except PermissionDeniedError as error:
                if error.right == "observe":  # of nothing it may ask what it comes from
                    raise
                self._pending.remove(wanted)
                self._nulls.discard(wanted)
                self._miss_one(wanted, DENIED)

    def _give_up_dropped(self, batch: list[Wanted]) -> None:
        """Record of contexts that are dropped that they end; what else waits of them is missing."""
        for name in sorted({wanted.slot.context for wanted in batch}):
            some = [wanted for wanted in batch if wanted.slot.context == name]
            try:
                explained(self._session, some)
                found_of(self._session, some)
            except (LinkError, LockTimeoutError):
                continue
            except UnknownWorldError:
                gone = set(some)
                self._pending = [wanted for wanted in self._pending if wanted not in gone]
                for wanted in sorted(gone - self._nulls):
                    self._miss_one(wanted, DROPPED)
                ends = sorted(gone & self._nulls)
                found = {wanted: Retained(NullReason.DELETED.name, None) for wanted in ends}
                self._write_commits(ends, {}, found)
                self._nulls -= gone

    def _write(
        self,
        group: Sequence[Wanted],
        commit: int,
        log_ns: int,
        entries: Mapping[Wanted, VersionEntry],
        found: Mapping[Wanted, Retained],
    ) -> None:
        self.summary.versions += len(group)
        causes = {w: entries[w].cause for w in group if w in entries}
        versions = tuple(recorded_of(w, causes.get(w), found[w], commit) for w in group)
        self._disk.put(versions, log_ns)

    def _finish(self, watch: Watch) -> None:
        """Record what was committed until now."""
        self._settling.wait_shown(wait_s=END_S)
        self._listen_until_settled(watch)
        self._settled_ns = max((w.stamp_ns for w in self._pending), default=0)
        gives_up_s = time.monotonic() + FINISH_S
        while self._pending and time.monotonic() < gives_up_s:
            self._record_settled()
        for wanted in self._pending:
            self._miss_one(wanted, DISK_SLOW if not self._disk.has_room else UNREACHABLE)
        self._pending.clear()
        with contextlib.suppress(LinkError):  # of a shard that is away
            self._session.client.greet()
        known = self._session.client.aspect_entries()
        self._aspects.update((name, known[name]) for name in self._aspects if name in known)


def _stamp(wanted: Wanted) -> int:
    return wanted.stamp_ns


def _fitting(batch: list[Wanted], entries: Mapping[Wanted, VersionEntry]) -> list[Wanted]:
    """Return as many of the first as have `BATCH_BYTES_MAX` together, commits whole."""
    size = 0
    for index, wanted in enumerate(batch):
        size += entries[wanted].state.size if wanted in entries else UNLISTED_BYTES
        if size > BATCH_BYTES_MAX and index and wanted.stamp_ns != batch[index - 1].stamp_ns:
            return batch[:index]
    return batch


def _commits(
    batch: Sequence[Wanted], entries: Mapping[Wanted, VersionEntry]
) -> Iterator[list[Wanted]]:
    """Yield the versions of one commit after another.

    The data of a commit bear one stamp on all shards.  The locks distinguish two commits that bear
    the same one; where one of these is not known they count as one.
    """
    for _, same in itertools.groupby(batch, _stamp):
        group = list(same)
        causes = [entries[wanted].cause if wanted in entries else None for wanted in group]
        by_lock: dict[LockId | None, list[Wanted]] = {}
        for wanted, cause in zip(group, causes, strict=True):
            lock = cause.lock if cause is not None and None not in causes else None
            by_lock.setdefault(lock, []).append(wanted)
        yield from by_lock.values()
