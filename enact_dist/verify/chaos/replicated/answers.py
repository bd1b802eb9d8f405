"""When a daemon let answers out: its last ones, in a file that survives its death.

The file of a process begins with the epoch that it served and with the number of its answers; a
ring of times follows, in ns of the clock that all journals share.
"""

from __future__ import annotations

import mmap
import struct
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

SUFFIX: Final = ".answers"
_HEAD: Final = struct.Struct("<qq")
_TIME: Final = struct.Struct("<q")
_KEPT: Final = 1 << 14


class AnswerTimes:
    """Keeps the times of answers.

    Args:
        path: The file; made new.
    """

    def __init__(self, path: Path) -> None:
        with path.open("xb+") as file:
            file.truncate(_HEAD.size + _KEPT * _TIME.size)
            self._map = mmap.mmap(file.fileno(), 0)
        self._epoch = self._count = 0

    def serves(self, epoch: int) -> None:
        """Take note of the epoch whose answers follow."""
        self._epoch = epoch
        _HEAD.pack_into(self._map, 0, epoch, self._count)

    def add(self, now_ns: int) -> None:
        """Take note of an answer."""
        _TIME.pack_into(self._map, _HEAD.size + self._count % _KEPT * _TIME.size, now_ns)
        self._count += 1
        _HEAD.pack_into(self._map, 0, self._epoch, self._count)


class ServedEpoch(NamedTuple):
    """What one process answered.

    Attributes:
        answers: How many.
        last_ns: The times of its last ones.
    """

    epoch: int
    answers: int
    last_ns: tuple[int, ...]


def read_answers(path: Path) -> ServedEpoch:
    """Return what a process left."""
    data = path.read_bytes()
    epoch, count = _HEAD.unpack_from(data)
    kept = min(count, _KEPT)
    times = struct.unpack_from(f"<{kept}q", data, _HEAD.size)
    return ServedEpoch(epoch, count, times)
