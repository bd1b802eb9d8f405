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
"""How often a difference with the present is made anew."""
NOW: Final = "now"
MARKED: Final = "the marked moment"


class Side(NamedTuple):
    """A world context as of a moment."""

    world: str
    at_ns: int


class ShownDifference:
    """Makes the difference and colours it.

    Args:
        compare: Returns how two sides differ.

    Attributes:
        against: `NOW`, `MARKED`, a world context, or "": nothing.
        right: What the right side is.
        content: The difference as HTML, or why there is none.
    """

    def __init__(self, compare: Callable[[Side, Side], Diff]) -> None:
        self._compare = compare
        self.against = ""
        self.right = Side("", 0)
        self.content = ""
        self._rows: tuple[Comparison, ...] = ()
        self._key: tuple[Side, Side] | None = None
        self._made_s = 0.0

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
        if self.against == NOW:
            right = Side(left.world, now_ns)
        elif self.against == MARKED:
            right = Side(left.world, marked_ns)
        else:
            right = Side(self.against, left.at_ns)
        moves = live or self.against == NOW
        if (left, right) == self._key or not left.at_ns or not right.at_ns:
            return
        if moves and time.monotonic() - self._made_s < AGAIN_S:
            return
        self._key, self.right = (left, right), right
        try:
            diff = self._compare(left, right)
            self._rows, self.content = diff.rows, difference_table(diff)
        except EnactError as error:
            self._rows, self.content = (), small(text(error))
        self._made_s = time.monotonic()

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
