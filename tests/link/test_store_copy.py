"""Back-ups of folders that are written meanwhile, and what a restored one is."""

import os
import shutil
import signal
import time
from types import SimpleNamespace

import pytest
from store_writer import persist, slot_record

from enact_dist.errors import StoreError
from enact_dist.link import held_bodies as held_bodies_module
from enact_dist.link import store_copy
from enact_dist.link.folder_lock import FolderLock
from enact_dist.link.held_bodies import HELD_FOLDER, held_bodies
from enact_dist.link.store import open_store, read_store
from enact_dist.link.store_copy import BACKUP_FILE, back_up, restore
from enact_dist.terms import Durability

NAMES = {"cell": "line", "shard": "left"}
LARGE = 70_000
GROUPS = 20


def versions(folder):
    """Return the newest version of each slot of a folder."""
    with read_store(folder) as stored:
        return {record.slot.entity: record.version for record in stored.slots}


def fill(folder, version, *, unix_s=1):
    """Write one version of two slots, one of them large, and close; return the epoch."""
    store, found = open_store(folder, unix_s=unix_s)
    store.write([persist(slot_record("a", version, size=LARGE), slot_record("b", version))])
    store.close()
    return found.epoch


@pytest.fixture
def folder(tmp_path):
    """The folder of a stopped shard."""
    fill(tmp_path / "left", 1)
    return tmp_path / "left"


def test_a_stopped_shard_comes_back_as_it_was(folder, tmp_path):
    """On the way back with a later epoch; what was there goes aside."""
    backup = back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    assert (backup.entities, backup.states, backup.size) == (2, 2, LARGE + 200)
    fill(folder, 7)

    with pytest.raises(StoreError, match="has data; say --replace"):
        restore(tmp_path / "copy", folder, unix_s=100, **NAMES)
    _, aside = restore(tmp_path / "copy", folder, unix_s=100, replace=True, **NAMES)

    assert versions(folder) == {"a": 1, "b": 1}
    assert versions(aside) == {"a": 7, "b": 7}
    assert restore(tmp_path / "copy", folder, unix_s=100, replace=True, **NAMES)[1] != aside
    assert restore(tmp_path / "copy", tmp_path / "new", unix_s=100, **NAMES)[1] is None


def test_no_epoch_of_before_comes_again(folder, tmp_path):
    """Neither one of the folder that is replaced, nor of one replaced earlier, whatever the clock."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    epochs = [fill(folder, 2), fill(folder, 3, unix_s=500)]  # the clock was ahead for a while

    restore(tmp_path / "copy", folder, unix_s=100, replace=True, **NAMES)
    epochs.append(fill(folder, 3))
    assert epochs[-1] > max(epochs[:-1])
    shutil.rmtree(folder)  # as after a kill between the two renames
    restore(tmp_path / "copy", folder, unix_s=100, **NAMES)
    assert fill(folder, 3) >= epochs[-1]


def write_on(folder, said):
    """Write batches of two slots each until somebody kills this process; say which are kept."""
    store, _ = open_store(folder, unix_s=1)
    for version in range(1, 1_000_000):
        names = [f"{part}{version % GROUPS}" for part in "ab"]
        records = [slot_record(name, version, size=LARGE) for name in names]
        records.append(slot_record("c", version, size=30_000))  # so that the log begins anew
        store.write([persist(*records, durability=Durability.OS)])
        store.rest()
        os.pwrite(said, version.to_bytes(8, "little"), 0)


def test_a_backup_of_a_shard_that_writes_is_one_state(tmp_path):
    """The slots of each batch are of one version, and what was acknowledged before is there."""
    folder = tmp_path / "left"
    said = os.open(tmp_path / "said", os.O_RDWR | os.O_CREAT)
    pid = os.fork()
    if not pid:  # another process: SQLite's locks are those of a process
        try:
            write_on(folder, said)
        finally:
            os._exit(1)
    try:
        kept = 0
        for number in range(6):
            deadline_s = time.monotonic() + 30.0
            while (now := int.from_bytes(os.pread(said, 8, 0), "little")) <= kept + GROUPS:
                assert time.monotonic() < deadline_s
            kept = now
            back_up(folder, tmp_path / f"copy{number}", unix_s=5, **NAMES)
            found = versions(tmp_path / f"copy{number}")
            assert all(found[f"a{group}"] == found[f"b{group}"] for group in range(GROUPS))
            assert found["c"] == max(found.values()) >= kept
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(said)


def test_a_log_begun_anew_while_it_is_copied_is_copied_again(folder, tmp_path, monkeypatch):
    """Then rows and log do not fit together."""
    copies = []
    real = shutil.copyfile

    def copyfile(source, target):
        copies.append(source.name)
        if source.name == "store.db" and copies.count("store.db") == 1:
            (folder / "store.db-wal").write_bytes(b"a new log")
        if copies.count("store.db") == 2:
            (folder / "store.db-wal").unlink(missing_ok=True)
        return real(source, target)

    monkeypatch.setattr(store_copy.shutil, "copyfile", copyfile)
    back_up(folder, tmp_path / "copy", unix_s=5, **NAMES)
    assert copies.count("store.db") == 3
    assert versions(tmp_path / "copy") == {"a": 1, "b": 1}


def test_a_shard_that_starts_during_a_restore_loses_nothing(folder, tmp_path, monkeypatch):
    """An empty folder may have data by the time that the backup is read."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    new, build = tmp_path / "new", store_copy._build
    new.mkdir()

    def meanwhile(*arguments, **more):
        build(*arguments, **more)
        fill(new, 5)

    monkeypatch.setattr(store_copy, "_build", meanwhile)
    with pytest.raises(StoreError, match="has data; say --replace"):
        restore(tmp_path / "copy", new, unix_s=100, **NAMES)
    assert versions(new) == {"a": 5, "b": 5}
    monkeypatch.undo()
    assert restore(tmp_path / "copy", new, unix_s=100, replace=True, **NAMES)[1] is not None
    assert versions(new) == {"a": 1, "b": 1}


def test_what_must_not_be_restored_is_refused(folder, tmp_path):
    """Another shard's, one from the future, a changed one, and onto a folder in use."""
    copy = tmp_path / "copy"
    back_up(folder, copy, unix_s=100, **NAMES)
    new = tmp_path / "new"
    with pytest.raises(StoreError, match="backup of shard left of cell line, not of right of line"):
        restore(copy, new, unix_s=100, cell="line", shard="right")
    with pytest.raises(StoreError, match=r"1970-01-01 00:01:39 UTC, the backup is of .* set the"):
        restore(copy, new, unix_s=99, **NAMES)
    with pytest.raises(StoreError, match="is no backup of a shard"):
        restore(folder, new, unix_s=100, **NAMES)
    lock = FolderLock(folder)
    with pytest.raises(StoreError, match="is in use by process"):
        restore(copy, folder, unix_s=100, replace=True, **NAMES)
    lock.close()
    assert versions(folder) == {"a": 1, "b": 1}

    blob = next((copy / "blobs").iterdir())
    blob.write_bytes(bytes(LARGE))
    with pytest.raises(StoreError, match="its checksum is wrong"):
        restore(copy, new, unix_s=100, **NAMES)
    blob.unlink()
    (copy / "mark").write_bytes(b"")
    with pytest.raises(StoreError, match=r"is missing|is not what it was"):
        restore(copy, new, unix_s=100, **NAMES)
    assert not new.exists()


def test_a_damaged_shard_is_not_backed_up(folder, tmp_path):
    """A backup that cannot be restored would be found out too late; nor is one replaced."""
    (tmp_path / "there").mkdir()
    with pytest.raises(StoreError, match="there is there already"):
        back_up(folder, tmp_path / "there", unix_s=1, **NAMES)
    with pytest.raises(StoreError, match="no shard has its data in"):
        back_up(tmp_path / "there", tmp_path / "copy", unix_s=1, **NAMES)
    next((folder / "blobs").iterdir()).write_bytes(bytes(LARGE))
    with pytest.raises(StoreError, match="its checksum is wrong"):
        back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
    assert not (tmp_path / "copy" / BACKUP_FILE).exists()
    assert not (folder / HELD_FOLDER).exists()


def test_one_backup_at_a_time(folder, tmp_path):
    """The second is told so, and takes nothing from under the first; nor does a start."""
    with held_bodies(folder) as bodies:
        bodies.hold(folder / "blobs")
        with pytest.raises(StoreError, match=r"a backup of .* is under way.*wait for its end"):
            back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
        fill(folder, 2)
        assert len(list((folder / HELD_FOLDER).iterdir())) == 1
    assert not (folder / HELD_FOLDER).exists()
    back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)


def test_a_start_lets_go_of_what_a_killed_backup_held(folder):
    """Bodies that the shard has replaced since would stay on the disk."""
    links = folder / HELD_FOLDER
    links.mkdir()
    body = next((folder / "blobs").iterdir())
    os.link(body, links / body.name)
    fill(folder, 2)
    assert not links.exists()
    assert versions(folder) == {"a": 2, "b": 2}


def test_links_that_cannot_be_removed_keep_no_shard_from_its_start(folder, monkeypatch, caplog):
    """As those of a backup that another user has made; they cost room, and the log says where."""
    (folder / HELD_FOLDER).mkdir()

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(held_bodies_module, "shutil", SimpleNamespace(rmtree=refuse))
    fill(folder, 2)
    assert "stays: [Errno 13] Permission denied" in caplog.text
