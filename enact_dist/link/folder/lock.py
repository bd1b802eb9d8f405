"""One process per data folder: the exclusive lock, and the folder's format version.

The lock is the kernel's (`flock`), so it ends with its process, even after `kill -9`; the text in
the lock file, which names the holder, is for people.  The format is checked under the lock, before
anything else in the folder is opened: a folder of a newer format is not touched.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
from typing import TYPE_CHECKING, Final

from enact_dist.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

LOCK_FILE: Final = "lock"
FORMAT_FILE: Final = "format"
FORMAT_READ_MIN: Final = 3
"""The oldest format that this program reads."""
FORMAT: Final = 4
"""Format of the whole data folder; raised when an older program could misread a folder.

2: commits over several shards are stored (prepared locks, decisions), and the mark comes first.
3: slots have one row per stored state, with its cause.  A folder of format 2 is refused: accepting
both row forms would weaken the check that rows are exactly as written.
4: rows of sessions and operator actions end with an identity; a folder of format 3 is read and
marked as 4, which older programs refuse.
"""

_FORMAT_WORDS: Final = "enact-dist store"
_LOCK_BYTES_MAX: Final = 512


def file_mode(folder: Path) -> int:
    """Return the mode of new files in a folder: private, or as open as the folder.

    Raises:
        OSError: As the system reports it.
    """
    return 0o600 | folder.stat().st_mode & 0o066


class FolderLock:
    """The exclusive lock on an existing data folder, held from construction to `close`.

    Raises:
        StoreError: Another process holds it, or the lock file cannot be made.
    """

    __slots__ = ("_descriptor",)

    def __init__(self, folder: Path) -> None:
        path = folder / LOCK_FILE
        try:
            mode = file_mode(folder)
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, mode)
        except OSError as failure:
            raise StoreError(
                f"cannot open {path}: {failure.strerror}; the data folder must belong to the user"
                " that runs the shard, on a file system that is mounted for writing",
                path=str(path),
            ) from failure
        try:
            self._take(folder)
        except BaseException:
            os.close(self._descriptor)
            raise

    def _take(self, folder: Path) -> None:
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as failure:
            if failure.errno not in {errno.EWOULDBLOCK, errno.EACCES}:
                raise StoreError(
                    f"cannot lock {folder}: {failure.strerror}; use a folder on a local disk",
                    path=str(folder),
                ) from failure
            raise StoreError(
                f"data folder {folder} is in use by {self._holder()}; a folder serves one shard"
                " process at a time: stop that one first, or give this shard a folder of its own",
                path=str(folder),
            ) from failure
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()} {socket.gethostname()}\n".encode(), 0)

    def _holder(self) -> str:
        words = os.pread(self._descriptor, _LOCK_BYTES_MAX, 0).decode(errors="replace").split()
        if len(words) != 2:
            return "another process"
        pid, host = words
        mine = words == [str(os.getpid()), socket.gethostname()]
        return f"process {pid} on host {host}" + (" (this one)" if mine else "")

    def close(self) -> None:
        """Release the folder; idempotent."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def sync_folder(folder: Path) -> None:
    """Make the entries of `folder` durable: all names created, renamed and unlinked so far.

    Raises:
        OSError: As the system reports it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, content: bytes, *, mode: int | None = None) -> None:
    """Put `content` in place of the file at `path`, durably and atomically.

    Args:
        path: May exist already.
        content: The whole new content.
        mode: Permissions, before the umask; None: as `file_mode` says.

    Raises:
        OSError: As the system reports it; the previous file then remains.
    """
    draft = path.with_name(path.name + ".tmp")
    mode = file_mode(path.parent) if mode is None else mode
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, mode)
    left = memoryview(content)
    try:
        while left:  # a nearly full disk accepts a part
            left = left[os.write(descriptor, left) :]
        os.fsync(descriptor)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    finally:
        os.close(descriptor)
    draft.rename(path)
    sync_folder(path.parent)


def check_format(folder: Path, *, is_new: bool) -> None:
    """Refuse a folder of another format; mark a new or compatible one with ours.

    Raises:
        StoreError: The format is newer or older, unreadable, or missing in a folder with data.
        OSError: The mark cannot be written.
    """
    path = folder / FORMAT_FILE
    text = None
    with contextlib.suppress(FileNotFoundError):
        text = path.read_text(encoding="ascii", errors="replace").strip()
    if (text is None and is_new) or text == f"{_FORMAT_WORDS} {FORMAT_READ_MIN}":
        replace_file(path, f"{_FORMAT_WORDS} {FORMAT}\n".encode())
        return
    words, _, version = (text or "").rpartition(" ")
    if words != _FORMAT_WORDS or not version.isdecimal():
        raise StoreError(
            f"{path} contains {text!r} instead of '{_FORMAT_WORDS} {FORMAT}': {folder} is no"
            " data folder of a shard, or the file is damaged; restore the folder from a backup, or"
            " give the shard an empty folder",
            path=str(path),
        )
    by, remedy = "an older", "export its data with that one, or give the shard an empty folder;"
    if int(version) > FORMAT:
        by, remedy = "a newer", "install that one again,"
    if int(version) != FORMAT:
        raise StoreError(
            f"{folder} has store format {version}, this program reads {FORMAT}: it was written by"
            f" {by} enact-dist; {remedy} nothing was changed",
            path=str(path),
        )
