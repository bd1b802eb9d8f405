"""Maps files into memory; each map lasts as long as any view of its bytes.

A body over a map is a plain memoryview; when the last view, slice or array over it is gone, its
pages are returned to the system.  That costs the kernel up to 0.2 ms per MB, so a separate thread
does it for large maps.  Python's own `mmap` would keep a descriptor per map (before 3.13).

Makes the C library recycle memory blocks as large as a slice.

By default it requests each block over 128 KiB from the system and returns it at once, so the next
block touches all its pages for the first time: half the work of a shard that sends 10 MB.  glibc
adapts after the first long block is freed; with other C libraries this has no effect.

Errors of the system pass through as `OSError`.
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

RECYCLED_BYTES_MAX: Final = 16 << 20
"""Blocks up to this length are recycled; an idle process keeps up to twice as much."""


@cache
def recycle_blocks() -> None:
    """Enable recycling for the rest of this process; touches no page of the block."""
    bytes(RECYCLED_BYTES_MAX)


AT_ONCE_BYTES: Final = 256 << 10
"""Maps up to this size are freed by the thread that drops them: waking another costs more."""
STEP_BYTES: Final = 4 << 20
"""Bytes freed in one step; during a step no other thread of the process gets memory."""
GATHER_S: Final = 0.02
"""How long freed maps are collected: a thread that wakes for each would disturb all others."""
_log = logging.getLogger("enact.link")
_to_fill: Final[weakref.WeakValueDictionary[int, Pages]] = weakref.WeakValueDictionary()
"""Maps whose writes still reach their files, by file descriptor."""
_FAILED: Final = ctypes.c_void_p(-1).value
_MAP_FIXED: Final = 0x10


class _Mapped(ctypes.Union):
    """Mapped memory as a memoryview shows it; `_mapped` makes it and `body_of` slices it.

    The declared length is the largest possible.
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


class PlainMemory(_Mapped):
    """Memory of this process alone, freed in the same way as `Pages`.

    A `bytearray` would be zeroed while all other threads wait: 50 ms for 100 MB.
    """


Kind = TypeVar("Kind", bound=_Mapped)


def plain_memory(size: int, *, ended: Callable[[], None] | None = None) -> PlainMemory:
    """Return `size` bytes (at least 1) of private memory, whose pages appear as they are filled.

    Args:
        size: How many bytes.
        ended: Called when the last view is gone, as in `map_file`.
    """
    protection = mmap.PROT_READ | mmap.PROT_WRITE
    address = _map(None, size, protection, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1)
    return _mapped(PlainMemory, address, size, ended)


def map_file(
    descriptor: int, size: int, *, writable: bool, ended: Callable[[], None] | None = None
) -> Pages:
    """Map a file of at least `size` bytes, shared with all other processes that map it.

    Args:
        descriptor: Of the file; may be closed afterwards.
        size: How many bytes, at least 1.
        writable: Whether the memory may be changed; this needs a descriptor open for writing.
        ended: Called from any thread once the pages are freed; must not raise.
    """
    protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
    address = _map(None, size, protection, mmap.MAP_SHARED, descriptor)
    return _mapped(Pages, address, size, ended)


def map_to_fill(descriptor: int, size: int) -> Pages:
    """Map a file for writing until `cut_off`; in a forked child the map becomes private at once."""
    pages = _to_fill[descriptor] = map_file(descriptor, size, writable=True)
    return pages


def cut_off(pages: Pages, descriptor: int) -> None:
    """Make a filled map private, and close its file."""
    try:
        withdraw(pages, descriptor)
    finally:
        _to_fill.pop(descriptor, None)
        os.close(descriptor)


def _cut_child_off() -> None:
    """Make a forked child's copies of its parent's writable maps private."""
    for descriptor, pages in list(_to_fill.items()):
        try:
            withdraw(pages, descriptor)
        except OSError as error:
            _log.warning("the parent's writable maps could not be made private: %s", error)
    _to_fill.clear()


def anonymous_file(size: int) -> int:
    """Return the descriptor of a file without a name, with all of its pages allocated.

    The file disappears with its descriptor and maps.
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


def body_of(pages: Pages | PlainMemory) -> memoryview:
    """Return the bytes; the map lasts as long as these or any view of them."""
    return memoryview(pages).cast("B")[: pages.size]


def withdraw(pages: Pages, descriptor: int) -> None:
    """Detach a writable map from its file: later writes to it stay in this process.

    Arrays over it keep their content; a stray write neither changes the file nor crashes.
    """
    for offset in range(0, pages.size, STEP_BYTES):
        length = min(STEP_BYTES, pages.size - offset)
        _system().madvise(pages.address + offset, length, mmap.MADV_DONTNEED)
    # Leave nothing to unmap while all other threads of the process are stopped.
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
    """Runs tasks that no caller should wait for, in a thread of its own."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]]] = (
            queue.SimpleQueue()
        )
        self._mutex = threading.Lock()
        self._hurry = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the thread unless it runs."""
        if self._thread is None:
            with self._mutex:
                if self._thread is None:
                    self._thread = threading.Thread(
                        target=self._run, name="enact-leftovers", daemon=True
                    )
                    self._thread.start()

    def later(self, task: Callable[..., None], *arguments: object) -> None:
        """Queue a task for the thread; may be called from a destructor."""
        self._tasks.put((task, arguments))

    def wait(self, timeout_s: float) -> bool:
        """Wait until all tasks queued so far are done; return False after `timeout_s`."""
        self.start()
        done = threading.Event()
        self.later(done.set)
        self._hurry.set()
        return done.wait(timeout_s)

    def forget(self) -> None:
        """Start afresh in a forked child: the thread and its tasks belong to the parent."""
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
                    _log.exception("a task that frees memory has failed")
                del task, arguments
                try:
                    task, arguments = self._tasks.get_nowait()
                except queue.Empty:
                    break


_leftovers = Leftovers()
os.register_at_fork(after_in_child=_cut_child_off)
os.register_at_fork(after_in_child=_leftovers.forget)


def leftovers() -> Leftovers:
    """Return the task queue of this process."""
    return _leftovers
