"""The floors: what this machine and the bare transports do by themselves, in the same run.

========================  ===================================================================
floor                     what it is
========================  ===================================================================
zenoh query               one raw query and its answer, 64 bytes, between two Python processes
zenoh pub/sub             a publication and the one that comes back for it
zenoh reply SIZE          a query whose answer has so many bytes, into Python's memory
socket echo               64 bytes to a Python process and back over a Unix socket
memcpy SIZE               `bytes` copied into memory that is there already
write SIZE                `write()` of so many bytes to a new file in shared memory
mmap SIZE                 such a file opened, mapped, its first byte read, and let go
fdatasync                 4 kB appended to a file of the data's disk and forced out
========================  ===================================================================
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.bench.echoes.socket_echo import SocketEcho
from enact_dist.bench.rows import FLOOR, Case, Key
from enact_dist.bench.timing import PAUSE_S, repeating
from enact_dist.errors import MisuseError
from enact_dist.verify.daemons import KeptPorts, LineProcess

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.bench.echoes.zenoh_echo import ZenohEcho

PAUSED: Final = ", paused"
"""Ends the name of a variant with pauses between the acts."""
QUERY: Final = (FLOOR, "zenoh query")
QUERY_PAUSED: Final = (FLOOR, "zenoh query" + PAUSED)
PUBLISH: Final = (FLOOR, "zenoh pub/sub")
ECHO: Final = (FLOOR, "socket echo")
ECHO_PAUSED: Final = (FLOOR, "socket echo" + PAUSED)
FDATASYNC: Final = (FLOOR, "fdatasync")
SIZES: Final = {"1 kB": 1_024, "0.9 MB": 921_600, "10 MB": 10_000_000, "100 MB": 100_000_000}
"""Bytes of the payloads that are measured."""


def reply(size: str) -> Key:
    """Return the floor of a fetch over the network."""
    return (FLOOR, f"zenoh reply {size}")


def written(size: str) -> Key:
    """Return the floor of a publication in shared memory."""
    return (FLOOR, f"write {size}")


def mapped(size: str) -> Key:
    """Return the floor of a fetch in shared memory."""
    return (FLOOR, f"mmap {size}")


def copied(size: str) -> Key:
    """Return the floor of a copy."""
    return (FLOOR, f"memcpy {size}")


def size_of(variant: str) -> str:
    """Return the size that a floor is named after, as in `SIZES`; what follows its kind else."""
    return variant.removeprefix("zenoh ").partition(" ")[2]


class Floors:
    """Measures floors; starts the processes behind them at their first use.  A context manager.

    Args:
        folder: Where data would be kept: its disk is measured.
        memory: A folder in shared memory.
    """

    def __init__(self, folder: Path, memory: Path) -> None:
        self._folder, self._memory = folder, memory
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Floors:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @staticmethod
    def every() -> list[Key]:
        """Return all floors."""
        plain = [QUERY, QUERY_PAUSED, PUBLISH, ECHO, ECHO_PAUSED, FDATASYNC]
        by_size = (copied, written, mapped, reply)
        return plain + [floor(size) for floor in by_size for size in SIZES]

    def case(self, variant: str) -> Case:
        """Return the case of a floor.

        Raises:
            MisuseError: There is none of that name.
        """
        bare = variant.removesuffix(PAUSED)
        pause_s = PAUSE_S if bare != variant else 0.0
        act = self._act(bare)
        moved = 0 if bare.startswith("mmap") else SIZES.get(size_of(bare), 0)
        return Case(FLOOR, variant, repeating(act, pause_s=pause_s), bytes=moved)

    def _act(self, variant: str) -> Callable[[], object]:
        if variant == "zenoh query":
            return self._zenoh.query
        if variant == "zenoh pub/sub":
            return self._zenoh.publish
        if variant == "socket echo":
            return self._socket.echo
        if variant == "fdatasync":
            return self._fdatasync
        size = size_of(variant)
        acts: dict[str, Callable[[int], Callable[[], object]]] = {
            "zenoh reply": lambda count: functools.partial(self._zenoh.query, count),
            "memcpy": self._memcpy,
            "write": self._write,
            "mmap": self._mmap,
        }
        kind = variant.removesuffix(" " + size)
        if kind not in acts or size not in SIZES:
            raise MisuseError(f"there is no floor {variant!r}")
        return acts[kind](SIZES[size])

    # ---------------------------------------------------------------- transports

    def _process(self, module: str, word: str) -> None:
        process = LineProcess(module, (word,), self._folder / f"{module}.log")
        self._stack.callback(process.end)
        process.expect("ready:")

    @functools.cached_property
    def _zenoh(self) -> ZenohEcho:
        from enact_dist.bench.echoes.zenoh_echo import ZenohEcho

        ports = KeptPorts()
        self._stack.callback(ports.close)
        port = ports.free()
        self._process("enact_dist.bench.echoes.zenoh_echo", str(port))
        return self._stack.enter_context(ZenohEcho(port))

    @functools.cached_property
    def _socket(self) -> SocketEcho:
        path = self._memory / "echo"
        self._process("enact_dist.bench.echoes.socket_echo", str(path))
        return self._stack.enter_context(SocketEcho(path))

    # ---------------------------------------------------------------- memory and disk

    @staticmethod
    def _memcpy(size: int) -> Callable[[], object]:
        source, target = memoryview(bytes(b"x" * size)), memoryview(bytearray(size))

        def copy() -> None:
            target[:] = source

        return copy

    def _write(self, size: int) -> Callable[[], object]:
        body = memoryview(b"x" * size)
        path = self._memory / f"written-{size}"

        def write() -> None:
            path.unlink(missing_ok=True)
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            try:
                done = 0
                while done < size:
                    done += os.write(descriptor, body[done:])
            finally:
                os.close(descriptor)

        self._stack.callback(path.unlink, missing_ok=True)
        return write

    def _mmap(self, size: int) -> Callable[[], object]:
        path = self._memory / f"mapped-{size}"
        path.write_bytes(b"x" * size)
        self._stack.callback(path.unlink, missing_ok=True)

        def map_and_look() -> int:
            descriptor = os.open(path, os.O_RDONLY)
            try:
                with mmap.mmap(descriptor, size, prot=mmap.PROT_READ) as found:
                    return found[0]
            finally:
                os.close(descriptor)

        return map_and_look

    @functools.cached_property
    def _fdatasync(self) -> Callable[[], object]:
        descriptor = os.open(self._folder / "forced", os.O_WRONLY | os.O_CREAT, 0o600)
        self._stack.callback(os.close, descriptor)
        block = b"x" * 4096

        def append_and_force() -> None:
            os.write(descriptor, block)
            os.fdatasync(descriptor)

        return append_and_force
