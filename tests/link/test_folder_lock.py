"""Files that are replaced are whole or as they were, whatever the disk takes."""

import errno
import os

import pytest

from enact_dist.link.folder.lock import replace_file


def test_file_is_whole_where_the_disk_takes_it_in_parts(tmp_path, monkeypatch):
    """A disk that is nearly full, or a signal, may let one write end early."""
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, content: write(file, content[:7]))

    replace_file(tmp_path / "file", b"0123456789" * 3)

    assert (tmp_path / "file").read_bytes() == b"0123456789" * 3


def test_file_is_as_it_was_where_the_disk_is_full(tmp_path, monkeypatch):
    """The error says so, and no draft takes what room there is."""
    (tmp_path / "file").write_bytes(b"before")
    write, written = os.write, []

    def until_full(file, content):
        if written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(write(file, content[:7]))
        return written[0]

    monkeypatch.setattr(os, "write", until_full)

    with pytest.raises(OSError, match="No space left"):
        replace_file(tmp_path / "file", b"0123456789")

    assert (tmp_path / "file").read_bytes() == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
