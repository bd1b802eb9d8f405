"""The thread that writes a recording, behind a queue that is bounded in bytes.

The recorder waits for room here, and never with more than one batch in hand.  So a slow disk
costs no memory: the versions stay with their shards, as long as their history keeps them.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.errors import EnactError, StoreError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.recording.exact import Recorded
    from enact_dist.recording.file import RecordingFile

QUEUE_BYTES_MAX: Final = 128 << 20
"""Data that wait to be written: 1.7 s of cameras at 74 MB/s."""


class _Entry(NamedTuple):
    """One commit, or one gap, on its way into the file."""

    versions: tuple[Recorded, ...]
    gap: Mapping[str, object] | None
    log_ns: int
    size: int


class DiskThread:
    """Writes commits into a file in the order in which they come; at most `bytes_max` wait.

    Attributes:
        waited_s: How long `put` has waited for room, in all.
    """

    def __init__(self, file: RecordingFile, *, bytes_max: int = QUEUE_BYTES_MAX) -> None:
        self._file = file
        self._bytes_max = bytes_max
        self._entries: deque[_Entry] = deque()
        self._bytes = 0
        self._changed = threading.Condition(threading.Lock())
        self._ending = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write_all, name="enact-recording", daemon=True)
        self._thread.start()

    @property
    def has_room(self) -> bool:
        """Whether something may be put now."""
        with self._changed:
            return self._bytes < self._bytes_max

    def put(self, versions: tuple[Recorded, ...], log_ns: int) -> None:
        """Let a commit be written; for a caller that has waited for room.

        Raises:
            StoreError: The file cannot be written any more.
        """
        self._put(_Entry(versions, None, log_ns, sum(each.size for each in versions)))

    def put_gap(self, facts: Mapping[str, object], log_ns: int) -> None:
        """Let it be written that versions are missing.

        Raises:
            StoreError: The file cannot be written any more.
        """
        self._put(_Entry((), facts, log_ns, 256))

    def _put(self, entry: _Entry) -> None:
        with self._changed:
            self._check()
            self._entries.append(entry)
            self._bytes += entry.size
            self._changed.notify_all()

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until something may be put; say whether it may.

        Raises:
            StoreError: The file cannot be written any more.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: self._bytes < self._bytes_max or self._error is not None, timeout_s
            )
            self._check()
            return self._bytes < self._bytes_max

    def _check(self) -> None:
        error = self._error
        if isinstance(error, EnactError):
            raise error
        if error is not None:
            raise StoreError(
                f"recording into {self._file.path} ended: {error}; it is good up to its last whole"
                f" chunk ({self._file.size} bytes)",
                path=str(self._file.path),
            ) from error

    def close(self, facts: Mapping[str, str]) -> None:
        """Write what waits and end the file.

        Raises:
            StoreError: The file could not be written to its end.
        """
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        if self._error is None:
            try:
                self._file.close(facts)
            except OSError as error:
                self._error = error
        self._check()

    # ---------------------------------------------------------------- the thread

    def _write_all(self) -> None:
        try:
            while (entry := self._next()) is not None:
                if entry.gap is not None:
                    self._file.add_gap(entry.log_ns, entry.gap)
                elif entry.versions:
                    self._file.add_commit(entry.versions, entry.log_ns)
        except Exception as error:  # noqa: BLE001 - the recorder learns of it, and ends
            self._file.abandon()
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _next(self) -> _Entry | None:
        """Return what is to be written next; None at the end.  Ends chunks that are due."""
        while True:
            left_s = self._file.chunk_left_s()
            if left_s == 0.0:
                self._file.end_chunk()
                continue
            with self._changed:
                self._changed.wait_for(lambda: self._entries or self._ending, left_s)
                if self._entries:
                    entry = self._entries.popleft()
                    self._bytes -= entry.size
                    self._changed.notify_all()
                    return entry
                if self._ending:
                    return None
