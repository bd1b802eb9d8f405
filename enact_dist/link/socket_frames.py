"""How frames travel on a stream between two processes of one host.

Each frame is a prefix of 16 bytes, the header and the payload::

    "ED" | version of the stream | kind | length of the header | length of the payload
      2              1               1             4                        8

`Stream` reads one frame at a time into a buffer that it keeps; what is longer gets memory of its
own, after its length was found to be within the limits.  The peer must not send a second frame
before the first was answered (a feed of notices excepted), so a call costs one system call per
direction.

Rule to keep: a stream on which anything was unexpected is closed; a part of a frame would be taken
for the beginning of the next.
"""

from __future__ import annotations

import enum
import math
import mmap
import socket
import struct
from collections.abc import Sequence
from typing import Final

from enact_dist.errors import ProtocolError
from enact_dist.wire.keys import quoted_identity
from enact_dist.wire.limits import HEADER_BYTES_MAX, NAME_CHARACTERS_MAX, PAYLOAD_BYTES_MAX

Buffer = bytes | memoryview

STREAM_VERSION: Final = 2
MAGIC: Final = b"ED"
BUFFER_BYTES: Final = 32 << 10
"""Kept per connection; frames up to this length are read without taking memory."""
PARTS_MAX: Final = 512
"""Pieces of memory that one system call may send together (the kernel allows 1024)."""
ROUND_S: Final = 0.1
"""Long waits are rounded up to this, so that the kernel is seldom told a new one."""

_PREFIX: Final = struct.Struct("<2sBBIQ")
PREFIX_BYTES: Final = _PREFIX.size
_TIMEVAL: Final = struct.Struct("ll")


class Kind(enum.IntEnum):
    """What a frame is."""

    OPEN = 1
    """Client: I speak for this session (the header is `greeting_of` it)."""
    OPENED = 2
    """Shard: go on (the header is the shard's name)."""
    REFUSED = 3
    """Shard: no, for this reason (the header is text); nothing follows."""
    MESSAGE = 4
    """A request, its answer, or a notice: the frame of `wire.frames`."""
    WATCH = 5
    """Client: from now on send notices, I say nothing more (the header is the `Survey` that lists
    what I watch, or empty for all)."""
    SKIPPED = 6
    """Shard: these notices were of no interest to you (the header is epoch, first and last)."""


_MESSAGE: Final = int(Kind.MESSAGE)
_KINDS: Final = frozenset(int(kind) for kind in Kind)


_SKIPPED: Final = struct.Struct("<QQQ")


def greeting_of(session: str, identity: str) -> bytes:
    """Return how a connection says for which session it speaks, and whose that is."""
    return f"{session} {quoted_identity(identity)}".encode()


def read_greeting(header: bytes) -> tuple[str, str]:
    """Return the session and the identity for which a connection speaks.

    Raises:
        ProtocolError: The header says neither.
    """
    session, _, identity = header.decode("ascii", "replace").partition(" ")
    fits = 0 < len(session) <= NAME_CHARACTERS_MAX and identity
    if not fits or quoted_identity(identity) != identity:
        raise ProtocolError("a connection did not say for whom it speaks")
    return session, identity


def skipped_frame(epoch: int, after: int, number: int) -> bytes:
    """Return the frame that says which notices of an epoch were of no interest."""
    return prefixed(_SKIPPED.pack(epoch, after, number), 0, Kind.SKIPPED)


def read_skipped(header: bytes) -> tuple[int, int, int]:
    """Return the epoch, the number before the first and the last of what was skipped.

    Raises:
        ProtocolError: The header says something else.
    """
    if len(header) != _SKIPPED.size:
        raise ProtocolError(f"{len(header)} bytes say which notices were skipped")
    epoch, after, number = _SKIPPED.unpack(header)
    return epoch, after, number


def prefixed(header: bytes, payload_bytes: int, kind: int = _MESSAGE) -> bytes:
    """Return the beginning of a frame: the prefix and the header."""
    return _PREFIX.pack(MAGIC, STREAM_VERSION, kind, len(header), payload_bytes) + header


def send_frame(
    connected: socket.socket, header: bytes, bodies: Sequence[Buffer] = (), kind: int = _MESSAGE
) -> None:
    """Send a frame whole; blocks while the peer does not read.

    Raises:
        OSError: The peer is gone, or did not read for as long as the socket waits.
    """
    if not bodies:
        start = prefixed(header, 0, kind)
        sent = connected.send(start)
        if sent < len(start):
            connected.sendall(memoryview(start)[sent:])
        return
    size = sum(map(len, bodies))
    _send_parts(connected, [prefixed(header, size, kind), *bodies])


def _send_parts(connected: socket.socket, parts: Sequence[Buffer]) -> None:
    """Send pieces one after another, many of them in one call, none of them copied."""
    for first in range(0, len(parts), PARTS_MAX):
        group = parts[first : first + PARTS_MAX]
        sent = connected.sendmsg(group)
        for part in group:
            if sent < len(part):
                connected.sendall(memoryview(part)[sent:])
                sent = 0
            else:
                sent -= len(part)


def wait_at_most(connected: socket.socket, option: int, wait_s: float) -> None:
    """Let the kernel end a blocked `SO_RCVTIMEO` or `SO_SNDTIMEO` call after a while.

    Python's own timeouts would cost a further system call for each one that sends or receives.
    0 stands for no limit.
    """
    seconds, fraction = divmod(wait_s, 1.0)
    value = _TIMEVAL.pack(int(seconds), int(fraction * 1e6))
    connected.setsockopt(socket.SOL_SOCKET, option, value)


def rounded_s(wait_s: float) -> float:
    """Return a time to wait, rounded up so that few different ones occur."""
    step_s = ROUND_S if wait_s >= 1.0 else ROUND_S / 10
    return math.ceil(max(wait_s, 0.001) / step_s - 1e-9) * step_s


class Stream:
    """Reads the frames of one connection.  For one thread at a time."""

    __slots__ = ("_buffer", "_connected", "_filled", "_long", "_view")

    def __init__(self, connected: socket.socket) -> None:
        self._connected = connected
        self._buffer = bytearray(BUFFER_BYTES)
        self._view = memoryview(self._buffer)
        self._filled = 0
        self._long: memoryview | None = None

    @property
    def begun(self) -> bool:
        """Whether something of the next frame is here already."""
        return bool(self._filled)

    def receive(self, into: memoryview | None = None) -> tuple[int, bytes, Buffer]:
        """Return kind, header and payload of the next frame; blocks until it is there.

        A payload longer than the buffer, and exactly as long as `into`, is put there.

        Raises:
            EOFError: The peer has closed the connection.
            OSError: The connection is broken, or nothing came for as long as the socket waits.
            ProtocolError: What came is no frame, or one over a limit.
        """
        filled, view = self._filled, self._view
        while filled < PREFIX_BYTES:
            filled += self._more(view[filled:] if filled else view)
        kind, header_bytes, payload_bytes = _read_prefix(self._buffer)
        length = PREFIX_BYTES + header_bytes + payload_bytes
        if length > BUFFER_BYTES:
            self._filled = 0
            return self._receive_long(kind, header_bytes, payload_bytes, filled, into)
        while filled < length:
            filled += self._more(view[filled:])
        return self._taken(kind, header_bytes, length, filled)

    def receive_here(self, *, wait: bool = False) -> tuple[int, bytes, Buffer] | None:
        """Return kind, header and payload of the next frame if all of it has come, else None.

        What has come of it stays for the next time.

        Args:
            wait: Whether to wait until something has come; never for the rest of it.

        Raises:
            EOFError: As `receive`.
            OSError: As `receive`.
            ProtocolError: As `receive`.
        """
        flags = 0 if wait else socket.MSG_DONTWAIT
        while (frame := self._whole()) is None:
            memory = self._long if self._long is not None else self._view
            try:
                self._filled += self._more(memory[self._filled :], flags)
            except BlockingIOError:
                return None
            flags = socket.MSG_DONTWAIT
        return frame

    def _whole(self) -> tuple[int, bytes, Buffer] | None:
        """Take the next frame, if all of it is in memory."""
        filled, memory = self._filled, self._long
        if filled < PREFIX_BYTES:
            return None
        kind, header_bytes, payload_bytes = _read_prefix(memory or self._buffer)
        length = PREFIX_BYTES + header_bytes + payload_bytes
        if memory is None and length > BUFFER_BYTES:
            # As in `_receive_long`: a length that is only claimed costs nothing.
            memory = self._long = memoryview(mmap.mmap(-1, length))
            memory[:filled] = self._view[:filled]
        if filled < length:
            return None
        if memory is None:
            return self._taken(kind, header_bytes, length, filled)
        self._filled, self._long = 0, None
        end = PREFIX_BYTES + header_bytes
        return kind, bytes(memory[PREFIX_BYTES:end]), memory[end:].toreadonly()

    def _taken(
        self, kind: int, header_bytes: int, length: int, filled: int
    ) -> tuple[int, bytes, Buffer]:
        """Take a frame that is whole in the buffer out of it."""
        view, end = self._view, PREFIX_BYTES + header_bytes
        header = bytes(view[PREFIX_BYTES:end])
        payload = bytes(view[end:length]) if end < length else b""
        self._filled = filled - length
        if self._filled:  # notices may follow each other
            view[: self._filled] = bytes(view[length:filled])
        return kind, header, payload

    def _more(self, into: memoryview, flags: int = 0) -> int:
        count = self._connected.recv_into(into, 0, flags)
        if not count:
            raise EOFError("the connection was closed")
        return count

    def _receive_long(
        self,
        kind: int,
        header_bytes: int,
        payload_bytes: int,
        filled: int,
        into: memoryview | None,
    ) -> tuple[int, bytes, Buffer]:
        """Read a frame that is longer than the buffer into memory of its own.

        The memory is the kernel's and comes page by page as it is filled, so a length that is only
        claimed costs nothing.
        """
        header, payload = memoryview(bytearray(header_bytes)), memoryview(bytearray())
        if into is not None and len(into) == payload_bytes:
            payload = into
        elif payload_bytes:
            payload = memoryview(mmap.mmap(-1, payload_bytes))  # begins at a page
        at = PREFIX_BYTES
        for part in (header, payload):
            taken = min(filled - at, len(part))
            part[:taken] = self._view[at : at + taken]
            at += taken
            while taken < len(part):
                taken += self._more(part[taken:])
        return kind, bytes(header), payload.toreadonly()


def _read_prefix(buffer: bytearray | memoryview) -> tuple[int, int, int]:
    """Return kind, length of the header and of the payload.

    Raises:
        ProtocolError: It is none of ours, or claims more than a frame may have.
    """
    magic, version, kind, header_bytes, payload_bytes = _PREFIX.unpack_from(buffer)
    if magic != MAGIC or version != STREAM_VERSION or kind not in _KINDS:
        raise ProtocolError(
            f"{bytes(buffer[:4])!r} begins no frame of a stream of version {STREAM_VERSION}; run"
            " the same release of enact-dist in all processes of this host"
        )
    if header_bytes > HEADER_BYTES_MAX or payload_bytes > PAYLOAD_BYTES_MAX:
        raise ProtocolError(
            f"a frame of {header_bytes} + {payload_bytes} bytes is announced; at most"
            f" {HEADER_BYTES_MAX} + {PAYLOAD_BYTES_MAX}"
        )
    return kind, header_bytes, payload_bytes
