"""The folder in shared memory through which processes of one host meet their shards.

::

    /dev/shm/enact-1000/             the root: ENACT_SHARED_FOLDER, or this one of the user
        cell.shard.5f0c…/            one start of a shard: its socket, and what else it shares
            nonce                    128 random bits, sent in the shard's WELCOME
            files/                   only in the root of a group: what its own user alone may enter

Host names and boot ids cannot tell whether two processes share memory, since containers have them
in common.  So a client opens *its own* path of that name and compares the nonce.

Rules that a change must keep:

- A folder belongs to one start of one shard, which holds an exclusive `flock` on it for its
  lifetime; a process that gets the lock may delete the folder.
- The shard writes the nonce after taking the lock and before sending the folder's name.
- Only the owner, root, and the group of a deliberately configured root may enter.
- The group reaches the socket and the nonce, and nothing else: a file that other users may write
  could be changed after its commit, and one that they may read needs no right.
- Only its owner and root may replace a folder in the root, so a root of a group has the sticky bit.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hmac
import os
import re
import secrets
import shutil
import stat
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from enact_dist.errors import LinkError

SHARED_FOLDER_VARIABLE: Final = "ENACT_SHARED_FOLDER"
"""Names the root if the default does not fit, for example a tmpfs shared by containers."""
MEMORY: Final = Path("/dev/shm")  # noqa: S108 - the kernel's folder, not a temporary file
NONCE: Final = "nonce"
NONCE_BYTES: Final = 16
FILES: Final = "files"
"""The folder of payloads and pages in the root of a group; elsewhere they are beside the nonce."""
PAGES: Final = "uses-"
"""So begin the names of the pages on which clients see which of their grants live (`use_marks`)."""
NAME_BYTES_MAX: Final = 200
"""Longest name of a folder; names that a shard sends are checked against it."""
PART_CHARACTERS_MAX: Final = 60
"""Characters of the cell's and the shard's names in a folder's name, for people."""
UNFINISHED_S: Final = 60.0
"""A folder without a nonce is being made; after this time it counts as abandoned."""
_MADE_HERE: Final = re.compile(r".+\..+\.[0-9a-f]{16}\Z", re.DOTALL)
"""Names of folders that `SharedFolder` makes; other files in a root are left alone."""
ADDRESS_BYTES_MAX: Final = 107
"""Longest path of a Unix socket; a longer one is reached through an open descriptor."""


def shared_root() -> Path:
    """Return the root as the environment has it, or the default of this user."""
    given = os.environ.get(SHARED_FOLDER_VARIABLE)
    return Path(given) if given else MEMORY / f"enact-{os.geteuid()}"


class FolderAccess(NamedTuple):
    """Permissions of what a group may reach below a root; all else is 0700 and 0600.

    Attributes:
        group: The group that may enter, besides owner and root; None: no group.
        folder_mode: Mode of a folder: its files inherit the group, which may not list them.
        socket_mode: Mode of a socket: connecting needs write permission.
        nonce_mode: Mode of the nonce.
    """

    group: int | None
    folder_mode: int = 0o2710
    socket_mode: int = 0o660
    nonce_mode: int = 0o440


_PRIVATE: Final = FolderAccess(None, 0o700, 0o600, 0o400)


def _open_root(root: Path, *, make: bool) -> tuple[int, FolderAccess]:
    """Open the root and find out who may use its contents.

    Raises:
        LinkError: It is missing, or other users could replace our folders.
    """
    chosen = bool(os.environ.get(SHARED_FOLDER_VARIABLE))
    try:
        if make:
            root.mkdir(mode=0o700, parents=True, exist_ok=True)
        # A link is followed only if the user has chosen the path.
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | (0 if chosen else os.O_NOFOLLOW)
        opened = os.open(root, flags)
    except OSError as error:
        raise LinkError(f"the shared folder {root} cannot be used: {error.strerror}") from None
    found = os.fstat(opened)
    mode = found.st_mode
    problem = ""
    shared_by_group = chosen and mode & stat.S_IWGRP and not mode & stat.S_IWOTH
    if make and shared_by_group and not mode & stat.S_ISVTX and found.st_uid == os.geteuid():
        with contextlib.suppress(OSError):  # refused below
            os.fchmod(opened, stat.S_IMODE(mode) | stat.S_ISVTX)
            mode = os.fstat(opened).st_mode
    if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
        problem = "every user may replace its contents (its mode lacks the sticky bit)"
    elif shared_by_group and not mode & stat.S_ISVTX:
        problem = "its group may replace its contents (its mode lacks the sticky bit)"
    elif not chosen and found.st_uid != os.geteuid():
        problem = f"it belongs to user {found.st_uid}"
    if problem:
        os.close(opened)
        raise LinkError(
            f"the shared folder {root} is refused: {problem}; correct it, or name another in"
            f" {SHARED_FOLDER_VARIABLE}"
        )
    return opened, FolderAccess(found.st_gid) if shared_by_group else _PRIVATE


class SharedFolder:
    """The folder of this start of a shard; made empty, gone with `close`.  Shard side.

    Folders left behind by earlier starts are deleted first.  The descriptor holds the lock that
    shows that the shard lives; the kernel releases it when the process is killed.

    Args:
        cell: Name of the cell.
        shard: Name of the shard.
        root: Where; None: as the environment says.

    Attributes:
        name: Its name below the root, for the WELCOME.
        nonce: Content of its nonce file.
        path: Its path in this process.
        descriptor: Of the folder, open until `close`.
        files: Of the folder of payloads and pages, perhaps the same; open until `close`.
        access: Its permissions.

    Raises:
        LinkError: No folder can be made, or the root is not safe.
    """

    def __init__(self, cell: str, shard: str, *, root: Path | None = None) -> None:
        root = root or shared_root()
        opened, access = _open_root(root, make=True)
        try:
            _sweep(opened, root)
            parts = (cell[:PART_CHARACTERS_MAX], shard[:PART_CHARACTERS_MAX])
            self.name = f"{'.'.join(parts)}.{secrets.token_hex(8)}"
            self.nonce = secrets.token_bytes(NONCE_BYTES)
            self.path = root / self.name
            self.access, self.descriptor = _make(opened, self.name, access)
        except OSError as error:
            raise LinkError(f"nothing can be made in {root}: {error.strerror}") from None
        finally:
            os.close(opened)
        self.files = self.descriptor
        try:
            self._write_nonce()
            if self.access.group is not None:
                os.mkdir(FILES, 0o700, dir_fd=self.descriptor)
                self.files = _open_folder(FILES, self.descriptor)
        except OSError as error:
            self.close()
            raise LinkError(f"nothing can be written to {self.path}: {error.strerror}") from None

    def _write_nonce(self) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        written = os.open(NONCE, flags, self.access.nonce_mode, dir_fd=self.descriptor)
        try:
            os.fchmod(written, self.access.nonce_mode)
            os.write(written, self.nonce)
        finally:
            os.close(written)

    def address(self, name: str) -> str:
        """Return a path at which a socket called `name` in this folder can be bound or reached."""
        return address_in(self.descriptor, self.path, name)

    def close(self) -> None:
        """Delete the folder with its contents; calling it twice is harmless."""
        if self.descriptor >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            # Another thread may get this descriptor's number, so no file may be named by it any
            # more.
            opened = {self.descriptor, self.files}
            self.descriptor = self.files = -1
            for descriptor in opened:
                os.close(descriptor)


def _open_folder(name: str, above: int) -> int:
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.open(name, flags, dir_fd=above)


def _make(root: int, name: str, access: FolderAccess) -> tuple[FolderAccess, int]:
    """Make a folder and lock it; set its permissions last."""
    os.mkdir(name, 0o700, dir_fd=root)
    made = _open_folder(name, root)
    try:
        # A sweeper that holds it right now releases it at once: it finds no nonce.
        fcntl.flock(made, fcntl.LOCK_EX)
        if access.group is not None:
            try:
                os.fchown(made, -1, access.group)
            except PermissionError:  # we are not in that group
                access = _PRIVATE
        os.fchmod(made, access.folder_mode)
    except BaseException:
        os.close(made)
        raise
    return access, made


def _sweep(root: int, path: Path) -> None:
    """Delete the folders of this user's shards that no longer run."""
    for entry in filter(_MADE_HERE.match, os.listdir(root)):
        try:
            found = os.stat(entry, dir_fd=root, follow_symlinks=False)
            if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
                continue
            opened = _open_folder(entry, root)
        except OSError:  # gone meanwhile
            continue
        try:
            if _is_left_behind(opened, found):
                _clear_pages(opened)
                shutil.rmtree(path / entry, ignore_errors=True)
        finally:
            os.close(opened)


def _clear_pages(folder: int) -> None:
    """Clear the pages of a start that is over, before its folder is removed.

    Its clients may not have heard of that, and what they have mapped stays.  Data that were lost
    with it must not be read under its grants once the next start shows that they are lost.
    """
    with contextlib.suppress(OSError):
        for name in os.listdir(folder):
            if name.startswith(PAGES):
                flags = os.O_WRONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
                page = os.open(name, flags, dir_fd=folder)
                try:
                    os.pwrite(page, bytes(os.fstat(page).st_size), 0)
                finally:
                    os.close(page)
    with contextlib.suppress(OSError):  # usually there is none
        files = _open_folder(FILES, folder)
        try:
            _clear_pages(files)
        finally:
            os.close(files)


def _is_left_behind(folder: int, found: os.stat_result) -> bool:
    """Return whether a folder is abandoned; while it is open here, no process can take it."""
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    try:
        size = os.stat(NONCE, dir_fd=folder, follow_symlinks=False).st_size
    except FileNotFoundError:
        # Being made right now, abandoned while being made, or not one of ours.
        return not os.listdir(folder) and time.time() - found.st_mtime > UNFINISHED_S
    return size == NONCE_BYTES


@dataclass(frozen=True, slots=True)
class OpenedFolder:
    """A shard's folder, opened by a client; to be closed.

    Attributes:
        descriptor: Of the folder.
        files: Of the folder of payloads and pages, perhaps the same; -1: this user may not enter.
        path: Its path in this process.
        owner: The user that runs the shard.
    """

    descriptor: int
    files: int
    path: Path
    owner: int

    def address(self, name: str) -> str:
        """Return a path at which a socket called `name` in this folder can be reached."""
        return address_in(self.descriptor, self.path, name)

    def opened(self, file: str, size: int, access: int) -> int:
        """Open a payload of so many bytes, verified to be a file of the shard.

        Args:
            file: Its name.
            size: Its length in bytes.
            access: `os.O_RDWR` or `os.O_RDONLY`.

        Returns:
            A descriptor, which the caller closes.

        Raises:
            OSError: It is not one.
        """
        flags = access | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        descriptor = os.open(file, flags, dir_fd=self.files)
        found = os.fstat(descriptor)
        # If it were shorter than announced, touching the missing part would kill the process.
        fits = stat.S_ISREG(found.st_mode) and found.st_size == size
        if not fits or found.st_uid != self.owner:
            os.close(descriptor)
            raise OSError(f"user {found.st_uid}, {stat.filemode(found.st_mode)}, {found.st_size}")
        return descriptor

    def close(self) -> None:
        """Close the descriptors; files opened and sockets connected through them stay open."""
        for descriptor in {self.descriptor, self.files} - {-1}:
            os.close(descriptor)


def open_shared(name: str, nonce: bytes, *, root: Path | None = None) -> OpenedFolder:
    """Open the folder that a shard has named, if this process sees the same one.  Client side.

    Raises:
        LinkError: It does not exist, is a different one, or is not safe; the message says which.
    """
    if not _is_plain(name) or len(nonce) != NONCE_BYTES:
        raise LinkError(f"a shard sent {name[:80]!r} as its shared folder, which is no valid name")
    root = root or shared_root()
    path = root / name
    above, access = _open_root(root, make=False)
    try:
        # It need not be readable: files in it are opened by name.
        flags = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
        opened = os.open(name, flags, dir_fd=above)
    except FileNotFoundError:
        raise LinkError(
            f"{path} is not shared with this process, or its shard is gone: it does not exist"
        ) from None
    except OSError as error:
        raise LinkError(f"{path} is not shared with this process: {error.strerror}") from None
    finally:
        os.close(above)
    try:
        found = os.fstat(opened)
        if found.st_mode & stat.S_IWOTH or (
            found.st_uid not in (os.geteuid(), 0) and access.group is None
        ):
            raise LinkError(
                f"{path} is refused: user {found.st_uid}, mode {stat.filemode(found.st_mode)}"
            )
        if not hmac.compare_digest(_read_nonce(opened, path), nonce):
            raise LinkError(
                f"{path} is not the shard's folder: the nonces differ, so these processes"
                " have different shared memory"
            )
    except BaseException:
        os.close(opened)
        raise
    files = opened
    if found.st_mode & stat.S_IRWXG:
        try:
            files = _open_folder(FILES, opened)
        except OSError:
            files = -1  # of another user: large data come through the socket
    return OpenedFolder(opened, files, path, found.st_uid)


def _is_plain(name: str) -> bool:
    return (
        0 < len(name) <= NAME_BYTES_MAX
        and name.isascii()
        and not name.startswith(".")
        and not set(name) & {"/", "\0"}
    )


def _read_nonce(folder: int, path: Path) -> bytes:
    try:
        opened = os.open(NONCE, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    except OSError as error:
        raise LinkError(f"{path / NONCE} cannot be read: {error.strerror}") from None
    try:
        return os.read(opened, NONCE_BYTES + 1)
    finally:
        os.close(opened)


def address_in(folder: int, path: Path, name: str) -> str:
    """Return a path of a socket that fits into a socket address."""
    direct = str(path / name)
    if len(os.fsencode(direct)) <= ADDRESS_BYTES_MAX:
        return direct
    return f"/proc/self/fd/{folder}/{name}"
