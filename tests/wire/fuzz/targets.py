"""What is fuzzed: every place where bytes of others become values.

A target takes one input of bytes and returns None where they are refused by the named error, else
what they stand for, having seen that it can be written again and then reads equal.  Whatever else
leaves a target is a finding.
"""

from __future__ import annotations

import enum
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from enact_dist.actor.report import read_reports
from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import DatumTypeError, ProtocolError, StoreError
from enact_dist.link.folder.blobs import Blob
from enact_dist.link.folder.mark import MARK_FILE, read_mark
from enact_dist.link.folder.wal_check import check_wal
from enact_dist.link.store.database import DatabaseRow
from enact_dist.link.store.recovery import put_together, read_contents
from enact_dist.link.store.rows import Key, RowKind, row_checksum
from enact_dist.wire import keys
from enact_dist.wire.codecs import register_codec
from enact_dist.wire.frames import decode_frame, encode_frame
from enact_dist.wire.payload import decode_datum, decode_untyped, encode_datum
from enact_dist.world.listings import unpacked_report

_LENGTH = struct.Struct("<I")
ROWS_MAX = 100
"""Rows of one input: a longer one has nothing new to say."""


def join(*parts: bytes) -> bytes:
    """Return one input of several parts: the lengths of all but the last stand first."""
    return b"".join([*(_LENGTH.pack(len(part)) for part in parts[:-1]), *parts])


def split(raw: bytes, count: int) -> list[bytes]:
    """Take an input apart; lengths that go too far are cut, so that every input is one."""
    begin = _LENGTH.size * (count - 1)
    lengths = [
        int.from_bytes(raw[at : at + _LENGTH.size], "little")
        for at in range(0, begin, _LENGTH.size)
    ]
    parts = []
    for length in lengths:
        parts.append(raw[begin : begin + length])
        begin += length
    return [*parts, raw[begin:]]


# ---------------------------------------------------------------- frames


def frame(raw: bytes) -> object:
    """Read a message of either direction."""
    header, payload = split(raw, 2)
    try:
        message = decode_frame(header, payload)
    except ProtocolError:
        return None
    again = encode_frame(message)
    assert decode_frame(again[0], again[1] or b"") == message
    return message


# ---------------------------------------------------------------- data


class Side(enum.Enum):
    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True)
class Part:
    side: Side
    note: str | None


@dataclass(frozen=True)
class Scan:
    points_m: np.ndarray
    weights: NDArray[np.float32] | None
    labels: list[str]
    scores: dict[int, float]
    box: tuple[float, ...]
    pair: tuple[int, str]
    raw: bytes
    parts: list[Part]
    extra: dict


class Even:
    """A value whose codec refuses half of what it may be given."""

    def __init__(self, half: int) -> None:
        self.half = half


def _even(number: Any) -> Even:
    if number % 2:
        raise ValueError("odd")
    return Even(number // 2)


register_codec(Side, "side", encode=lambda side: side.value, decode=Side)
register_codec(Even, "half", encode=lambda even: even.half * 2, decode=_even)
TYPES: tuple[Any, ...] = (
    Scan,
    Part,
    Even,
    int,
    float,
    bool,
    str,
    bytes,
    list,
    dict,
    np.ndarray,
    NDArray[np.float32],
    list[int],
    list[Part],
    dict[str, list[float]],
    dict[int, tuple[int, ...]],
)
"""What an input is read as; the first byte says which (255: as none at all)."""


def datum_input(kind: int, datum: Datum) -> bytes:
    """Return the input of a datum that is read as `TYPES[kind]`."""
    return bytes([kind]) + join(datum.encoding, bytes(datum.body))


def datum(raw: bytes) -> object:
    """Read a datum, as a value of a type and as plain Python."""
    kind, rest = (raw[0] if raw else 255), raw[1:]
    encoding, body = split(rest, 2)
    received = Datum(encoding, body, len(body))
    try:
        found = decode_untyped(received)
    except ProtocolError:
        found = None
    datum_type = TYPES[kind % len(TYPES)] if kind != 255 else object
    try:
        value = decode_datum(received, datum_type)
    except (ProtocolError, DatumTypeError):
        return found
    if datum_type is not object:
        written = encode_datum(value, datum_type)
        again = encode_datum(decode_datum(written, datum_type), datum_type)
        assert (again.encoding, again.body) == (written.encoding, written.body)
    return value


# ---------------------------------------------------------------- names and reports


def key(raw: bytes) -> object:
    """Read the key of a request, a notice or a token."""
    text = raw.decode("utf-8", "surrogatepass") if _is_text(raw) else raw.decode("latin-1")
    keys.token_of(text)
    keys.shard_of(text)
    try:
        parts = keys.parse_request_key(text)
    except ProtocolError:
        return None
    try:
        # An answer takes verb and actor as they stand in the key of the question.
        again = keys.request_key(parts.cell, parts.shard, *text.split("/")[-2:])
    except ValueError:
        return None
    assert keys.parse_request_key(again) == parts
    return parts


def _is_text(raw: bytes) -> bool:
    try:
        raw.decode("utf-8", "surrogatepass")
    except UnicodeDecodeError:
        return False
    return True


def report(raw: bytes) -> object:
    """Read an actor's report out of a keep-alive; it is only shown, never written again."""
    try:
        return read_reports(unpacked_report(raw))
    except ProtocolError:
        return None


# ---------------------------------------------------------------- a store's folder


class _Rows:
    """A database that holds these rows."""

    def __init__(self, rows: list[DatabaseRow]) -> None:
        self._rows = rows

    def rows(self) -> Iterator[DatabaseRow]:
        return iter(self._rows)


def row_input(*stored: tuple[int, bytes, bytes]) -> bytes:
    """Return the input of rows (kind, key, body)."""
    return b"".join(
        bytes([kind]) + _LENGTH.pack(len(name)) + _LENGTH.pack(len(body)) + name + body
        for kind, name, body in stored
    )


def rows(raw: bytes) -> object:
    """Read rows whose checksums are right, as a program with a bug may have written them."""
    stored = []
    begin = 0
    while begin < len(raw) and len(stored) < ROWS_MAX:
        kind = raw[begin] % (max(RowKind) + 2)
        middle = begin + 9 + int.from_bytes(raw[begin + 1 : begin + 5], "little")
        end = middle + int.from_bytes(raw[begin + 5 : begin + 9], "little")
        name, body = raw[begin + 9 : middle], raw[middle:end]
        crc = row_checksum(Key(kind, name), 1, body)  # type: ignore[arg-type]  # any number at all
        stored.append(DatabaseRow(len(stored) + 1, kind, 1, name, body, crc))
        begin = end
    try:
        contents = read_contents(_Rows(stored), Path("store.db"))  # type: ignore[arg-type]  # rows
        put_together(contents, Path("store.db"))
    except StoreError:
        return None
    assert all(isinstance(blob, Blob) for blob in contents.states.blobs.values())
    return contents


_folder = tempfile.TemporaryDirectory(prefix="enact-fuzz-")
_scratch = Path(_folder.name)


def mark(raw: bytes) -> object:
    """Read a store's mark."""
    (_scratch / MARK_FILE).write_bytes(raw)
    return read_mark(_scratch)


def log(raw: bytes) -> object:
    """Look for damage in a write-ahead log."""
    path = _scratch / "log"
    path.write_bytes(raw)
    verdict = check_wal(path)
    assert verdict.damaged_at is None or 0 <= verdict.damaged_at < len(raw)
    return verdict if verdict.frames else None


TARGETS: dict[str, Callable[[bytes], object]] = {
    "frame": frame,
    "datum": datum,
    "key": key,
    "report": report,
    "rows": rows,
    "mark": mark,
    "log": log,
}
"""Targets by the name of their folder in the corpus."""


def packed(*values: object) -> bytes:
    """Return values as msgpack, one after another."""
    return b"".join(msgpack.packb(value) for value in values)
