"""Replaced states of slots, kept for a moment so that a shard can answer as of a recent stamp.

Only the tail of each slot's history is here, without holes: whatever is forgotten is older than
all that is kept of the same slot.  What is not here any more is answered with the present.
"""

from __future__ import annotations

from collections import deque
from itertools import chain
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.slots import Content

PAST_NS: Final = 2_000_000_000
"""How long a replaced state is kept, on the clock of the stamps."""
PAST_BYTES_MAX: Final = 64 << 20
"""Bytes of replaced data that are kept at most."""
PAST_STATES_MAX: Final = 50_000
"""Replaced states that are kept at most: where the wall clock was set back, the stamps stand still
for as long, and nothing would be old."""


class Past:
    """The recently replaced states of one shard's slots."""

    __slots__ = ("_by_slot", "_order", "bytes")

    def __init__(self) -> None:
        self._by_slot: dict[Slot, deque[Content]] = {}
        self._order: deque[tuple[int, Slot]] = deque()
        self.bytes = 0

    def keep(self, slot: Slot, old: Content, *, until_ns: int) -> None:
        """Keep a state that another one, stamped `until_ns`, has replaced."""
        states = self._by_slot.get(slot)
        if states is None:
            states = self._by_slot[slot] = deque()
        states.append(old)
        self._order.append((until_ns, slot))
        self.bytes += old.datum.size if old.datum is not None else 0
        self.forget(until_ns - PAST_NS)

    def forget(self, before_ns: int) -> None:
        """Forget what was replaced before a stamp, and the oldest of what is too much."""
        while self._order and (
            self._order[0][0] < before_ns
            or self.bytes > PAST_BYTES_MAX
            or len(self._order) > PAST_STATES_MAX
        ):
            self.forget_oldest()

    def __len__(self) -> int:
        return len(self._order)

    def states(self) -> Iterator[Content]:
        """Yield all of them."""
        return chain.from_iterable(self._by_slot.values())

    def forget_oldest(self) -> tuple[Slot, Content]:
        """Forget the state that was replaced first, and return it."""
        _, slot = self._order.popleft()
        states = self._by_slot[slot]
        old = states.popleft()
        self.bytes -= old.datum.size if old.datum is not None else 0
        if not states:
            del self._by_slot[slot]
        return slot, old

    def drop(self, context: str) -> None:
        """Forget all states of a context."""
        self._order = deque(entry for entry in self._order if entry[1].context != context)
        for slot in [slot for slot in self._by_slot if slot.context == context]:
            for old in self._by_slot.pop(slot):
                self.bytes -= old.datum.size if old.datum is not None else 0

    def of(self, slot: Slot) -> Iterable[Content]:
        """Return the replaced states of a slot that are known, oldest first."""
        return self._by_slot.get(slot, ())

    def at(self, slot: Slot, at_ns: int) -> Content | None:
        """Return the replaced state that was current at a stamp, None if it is forgotten."""
        for old in reversed(self._by_slot.get(slot, ())):
            if old.stamp_ns <= at_ns:
                return old
        return None
