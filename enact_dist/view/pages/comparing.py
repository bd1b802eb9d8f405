"""The difference that a page shows: a moment of a world context against another one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import EnactError
from enact_dist.view.markup import (
    ONLY_RIGHT,
    OTHER,
    colour_of_difference,
    difference_table,
    small,
    text,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.compare.diff import Comparison, Diff

AGAIN_S: Final = 1.0
"""Pause after a difference that could not be made."""
PAUSE: Final = 9.0
"""Pause after a difference with the present, in durations of its making: a tenth of the time goes
into differences, however fast the data change."""
NOW: Final = "now"
MARKED: Final = "the marked moment"


class Side(NamedTuple):
    """A world context as of a moment."""

    world: str
    at_ns: int


class _SideKey(NamedTuple):
    """What a side holds: its moment, or how often its world context has changed until now."""

    world: str
    at_ns: int
    changes: int


class ShownDifference:
    """Makes the difference when what it compares has changed, and colours it.

    Args:
        compare: Returns how two sides differ.
        changes: Returns how often a world context has changed so far.

    Attributes:
        against: `NOW`, `MARKED`, a world context, or "": nothing.
        right: What the right side is.
        content: The difference as HTML, or why there is none.
    """

    def __init__(
        self, compare: Callable[[Side, Side], Diff], changes: Callable[[str], int]
    ) -> None:
        self._compare, self._changes = compare, changes
        self.against = ""
        self.right = Side("", 0)
        self.content = ""
        self._rows: tuple[Comparison, ...] = ()
        self._key: tuple[_SideKey, _SideKey] | None = None
        self._failed = False
        self._due_s = 0.0

    def look(self, left: Side, *, live: bool, now_ns: int, marked_ns: int) -> None:
        """Make the difference if what it compares has changed.

        Args:
            left: What the page shows.
            live: Whether that is the present.
            now_ns: The present.
            marked_ns: The marked moment; 0: none.
        """
        if not self.against:
            self._rows, self._key, self.content = (), None, ""
            return
        if live:
            left = Side(left.world, now_ns)
        if self.against == NOW:
            right, present = Side(left.world, now_ns), True
        elif self.against == MARKED:
            right, present = Side(left.world, marked_ns), False
        else:
            right, present = Side(self.against, left.at_ns), live
        if not left.at_ns or not right.at_ns:
            return
        key = (self._key_of(left, present=live), self._key_of(right, present=present))
        begun_s = time.monotonic()
        if self._key is not None:
            if key == self._key and not self._failed:
                return
            same_moments = [each[:2] for each in key] == [each[:2] for each in self._key]
            if same_moments and begun_s < self._due_s:
                return
        self._key, self._failed, self.right = key, False, right
        try:
            diff = self._compare(left, right)
            self._rows, self.content = diff.rows, difference_table(diff)
        except EnactError as error:
            self._rows, self.content = (), small(text(error))
            self._failed = True
        ended_s = time.monotonic()
        pause_s = PAUSE * (ended_s - begun_s)
        self._due_s = ended_s + (max(AGAIN_S, pause_s) if self._failed else pause_s)

    def _key_of(self, side: Side, *, present: bool) -> _SideKey:
        if present:
            return _SideKey(side.world, 0, self._changes(side.world))
        return _SideKey(side.world, side.at_ns, 0)

    def tint(self, slot: Slot) -> tuple[int, int, int] | None:
        """Return the colour of a slot of the left side that differs."""
        for row in self._rows:
            if (row.entity.name, row.aspect) == slot[1:]:
                return colour_of_difference(row.kind.value)
        return None

    def right_tints(self) -> dict[Slot, tuple[int, int, int]]:
        """Return the data of the right side that differ, with their colours."""
        return {
            Slot(self.right.world, row.entity.name, row.aspect): (
                OTHER if row.left is not None else ONLY_RIGHT
            )
            for row in self._rows
            if row.right is not None
        }

    def texts(self) -> dict[str, str]:
        """Return what differs, by entity."""
        found: dict[str, str] = {}
        for row in self._rows:
            how = str(row.difference) if row.difference else row.kind.value
            found.setdefault(row.entity.name, f"{row.aspect}: {how}")
        return found
