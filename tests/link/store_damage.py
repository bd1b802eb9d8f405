"""How tests damage a folder of a shard, and how they see that it is refused."""

import pytest

from enact_dist.errors import StoreError
from enact_dist.link.folder import mark as store_mark
from enact_dist.link.store.store import open_store

CHANGED_ROWS = ("batch = batch + 1", "kind = 3", "kind = 99", "body = 'text'", "key = 'text'")
"""What was set in one row by hand, as SQL, in a folder's database or in one of the cell."""
FRAME_BYTES = 24 + 4096
LOG_HEADER_BYTES = 32


def refusal(folder):
    """Return why a folder is refused, having seen that a second try is refused as well."""
    with pytest.raises(StoreError) as refused:
        open_store(folder, unix_s=1)
    with pytest.raises(StoreError):
        open_store(folder, unix_s=1)
    return refused.value


def flip(path, offset):
    """Turn over one bit."""
    content = bytearray(path.read_bytes())
    content[offset] ^= 0x10
    path.write_bytes(content)


def after_power_cut(folder):
    """Let the mark say that the folder was written before the system started anew."""
    mark = store_mark.read_mark(folder)
    file = store_mark.MarkFile.open(folder, mark.batch)
    file._boot = bytes(range(16))
    file.note(mark.batch, forced=True)
    file.close()


def frame_offset(number):
    return LOG_HEADER_BYTES + number * FRAME_BYTES


def frames_of(folder):
    return ((folder / "store.db-wal").stat().st_size - LOG_HEADER_BYTES) // FRAME_BYTES
