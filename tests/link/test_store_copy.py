"""Back-ups of folders that are written meanwhile, and what a restored one is."""

import errno
import hashlib
import json
import os
import shutil
import signal
import time
from random import Random
from types import SimpleNamespace

import pytest
from store_writer import LARGE_BYTES as LARGE
from store_writer import fill, persist, slot_record, versions

from enact_dist.errors import StoreError
from enact_dist.link.folder import held_bodies as held_bodies_module
from enact_dist.link.folder.held_bodies import HELD_FOLDER, held_bodies, hold
from enact_dist.link.folder.lock import FolderLock
from enact_dist.link.offline import backup as store_copy
from enact_dist.link.offline import backup_files
from enact_dist.link.offline.backup import back_up, restore
from enact_dist.link.offline.backup_files import BACKUP_FILE, read_sealed, sealed
from enact_dist.link.store.store import open_store
from enact_dist.terms import Durability

NAMES = {"cell": "line", "shard": "left"}
GROUPS = 20


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

    with pytest.raises(StoreError, match="has data; use --replace"):
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

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    back_up(folder, tmp_path / "copy", unix_s=5, **NAMES)
    assert copies.count("store.db") == 3
    assert versions(tmp_path / "copy") == {"a": 1, "b": 1}


def test_a_full_disk_of_a_backup_is_not_blamed_on_the_data(folder, tmp_path, monkeypatch):
    """The error of a copy names both files, and first the one that could be read."""

    def full(source, target, **_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(source), None, str(target))

    monkeypatch.setattr(shutil, "copyfile", full)

    with pytest.raises(StoreError, match=r"cannot be written to .*copy .*name another place"):
        back_up(folder, tmp_path / "copy", cell="c", shard="left", unix_s=1)


def test_a_shard_that_starts_during_a_restore_loses_nothing(folder, tmp_path, monkeypatch):
    """An empty folder may have data by the time that the backup is read."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    new, build = tmp_path / "new", store_copy._build
    new.mkdir()

    def meanwhile(*arguments, **more):
        build(*arguments, **more)
        fill(new, 5)

    monkeypatch.setattr(store_copy, "_build", meanwhile)
    with pytest.raises(StoreError, match="has data; use --replace"):
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
    with pytest.raises(StoreError, match=f"{blob.name} has {LARGE} bytes with SHA-256"):
        restore(copy, new, unix_s=100, **NAMES)
    blob.unlink()
    (copy / "mark").write_bytes(b"")
    with pytest.raises(StoreError, match=r"mark has 0 bytes .* \(and 1 more files\)"):
        restore(copy, new, unix_s=100, **NAMES)
    assert not new.exists()


def test_a_damaged_shard_is_not_backed_up(folder, tmp_path):
    """A backup that cannot be restored would be found out too late; nor is one replaced."""
    (tmp_path / "there").mkdir()
    with pytest.raises(StoreError, match="there exists already"):
        back_up(folder, tmp_path / "there", unix_s=1, **NAMES)
    with pytest.raises(StoreError, match="holds no data of a shard"):
        back_up(tmp_path / "there", tmp_path / "copy", unix_s=1, **NAMES)
    next((folder / "blobs").iterdir()).write_bytes(bytes(LARGE))
    with pytest.raises(StoreError, match="its checksum is wrong"):
        back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
    assert not (tmp_path / "copy" / BACKUP_FILE).exists()
    assert not (folder / HELD_FOLDER).exists()


def test_one_backup_at_a_time(folder, tmp_path):
    """The second is told so, and takes nothing from under the first; nor does a start."""
    with held_bodies(folder, tmp_path / "first") as held:
        hold(folder / "blobs", held)
        by = f"by process {os.getpid()} on host .* into {tmp_path / 'first'}; .*wait until it ends"
        with pytest.raises(StoreError, match=f"a backup of .* is in progress, {by}"):
            back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
        fill(folder, 2)
        assert len(list((folder / HELD_FOLDER).glob("*.blob"))) == 1
    assert not (folder / HELD_FOLDER).exists()
    back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)


def in_a_child(act):
    """Run `act` in another process until this one kills it; return how, as soon as it says `1`."""
    heard, said = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            act(lambda: (os.write(said, b"1"), signal.pause()))
        finally:
            os._exit(1)
    os.close(said)
    assert os.read(heard, 1) == b"1"
    os.close(heard)

    def kill():
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)

    return pid, kill


def test_backups_into_one_place_are_told_of_each_other(folder, tmp_path, monkeypatch):
    """Of two shards, so that each has its own lock; what a killed one has left goes."""
    fill(tmp_path / "right", 1)
    copy, right = tmp_path / "copy", {"cell": "line", "shard": "right"}

    def backup(rest):
        monkeypatch.setattr(store_copy, "sync_all", lambda _: rest())
        back_up(folder, copy, unix_s=1, **NAMES)

    _, kill = in_a_child(backup)
    try:
        with pytest.raises(StoreError, match=r"another backup or restore works in .*copy.partial"):
            back_up(tmp_path / "right", copy, unix_s=1, **right)
    finally:
        kill()
    assert (tmp_path / "copy.partial" / BACKUP_FILE).exists()
    back_up(tmp_path / "right", copy, unix_s=1, **right)
    assert not (tmp_path / "copy.partial").exists()
    assert restore(copy, tmp_path / "new", unix_s=1, **right)[0].shard == "right"


def test_a_backup_is_made_where_no_folder_can_be_locked(folder, tmp_path, monkeypatch):
    """As on NFS; what a killed one has left there goes, too."""

    def refuse(*_):
        raise OSError(errno.EBADF, "Bad file descriptor")

    (tmp_path / "copy.partial" / "blobs").mkdir(parents=True)
    monkeypatch.setattr(backup_files, "fcntl", SimpleNamespace(flock=refuse, LOCK_EX=2, LOCK_NB=4))
    back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
    restore(tmp_path / "copy", tmp_path / "new", unix_s=1, **NAMES)
    assert versions(tmp_path / "new") == {"a": 1, "b": 1}


def test_a_place_that_is_taken_meanwhile_is_there_already(folder, tmp_path, monkeypatch):
    """And no fault of the disk; what was copied for it goes."""

    def taken(_):
        (tmp_path / "copy").mkdir()
        (tmp_path / "copy" / "notes.txt").touch()

    monkeypatch.setattr(store_copy, "sync_all", taken)
    with pytest.raises(StoreError, match="copy exists already; name a new folder"):
        back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy", "left"]


def test_two_restores_at_once_are_told_of_each_other(folder, tmp_path, monkeypatch):
    """The second must not take from under the first what that has built."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    back_up(folder, copy, unix_s=100, **NAMES)
    build = store_copy._build

    def second(*arguments, **more):
        build(*arguments, **more)
        with pytest.raises(StoreError, match=r"another backup or restore works in .*new.restoring"):
            restore(copy, new, unix_s=100, **NAMES)

    monkeypatch.setattr(store_copy, "_build", second)
    restore(copy, new, unix_s=100, **NAMES)
    assert versions(new) == {"a": 1, "b": 1}


def test_a_start_lets_go_of_what_a_killed_backup_held(folder, tmp_path, monkeypatch, caplog):
    """Bodies that the shard has replaced since would stay on the disk; the log says whose it was."""
    links = folder / HELD_FOLDER

    def backup(rest):
        monkeypatch.setattr(store_copy, "sync_all", lambda _: rest())
        back_up(folder, tmp_path / "copy", unix_s=1, **NAMES)

    pid, kill = in_a_child(backup)
    kill()
    assert len(list(links.glob("*.blob"))) == 1
    fill(folder, 2)
    assert not links.exists()
    assert f"a backup was killed, by process {pid} on host" in caplog.text
    assert f"into {tmp_path / 'copy'}" in caplog.text
    assert versions(folder) == {"a": 2, "b": 2}


def test_links_that_cannot_be_removed_keep_no_shard_from_its_start(folder, monkeypatch, caplog):
    """As those of a backup that another user has made; they cost room, and the log says where."""
    (folder / HELD_FOLDER).mkdir()

    def refuse(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(held_bodies_module, "shutil", SimpleNamespace(rmtree=refuse))
    fill(folder, 2)
    assert "left: [Errno 13] Permission denied" in caplog.text


def damages(random, size):
    """Yield a name and an edit of the bytes of a file, several of each kind."""
    for _ in range(12):
        at, bit = random.randrange(size), 1 << random.randrange(8)
        yield (
            f"bit {bit} of byte {at}",
            lambda b, at=at, bit=bit: b[:at] + bytes((b[at] ^ bit,)) + b[at + 1 :],
        )
    cut = random.randrange(size)
    yield f"cut to {cut}", lambda b: b[:cut]
    yield "empty", lambda _: b""
    yield "one byte more", lambda b: b + bytes((random.randrange(256),))
    yield "one byte less", lambda b: b[:-1]
    yield "missing", lambda _: None


@pytest.mark.parametrize("kind", ["backup.json", "mark", "format", "store.db", "blobs"])
def test_one_byte_of_a_backup_that_differs_is_refused(folder, tmp_path, kind):
    """Whatever the byte means, before anything is written; the error names the file."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    back_up(folder, copy, unix_s=100, **NAMES)
    path = copy / kind if kind != "blobs" else next((copy / kind).iterdir())
    whole, random = path.read_bytes(), Random(7)

    for what, edit in damages(random, len(whole)):
        damaged = edit(whole)
        path.unlink()
        if damaged is not None:
            path.write_bytes(damaged)
        with pytest.raises(StoreError) as found:
            restore(copy, new, unix_s=200, **NAMES)
            pytest.fail(f"{kind}, {what}")
        assert path.name in str(found.value), what
        if kind != "backup.json":
            assert digest_of_bytes(whole) in str(found.value)
            assert damaged is None or digest_of_bytes(damaged) in str(found.value)
        assert not new.exists()
        assert not new.with_name("new.restoring").exists()
        path.write_bytes(whole)
    restore(copy, new, unix_s=200, **NAMES)
    assert versions(new) == {"a": 1, "b": 1}


def digest_of_bytes(content):
    return f"{len(content)} bytes with SHA-256 {hashlib.sha256(content).hexdigest()}"


def test_what_lies_beside_the_files_of_a_backup_is_not_restored(folder, tmp_path):
    """Nor does it stand in the way; a log of another database would be read as this one's."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    store, _ = open_store(folder, unix_s=1)
    try:
        store.write([persist(slot_record("a", 2))])
        back_up(folder, copy, unix_s=100, **NAMES)
        files = {path.relative_to(copy).as_posix() for path in copy.rglob("*") if path.is_file()}
        assert files == {*read_sealed(copy)[1], BACKUP_FILE}
        shutil.copyfile(folder / "store.db-wal", copy / "store.db-wal")
    finally:
        store.close()
    (copy / "notes.txt").write_text("of the old host")

    restore(copy, new, unix_s=200, **NAMES)

    assert versions(new) == {"a": 2, "b": 1}
    assert not (new / "notes.txt").exists()


def test_a_copy_that_is_not_what_was_copied_is_refused(folder, tmp_path, monkeypatch):
    """A disk may fail under the restored folder, too."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    back_up(folder, copy, unix_s=100, **NAMES)
    real = shutil.copyfile

    def copyfile(source, target):
        real(source, target)
        if target.name == "mark":
            target.write_bytes(target.read_bytes()[:-1])

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    with pytest.raises(StoreError, match=r"new.restoring/mark has 43 bytes"):
        restore(copy, new, unix_s=200, **NAMES)
    assert not new.exists()


def test_a_backup_of_before_there_were_digests_is_restored(folder, tmp_path):
    """It says so of itself; a newer one cannot pass for it, whatever it has lost."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    back_up(folder, copy, unix_s=100, **NAMES)
    told = json.loads((copy / BACKUP_FILE).read_text())
    for lost in ("sha256", "files", "modes"):
        del told[lost]
        (copy / BACKUP_FILE).write_text(json.dumps(told))
        if lost != "modes":
            with pytest.raises(StoreError, match=r"backup.json is damaged .*modes"):
                restore(copy, new, unix_s=200, **NAMES)
    assert restore(copy, new, unix_s=200, **NAMES)[0].digests is False
    assert versions(new) == {"a": 1, "b": 1}


def test_a_backup_names_no_file_outside_of_it(folder, tmp_path):
    """Its text may come from anywhere."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    told, files = read_sealed(tmp_path / "copy")
    for name in ("../mark", "blobs/..", "blobs/../../mark", "/etc/passwd", "other"):
        text = sealed(told, {**files, name: files["mark"]})
        (tmp_path / "copy" / BACKUP_FILE).write_bytes(text)
        with pytest.raises(StoreError, match="is no file of a backup"):
            restore(tmp_path / "copy", tmp_path / "new", unix_s=200, **NAMES)


@pytest.mark.parametrize(
    ("place", "found"),
    [
        ("file/copy", r"file is a file, not a folder"),
        ("/proc/copy", r"cannot be written to /proc/copy \(.*No such file"),
        ("x" * 300, r"cannot be written to .*File name too long"),
        ("left/copy", r"is inside the shard's folder"),
    ],
)
def test_a_place_that_takes_no_backup_is_named_and_not_the_shard(folder, tmp_path, place, found):
    """The remedy is another place; the shard has nothing to do with it and need not start again."""
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))

    with pytest.raises(StoreError, match=found) as refused:
        back_up(folder, tmp_path / place, unix_s=100, **NAMES)

    assert "--to" in str(refused.value)
    assert "start the shard" not in str(refused.value)
    assert sorted(tmp_path.rglob("*")) == before
