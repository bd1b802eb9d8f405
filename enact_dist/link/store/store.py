"""The durable store of one shard: applies batches of records atomically, restores them at start.

::

    folder/
      lock        held by the one process that serves the folder
      format      version of all this
      mark        boot and newest batches (store_mark)
      store.db    one row per record (store_rows); slots have one per stored state (store_batch)
      store.db-wal
      blobs/      bodies over 64 KiB, named by their rows (blobs)

Its content after a series of records is defined in `core.offline.ledger`; outcomes of ended
sessions are deleted after a day.  When `write` returns, the batch survives `kill -9`; if a
`Persist` in it is durable, it also survives a power cut, with everything written before.  This
includes history: a durable version stays durable when it is replaced.  Rules that a change must
keep (and those of `link.store.medium`):

- A durable row names only forced files: an unforced one (a fork of an `os` datum) is forced first,
  which writes what is not yet on the disk and copies nothing.
- After any error the store is dead: the state of the disk is unknown, and a second `fsync` may
  report success for writes that the first one lost.
"""

from __future__ import annotations

from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.records import Persist, Recovered
from enact_dist.errors import StoreError
from enact_dist.link.folder.lock import FolderLock
from enact_dist.link.folder.moving_marks import refuse_moving
from enact_dist.link.store.batch import Batch
from enact_dist.link.store.database import DatabaseRow
from enact_dist.link.store.medium import FolderMedium, folder_errors, read_folder
from enact_dist.link.store.rows import (
    EPOCH_KEY,
    Key,
    epoch_body,
    read_order,
    row_checksum,
    slot_body,
)
from enact_dist.link.store.states import Outcomes

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from enact_dist.link.folder.blobs import Blob
    from enact_dist.link.store.gathering import Contents
    from enact_dist.link.store.media import Medium

FOLDER_MODE: Final = 0o700
"""A new data folder is private; an existing one keeps its owner's permissions."""


def open_store(folder: Path, *, unix_s: int, moving: bool = False) -> tuple[Store, Recovered]:
    """Open and check a shard's data folder (see `link.store.recovery`), in a new durable epoch.

    Args:
        folder: Made if it does not exist.
        unix_s: The wall clock, seconds since 1970; the epoch is this or one more than the last.
        moving: Whether the folder may be part of an unfinished rebalance.

    Returns:
        The store and its content; large bodies are read-only maps of their files.

    Raises:
        StoreError: The folder is in use, of another format, damaged, or not writable.
    """
    with folder_errors(folder):
        folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        lock = FolderLock(folder)
        database = None
        try:
            if not moving:
                refuse_moving(folder)
            database, contents = read_folder(folder)
            epoch = contents.recovered.epoch = max(contents.recovered.epoch + 1, unix_s)
            medium = FolderMedium(folder, lock=lock, database=database, epoch=epoch)
            medium.begin()
            store = Store(medium, contents, wall_ns=unix_s * 1_000_000_000)
            medium.begun(store.batch, (blob.name for blob in contents.states.blobs.values()))
        except BaseException:
            if database is not None:
                database.close()
            lock.close()
            raise
    return store, contents.recovered


@contextmanager
def read_store(folder: Path) -> Iterator[Recovered]:
    """Return the content of a folder, checked as in `open_store`; its epoch is the stored one.

    The folder is locked meanwhile and stays unchanged.  An empty or missing folder has no content.

    Raises:
        StoreError: As `open_store`.
    """
    if not folder.exists() or not any(folder.iterdir()):
        yield Recovered(epoch=0)
        return
    with closing(FolderLock(folder)):
        with folder_errors(folder):
            database, contents = read_folder(folder)
        with closing(database):
            yield contents.recovered


class Store:
    """The open store of one shard.  Used by one thread at a time.

    Args:
        medium: Where its rows and bodies are.
        contents: What was read from there; `epoch` is the new one, made durable here.
        wall_ns: The wall clock.

    Attributes:
        batch: Number of the newest batch.
        holding: For how long this process holds the shard; None: until `close`.
    """

    def __init__(self, medium: Medium, contents: Contents, *, wall_ns: int) -> None:
        self._medium = medium
        self.holding = medium.holding
        self._ids = contents.ids
        self._states = contents.states
        locks = (outcome.lock for outcome in contents.recovered.outcomes)
        self._outcomes = Outcomes(locks, contents.ended)
        self._next_id = max(self._ids.values(), default=0) + 1
        self.batch = contents.batch
        self._epoch = contents.recovered.epoch
        self._failure: BaseException | None = None
        self._closed = False
        changes: dict[Key, bytes | None] = {EPOCH_KEY: epoch_body(self._epoch)}
        for key, record in contents.lost.items():
            cause = self._states.causes.get(key)
            changes[key] = slot_body(record, None, cause and read_order(cause))
        changes.update(dict.fromkeys(self._outcomes.expired(wall_ns)))
        self._commit(changes, forced=True)

    # ---------------------------------------------------------------- writing

    def write(self, batch: Sequence[Persist]) -> None:
        """Apply a batch atomically and in order; see the module for what it survives.

        Raises:
            StoreError: The disk is full or fails, now or earlier: nothing of the batch may be
                acknowledged, and the store accepts no more.
        """
        self._guarded(lambda: self._write(batch))

    def raise_epoch(self, epoch: int) -> None:
        """Make every later epoch exceed `epoch`, in which another shard had some of its data.

        Raises:
            StoreError: As in `write`.
        """
        self._epoch = max(self._epoch, epoch)
        changes: dict[Key, bytes | None] = {EPOCH_KEY: epoch_body(self._epoch)}
        self._guarded(lambda: self._commit(changes, forced=True))

    @property
    def tired(self) -> bool:
        """Whether `rest` has something to do."""
        return self._medium.tired

    def rest(self) -> None:
        """Do what can wait until a batch is acknowledged: unlink files, shorten the log.

        Raises:
            StoreError: As in `write`.
        """
        self._guarded(self._medium.rest)

    def close(self) -> None:
        """Write what is left and release the medium; idempotent."""
        if not self._closed:
            self._closed = True
            self._medium.close()

    def _guarded(self, act: Callable[[], None]) -> None:
        name = self._medium.name
        if self._closed:
            raise StoreError(f"the store {name} is closed", path=name)
        if self._failure is not None:
            raise StoreError(
                f"the store {name} has failed before ({self._failure}) and accepts nothing more;"
                " restart the shard",
                path=name,
            )
        try:
            act()
        except BaseException as failure:
            self._failure = failure
            with self._medium.errors():
                raise

    def _write(self, batch: Sequence[Persist]) -> None:
        gathered = Batch(self.batch + 1, self._states, self._outcomes)
        for persist in batch:
            gathered.take(persist)
        unnamed = gathered.settle(self._medium.bodies)
        if gathered.changes:
            self._commit(gathered.changes, unnamed, forced=gathered.forced)

    def _commit(
        self, changes: dict[Key, bytes | None], unnamed: Sequence[Blob] = (), *, forced: bool
    ) -> None:
        self.batch += 1
        if all(body is None for body in changes.values()):
            # The newest row shows how far the store got, so a batch must not only delete rows.
            changes[EPOCH_KEY] = epoch_body(self._epoch)
        # A new row replaces a deleted one: as many pages are written as for an update.
        free = [self._ids.pop(key, 0) for key, body in changes.items() if body is None]
        free = [row_id for row_id in reversed(free) if row_id]
        rows: list[DatabaseRow] = []
        for key, body in changes.items():
            if body is None:
                continue
            row_id = self._ids.get(key) or self._new_id(free)
            self._ids[key] = row_id
            crc = row_checksum(key, self.batch, body)
            rows.append(DatabaseRow(row_id, key.kind, self.batch, key.name, body, crc))
        self._medium.commit(self.batch, rows, free, unnamed, forced=forced)

    def _new_id(self, free: list[int]) -> int:
        if free:
            return free.pop()
        self._next_id += 1
        return self._next_id - 1
