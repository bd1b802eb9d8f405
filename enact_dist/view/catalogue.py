"""What a cell has: every slot with its newest state and its rate, and how the page lists them."""

from __future__ import annotations

import re
import threading
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.cli.text.rates import Rates, Sample
from enact_dist.patterns import pattern_matches

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.datum import Slot

_NUMBERS: Final = re.compile(r"(\d+)")
ROWS_MAX: Final = 30
"""Most data, and most branches, that are listed at once."""


class ListedState(NamedTuple):
    """The newest known state of a slot.

    Attributes:
        version: Its version.
        stamp_ns: Of its commit; 0: it ended with its shard.
        null: Whether it is null.
        captured_ns: When the datum was captured; 0: unknown.
    """

    version: int
    stamp_ns: int
    null: bool
    captured_ns: int = 0


class Listing(NamedTuple):
    """One look into the tree.

    Attributes:
        branches: Names below the path, each with the number of its data.
        slots: The data at the path, or those that the filter finds.
        left_out: How many more branches and data there are.
    """

    branches: tuple[tuple[str, int], ...]
    slots: tuple[Slot, ...]
    left_out: int


def _as_read(name: str) -> list[str | int]:
    """Order names as people do: number 10 after number 9."""
    return [int(part) if part.isdigit() else part for part in _NUMBERS.split(name)]


class SlotCatalogue:
    """All slots of a cell.  One thread writes it, any may list.

    Attributes:
        newest_ns: The newest commit that is known.
    """

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._states: dict[Slot, ListedState] = {}
        self._by_world: dict[str, list[Slot]] = {}
        self._first: dict[str, Slot] = {}
        self._worlds: tuple[str, ...] = ()
        self._rates = Rates()
        self._changes: Counter[str] = Counter()
        self.newest_ns = 0

    def clear(self) -> None:
        """Forget all slots: they are noted anew."""
        with self._guard:
            self._states, self._by_world, self._first = {}, {}, {}
            self._rates = Rates()

    def keep(self, worlds: Iterable[str]) -> None:
        """Take which world contexts the cell has; forget those of others that have been dropped.

        The data of a dropped one are null; one with others is newer than the list.
        """
        with self._guard:
            self._worlds = tuple(worlds)
            gone = {slot.context for slot in self._states}.difference(self._worlds)
            if gone:
                states = self._states.items()
                gone -= {slot.context for slot, at in states if not at.null}
                self._states = {slot: at for slot, at in states if slot.context not in gone}

    def note(self, slot: Slot, state: ListedState, *, gap: int, now_s: float) -> None:
        """Take a change; the first one of a slot is no change of it."""
        with self._guard:
            if slot not in self._states:
                self._rates.there([slot])
            elif state.stamp_ns:
                sample = Sample(state.stamp_ns, gap, 0, state.captured_ns)
                self._rates.add(slot, sample, now_s)
            before = self._states.get(slot)
            if before is None or before.null != state.null:
                self._by_world.pop(slot.context, None)
            if not state.null:
                self._first.setdefault(slot.aspect, slot)
            elif self._first.get(slot.aspect) == slot:
                del self._first[slot.aspect]
            if before != state:
                self._changes[slot.context] += 1
            self._states[slot] = state
            self.newest_ns = max(self.newest_ns, state.stamp_ns)

    def state(self, slot: Slot) -> ListedState | None:
        """Return the state of a slot, None if it is not known."""
        return self._states.get(slot)

    def changes(self, world: str) -> int:
        """Return how many changes of the data of a world context were noted so far."""
        return self._changes[world]

    def rate_hz(self, slot: Slot, now_s: float) -> float | None:
        """Return the commits per second of a slot over the last seconds; None: fewer than two."""
        with self._guard:
            return self._rates.of(slot, now_s).rate_hz

    def first_of_aspects(self) -> list[Slot]:
        """Return one datum of each aspect, not a null one."""
        with self._guard:
            return list(self._first.values())

    def slots(self, world: str, at_ns: int = 0) -> list[Slot]:
        """Return the data of a world context that are not null, by name; not to be changed.

        Only a recording knows which these were at an earlier moment, `at_ns`.
        """
        with self._guard:
            known = self._by_world.get(world)
            if known is None:
                there = [slot for slot, at in self._states.items() if not at.null]
                known = sorted(slot for slot in there if slot.context == world)
                self._by_world[world] = known
            return known

    def worlds(self) -> list[str]:
        """Return the world contexts of the cell, and those that have slots."""
        with self._guard:
            return sorted({slot.context for slot in self._states}.union(self._worlds))

    def listing(self, world: str, path: str = "", wanted: str = "", at_ns: int = 0) -> Listing:
        """Return what the tree shows.

        Args:
            world: The world context.
            path: Entities below this one (``camera/``); "": all.
            wanted: Text that ``entity/aspect`` contains, or a pattern of entities with ``*``; it
                goes through the whole context.
            at_ns: As of which moment, see `slots`; 0: the present.
        """
        slots = self.slots(world, at_ns)
        if wanted:
            low = wanted.lower()
            found = [
                slot
                for slot in slots
                if low in f"{slot.entity}/{slot.aspect}".lower()
                or ("*" in wanted and pattern_matches(wanted, slot.entity))
            ]
            return Listing((), tuple(found[:ROWS_MAX]), max(0, len(found) - ROWS_MAX))
        branches: Counter[str] = Counter()
        here: list[Slot] = []
        for slot in slots:
            if not slot.entity.startswith(path):
                continue
            name, slash, _ = slot.entity[len(path) :].partition("/")
            if slash:
                branches[name] += 1
            else:
                here.append(slot)
        here.sort(key=lambda slot: (_as_read(slot.entity), slot.aspect))
        shown = sorted(branches.items(), key=lambda each: _as_read(each[0]))[:ROWS_MAX]
        left_out = len(branches) - len(shown) + max(0, len(here) - ROWS_MAX)
        return Listing(tuple(shown), tuple(here[:ROWS_MAX]), left_out)
