"""Large bodies in files: what is read is what was written, or an error that names the file."""

import random
import resource
from pathlib import Path

import pytest

from enact_dist.link.folder.blobs import Blob, BlobFolder, DamagedBlobError

BODY = random.Random(1).randbytes(2_500_001)


@pytest.fixture
def blobs(tmp_path):
    """An empty folder of blobs."""
    return BlobFolder(tmp_path, epoch=1700)


@pytest.mark.parametrize("durable", [False, True])
@pytest.mark.parametrize("body", [BODY, memoryview(BODY), b"x"])
def test_body_is_read_as_it_was_written(blobs, body, durable):
    """Bytes and memoryviews, forced or not, over several parts."""
    blob = blobs.write(body, durable=durable)
    blobs.sync_names()
    assert (blob.size, blob.synced) == (len(body), durable)
    found = read(blobs, blob)
    assert found.readonly
    assert found == body


def test_memoryview_of_other_items_is_written_by_bytes(blobs):
    """A view of wider items counts its bytes, not its items."""
    view = memoryview(bytes(800)).cast("d")
    blob = blobs.write(view, durable=False)
    assert blob.size == 800
    assert read(blobs, blob) == bytes(800)


def test_names_are_unique_and_tell_nothing(blobs, tmp_path):
    """Equal bodies get different names, and another epoch never uses a name again."""
    names = {blobs.write(BODY, durable=False).name for _ in range(3)}
    names |= {BlobFolder(tmp_path, epoch=1701).write(BODY, durable=False).name}
    assert len(names) == 4
    assert sorted(names) == sorted(blobs.names())


def test_used_name_is_never_overwritten(blobs, tmp_path):
    """If a name should be there already, the write fails and the file stands."""
    first = blobs.write(BODY, durable=False)
    (tmp_path / (first.name + ".tmp")).touch()
    with pytest.raises(FileExistsError):
        BlobFolder(tmp_path, epoch=1700).write(b"other", durable=False)
    assert read(blobs, first) == BODY


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.unlink(), "is missing"),
        (lambda path: path.write_bytes(BODY[:-1]), "has 2500000 bytes instead of 2500001"),
        (lambda path: path.write_bytes(BODY + b"x"), "has 2500002 bytes instead of 2500001"),
        (lambda path: path.write_bytes(bytes(1) + BODY[1:]), "its checksum is wrong"),
        (lambda path: path.write_bytes(BODY[:-1] + bytes(1)), "its checksum is wrong"),
        (lambda path: path.write_bytes(b""), "has 0 bytes"),
    ],
)
def test_damaged_file_is_named(blobs, tmp_path, spoil, said):
    """Missing, short, long, changed at either end, empty: an error with the path and what is."""
    blob = blobs.write(BODY, durable=True)
    spoil(tmp_path / blob.name)
    with pytest.raises(DamagedBlobError, match=said) as damaged:
        read(blobs, blob)
    assert str(tmp_path / blob.name) in str(damaged.value)


def test_mapped_body_survives_its_file(blobs):
    """Whoever has the body keeps it when the file is unlinked; unlinking twice is harmless."""
    blob = blobs.write(BODY, durable=False)
    body, unchecked = read(blobs, blob), blobs.map(blob, whole=False)
    blobs.unlink(blob.name)
    blobs.unlink(blob.name)
    assert body == unchecked.body == BODY
    assert unchecked.fault() == ""
    with pytest.raises(DamagedBlobError):
        blobs.map(blob, whole=False)


def test_sweep_removes_drafts_and_orphans_only(blobs, tmp_path):
    """Named files and files of others stay."""
    kept, orphan = (blobs.write(BODY, durable=False) for _ in range(2))
    (tmp_path / "9-9.blob.tmp").touch()
    (tmp_path / "notes.txt").touch()
    assert blobs.sweep([kept.name]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([kept.name, "notes.txt"])
    assert orphan.name not in blobs.names()


def test_failed_write_leaves_only_a_draft(blobs, tmp_path):
    """A body that cannot be written whole never gets a name."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            blobs.write(BODY, durable=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.suffix for path in tmp_path.iterdir()] == [".tmp"]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.write_bytes(BODY[:-1] + bytes(1)), "is damaged: its checksum is wrong"),
        (lambda path: path.write_bytes(BODY), ""),
    ],
)
def test_content_is_checked_when_it_is_asked_for(blobs, tmp_path, spoil, said):
    """A file that is only mapped is read once, at the first question; the answer stands then."""
    blob = blobs.write(BODY, durable=False)
    found = blobs.map(blob, whole=False)
    spoil(tmp_path / blob.name)
    assert found.fault().endswith(said)
    assert (str(tmp_path / blob.name) in found.fault()) == bool(said)
    blobs.unlink(blob.name)
    assert found.fault().endswith(said)


def test_error_of_the_disk_is_a_fault_of_the_content(blobs, tmp_path, monkeypatch):
    """Whoever asks is told, and goes on: one bad file is not the end of the shard."""
    found = blobs.map(blobs.write(BODY, durable=False), whole=False)

    def broken(descriptor, parts):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("enact_dist.link.folder.blobs.os.readv", broken)
    assert "cannot be read: Input/output error" in found.fault()


@pytest.mark.parametrize("whole", [False, True])
def test_maps_keep_no_open_files(blobs, whole):
    """As many large data as the system maps, however few files may be open."""
    blob = blobs.write(b"x" * 4096, durable=False)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(
        resource.RLIMIT_NOFILE, (len(list(Path("/proc/self/fd").iterdir())) + 20, hard)
    )
    try:
        bodies = [blobs.map(blob, whole=whole).body for _ in range(600)]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert {bytes(body) for body in bodies} == {b"x" * 4096}


def test_row_of_a_blob_is_a_plain_tuple():
    """Rows store it field by field, in this order."""
    assert Blob._fields == ("name", "size", "crc", "synced")


def read(blobs, blob):
    """Return the body of a file whose content is right."""
    return blobs.map(blob, whole=True).body
