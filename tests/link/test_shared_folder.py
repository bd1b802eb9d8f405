"""Where processes of one host meet: who may enter, what is swept, what is refused."""

import os
import stat
import time

import pytest

from enact_dist.errors import LinkError
from enact_dist.link.memory.shared_folder import NONCE, SharedFolder, address_in, open_shared

HOLDER = """
import sys
from pathlib import Path
from enact_dist.link.memory.shared_folder import SharedFolder
folder = SharedFolder("cell", "s0", root=Path(sys.argv[1]))
(folder.path / "left.bin").write_bytes(b"x" * 1000)
print(folder.name, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path):
    made = SharedFolder("cell", "s0", root=tmp_path)
    yield made
    made.close()


def mode_of(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_client_finds_the_folder_that_the_shard_has_named(folder, tmp_path):
    """The same name and the same nonce prove that both see the same memory."""
    opened = open_shared(folder.name, folder.nonce, root=tmp_path)

    assert (opened.path, opened.owner) == (folder.path, os.geteuid())
    assert os.fstat(opened.descriptor).st_ino == folder.path.stat().st_ino
    opened.close()


def test_folder_of_another_memory_is_refused(folder, tmp_path):
    """A folder of that name whose nonce differs belongs to another start or another host."""
    with pytest.raises(LinkError, match="nonces differ"):
        open_shared(folder.name, bytes(16), root=tmp_path)


@pytest.mark.parametrize("damage", [b"", b"x" * 15, b"x" * 17, None])
def test_damaged_nonce_is_refused(folder, tmp_path, damage):
    """A nonce that is cut, too long or missing proves nothing."""
    file = folder.path / NONCE
    file.chmod(0o600)
    file.write_bytes(damage or b"")
    if damage is None:
        file.unlink()

    with pytest.raises(LinkError):
        open_shared(folder.name, folder.nonce, root=tmp_path)


@pytest.mark.parametrize("name", ["", ".", "..", "../up", "a/b", "n" * 201, ".hidden", "e\0", "ü"])
def test_name_that_leads_elsewhere_is_refused(folder, tmp_path, name):
    """What a shard says is a name below our own root, or nothing."""
    with pytest.raises(LinkError, match="no valid name"):
        open_shared(name, folder.nonce, root=tmp_path)


def test_link_in_place_of_the_folder_is_refused(folder, tmp_path):
    """Nobody is led elsewhere by a symbolic link, even to the right nonce."""
    (tmp_path / "other").symlink_to(folder.path)

    with pytest.raises(LinkError, match="not shared with this process"):
        open_shared("other", folder.nonce, root=tmp_path)


def test_folder_is_for_its_user_alone(folder):
    """In a root of the default mode nobody else gets in."""
    assert mode_of(folder.path) == 0o700
    assert mode_of(folder.path / NONCE) == 0o400


def test_folder_in_a_root_of_a_group_is_for_that_group(tmp_path, monkeypatch):
    """A root that was named and is writable by its group lets the group in, and nobody else."""
    tmp_path.chmod(0o770)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    folder = SharedFolder("cell", "s0")

    assert folder.access.group == tmp_path.stat().st_gid
    assert mode_of(folder.path) == 0o2710
    assert mode_of(folder.path / NONCE) == 0o440
    folder.close()


def test_root_in_which_everybody_may_replace_files_is_refused(tmp_path, monkeypatch):
    """A world-writable root without the sticky bit is named and not used."""
    tmp_path.chmod(0o777)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    with pytest.raises(LinkError, match="sticky bit"):
        SharedFolder("cell", "s0")


def test_root_that_cannot_be_made_is_named(tmp_path):
    """A read-only or missing place is an error with the path in it, not a crash."""
    (tmp_path / "file").write_text("")

    with pytest.raises(LinkError, match=str(tmp_path / "file")):
        SharedFolder("cell", "s0", root=tmp_path / "file" / "below")


def test_close_removes_the_folder_with_all_that_is_in_it(folder):
    """A shard that stops leaves nothing behind; closing twice is harmless."""
    (folder.path / "datum").write_bytes(b"x")

    folder.close()
    folder.close()

    assert not folder.path.exists()


def test_folder_of_a_killed_shard_is_swept_at_the_next_start(program, tmp_path):
    """What a killed process leaves goes when the next one starts; a living one keeps its own."""
    dead, living = program(HOLDER, tmp_path), program(HOLDER, tmp_path)
    left, kept = dead.stdout.readline().strip(), living.stdout.readline().strip()
    dead.kill()
    dead.wait()
    assert (tmp_path / left / "left.bin").exists()

    folder = SharedFolder("cell", "s1", root=tmp_path)

    assert {entry.name for entry in tmp_path.iterdir()} == {kept, folder.name}
    folder.close()


def test_sweep_leaves_alone_what_is_not_ours(tmp_path):
    """Files, and folders in which no shard has written a nonce, stay."""
    (tmp_path / "file").write_text("x")
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "data").write_text("x")
    (tmp_path / "being-made").mkdir()

    SharedFolder("cell", "s0", root=tmp_path).close()

    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["being-made", "file", "strange"]


def test_sweep_takes_a_folder_whose_making_was_broken_off(tmp_path):
    """An empty folder without a nonce that is a minute old was left by a process that died."""
    old = tmp_path / "cell.s0.0123456789abcdef"
    old.mkdir()
    os.utime(old, (time.time() - 100, time.time() - 100))

    SharedFolder("cell", "s0", root=tmp_path).close()

    assert not old.exists()


def test_long_path_is_reached_through_a_descriptor(tmp_path):
    """A socket's address has 108 bytes; a deeper folder is reached all the same."""
    deep = tmp_path / ("d" * 100)
    deep.mkdir()

    assert address_in(7, tmp_path, "s") == f"{tmp_path}/s"
    assert address_in(7, deep, "socket") == "/proc/self/fd/7/socket"


def test_long_names_of_cell_and_shard_still_make_one_name(tmp_path):
    """A name of a folder stays within what a client accepts."""
    folder = SharedFolder("c" * 200, "s" * 200, root=tmp_path)

    open_shared(folder.name, folder.nonce, root=tmp_path).close()
    folder.close()


def test_folders_that_are_none_of_ours_are_left_alone(tmp_path):
    """A root that somebody names may hold anything: an empty folder, a file that is called nonce."""
    mine = [tmp_path / "empty", tmp_path / "a.b", tmp_path / "with_nonce"]
    for path in mine:
        path.mkdir()
    (mine[2] / NONCE).write_bytes(b"x" * 16)
    for path in mine:
        os.utime(path, (1_000_000, 1_000_000))

    SharedFolder("cell", "s0", root=tmp_path).close()

    assert [path.is_dir() for path in mine] == [True, True, True]
