"""Listings in pages: every answer fits a frame, and none occupies the shard for long.

::

    ListLocks()               ─> Locks(…, more=Cursor(epoch, …))
    ListLocks(after=that)     ─> Locks(…, more=START)              the end

A page ends at `PAGE_BYTES_MAX`, or after `WORK_MAX` units of work, so it may be empty although
the listing continues.  The shard keeps nothing between two pages: the cursor holds everything, so a
client that stops asking costs nothing.  An entry that exists all the time is listed exactly once;
one that is added or removed meanwhile may be listed or not.

Slots go column by column, by name, and within a column as they came: no slot leaves a column but
with all of its context, so a place in it names the same slot for a whole epoch.
"""

from __future__ import annotations

from itertools import islice
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from enact_dist.core.protocol.datum import Column, Slot
from enact_dist.core.protocol.parts import START, Cursor
from enact_dist.patterns import Patterns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from enact_dist.core.protocol.records import Content
    from enact_dist.core.protocol.requests import ListHistory, Survey

PAGE_BYTES_MAX: Final = 8 << 20
"""Bytes of one page: half of what a header may have, so that an entry may be large, too."""
WORK_MAX: Final = 2_000
"""Most slots, versions and causes that are examined for one page: about 5 ms."""
PATTERNS_WORK: Final = 8
"""How many patterns can be tried in the time that one slot takes."""
VERSIONS_OF_A_LOOK: Final = 16
"""How many versions of one slot can be skipped in that time."""
HOLDER_WORK: Final = 10
"""Work to describe a lock, including the search for the locks that block it."""

E = TypeVar("E")
Step = tuple[E | None, int, int, Cursor]
"""An entry (None: nothing was found), its bytes, what it took to look, and what comes after it."""


class Columns(Protocol):
    """Slots by context and aspect."""

    def columns(self) -> Iterable[Column]:
        """Return every (context, aspect) that has slots."""

    def of_column(self, column: Column) -> Mapping[str, Content]:
        """Return the slots of a column by entity, as they came, null ones too."""


def page_of(steps: Iterable[Step[E]]) -> tuple[tuple[E, ...], Cursor]:
    """Return the entries of one page, and the start of the next one (`START`: none left)."""
    entries: list[E] = []
    size = looked = 0
    end = START
    for entry, entry_bytes, work, after in steps:
        if looked >= WORK_MAX or (entries and size + entry_bytes > PAGE_BYTES_MAX):
            return tuple(entries), end
        looked += work
        if entry is not None:
            size += entry_bytes
            entries.append(entry)
        end = after
    return tuple(entries), START


def over_slots(
    slots: Columns,
    asked: Survey | ListHistory | None,
    after: Cursor,
    listed: Callable[[Slot, Content, int], tuple[Iterable[E], int]],
    *,
    epoch: int,
    version_of: Callable[[E], int],
    bytes_of: Callable[[E], int],
) -> Iterator[Step[E]]:
    """Yield the entries of each requested slot, from a cursor on.

    Args:
        slots: All slots.
        asked: Which of them; None: all.
        after: Where the page begins.
        listed: Returns the entries of one slot above a version, oldest first, and what it took to
            find the first one; the others are made as they are asked for.
        epoch: In which the cursors are good.
        version_of: Returns the version of an entry.
        bytes_of: Returns at least how many bytes it takes in an answer.
    """
    contexts, aspects, patterns = map(
        frozenset, (asked.contexts, asked.aspects, asked.patterns) if asked else ((), (), ())
    )
    entities = Patterns(patterns)
    work_each = 1 + len(entities.starred) // PATTERNS_WORK
    for column in sorted(slots.columns()):
        here = column == after.names
        wanted = (not contexts or column.context in contexts) and (
            not aspects or column.aspect in aspects
        )
        if column < after.names or not wanted:
            continue
        begin = max(0, after.number) if here else 0
        column_slots = islice(slots.of_column(column).items(), begin, None)
        for number, (entity, content) in enumerate(column_slots, begin):
            last: E | None = None
            work = work_each
            if entities.cover(entity):
                above = after.version if here and number == begin else 0
                found, more = listed(Slot(column.context, entity, column.aspect), content, above)
                work += min(more, WORK_MAX // 2)  # the rest of a page is for what was found
                for entry in found:
                    if last is not None:
                        here_on = Cursor(epoch, column, number, version_of(last))
                        yield last, bytes_of(last), work, here_on
                        work = 1
                    last = entry
            size = bytes_of(last) if last is not None else 0
            yield last, size, work, Cursor(epoch, column, number + 1)


def bytes_in_frame(value: object) -> int:
    """Return at least how many bytes a value of a message's header takes, data left out."""
    if isinstance(value, str):
        return 5 + (len(value) if value.isascii() else len(value.encode(errors="replace")))
    if isinstance(value, bytes):
        return 5 + len(value)
    if isinstance(value, tuple):
        return 5 + sum(map(bytes_in_frame, value))
    return 9
