"""Bodies of data in the payload of a frame: put there one after another, taken out the same way.

Rule to keep: there is one layout per sequence of bodies (each at the next multiple of 64), so
that nothing can hide between them, overlap, or be taken twice.
"""

from __future__ import annotations

import reprlib
from typing import Any, Final

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import ProtocolError
from enact_dist.wire.limits import (
    ALIGNMENT,
    BODY_BYTES_MAX,
    ENCODING_BYTES_MAX,
    INTEGER_MAX,
    PAYLOAD_BYTES_MAX,
    PAYLOAD_NAME,
    SMALL_BODY_BYTES,
    aligned,
)

_PADDING: Final = bytes(ALIGNMENT)
_DATUM: Final = (bytes, int, int, int, str)


class BodyWriter:
    """Collects the bodies of a frame that is written; `parts` are they with their padding."""

    __slots__ = ("_end", "parts")

    def __init__(self) -> None:
        self.parts: list[bytes | memoryview] = []
        self._end = 0

    def add(self, datum: Datum) -> tuple[bytes, int, int, int, str]:
        """Add a datum's body; return the datum's entry in the header.

        Raises:
            ProtocolError: The datum contradicts itself, or the payload is over its limit.
        """
        size = datum.size
        if datum.file:
            _check_file(datum.file, size)
            return datum.encoding, 0, size, datum.stamp_ns, datum.file
        if not 0 <= size <= BODY_BYTES_MAX or len(datum.body) != size:
            raise ProtocolError(
                f"a datum said to have {size} bytes has {len(datum.body)}; at most {BODY_BYTES_MAX}"
            )
        if not size:
            return datum.encoding, 0, 0, datum.stamp_ns, ""
        start = aligned(self._end)
        if start + size > PAYLOAD_BYTES_MAX:
            raise ProtocolError(
                f"data of more than {PAYLOAD_BYTES_MAX} bytes in one message; write fewer at once"
            )
        if start > self._end:
            self.parts.append(_PADDING[: start - self._end])
        self._end = start + size
        self.parts.append(datum.body)
        return datum.encoding, start, size, datum.stamp_ns, ""


class BodyReader:
    """Takes the bodies of a frame that is read; `end` is how far it has come."""

    __slots__ = ("_payload", "end")

    def __init__(self, payload: bytes | memoryview) -> None:
        self._payload = payload
        self.end = 0

    def take(self, raw: Any) -> Datum:
        """Return the datum of the header entry `raw`.

        Raises:
            ProtocolError: It is no datum, or its body is not where the next one must be.
        """
        if type(raw) is not tuple or (*map(type, raw),) != _DATUM:
            raise ProtocolError(f"a datum came as {reprlib.repr(raw)}")
        encoding, offset, size, stamp_ns, file = raw
        if len(encoding) > ENCODING_BYTES_MAX + 1 or not 0 <= stamp_ns <= INTEGER_MAX:
            raise ProtocolError(
                f"a datum has an encoding of {len(encoding)} bytes and the stamp {stamp_ns}"
            )
        if file:
            _check_file(file, size, offset)
            return Datum(encoding, b"", size, stamp_ns, file)
        if size == 0 == offset:
            return Datum(encoding, b"", 0, stamp_ns)
        start, end = aligned(self.end), offset + size
        if offset != start or not 0 < size <= BODY_BYTES_MAX or end > len(self._payload):
            raise ProtocolError(
                f"a datum is said to have {size} bytes at {offset}; expected at {start}, and"
                f" {len(self._payload)} bytes came in all"
            )
        self._check_padding(start)
        self.end = end
        return Datum(encoding, self._slice(start, end), size, stamp_ns)

    def _check_padding(self, start: int) -> None:
        between = bytes(self._payload[self.end : start])
        if between.strip(b"\0"):
            raise ProtocolError(f"the {len(between)} bytes before offset {start} are not zero")

    def _slice(self, start: int, end: int) -> bytes | memoryview:
        payload = self._payload
        if start == 0 and end == len(payload):
            # Whole, it keeps nothing else alive; a writable buffer could change under its reader.
            return payload if type(payload) is bytes else memoryview(payload).toreadonly()
        part, size = memoryview(payload)[start:end], end - start
        # A view keeps the whole payload alive: at most twice what it shows.  A copy takes 0.02 ms
        # per MB.
        if size < SMALL_BODY_BYTES or 2 * size < len(payload):
            return bytes(part)
        return part.toreadonly()


def _check_file(file: str, size: int, offset: int = 0) -> None:
    """Raise `ProtocolError` unless this can be a payload that lies at a shard."""
    if not PAYLOAD_NAME.match(file) or offset or not 0 < size <= BODY_BYTES_MAX:
        raise ProtocolError(
            f"a datum of {size} bytes at {offset} names {reprlib.repr(file)} as its payload"
        )
