"""A folder with stamps that no clock gives: refused by name, and back from its backup."""

from __future__ import annotations

import logging

import pytest
from store_writer import fill, persist, slot_record, versions

from enact_dist.core.protocol.parts import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import StoreError
from enact_dist.link.offline.backup import back_up, restore
from enact_dist.link.opening import open_host
from enact_dist.link.store.store import open_store

NAMES = {"cell": "line", "shard": "left"}
SETTINGS = ShardSettings("left", PlacementMap(1, (ShardEntry("left", ()),), ()))


def stamped(folder, stamp_ns):
    """Commit a datum with this stamp, as an older release could be made to."""
    store, _ = open_store(folder, unix_s=1)
    record = slot_record("a", 9, size=10)
    store.write([persist(type(record)(record.slot, 9, stamp_ns, record.datum, ""))])
    store.close()


@pytest.fixture
def folder(tmp_path):
    """The folder of a stopped shard."""
    fill(tmp_path / "left", 1)
    return tmp_path / "left"


def test_folder_with_a_stamp_beyond_all_clocks_does_not_start(folder, tmp_path):
    """Each later grant could not be sent; the remedy that is named is one."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    stamped(folder, (1 << 63) - 1)

    with pytest.raises(
        StoreError, match=r"slot .*a.* with timestamp 92\d+, .*shard restore"
    ) as refused:
        open_host(SETTINGS, folder)
    assert refused.value.path == str(folder)
    restore(tmp_path / "copy", folder, unix_s=100, replace=True, **NAMES)

    open_host(SETTINGS, folder).close()
    assert versions(folder) == {"a": 1, "b": 1}


def test_folder_that_is_ahead_of_the_clock_starts_with_a_warning(folder, caplog):
    """Its host may have started without the right time: data must not be kept from people."""
    stamped(folder, 4_000_000_000_000_000_000)

    with caplog.at_level(logging.WARNING, "enact.store"):
        open_host(SETTINGS, folder).close()

    assert any("ahead of this host's clock" in record.message for record in caplog.records)
