"""Bytes of a small store flipped, one after the other: refused by place, or harmless.

Harmless is only what changes nothing: free space of a page, a field that nobody reads.  Flipped are
the log of a killed process, database and large body of a closed store, mark and format: of the large
files one byte in 16, others in each run.

    ENACT_FLIP_EVERY=1 python -m pytest tests/link/test_store_flips.py       # every byte, ten minutes
    ENACT_FLIP_FIRST=7 python -m pytest tests/link/test_store_flips.py       # once again
"""

import collections
import os
import random
import re
import secrets
import shutil
from dataclasses import replace

import pytest
from store_disk import memory_folder
from store_model import State
from store_writer import outcome_record, persist, slot_record

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot, Token
from enact_dist.core.protocol.messages import Cause, DatumRead, Item, SlotVersion, WriteItem
from enact_dist.core.protocol.records import (
    DecisionRecord,
    KeptRecord,
    PreparedRecord,
    SessionRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.errors import StoreError
from enact_dist.link.folder.blobs import Blob, BlobFolder, DamagedBlobError
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability

pytestmark = pytest.mark.slow
FRAME_BYTES = 24 + 4096
LARGE = 66_000
EVERY = int(os.environ.get("ENACT_FLIP_EVERY", "16"))
FIRST = int(os.environ.get("ENACT_FLIP_FIRST", secrets.randbelow(EVERY)))
READ = Slot("online", "b", "aspect")


CAUSE = Cause(LockId("s", 1, 1), "commit", "a", "h", 1, 5, 2, (DatumRead(READ, 1, 4),), 3, ())


def fork(name, version, **more):
    """Return the state of a fork's slot, with the bytes of its source's version."""
    source = slot_record(name, version, **more)
    same_as = SlotVersion(source.slot, version)
    slot = source.slot._replace(context="fork")
    return replace(source, slot=slot, same_as=same_as, cause=CAUSE)


def batches():
    """Yield small batches of records of many kinds; the last one is `os`."""
    slot = slot_record("prepared", 1).slot
    yield [
        SessionRecord("session", 5),
        WorldRecord("online"),
        slot_record("a", 1, size=40),
        slot_record("large", 1, size=LARGE),
        outcome_record(0, 1),
        PreparedRecord(
            LockId("far", 1, 1),
            Token(1, 1),
            (Item(2, *slot),),
            (WriteItem(slot, Datum(b"e", b"body", 4)),),
            (SlotVersion(slot, 1),),
            7,
            "s1",
            Token(2, 2),
            CAUSE,
        ),
        DecisionRecord(LockId("near", 1, 1), Position(5, "s0"), ("s1",)),
        WorldRecord("fork", "online", 7),
        WorldDropped("gone", 3),
        KeptRecord("label", (SlotVersion(slot, 1),)),
        fork("a", 1, size=40),
        fork("large", 1, size=LARGE),
    ]
    yield [replace(slot_record("a", 2, size=60), history=True, cause=CAUSE)]


def offsets(content):
    """Return the bytes that are flipped: of each `EVERY` one, from a drawn one on."""
    first = FIRST % EVERY
    print(f"\nENACT_FLIP_FIRST={first}")
    return range(first, len(content), EVERY)


@pytest.fixture
def memory(tmp_path):
    """A folder on which a sync costs nothing."""
    with memory_folder(tmp_path) as folder:
        yield folder


@pytest.fixture
def folders(memory):
    """A folder as `kill -9` leaves it, the same one as a clean end does, and what they hold."""
    state = State()
    folder = memory / "closed"
    store, _ = open_store(folder, unix_s=1)
    for records in batches():
        durability = Durability.OS if len(records) == 1 else Durability.DURABLE
        store.write([persist(*records, durability=durability)])
        state = state.after([(durability, records)])
    shutil.copytree(folder, memory / "killed")
    store.close()
    return memory / "killed", folder, state


class Flipper:
    """Flips bytes of one file in a folder that is made again whenever it was opened."""

    def __init__(self, whole, file, state, folder):
        self.whole, self.file, self.state = whole, file, state
        self.folder = folder / "flipped"
        self.content = (whole / file).read_bytes()
        self.outcomes = collections.Counter()
        self.harmless = set()
        shutil.copytree(whole, self.folder)

    def make_again(self):
        """Put the folder back as it was."""
        shutil.rmtree(self.folder)
        shutil.copytree(self.whole, self.folder)

    def flip(self, offset, bits):
        """Flip bits of one byte; return the refusal, None where all is as it was."""
        spoilt = bytearray(self.content)
        spoilt[offset] ^= bits
        (self.folder / self.file).write_bytes(spoilt)
        try:
            store, recovered = open_store(self.folder, unix_s=1)
        except StoreError as refused:
            self.outcomes["refused"] += 1
            if "is damaged at byte" not in str(refused):
                self.make_again()  # else it was refused before anything was opened
            return str(refused)
        difference = self.state.difference(recovered, power_cut=False)
        store.close()
        self.make_again()
        assert not difference, f"byte {offset} of {self.file}: {difference}"
        self.outcomes["harmless"] += 1
        self.harmless.add(offset)
        return None


def test_byte_of_the_log_is_refused_with_its_frame(folders, memory):
    """Header, frame headers, salts, checksums, pages: each flip is placed in its frame."""
    killed, _, state = folders
    flipper = Flipper(killed, "store.db-wal", state, memory)
    rng = random.Random(5)
    frames = (len(flipper.content) - 32) // FRAME_BYTES
    for offset in offsets(flipper.content):
        refused = flipper.flip(offset, rng.randrange(1, 256))
        assert refused is not None, f"byte {offset} of the log may be anything"
        place = 0 if offset < 32 else 32 + (offset - 32) // FRAME_BYTES * FRAME_BYTES
        (found,) = re.findall(
            r"store\.db-wal is (?:damaged at|cut or damaged from) byte (\d+)", refused
        )
        assert int(found) == place, (offset, refused)
    print(f"\nlog of {frames} frames: {len(flipper.content)} bytes, {dict(flipper.outcomes)}")
    assert frames >= 3


def test_byte_of_the_database_is_refused_or_harmless(folders, memory):
    """SQLite's own check and the checksums of rows leave only free space and idle fields."""
    _, closed, state = folders
    flipper = Flipper(closed, "store.db", state, memory)
    rng = random.Random(6)
    for offset in offsets(flipper.content):
        refused = flipper.flip(offset, 1 << rng.randrange(8))
        assert refused is None or "store.db" in refused or str(flipper.folder) in refused
    print(f"\ndatabase: {len(flipper.content)} bytes, {dict(flipper.outcomes)}")
    assert flipper.outcomes["refused"] > 500 // EVERY


@pytest.mark.parametrize("file", ["mark", "format", "lock"])
def test_byte_of_the_small_files_is_refused_or_harmless(folders, memory, file):
    """A mark and a format that cannot be read are refused; what a lock says is for people."""
    killed, _, state = folders
    flipper = Flipper(killed, file, state, memory)
    for offset in range(len(flipper.content)):
        for bit in range(8):
            flipper.flip(offset, 1 << bit)
    print(f"\n{file}: {len(flipper.content)} bytes, {dict(flipper.outcomes)}")
    assert (flipper.outcomes["refused"] > 0) == (file != "lock")


def test_byte_of_a_large_body_is_refused(folders, memory):
    """Each byte by the check of its file, one in 500 by a whole start, which names the slot."""
    _, closed, state = folders
    (name,) = (path.name for path in (closed / "blobs").iterdir())
    folder = BlobFolder(memory / "closed" / "blobs", epoch=9)
    content = (closed / "blobs" / name).read_bytes()
    import zlib

    blob = Blob(name, len(content), zlib.crc32(content), synced=True)
    assert folder.map(blob, whole=True).body == content
    with (closed / "blobs" / name).open("r+b", buffering=0) as file:
        for offset in offsets(content):
            byte = content[offset]
            file.seek(offset)
            file.write(bytes([byte ^ (1 << offset % 8)]))
            with pytest.raises(DamagedBlobError, match="its checksum is wrong"):
                folder.map(blob, whole=True)
            file.seek(offset)
            file.write(bytes([byte]))
    flipper = Flipper(closed, f"blobs/{name}", state, memory)
    for offset in range(0, len(content), 500):
        refused = flipper.flip(offset, 0x10)
        assert f"{name} holds online:large/aspect, version 1" in refused
