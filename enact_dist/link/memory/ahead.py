"""Files that a shard makes before a client asks for them: the rules of both ends.

A client that fills a file per commit would ask for each one by a call.  It numbers the payloads of
one length in a row instead, and asks once: the shard then makes further files under the next
numbers, and one more whenever a commit has taken one.  They appear after the shard has answered, so
that no call waits for them.

A client finds out by opening the next one.  If it is not there, a call asks for it, as for the
first one, and for more files ahead than before.  So no client relies on them: a shard that runs
short makes none, and removes unused ones first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

FILES_MAX: Final = 7
"""Files ahead of one session, whatever their lengths; a client that pauses needs one."""
BYTES_MAX: Final = 16 << 20
"""Bytes of all files of one session that no commit has named, beyond which none are made ahead."""
ROW_BITS: Final = 20
"""Numbers in a row, in bits: a million payloads of one length."""
ROWS_MAX: Final = 8
"""Lengths that a client remembers; beyond this, the one that has been unused for longest goes."""
IDLE_S: Final = 20.0
"""After so long a pause a client relies on no file: soon its shard gives them up."""


class AheadOf(NamedTuple):
    """A payload behind which files are to be made ahead.

    Attributes:
        file: Its name.
        owner: The identity whose share they take.
        size: Their length in bytes.
        behind: How many of the next numbers are to have a file.
    """

    file: str
    owner: str
    size: int
    behind: int

    @property
    def session(self) -> str:
        """The session that will fill them."""
        return self.file.rpartition("-")[0]

    def names(self) -> list[str]:
        """Return what the files are called, in the order in which they are used.

        None is of the row behind, whose payloads may have another length.
        """
        session, _, digits = self.file.rpartition("-")
        number = int(digits, 16)
        end = ((number >> ROW_BITS) + 1) << ROW_BITS
        numbers = range(number + 1, min(number + 1 + min(self.behind, FILES_MAX), end))
        return [f"{session}-{number:x}" for number in numbers]


@dataclass(slots=True)
class _Row:
    """The payloads of one length."""

    number: int
    end: int
    used_s: float
    asked: int = -1


class NamesAhead:
    """The rows of one session at one start of a shard.  Not thread-safe.

    Args:
        next_row: Returns a number that the session uses for no other row.
    """

    def __init__(self, next_row: Callable[[], int]) -> None:
        self._next_row = next_row
        self._rows: dict[int, _Row] = {}

    def take(self, size: int, now_s: float) -> tuple[int, bool]:
        """Return the number of the next payload, and whether its file may be there already."""
        row = self._rows.pop(size, None)
        if row is None or row.number == row.end:
            first = self._next_row() << ROW_BITS
            row = _Row(first, first + (1 << ROW_BITS), now_s)
        elif now_s - row.used_s > IDLE_S:
            row.asked = -1
        if len(self._rows) == ROWS_MAX:
            del self._rows[next(iter(self._rows))]
        self._rows[size] = row
        row.used_s, row.number = now_s, row.number + 1
        return row.number - 1, row.asked > 0

    def asks(self, size: int) -> int:
        """Return how many files to ask for, beside one that was not there.

        One is enough for a client that pauses between two payloads; for others it would be late.
        """
        row = self._rows.get(size)
        # Making larger ones would take memory's bandwidth from the client that fills the last one.
        if row is None or size * FILES_MAX > BYTES_MAX:
            return 0
        row.asked = {-1: 0, 0: 1}.get(row.asked, FILES_MAX)
        return row.asked

    def unusable(self, size: int) -> None:
        """Ask for none soon: a file that the shard has made cannot be opened here."""
        row = self._rows.get(size)
        if row is not None:
            row.asked = -1
