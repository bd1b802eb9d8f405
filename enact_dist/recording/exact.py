"""One version of one slot as the bytes of a message, and back, bit for bit.

The message is one msgpack map, so that any language can read it:

===============  ====  ===========================================================================
key              type  value
===============  ====  ===========================================================================
``v``            int   format of this map, 1
``world``        str   the slot: its world context,
``entity``       str   … entity
``aspect``       str   … and aspect
``version``      int   the slot's version
``stamp_ns``     int   stamp of its commit, nanoseconds since 1970
``captured_ns``  int   when the datum was captured, 0 where its writer did not say
``shard``        str   where it was committed
``commit``       int   number of the commit in this recording; 0: was there when it began
``actor``        str   who committed it ("" where that is not known any more),
``host``         str   … on which host
``pid``          int   … in which process
``null``         str   why it is null, as `NullReason` names it; "" for a datum
``encoding``     bin   the datum as `docs/protocol.md` defines it: its encoding
``body``         bin   … and its body
===============  ====  ===========================================================================

Rule to keep: what this version does not know is refused; a change of the map raises ``v``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgpack

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.errors import ProtocolError
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from collections.abc import Mapping

FORMAT: Final = 1

_TYPES: Final = {
    "v": int,
    "world": str,
    "entity": str,
    "aspect": str,
    "version": int,
    "stamp_ns": int,
    "captured_ns": int,
    "shard": str,
    "commit": int,
    "actor": str,
    "host": str,
    "pid": int,
    "null": str,
    "encoding": bytes,
    "body": bytes,
}
_BIN_32: Final = struct.Struct(">BI")
_BIN_32_CODE: Final = 0xC6


@dataclass(frozen=True, slots=True)
class Recorded:
    """One version of one slot in a recording.

    Attributes:
        slot: Which slot.
        version: Which version.
        stamp_ns: Stamp of its commit.
        shard: Where it was committed.
        commit: Number of the commit in the recording, from 1; 0: was there when it began.
        datum: The datum, with its capture stamp; None for null.
        null_reason: Why it is null, a name of `NullReason`; "" for a datum.
        actor: Who committed it, "" where that is not known.
        host: Where that one ran.
        pid: As which process.
    """

    slot: Slot
    version: int
    stamp_ns: int
    shard: str
    commit: int
    datum: Datum | None
    null_reason: str = ""
    actor: str = ""
    host: str = ""
    pid: int = 0

    @property
    def state(self) -> tuple[int, int]:
        """Return version and stamp, which no other state of the slot has."""
        return self.version, self.stamp_ns

    @property
    def captured_ns(self) -> int:
        """Return when the datum was captured, 0 where that is not known."""
        return self.datum.stamp_ns if self.datum is not None else 0

    @property
    def size(self) -> int:
        """Return about how many bytes it takes."""
        return 256 + (self.datum.size + len(self.datum.encoding) if self.datum else 0)


def encode_recorded(recorded: Recorded) -> bytes:
    """Return the message of one version; the body is copied once."""
    datum = recorded.datum
    head = {
        "v": FORMAT,
        "world": recorded.slot.context,
        "entity": recorded.slot.entity,
        "aspect": recorded.slot.aspect,
        "version": recorded.version,
        "stamp_ns": recorded.stamp_ns,
        "captured_ns": recorded.captured_ns,
        "shard": recorded.shard,
        "commit": recorded.commit,
        "actor": recorded.actor,
        "host": recorded.host,
        "pid": recorded.pid,
        "null": recorded.null_reason,
        "encoding": datum.encoding if datum is not None else b"",
    }
    packer = msgpack.Packer(autoreset=False)
    packer.pack_map_header(len(head) + 1)
    for key, value in head.items():
        packer.pack(key)
        packer.pack(value)
    packer.pack("body")
    body = datum.body if datum is not None else b""
    return b"".join((packer.bytes(), _BIN_32.pack(_BIN_32_CODE, len(body)), body))


def decode_recorded(message: bytes) -> Recorded:
    """Return the version in a message.

    Raises:
        ProtocolError: It is damaged, or of another format.
    """
    try:
        found = msgpack.unpackb(message)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError(f"a recorded version cannot be read: {error}") from error
    if not isinstance(found, dict) or type(found.get("v")) is not int:
        raise ProtocolError("a recorded version is a map with its format under 'v'; found none")
    if found["v"] != FORMAT:
        raise ProtocolError(f"a recorded version has format {found['v']}; this one reads {FORMAT}")
    _check(found)
    datum = None
    if not found["null"]:
        body = found["body"]
        datum = Datum(found["encoding"], body, len(body), found["captured_ns"])
    return Recorded(
        Slot(found["world"], found["entity"], found["aspect"]),
        found["version"],
        found["stamp_ns"],
        found["shard"],
        found["commit"],
        datum,
        found["null"],
        found["actor"],
        found["host"],
        found["pid"],
    )


def _check(found: Mapping[str, Any]) -> None:
    for key, wanted in _TYPES.items():
        if type(found.get(key)) is not wanted:
            raise ProtocolError(
                f"a recorded version has {type(found.get(key)).__name__} under {key!r}, not"
                f" {wanted.__name__}"
            )
    if found["null"] and found["null"] not in NullReason.__members__:
        raise ProtocolError(f"a recorded version is null for the unknown reason {found['null']!r}")
