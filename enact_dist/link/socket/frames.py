"""Frames on a stream between two processes of one host.

Each frame is a prefix of 16 bytes, the header and the payload::

    "ED" | version of the stream | kind | length of the header | length of the payload
      2              1               1             4                        8

`Stream` reads one frame at a time into a buffer that it keeps; a longer frame gets its own memory,
once its length is known to be within the limits.  The peer must not send a second frame before the
first was answered (except on a feed of notices), so a call costs one system call per direction.

Rule to keep: close a stream after anything unexpected; otherwise a part of a frame would be taken
for the start of the next one.
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
"""Kept per connection; frames up to this length are read without allocating memory."""
PARTS_MAX: Final = 512
"""Pieces of memory that one system call may send together (the kernel allows 1024)."""
ROUND_S: Final = 0.1
"""Long waits are rounded up to this, so that the kernel's timeout rarely has to be changed."""

_CLOSED: Final = "the connection was closed"
_PREFIX: Final = struct.Struct("<2sBBIQ")
_START: Final = struct.Struct("<4sIQ")
PREFIX_BYTES: Final = _PREFIX.size
_TIMEVAL: Final = struct.Struct("ll")


class FrameKind(enum.IntEnum):
    """The kind of a frame."""

    OPEN = 1
    """Client: the connection's session (the header is its `greeting_of`)."""
    OPENED = 2
    """Shard: accepted (the header is the shard's name)."""
    REFUSED = 3
    """Shard: refused (the header is the reason); nothing follows."""
    MESSAGE = 4
    """A request, its answer, or a notice: the frame of `wire.frames`."""
    WATCH = 5
    """Client: send notices from now on; the client sends nothing more.  The header is the `Survey`
    that
    lists the watched slots; empty: all.
    """
    SKIPPED = 6
    """Shard: these notices were skipped (the header is epoch, first and last)."""


_MESSAGE: Final = int(FrameKind.MESSAGE)
_START_OF_MESSAGE: Final = MAGIC + bytes((STREAM_VERSION, _MESSAGE))
_KINDS: Final = frozenset(int(kind) for kind in FrameKind)


_SKIPPED: Final = struct.Struct("<QQQ")


def greeting_of(session: str, identity: str, secret: str = "") -> bytes:
    """Return the header that names a connection's session and identity, and opens the session."""
    return f"{session} {quoted_identity(identity)} {secret}".rstrip().encode()


def read_greeting(header: bytes) -> tuple[str, str, str]:
    """Return the session and the identity of a connection, and the session's secret.

    Raises:
        ProtocolError: The header is invalid.
    """
    session, _, rest = header.decode("ascii", "replace").partition(" ")
    identity, _, secret = rest.partition(" ")
    fits = 0 < len(session) <= NAME_CHARACTERS_MAX and identity
    if not fits or quoted_identity(identity) != identity:
        raise ProtocolError("a connection did not name its session")
    return session, identity, secret


def skipped_frame(epoch: int, after: int, number: int) -> bytes:
    """Return the frame that tells which notices of an epoch were skipped."""
    return prefixed(_SKIPPED.pack(epoch, after, number), 0, FrameKind.SKIPPED)


def read_skipped(header: bytes) -> tuple[int, int, int]:
    """Return the epoch, the number before the first and the last number of a skipped run.

    Raises:
        ProtocolError: The header is invalid.
    """
    if len(header) != _SKIPPED.size:
        raise ProtocolError(f"{len(header)} bytes are no run of skipped notices")
    epoch, after, number = _SKIPPED.unpack(header)
    return epoch, after, number


def prefixed(header: bytes, payload_bytes: int, kind: int = _MESSAGE) -> bytes:
    """Return the start of a frame: prefix and header."""
    return _PREFIX.pack(MAGIC, STREAM_VERSION, kind, len(header), payload_bytes) + header


def send_frame(
    connected: socket.socket, header: bytes, bodies: Sequence[Buffer] = (), kind: int = _MESSAGE
) -> None:
    """Send a frame whole; blocks while the peer does not read.

    Raises:
        OSError: The peer is gone, or did not read within the socket's time limit.
    """
    if not bodies:
        start = _PREFIX.pack(MAGIC, STREAM_VERSION, kind, len(header), 0) + header
        sent = connected.send(start)
        if sent < len(start):
            connected.sendall(memoryview(start)[sent:])
        return
    size = sum(map(len, bodies))
    _send_parts(connected, [prefixed(header, size, kind), *bodies])


def _send_parts(connected: socket.socket, parts: Sequence[Buffer]) -> None:
    """Send pieces in order, many per call, without copying them."""
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
    """Set the kernel's time limit (`SO_RCVTIMEO` or `SO_SNDTIMEO`) of blocked calls.

    Python's own timeouts would cost one more system call per send and receive.
    0: no limit.
    """
    seconds, fraction = divmod(wait_s, 1.0)
    value = _TIMEVAL.pack(int(seconds), int(fraction * 1e6))
    connected.setsockopt(socket.SOL_SOCKET, option, value)


def end_socket(connected: socket.socket) -> None:
    """Wake the thread that waits on a socket; that thread closes it."""
    try:
        connected.shutdown(socket.SHUT_RDWR)
    except OSError:  # ended already
        return


def rounded_s(wait_s: float) -> float:
    """Return a waiting time, rounded up so that few different ones occur."""
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
        """Whether a part of the next frame has arrived."""
        return bool(self._filled)

    def receive(self, into: memoryview | None = None) -> tuple[int, bytes, Buffer]:
        """Return kind, header and payload of the next frame; blocks until it has arrived.

        A payload longer than the buffer and exactly as long as `into` is put there.

        Raises:
            EOFError: The peer has closed the connection.
            OSError: The connection is broken, or nothing came within the socket's time limit.
            ProtocolError: The data are no frame, or exceed a limit.
        """
        filled, view = self._filled, self._view
        if not filled:
            filled = self._connected.recv_into(view)  # usually all of it
            if not filled:
                raise EOFError(_CLOSED)
        while filled < PREFIX_BYTES:
            filled += self._more(view[filled:])
        start, header_bytes, payload_bytes = _START.unpack_from(self._buffer)
        kind, length = _MESSAGE, PREFIX_BYTES + header_bytes + payload_bytes
        if start != _START_OF_MESSAGE or length > BUFFER_BYTES:
            kind = _read_prefix(self._buffer)[0]
        if length > BUFFER_BYTES:
            self._filled = 0
            return self._receive_long(kind, header_bytes, payload_bytes, filled, into)
        while filled < length:
            filled += self._more(view[filled:])
        if filled == length:  # usually: a peer waits for its answer
            self._filled = 0
            end = PREFIX_BYTES + header_bytes
            return kind, bytes(view[PREFIX_BYTES:end]), bytes(view[end:length])
        return self._taken(kind, header_bytes, length, filled)

    def receive_here(self, *, wait: bool = False) -> tuple[int, bytes, Buffer] | None:
        """Return kind, header and payload of the next frame once it is complete, else None.

        Incomplete data stay for the next call.

        Args:
            wait: Whether to wait for some data; never waits for the rest of a frame.

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
        """Return the next frame if all of it is in memory, else None."""
        filled, memory = self._filled, self._long
        if filled < PREFIX_BYTES:
            return None
        kind, header_bytes, payload_bytes = _read_prefix(memory or self._buffer)
        length = PREFIX_BYTES + header_bytes + payload_bytes
        if memory is None and length > BUFFER_BYTES:
            # As in `_receive_long`: a claimed length alone costs nothing.
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
        """Remove a complete frame from the buffer and return it."""
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
            raise EOFError(_CLOSED)
        return count

    def _receive_long(
        self,
        kind: int,
        header_bytes: int,
        payload_bytes: int,
        filled: int,
        into: memoryview | None,
    ) -> tuple[int, bytes, Buffer]:
        """Read a frame longer than the buffer into its own memory.

        The kernel provides the memory page by page as it is filled, so a claimed length alone costs
        nothing.
        """
        header, payload = memoryview(bytearray(header_bytes)), memoryview(bytearray())
        if into is not None and len(into) == payload_bytes:
            payload = into
        elif payload_bytes:
            payload = memoryview(mmap.mmap(-1, payload_bytes))  # starts at a page
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
        ProtocolError: It is invalid, or claims more than a frame's limit.
    """
    magic, version, kind, header_bytes, payload_bytes = _PREFIX.unpack_from(buffer)
    if magic == MAGIC and version != STREAM_VERSION:
        raise ProtocolError(
            f"a stream of version {version} came; this side speaks {STREAM_VERSION}; run the same"
            " release of enact-dist in all processes of this host"
        )
    if magic != MAGIC or kind not in _KINDS:
        raise ProtocolError(f"{bytes(buffer[:4])!r} starts no frame of enact-dist")
    if header_bytes > HEADER_BYTES_MAX or payload_bytes > PAYLOAD_BYTES_MAX:
        raise ProtocolError(
            f"a frame of {header_bytes} + {payload_bytes} bytes was announced; at most"
            f" {HEADER_BYTES_MAX} + {PAYLOAD_BYTES_MAX}"
        )
    return kind, header_bytes, payload_bytes
