"""The pages through which client and shard of one host see the use of kept grants.

A page is a file of the shard's shared folder, one per session.  Each of its cells holds the number
of a grant that lives; a client that finds another number there knows that its grant is over.  That
a block uses a grant is shown by a lock of the kernel on the byte of the same file whose offset is
the grant's number: the kernel gives it up with the client's process, and asking for it never waits.
(Locks of an open file description, `F_OFD_SETLK`: other locks would vanish whenever the process
closes any descriptor of the file.)

The client's lock on byte 0 proves to the shard that it sees the locks of this client.  A file
system without such locks, or one whose locks end at a container's wall, never shows it, and no
grant is kept.

Either side changes its own word first (mark or cell) and looks at the other's afterwards.  The
kernel takes the spin lock of the file's list of locks both to change it and to look at it, which
orders the two on every processor; it leaves that out only for an empty list, and the lock on byte 0
keeps it from being empty.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import struct
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import NOT_KEPT, PLACES, PROVE
from enact_dist.core.state.tenure import KEPT_OF_SESSION_MAX
from enact_dist.link.memory.maps import body_of, map_file
from enact_dist.link.memory.shared_folder import PAGES

if TYPE_CHECKING:
    from enact_dist.core.state.tenure import KeptGrants
    from enact_dist.link.memory.shared_folder import SharedFolder

RETAIN_VARIABLE: Final = "ENACT_RETAIN"
"""With the value 0 this process keeps no grants, as a client and as a shard."""
PAGE_BYTES: Final = KEPT_OF_SESSION_MAX * 8
_LOCK: Final = struct.Struct("hhqqi4x")  # struct flock of 64-bit Linux
PROOF: Final = 0
"""The byte that a client keeps locked."""

_log = logging.getLogger("enact.link")


def retains() -> bool:
    """Whether this process keeps grants."""
    return os.environ.get(RETAIN_VARIABLE, "") != "0"


def _cells_of(descriptor: int, *, writable: bool) -> memoryview:
    """Map a page; each cell is read and written whole, by one instruction.

    Half a number that is being written could be that of an older grant.
    """
    return body_of(map_file(descriptor, PAGE_BYTES, writable=writable)).cast("Q")


def page_name(session: str) -> str:
    """Return the name of a session's page in the folder."""
    return f"{PAGES}{session}"


class ShardPage:
    """One session's page, as the shard has it."""

    __slots__ = ("cells", "descriptor", "free", "places", "proven")

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self.cells = _cells_of(descriptor, writable=True)
        self.places: dict[int, int] = {}
        self.free = list(range(KEPT_OF_SESSION_MAX))
        self.proven = False

    def put(self, number: int) -> int:
        """Put a grant's number into a free cell; return which."""
        place = self.places[number] = self.free.pop()
        self.set(place, number)
        return place

    def clear(self, number: int) -> None:
        """Clear a grant's cell; another grant may have it."""
        place = self.places.pop(number, None)
        if place is not None:
            self.set(place, 0)
            self.free.append(place)

    def locked(self, byte: int) -> bool:
        """Whether the client has locked a byte."""
        asked = _LOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, byte, 1, 0)
        found = fcntl.fcntl(self.descriptor, fcntl.F_OFD_GETLK, asked)
        kind: int = _LOCK.unpack(found)[0]
        return kind != fcntl.F_UNLCK

    def has(self, byte: int, *, in_doubt: bool) -> bool:
        """As `locked`, for a caller that cannot do without an answer."""
        try:
            return self.locked(byte)
        except OSError as error:
            _log.warning("the kernel does not say whether byte %d is locked: %s", byte, error)
            return in_doubt

    def set(self, place: int, number: int) -> None:
        """Set a cell; 0 clears it."""
        self.cells[place] = number

    def close(self) -> None:
        """Let the file go."""
        os.close(self.descriptor)


class ShardMarks:
    """The pages of all sessions of one shard; called under its host's mutex.  See `UseMarks`.

    A session without a page has to prove that it hears of recalls: by the locks of its file, or
    by listening for them.
    """

    def __init__(self, folder: SharedFolder | None) -> None:
        self._folder = folder
        self._pages: dict[str, ShardPage | None] = {}

    def keep(self, session: str, number: int) -> int:
        """Put a grant's number into a free cell of its session's page."""
        page = self._pages.get(session)
        if page is None:
            if session not in self._pages:
                self._pages[session] = self._made(session)
            elsewhere = self._folder is None
            return PROVE if elsewhere or self._pages[session] is not None else NOT_KEPT
        page.proven = page.proven or page.has(PROOF, in_doubt=False)
        if not page.proven or not page.free:
            return NOT_KEPT if page.proven else PROVE
        return PLACES + page.put(number)

    def _made(self, session: str) -> ShardPage | None:
        """Make a session's page; None if there is no room for it, or no such locks."""
        folder, name = self._folder, page_name(session)
        if folder is None or folder.files < 0:
            return None
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            descriptor = os.open(name, flags, 0o600, dir_fd=folder.files)
            try:
                os.fchmod(descriptor, 0o600)
                os.posix_fallocate(descriptor, 0, PAGE_BYTES)
                page = ShardPage(descriptor)
                page.locked(PROOF)
            except BaseException:
                os.close(descriptor)
                self._unlink(session)
                raise
        except OSError as error:
            _log.info("no grants are kept for session %s: %s", session[:8], error)
            return None
        return page

    def recall(self, session: str, number: int) -> bool:
        """Clear a grant's cell, then return whether no block uses it."""
        self.over(session, number)
        return not self.used(session, number)

    def used(self, session: str, number: int) -> bool:
        """Whether a block uses the grant now; in doubt it does, and ends by its hold limit."""
        page = self._pages.get(session)
        return page is not None and page.has(number, in_doubt=True)

    def over(self, session: str, number: int) -> None:
        """Clear a grant's cell; another grant may have it.

        A session that has ended has none: a commit of it may still be on its way to the disk.
        """
        page = self._pages.get(session)
        if page is not None:
            page.clear(number)

    def drop(self, session: str) -> None:
        """Forget the page of a session that has ended."""
        page = self._pages.pop(session, None)
        if page is not None:
            page.close()
            self._unlink(session)

    def _unlink(self, session: str) -> None:
        if self._folder is not None and self._folder.files >= 0:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(page_name(session), dir_fd=self._folder.files)


def mark_uses(kept: KeptGrants, folder: SharedFolder | None) -> None:
    """Let a shard keep grants for clients that share its folder or listen for recalls."""
    if retains():
        kept.marks = ShardMarks(folder)
    else:
        kept.closed = True


class ClientPage:
    """This session's page at one shard, as the client has it.

    Closed with its last reference; a mark that it still has is given up with it.

    Attributes:
        marked: The grants whose marks it may have.

    Raises:
        OSError: It cannot be opened, mapped or locked here.
    """

    __slots__ = ("_cells", "descriptor", "marked")

    def __init__(self, folder: int, owner: int, session: str) -> None:
        self.marked: set[int] = set()
        self._cells: memoryview | None = None
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        self.descriptor = -1
        descriptor = os.open(page_name(session), flags, dir_fd=folder)
        try:
            found = os.fstat(descriptor)
            if found.st_uid != owner or found.st_size != PAGE_BYTES:
                raise OSError(f"{page_name(session)} is no page of the shard's user {owner}")
            self._cells = _cells_of(descriptor, writable=False)
            self.descriptor = descriptor
            self._lock(fcntl.F_WRLCK, PROOF)
        except BaseException:
            self.descriptor = descriptor
            self.close()
            raise

    def __del__(self) -> None:
        self.close()

    def mark(self, number: int) -> None:
        """Show that a block uses a grant."""
        self.marked.add(number)
        self._lock(fcntl.F_WRLCK, number)

    def unmark(self, number: int) -> None:
        """Show that no block uses it any more; a failure is repaired later."""
        with contextlib.suppress(OSError):
            self._lock(fcntl.F_UNLCK, number)
            self.marked.discard(number)

    def _lock(self, kind: int, byte: int) -> None:
        asked = _LOCK.pack(kind, os.SEEK_SET, byte, 1, 0)
        fcntl.fcntl(self.descriptor, fcntl.F_OFD_SETLK, asked)

    def lives(self, place: int, number: int) -> bool:
        """Whether a grant is not over; looked at after its mark was taken or given back."""
        cells = self._cells
        return cells is not None and cells[place] == number

    def is_in(self, folder: int, session: str) -> bool:
        """Whether it is still the page that its shard has in the folder."""
        there = os.stat(page_name(session), dir_fd=folder, follow_symlinks=False)
        return os.path.samestat(there, os.fstat(self.descriptor))

    def close(self) -> None:
        """Close the page; idempotent.  In a forked child this leaves the parent's marks to it."""
        self._cells = None
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
