"""Messages ↔ frames: a msgpack header, and beside it the bodies of the data as they are.

A frame's header is the array ``[version, code, field, …]`` with the fields of the message in the
order of its class; a NamedTuple is the array of its fields.  A datum is ``[encoding, offset,
size, stamp_ns, file]``, and its body stands in the payload at `offset`; where `file` names a
payload of the shard, no byte of it stands in the frame.

Rules to keep: a code is never used again for another message; what is received is checked whole
(every type, every length, nothing left over, no control character in the texts of a request)
before a message exists; only `ProtocolError` leaves,
so what came is shown by `reprlib` (`repr` itself gives up on 500 nested lists).
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from functools import partial
from typing import Any, Final, get_args

import msgpack

from enact_dist.core.protocol import messages as m
from enact_dist.errors import ProtocolError
from enact_dist.wire.bodies import BodyReader, BodyWriter
from enact_dist.wire.limits import (
    COMMIT_BYTES_MAX,
    ENTRIES_MAX,
    FRAME_BYTES_MAX,
    FRAME_VERSION,
    HEADER_BYTES_MAX,
    PAYLOAD_BYTES_MAX,
    TEXT_BYTES_MAX,
)
from enact_dist.wire.long_headers import LONG_HEADER_BYTES, LongHeaders
from enact_dist.wire.message_parts import Read, reader_of, values_of, writers_of
from enact_dist.wire.quick_readers import quick_reader_of, safe_reader


class FrameTooLongError(ProtocolError):
    """A message would be longer than any that is read."""


CODES: Final[dict[type[Any], int]] = {
    # Requests from 1, answers from 33, notices from 97: all fit into one byte of msgpack.
    m.Hello: 1,
    m.Register: 2,
    m.Acquire: 3,
    m.TakeView: 4,
    m.Fetch: 5,
    m.KeepAlive: 6,
    m.Commit: 7,
    m.Outcome: 8,
    m.Validate: 9,
    m.Release: 10,
    m.Goodbye: 11,
    m.AwaitStamp: 12,
    m.Survey: 13,
    m.ListLocks: 14,
    m.ListSessions: 15,
    m.Break: 16,
    m.Prepare: 17,
    m.Finish: 18,
    m.Resolve: 19,
    m.ForceAbort: 20,
    m.ListAudit: 21,
    m.Stage: 22,
    m.ListHistory: 23,
    m.Explain: 24,
    m.FindEffects: 25,
    m.Fork: 26,
    m.DropWorld: 27,
    m.KeepVersions: 28,
    m.Ping: 29,
    m.ListPlaces: 30,
    m.ListRefusals: 31,
    m.Welcome: 33,
    m.Registered: 34,
    m.Granted: 35,
    m.Waiting: 36,
    m.Stale: 37,
    m.Viewed: 38,
    m.Slice: 39,
    m.Gone: 40,
    m.Alive: 41,
    m.Committed: 42,
    m.Fenced: 43,
    m.OutcomeIs: 44,
    m.Valid: 45,
    m.Released: 46,
    m.Reached: 47,
    m.Surveyed: 48,
    m.Locks: 49,
    m.Sessions: 50,
    m.Broken: 51,
    m.EpochChanged: 52,
    m.WrongShard: 53,
    m.Refused: 54,
    m.Changed: 55,
    m.Prepared: 56,
    m.Finished: 57,
    m.Resolved: 58,
    m.Audited: 59,
    m.Staged: 60,
    m.Versions: 61,
    m.Forgotten: 62,
    m.Forked: 63,
    m.Dropped: 64,
    m.Kept: 65,
    m.Pong: 66,
    m.Places: 67,
    m.Refusals: 68,
    m.Notice: 97,
}

_VERSION: Final = bytes((FRAME_VERSION,))
_limits: Final = {
    "use_list": False,
    "max_str_len": TEXT_BYTES_MAX,
    "max_bin_len": TEXT_BYTES_MAX,
    "max_array_len": ENTRIES_MAX,
    "max_map_len": 0,
    "max_ext_len": 0,
}
_unpack = partial(msgpack.unpackb, **_limits)
_pack = msgpack.Packer().pack
"""One packer for all threads: none runs within a call, and to make one takes as long as four calls.

Its buffer stays as large as the largest header was.
"""


def encode_frame(message: m.Message) -> tuple[bytes, bytes | None]:
    """Return the header and the payload of a message; no payload where no datum has a body.

    Raises:
        ProtocolError: A value cannot travel, or the message is over a limit.
    """
    header, bodies = encode_parts(message)
    if len(bodies) == 1:
        return header, bytes(bodies[0])
    return header, b"".join(bodies) if bodies else None


def encode_parts(message: m.Message) -> tuple[bytes, list[bytes | memoryview]]:
    """Return the header and the pieces of the payload in order, none of them copied.

    Raises:
        ProtocolError: As `encode_frame`.
    """
    pieces: list[bytes | memoryview] = []
    try:
        code, values, writers = _writers[type(message)]
        parts = [FRAME_VERSION, code, *values(message)]
        if writers:
            bodies = BodyWriter()
            pieces = bodies.parts
            for index, write in writers:
                parts[index + 2] = write(parts[index + 2], bodies)
        header: bytes = _pack(parts)
    except (TypeError, ValueError, OverflowError, KeyError) as error:
        raise ProtocolError(f"{type(message).__name__} cannot be sent: {error}") from error
    if len(header) > HEADER_BYTES_MAX:
        raise FrameTooLongError(
            f"{type(message).__name__} has a header of {len(header)} bytes; at most"
            f" {HEADER_BYTES_MAX}; ask for less at once"
        )
    size = len(header) + sum(map(len, pieces)) if pieces else 0
    if size > FRAME_BYTES_MAX:
        raise FrameTooLongError(
            f"{type(message).__name__} has {size} bytes; at most {FRAME_BYTES_MAX}; ask for, or"
            " write, less at once"
        )
    return header, pieces


def refusal_of(error: ProtocolError) -> m.Refused:
    """Return what refuses the request in place of an answer that cannot be sent.

    Without any answer a client would take the shard for dead, and ask again and again.
    """
    return m.Refused(m.TOO_LONG if isinstance(error, FrameTooLongError) else m.PROTOCOL, str(error))


def decode_frame(header: bytes, payload: bytes | memoryview = b"") -> m.Message:
    """Return the message of a frame.

    A body is a view on `payload` where it is at least 64 KiB and half of it, and else a copy.

    Raises:
        ProtocolError: Whatever is wrong with the frame; it is checked whole.
    """
    return _decoded(header, payload, _unpack)


def _decoded(
    header: bytes, payload: bytes | memoryview, unpack: Callable[[bytes], Any]
) -> m.Message:
    if len(header) > HEADER_BYTES_MAX or len(payload) > PAYLOAD_BYTES_MAX:
        raise ProtocolError(
            f"a frame of {len(header)} + {len(payload)} bytes came; at most {HEADER_BYTES_MAX} +"
            f" {PAYLOAD_BYTES_MAX}"
        )
    if header[1:2] != _VERSION or not 0x92 <= header[0] <= 0x9F:
        _check_version(header)
    try:
        values = unpack(header)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ProtocolError(f"a frame cannot be read: {error or type(error).__name__}") from error
    code = values[1] if len(values) > 1 else None
    read = _readers.get(code) if type(code) is int else None
    if read is None or type(code) is not int:
        raise ProtocolError(
            f"a frame has the unknown code {reprlib.repr(code)}; is the peer newer?"
        )
    bodies = BodyReader(payload) if payload else _NO_BODIES
    try:
        message: m.Message = read(values[2:], bodies)
    except RecursionError as error:
        raise ProtocolError("a frame is nested too deeply") from error
    if bodies.end != len(payload):
        raise ProtocolError(
            f"{type(message).__name__} came with {len(payload)} bytes of data, {bodies.end} belong"
            " to it"
        )
    return message


def decode_answer(shard: str, header: bytes, payload: bytes | memoryview = b"") -> m.Answer:
    """Return the answer that a shard's frame carries.

    Raises:
        ProtocolError: As `decode_frame`; it is no answer.
    """
    answer = _decoded(header, payload, _unpack)
    if type(answer) not in _ANSWERS:
        raise ProtocolError(f"shard {shard} answered with a {type(answer).__name__}")
    return answer  # type: ignore[return-value]  # one of these


def decode_request(header: bytes, payload: bytes | memoryview = b"") -> m.Request:
    """Return the request of a frame.

    Raises:
        ProtocolError: As `decode_frame`; it is no request, or a commit that carries too much.
    """
    long = len(header) > LONG_HEADER_BYTES
    message = _decoded(header, payload, _long_requests.unpack if long else _unpack)
    kind = type(message)
    if kind not in _REQUESTS:
        raise ProtocolError(f"{kind.__name__} is no request")
    if len(payload) > COMMIT_BYTES_MAX and kind in _COMMITS:
        raise ProtocolError(
            f"a {kind.__name__} carries {len(payload)} bytes of data; at most {COMMIT_BYTES_MAX}"
            " travel with it, send what is more ahead of it in slices (Stage)"
        )
    return message  # type: ignore[return-value]  # one of these


def _check_version(header: bytes) -> None:
    """Look at the version alone: what follows may mean anything in another version."""
    first = header[0] if header else 0
    # An array of up to 15, up to 65535, or more elements; the version follows its length.
    start = 1 if 0x92 <= first <= 0x9F else {0xDC: 3, 0xDD: 5}.get(first, 0)
    if not start or len(header) <= start:
        raise ProtocolError(f"{header[:16]!r} begins no frame")
    if header[start] != FRAME_VERSION:
        raise ProtocolError(
            f"a frame of version {header[start]} came; this side speaks {FRAME_VERSION}; run the"
            " same release of enact-dist on all hosts"
        )


_NO_BODIES: Final = BodyReader(b"")
"""For all frames without a payload: nothing can be taken from it, so it never changes."""
_writers: Final = {cls: (code, values_of(cls), writers_of(cls)) for cls, code in CODES.items()}
_REQUESTS: Final = frozenset(get_args(m.Request))
_ANSWERS: Final = frozenset(get_args(m.Answer))
_COMMITS: Final = frozenset((m.Commit, m.Prepare))
_OF_EVERY_LOCK: Final = frozenset(
    (
        m.Acquire,
        m.Granted,
        m.Commit,
        m.Committed,
        m.Validate,
        m.Valid,
        m.Release,
        m.Released,
        m.TakeView,
        m.Viewed,
        m.Fetch,
        m.Notice,
    )
)


def _reader_of(cls: type[Any]) -> Read:
    """Return what reads a message; the texts of a request must be safe to show."""
    safe = cls in _REQUESTS
    read = safe_reader(reader_of(cls)) if safe else reader_of(cls)
    return quick_reader_of(cls, read, printable=safe) if cls in _OF_EVERY_LOCK else read


_readers: Final = {code: _reader_of(cls) for cls, code in CODES.items()}
_long_requests: Final = LongHeaders({CODES[cls]: cls for cls in _REQUESTS}, _limits)
_uncoded = set(get_args(m.Message)) ^ set(CODES)
assert not _uncoded, f"no message, or one without a code: {_uncoded}"
assert len(_readers) == len(CODES), "a code is used twice"
