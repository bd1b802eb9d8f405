"""Long headers of requests, refused as soon as one list in them is seen to be too long.

To read 100,000 parts only to refuse them took 0.2 s, for which a shard took no other request over
Zenoh; to read ten million fields too many took twenty seconds.  The length of a list stands before
it, so here the list of fields, and each field, is looked at before it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import msgpack

from enact_dist.errors import ProtocolError
from enact_dist.wire.limits import REQUEST_VALUES_MAX
from enact_dist.wire.message_parts import annotated, lengths_of, miscounted, too_long

LONG_HEADER_BYTES: Final = 16 << 10
"""Headers up to this length are read at once: they hold no more than so many values."""


class LongHeaders:
    """Reads the headers of long messages of some kinds.

    Args:
        classes: The kinds of messages by their codes.
        limits: What `msgpack.Unpacker` takes besides.
    """

    def __init__(self, classes: Mapping[int, type[Any]], limits: Mapping[str, Any]) -> None:
        self._classes = dict(classes)
        self._lengths = {code: dict(lengths_of(cls)) for code, cls in classes.items()}
        self._counts = {code: len(annotated(cls)) for code, cls in classes.items()}
        self._limits = dict(limits)

    def unpack(self, header: bytes) -> tuple[Any, ...]:
        """Return the version, the code and the fields of a header.

        Raises:
            ProtocolError: A list is longer than its field may be, or all of them together are; it
                has more fields than its kind; the code is none of these.
            ValueError: It cannot be read; or another error of `msgpack`.
        """
        left = REQUEST_VALUES_MAX

        def counted(values: tuple[Any, ...]) -> tuple[Any, ...]:
            nonlocal left
            left -= len(values)
            if left < 0:
                raise ProtocolError(f"a header came with more than {REQUEST_VALUES_MAX} values")
            return values

        unpacker = msgpack.Unpacker(
            **self._limits, list_hook=counted, max_buffer_size=len(header), read_size=len(header)
        )
        unpacker.feed(header)
        count = unpacker.read_array_header()
        version, place = unpacker.unpack(), unpacker.tell()
        code = header[place]
        if code not in self._classes:
            raise ProtocolError(
                f"a header of {len(header)} bytes has the code {code}, and no request with it is so"
                " long"
            )
        values = [version, unpacker.unpack()]
        if count - 2 > self._counts[code]:
            raise miscounted(self._classes[code], count - 2)
        lengths = self._lengths[code]
        for index in range(count - 2):
            length_max = lengths.get(index)
            if length_max is not None:
                length = list_length(header, unpacker.tell())
                if length > length_max:
                    raise too_long(self._classes[code], index, length, length_max)
            values.append(unpacker.unpack())
        if unpacker.tell() != len(header):
            raise ValueError(f"{len(header) - unpacker.tell()} bytes follow its end")
        return tuple(values)


def list_length(header: bytes, place: int) -> int:
    """Return the length of the list that begins at a place of a header; 0 if none does."""
    first = header[place] if place < len(header) else 0
    if 0x90 <= first <= 0x9F:
        return first & 0x0F
    size = {0xDC: 2, 0xDD: 4}.get(first, 0)
    return int.from_bytes(header[place + 1 : place + 1 + size], "big")
