"""One version of one slot as the bytes of a message, and back, bit for bit.

The message is one msgpack map, so that any language can read it:

===============  ====  ===========================================================================
key              type  value
===============  ====  ===========================================================================
``v``            int   format of this map, 2
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
``kind``         str   how it was made: "commit" or "fork" ("" where that is not known),
``held_ns``      int   how long its lock had been held then,
``reads``        list  … and what that had read: world context, entity, aspect, version, stamp_ns
``left_out``     int   how many further data it had read
``encoding``     bin   the datum as `docs/protocol.md` defines it: its encoding
``body``         bin   … and its body
===============  ====  ===========================================================================

Format 1 lacks ``kind``, ``held_ns``, ``reads`` and ``left_out``; it is read, too.

Rule to keep: what this version does not know is refused; a change of the map raises ``v``.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgpack

from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import (
    CAUSE_COMMIT,
    CAUSE_FORK,
    READS_MAX,
    Cause,
    DatumRead,
)
from enact_dist.errors import ProtocolError
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from enact_dist.world.version_data import Retained, Wanted

FORMAT: Final = 2
FORMATS: Final = (1, 2)
"""Formats that are read."""

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
_CAUSE_TYPES: Final = {"kind": str, "held_ns": int, "reads": list, "left_out": int}
"""Of a map of format 2 besides."""
_READ_TYPES: Final = [str, str, str, int, int]
READ_BYTES: Final = 128
"""About what a read takes."""
_BIN_32: Final = struct.Struct(">BI")
_BIN_32_CODE: Final = 0xC6


@dataclass(frozen=True, slots=True)
class Recorded:
    """One version of one slot in a recording.

    Attributes:
        stamp_ns: Stamp of its commit.
        shard: Where it was committed.
        commit: Number of the commit in the recording, from 1; 0: was there when it began.
        datum: The datum, with its capture stamp; None for null.
        null_reason: Why it is null, a name of `NullReason`; "" for a datum.
        actor: Who committed it, "" where that is not known.
        kind: How it was made, "commit" or "fork"; "" where that is not known.
        held_ns: How long its lock had been held when it committed.
        reads: What the lock had read.
        left_out: How many further data it had read.
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
    kind: str = ""
    held_ns: int = 0
    reads: tuple[DatumRead, ...] = ()
    left_out: int = 0

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
        datum_bytes = self.datum.size + len(self.datum.encoding) if self.datum else 0
        return 256 + READ_BYTES * len(self.reads) + datum_bytes


def recorded_of(wanted: Wanted, cause: Cause | None, found: Retained, commit: int) -> Recorded:
    """Return a version for a recording.

    Args:
        wanted: Which it is.
        cause: Where it comes from; None: that is not known.
        found: What it is.
        commit: Number of its commit in the recording.
    """
    facts = (wanted.slot, wanted.version, wanted.stamp_ns, wanted.shard, commit)
    if cause is None:
        return Recorded(*facts, found.datum, found.null_reason)
    return Recorded(
        *facts, found.datum, found.null_reason, cause.actor, cause.host, cause.pid, cause.kind,
        cause.held_ns, cause.reads, cause.reads_left_out,
    )  # fmt: skip


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
        "kind": recorded.kind,
        "held_ns": recorded.held_ns,
        "reads": [[*one.slot, one.version, one.stamp_ns] for one in recorded.reads],
        "left_out": recorded.left_out,
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
        found = msgpack.unpackb(message, max_array_len=READS_MAX)
    except (ValueError, msgpack.UnpackException) as error:
        raise ProtocolError(f"a recorded version cannot be read: {error}") from error
    if not isinstance(found, dict) or type(found.get("v")) is not int:
        raise ProtocolError("a recorded version is a map with its format under 'v'; found none")
    if found["v"] not in FORMATS:
        raise ProtocolError(
            f"a recorded version has format {found['v']}; this one reads"
            f" {' and '.join(map(str, FORMATS))}"
        )
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
        found.get("kind", ""),
        found.get("held_ns", 0),
        tuple(DatumRead(Slot(*one[:3]), *one[3:]) for one in found.get("reads", ())),
        found.get("left_out", 0),
    )


def _check(found: Mapping[str, Any]) -> None:
    for key, wanted in (_TYPES if found["v"] == 1 else _TYPES | _CAUSE_TYPES).items():
        if type(found.get(key)) is not wanted:
            raise ProtocolError(
                f"a recorded version has {type(found.get(key)).__name__} under {key!r}, not"
                f" {wanted.__name__}"
            )
    if found["null"] and found["null"] not in NullReason.__members__:
        raise ProtocolError(f"a recorded version is null for the unknown reason {found['null']!r}")
    if found.get("kind", "") not in ("", CAUSE_COMMIT, CAUSE_FORK):
        raise ProtocolError(f"a recorded version was made by the unknown way {found['kind']!r}")
    for one in found.get("reads", ()):
        if not isinstance(one, list) or [type(each) for each in one] != _READ_TYPES:
            raise ProtocolError("a recorded version names what it was made of in no known way")
