"""Files of measurements: the one error for bad input, and output that is whole or absent.

Two rules a change must keep:

1. Code that reads a user's file reports the file, what was expected, what was found and what to
   do, in one `InputFileError`; a library's own message never reaches the user alone.
2. Output appears under its name only when every byte of every file of the set is on disk.
"""

from __future__ import annotations

import errno
import os
import secrets
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


class InputFileError(ValueError):
    """A file from outside cannot be used; the person who chose the file must act.

    Attributes:
        path: The file or directory at fault.
        asked: What it must be.
        found: What it is.
        remedy: What to do about it.
    """

    def __init__(self, path: Path, *, asked: str, found: str, remedy: str) -> None:
        super().__init__(f"{path}: asked for {asked}; found {found}; {remedy}")
        self.path = path
        self.asked = asked
        self.found = found
        self.remedy = remedy


def existing_file(path: Path, *, asked: str) -> Path:
    """Return `path` if it is a file with content that this process may read.

    Args:
        path: The candidate.
        asked: What the file should be, for the message.

    Raises:
        InputFileError: Missing, a directory, empty or not readable.
    """
    if path.is_dir():
        raise InputFileError(
            path, asked=asked, found="a directory", remedy="name the file inside it"
        )
    if not path.exists():
        raise InputFileError(path, asked=asked, found="no such file", remedy="check the path")
    if not os.access(path, os.R_OK):
        raise InputFileError(
            path, asked=asked, found="a file this user may not read", remedy="change its mode"
        )
    if path.stat().st_size == 0:
        raise InputFileError(
            path, asked=asked, found="an empty file", remedy="record or export it again"
        )
    return path


def check_output(folder: Path) -> None:
    """Refuse an output folder that could not be written, before minutes go into its content.

    Raises:
        OSError: It is a file, or it or its nearest existing parent may not be written.
    """
    nearest = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not nearest.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "asked for a folder, found a file", str(nearest))
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, "this user may not write here", str(nearest))


def write_whole(contents: Mapping[Path, bytes]) -> None:
    """Write a set of files so that a failure leaves none of them half written.

    All bytes go to hidden neighbours first and reach the disk; only then the names change.
    Missing directories are made. A crash between two renames leaves earlier files whole and
    later ones as they were.

    Args:
        contents: File name to its complete content.

    Raises:
        OSError: A directory cannot be made or the disk refuses; no file of the set has changed.
    """
    for path in contents:
        if path.is_dir():
            raise IsADirectoryError(
                errno.EISDIR, "a directory has the name of this file", str(path)
            )
    staged: dict[Path, Path] = {}
    try:
        for path, content in contents.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
            staged[draft] = path
            with draft.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for draft, path in staged.items():
            draft.replace(path)
    finally:
        for draft in staged:
            draft.unlink(missing_ok=True)
