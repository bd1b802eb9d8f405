"""Valid inputs of every target, of every kind that there is: what mutation begins with."""

from __future__ import annotations

import random
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from fuzz.targets import TYPES, Even, Part, Scan, Side, datum_input, join, packed, row_input
from wire_samples import CLASSES, sample

from enact_dist.actor.report import ActorStatistics, encode_reports
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import SlotVersion
from enact_dist.core.protocol.records import Persist, SlotRecord
from enact_dist.link.folder.mark import MARK_FILE
from enact_dist.link.store.rows import RowKind
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability
from enact_dist.wire import keys
from enact_dist.wire.frames import encode_frame
from enact_dist.wire.payload import encode_datum

PARTS = [Part(Side.LEFT, None), Part(Side.RIGHT, "n" * 300)]
VALUES = (
    Scan(
        np.zeros(3, dtype=[("xyz", "<f4", (3,)), ("when", "<M8[us]")]),
        np.asfortranarray(np.ones((2, 3), np.float32)),
        ["a", "b" * 300],
        {1: 0.5, -7: 2.5},
        (1.0, 2.0),
        (5, "five"),
        b"r" * 300,
        PARTS,
        {"any": [1, 2.5, "text", b"bytes", {"deeper": [True]}]},
    ),
    PARTS[1],
    Even(21),
    -5,
    2.5,
    True,
    "größe",
    bytes(range(256)) * 2,
    list(range(2000)),
    {"a": [1, "x" * 300, np.arange(5)], "b": {"c": np.array("text")}},
    np.arange(12, dtype=">i2").reshape(3, 4),
    np.ones((2, 2), np.float32),
    [1, 2, 1 << 40],
    PARTS,
    {"a": [1.0, 2.0], "b": []},
    {1: (1, 2), -1: ()},
)
assert len(VALUES) == len(TYPES)


def frames(rng: random.Random) -> Iterator[bytes]:
    """Yield a message of every class."""
    for cls in CLASSES:
        header, payload = encode_frame(sample(cls, rng))
        yield join(header, payload or b"")


def data(rng: random.Random) -> Iterator[bytes]:
    """Yield a datum of every type."""
    for kind, (value, datum_type) in enumerate(zip(VALUES, TYPES, strict=True)):
        yield datum_input(kind, encode_datum(value, datum_type))
    yield datum_input(255, Datum(packed(1, {"__type__": None}), b"", 0))


def key_texts(rng: random.Random) -> Iterator[bytes]:
    """Yield a key of every kind."""
    for actor in ("", "größe/#", "fusion", "-", "%2d"):
        yield keys.request_key("cell", "s0", "take_view", actor).encode()
    yield keys.request_key(keys.ANY, keys.ANY, "hello", "x").encode()
    yield keys.notice_key("cell", "s0").encode()
    yield keys.token_key("cell", "fusion@host:7", "5e55").encode()
    yield keys.queryable_key("cell", "s0").encode()


def reports(rng: random.Random) -> Iterator[bytes]:
    """Yield a report of two actors, and one of none."""
    yield encode_reports([ActorStatistics(), ActorStatistics()])
    yield encode_reports([])


def rows(rng: random.Random) -> Iterator[bytes]:
    """Yield a row of every kind that a store writes."""
    folder = _stored(rng)
    connection = sqlite3.connect(folder / "store.db")
    found = connection.execute("SELECT kind, key, body FROM record").fetchall()
    connection.close()
    shutil.rmtree(folder)
    groups = [{RowKind.PREPARED, RowKind.PREPARED_WRITE}, {RowKind.SLOT, RowKind.CAUSE}]
    for together in groups:
        yield row_input(*(one for one in found if one[0] in together))
    for one in found:
        if not any(one[0] in together for together in groups):
            yield row_input(one)
    assert {RowKind(kind) for kind, *_ in found} == set(RowKind), "a kind of row without a sample"


def marks(rng: random.Random) -> Iterator[bytes]:
    """Yield a mark."""
    folder = _stored(rng)
    yield (folder / MARK_FILE).read_bytes()
    shutil.rmtree(folder)


def logs(rng: random.Random) -> Iterator[bytes]:
    """Yield a log with some commits, of small pages so that it is short."""
    folder = Path(tempfile.mkdtemp())
    connection = sqlite3.connect(folder / "db", isolation_level=None)
    for pragma in ("page_size=512", "journal_mode=WAL", "wal_autocheckpoint=0"):
        connection.execute(f"PRAGMA {pragma}")
    connection.execute("CREATE TABLE t (x)")
    for number in range(3):
        connection.execute("INSERT INTO t VALUES (?)", (number,))
    yield (folder / "db-wal").read_bytes()
    connection.close()
    shutil.rmtree(folder)


def _stored(rng: random.Random) -> Path:
    """Return a folder with a record of every class that the store takes."""
    folder = Path(tempfile.mkdtemp())
    store, _ = open_store(folder, unix_s=1)
    for number, record in enumerate(_records(rng), 1):
        together = [record]
        if isinstance(record, SlotRecord):
            # Two states with one cause, which then has a row of its own.
            together += [replace(record, version=record.version + 1, history=True)]
        store.write([Persist(number, tuple(together), Durability.DURABLE)])
    store.close()
    return folder


def _records(rng: random.Random) -> Iterator[object]:
    """Yield records that leave a row of every kind: ends of others, which leave none, come first."""
    from typing import get_args

    from enact_dist.core.protocol import records

    kinds = get_args(records.Record)
    ends = ("Ended", "Done", "Dropped", "Forgotten")
    for kind in sorted(kinds, key=lambda kind: not kind.__name__.endswith(ends)):
        yield _fitting(kind, rng)


def _fitting(kind: type, rng: random.Random) -> object:
    """Return a sample of a record that a shard could write."""
    record = sample(kind, rng)
    if kind.__name__ == "PreparedRecord":
        versions = tuple(SlotVersion(write.slot, 1) for write in record.writes)
        names = {version.slot for version in versions}
        if len(names) < len(versions):
            return _fitting(kind, rng)
        return replace(record, versions=versions)
    if kind.__name__ == "SlotRecord":
        while record.cause is None:
            record = sample(kind, rng)
        return replace(record, volatile=False, same_as=None)
    if kind.__name__ == "KeptRecord" and not record.versions:
        return _fitting(kind, rng)
    if kind.__name__ == "SessionEnded":
        return replace(record, session="ended")  # one that begins again later is not ended
    return record


SEEDS = {
    "frame": frames,
    "datum": data,
    "key": key_texts,
    "report": reports,
    "rows": rows,
    "mark": marks,
    "log": logs,
}
