"""Who may read a backup, what is being restored, and what is restored."""

import json
import os
import shutil
from pathlib import Path

import pytest
from store_writer import fill, versions

from enact_dist.errors import StoreError
from enact_dist.link.offline.backup import back_up, restore
from enact_dist.link.offline.backup_files import BACKUP_FILE, read_sealed, sealed

NAMES = {"cell": "line", "shard": "left"}


@pytest.fixture
def folder(tmp_path):
    """The folder of a stopped shard."""
    fill(tmp_path / "left", 1)
    return tmp_path / "left"


def modes_of(folder):
    paths = (folder, *folder.rglob("*"))
    return {path.relative_to(folder).as_posix(): path.stat().st_mode & 0o777 for path in paths}


@pytest.fixture
def open_umask():
    """Whatever is made without care may be read and written by everybody."""
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.fixture
def copied_openly(monkeypatch):
    """Return what others might read while it was copied, by itself or in its folder."""
    found = []
    real = shutil.copyfile

    def copyfile(source, target, **more):
        real(source, target, **more)
        target = Path(target)
        found.extend(path for path in (target, target.parent) if path.stat().st_mode & 0o077)

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    return found


@pytest.mark.usefixtures("open_umask")
def test_nobody_else_reads_a_backup_nor_what_is_being_restored(folder, tmp_path, copied_openly):
    """Whatever the umask, from the first byte on; then the modes are those of the shard's files."""
    copy, new = tmp_path / "copy", tmp_path / "new"
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o750 if path.is_dir() else 0o640)
    back_up(folder, copy, unix_s=100, **NAMES)
    made = modes_of(copy)
    assert {mode for name, mode in made.items() if (copy / name).is_file()} == {0o600}
    assert {mode for name, mode in made.items() if (copy / name).is_dir()} == {0o700}

    restore(copy, new, unix_s=200, **NAMES)
    kept = {name: mode for name, mode in modes_of(folder).items() if name in made}
    assert kept.keys() == made.keys() - {BACKUP_FILE}
    assert {name: mode for name, mode in modes_of(new).items() if name in kept} == kept
    assert copied_openly == []


@pytest.mark.usefixtures("open_umask")
def test_nobody_else_reads_what_is_being_restored_of_an_old_backup(folder, tmp_path, copied_openly):
    """It does not say who might read the shard's files: the modes are those of its own."""
    copy = tmp_path / "copy"
    back_up(folder, copy, unix_s=100, **NAMES)
    for lost in (("sha256", "files", "modes"), ("modes",)):
        told, files = read_sealed(copy)
        for name in lost:
            told.pop(name, None)
        text = json.dumps(told).encode() if "files" in lost else sealed(told, files)
        old = shutil.copytree(copy, tmp_path / f"old{len(lost)}")
        copied_openly.clear()
        (old / BACKUP_FILE).write_bytes(text)
        for path in (*old.rglob("*"), old):
            path.chmod(0o555 if path.is_dir() else 0o440)
        new = tmp_path / f"new{len(lost)}"

        assert restore(old, new, unix_s=200, **NAMES)[0].digests is ("files" not in lost)

        found = modes_of(new)
        assert found["."] == found["blobs"] == 0o755
        assert {mode for name, mode in found.items() if name in files} == {0o640}
        assert versions(new) == {"a": 1, "b": 1}
    assert copied_openly == []


def test_what_nobody_else_may_read_stays_so_when_it_is_restored(tmp_path):
    """Whatever the umask of whoever restores it."""
    folder, new = tmp_path / "left", tmp_path / "new"
    before = os.umask(0o077)
    try:
        fill(folder, 1)
        os.umask(0o022)
        back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
        restore(tmp_path / "copy", new, unix_s=200, **NAMES)
    finally:
        os.umask(before)
    kept = {name: mode for name, mode in modes_of(new).items() if name != "lock"}
    assert set(kept.values()) == {0o600, 0o700}


def test_permissions_that_are_none_are_refused(folder, tmp_path):
    """Or of what a backup does not have."""
    back_up(folder, tmp_path / "copy", unix_s=100, **NAMES)
    told, files = read_sealed(tmp_path / "copy")
    for modes in ({".": "9"}, {".": "777777"}, {"..": "777"}, {".": 7}, ["."]):
        (tmp_path / "copy" / BACKUP_FILE).write_bytes(sealed({**told, "modes": modes}, files))
        with pytest.raises(StoreError, match=r"its backup.json is damaged"):
            restore(tmp_path / "copy", tmp_path / "new", unix_s=200, **NAMES)
