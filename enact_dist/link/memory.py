"""Files mapped into memory, each for as long as somebody looks at its bytes.

A body over a map is a plain memoryview; when the last view, slice or array over it is gone, the
pages are given back.  That costs the kernel up to 0.2 ms per MB, so a thread of its own does it
for large ones.  Python's own `mmap` would keep a descriptor for each map (before 3.13).
"""

from __future__ import annotations

import ctypes
import logging
import mmap
import os
import queue
import threading
import weakref
from functools import cache
from typing import TYPE_CHECKING, Any, Final, TypeVar

from enact_dist.wire.limits import BODY_BYTES_MAX

if TYPE_CHECKING:
    from collections.abc import Callable

AT_ONCE_BYTES: Final = 256 << 10
"""Up to this size a map is given back by whoever drops it: waking a thread costs more."""
STEP_BYTES: Final = 4 << 20
"""So much is given back at a time: until it is, no other thread of the process gets memory."""
GATHER_S: Final = 0.02
"""How long leftovers are gathered: a thread that wakes for each would be in everybody's way."""
_log = logging.getLogger("enact.link")
_to_fill: Final[weakref.WeakValueDictionary[int, Pages]] = weakref.WeakValueDictionary()
"""Maps that their files still get what is written to, by the descriptors of the files."""
_FAILED: Final = ctypes.c_void_p(-1).value
_MAP_FIXED: Final = 0x10


class _Mapped(ctypes.Union):
    """Mapped memory, which a memoryview of this shows; `_mapped` makes it and `body_of` cuts it.

    The declared length is the longest possible.
    """

    _fields_ = (("bytes", ctypes.c_ubyte * BODY_BYTES_MAX),)

    address: int
    size: int
    ended: Callable[[], None] | None

    def __del__(self) -> None:
        if self.size <= AT_ONCE_BYTES:
            _unmap(self.address, self.size, self.ended)
        else:
            _leftovers.later(_unmap, self.address, self.size, self.ended)


class Pages(_Mapped):
    """A map of a file."""


class Plain(_Mapped):
    """Memory of this process alone, with the same end as `Pages`.

    A `bytearray` would be set to zero while all other threads wait: 50 ms for 100 MB.
    """


Kind = TypeVar("Kind", bound=_Mapped)


def plain_memory(size: int, *, ended: Callable[[], None] | None = None) -> Plain:
    """Return `size` bytes of this process, at least 1, which come page by page as they are filled.

    Args:
        size: How many bytes.
        ended: Called when nobody looks at them any more, as that of `map_file`.

    Raises:
        OSError: As the system reports it.
    """
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    address = _map(None, size, protection, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1)
    return _mapped(Plain, address, size, ended)


def map_file(
    descriptor: int, size: int, *, writable: bool, ended: Callable[[], None] | None = None
) -> Pages:
    """Map a file of at least `size` bytes, shared with whoever else maps it.

    Args:
        descriptor: Of the file; may be closed afterwards.
        size: How many bytes, at least 1.
        writable: Whether the memory may be changed; that needs a descriptor for writing, too.
        ended: Called when the pages were given back, from any thread; must not raise.

    Raises:
        OSError: As the system reports it.
    """
    protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
    address = _map(None, size, protection, mmap.MAP_SHARED, descriptor)
    return _mapped(Pages, address, size, ended)


def map_to_fill(descriptor: int, size: int) -> Pages:
    """Map a file for writing until `cut_off`; a forked child is cut off it at once.

    Raises:
        OSError: As the system reports it.
    """
    pages = _to_fill[descriptor] = map_file(descriptor, size, writable=True)
    return pages


def cut_off(pages: Pages, descriptor: int) -> None:
    """Withdraw a map that was filled, and close its file.

    Raises:
        OSError: As the system reports it.
    """
    try:
        withdraw(pages, descriptor)
    finally:
        _to_fill.pop(descriptor, None)
        os.close(descriptor)


def _cut_child_off() -> None:
    """Let a forked child change what it has of its parent's maps for itself alone."""
    for descriptor, pages in list(_to_fill.items()):
        try:
            withdraw(pages, descriptor)
        except OSError as error:
            _log.warning("what the parent fills could not be cut off: %s", error)
    _to_fill.clear()


def anonymous_file(size: int) -> int:
    """Return the descriptor of a file that has no name, all of whose pages are there.

    It goes with its descriptor and its maps.

    Raises:
        OSError: As the system reports it.
    """
    descriptor = os.memfd_create("enact", os.MFD_CLOEXEC)
    try:
        os.posix_fallocate(descriptor, 0, size)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _mapped(kind: type[Kind], address: int, size: int, ended: Callable[[], None] | None) -> Kind:
    mapped = kind.from_address(address)
    mapped.address, mapped.size, mapped.ended = address, size, ended
    if size > AT_ONCE_BYTES:
        _leftovers.start()
    return mapped


def body_of(pages: Pages | Plain) -> memoryview:
    """Return the bytes; they last as long as this or any view made of it."""
    return memoryview(pages).cast("B")[: pages.size]


def withdraw(pages: Pages, descriptor: int) -> None:
    """Cut a writable map off its file: what is written to it from now on stays in this process.

    Arrays over it keep their content; a stray write to one neither changes the file nor crashes.

    Raises:
        OSError: As the system reports it.
    """
    for offset in range(0, pages.size, STEP_BYTES):
        length = min(STEP_BYTES, pages.size - offset)
        _system().madvise(pages.address + offset, length, mmap.MADV_DONTNEED)
    # Nothing is left to be torn down while all other threads of the process stand still.
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    flags = mmap.MAP_PRIVATE | _MAP_FIXED
    _map(pages.address, pages.size, protection, flags, descriptor)


@cache
def _system() -> Any:
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = (
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_long,
    )
    library.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)
    library.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    return library


def _map(address: int | None, size: int, protection: int, flags: int, descriptor: int) -> int:
    found: int = _system().mmap(address, size, protection, flags, descriptor, 0)
    if found == _FAILED:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
    return found


def _unmap(address: int, size: int, ended: Callable[[], None] | None) -> None:
    for offset in range(0, size, STEP_BYTES):
        _system().munmap(address + offset, min(STEP_BYTES, size - offset))
    if ended is not None:
        ended()


class Leftovers:
    """Does in a thread of its own what nobody should wait for."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]]] = (
            queue.SimpleQueue()
        )
        self._mutex = threading.Lock()
        self._hurry = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Make sure that the thread runs."""
        if self._thread is None:
            with self._mutex:
                if self._thread is None:
                    self._thread = threading.Thread(
                        target=self._run, name="enact-leftovers", daemon=True
                    )
                    self._thread.start()

    def later(self, task: Callable[..., None], *arguments: object) -> None:
        """Leave a task to the thread; may be called from a destructor."""
        self._tasks.put((task, arguments))

    def wait(self, timeout_s: float) -> bool:
        """Wait until all that was left so far is done; False after `timeout_s`."""
        self.start()
        done = threading.Event()
        self.later(done.set)
        self._hurry.set()
        return done.wait(timeout_s)

    def forget(self) -> None:
        """Begin anew in a forked child: the thread and its tasks are the parent's."""
        self.__init__()  # type: ignore[misc]  # the same object stays in everybody's hands

    def _run(self) -> None:
        while True:
            task, arguments = self._tasks.get()
            if self._hurry.wait(GATHER_S):
                self._hurry.clear()
            while True:
                try:
                    task(*arguments)
                except Exception:  # noqa: BLE001 - memory of all others would never be given back
                    _log.exception("what was left to be done has failed")
                del task, arguments
                try:
                    task, arguments = self._tasks.get_nowait()
                except queue.Empty:
                    break


_leftovers = Leftovers()
os.register_at_fork(after_in_child=_cut_child_off)
os.register_at_fork(after_in_child=_leftovers.forget)


def leftovers() -> Leftovers:
    """Return what does the leftovers of this process."""
    return _leftovers
