"""What one client process did, line by line in a file that only grows: the evidence of a run.

Each line is a JSON array; the process may be killed at any moment, so a last line without its end
is no error.  Times are nanoseconds of the monotonic clock of the machine: a process on a host with
a clock of its own takes off by how much that is ahead.

=========  =====================================================================================
word       then
=========  =====================================================================================
begin      lock, time, kind, [access, context, entity, aspect] of each request
granted    lock, time, [shard, epoch, number] of each fencing token
seen       lock, [slot, version, writer, protected] of each datum looked at
write      lock, [slot, version, writer] of each datum that is about to be committed, the slots
           of the views that the commit expects
end        lock, time, told (a value of `checker.Told`), why
=========  =====================================================================================

`writer` is the lock that a datum names as its writer, "" for null, `UNSEEN` where only the version
was looked at.  A `write` comes before its commit is sent.
"""

from __future__ import annotations

import json
import os
import time
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

UNSEEN: Final = "?"
SUFFIX: Final = ".journal"


class Journal:
    """Writes a journal; one system call per line, so that only the kernel can lose one.

    Args:
        path: The file; made new.
        ahead_ns: By how much this host's monotonic clock is ahead of the machine's.
    """

    def __init__(self, path: Path, *, ahead_ns: int = 0) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
        self._file = os.open(path, flags, 0o644)
        self._ahead_ns = ahead_ns

    def now_ns(self) -> int:
        """Return the time that all journals share."""
        return time.monotonic_ns() - self._ahead_ns

    def write(self, *words: object) -> None:
        """Add one line."""
        os.write(self._file, json.dumps(words, separators=(",", ":")).encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)


def read_lines(path: Path) -> Iterator[list[Any]]:
    """Yield the lines of a journal; one that its process could not finish is left out.

    Raises:
        ValueError: Another line cannot be read; the message names it.
    """
    *lines, rest = path.read_bytes().split(b"\n")
    for number, line in enumerate(lines, start=1):
        try:
            words = json.loads(line)
        except ValueError:
            raise ValueError(f"{path.name}, line {number} is no line of a journal") from None
        yield words
    if rest:
        return
