"""The last versions of each slot, as many as its aspect retains: found by when they were captured.

`Past` answers *as of a commit stamp* and forgets by time; here a version stays until `retention`
newer ones have replaced it, so that data of one capture can be read together although their slots
have moved on.  A version that a lock or view pins stays readable for that lock after it left.

Kept in memory, whatever the aspect's commits survive: after a restart of its shard a slot has its
newest version only.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from itertools import chain
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.datum import Slot
    from enact_dist.core.slots import Content

RETAINED_BYTES_MAX: Final = 256 << 20
"""Bytes of replaced data that are retained at most, over all slots of a shard; those of payloads
have a cap of their own, which the link keeps."""
RETAINED_STATES_MAX: Final = 100_000
"""Replaced states that are retained at most, over all slots of a shard."""


class Retained:
    """The retained replaced versions of one shard's slots.

    Attributes:
        bytes: How many bytes of data they hold, payloads left out.
        dropped: Versions that had to go before their time, because of the limits above.
    """

    __slots__ = ("_by_slot", "_bytes_max", "_order", "bytes", "dropped")

    def __init__(self, *, bytes_max: int = RETAINED_BYTES_MAX) -> None:
        self._bytes_max = bytes_max
        self._by_slot: dict[Slot, deque[Content]] = {}
        self._order: OrderedDict[tuple[Slot, int], None] = OrderedDict()
        self.bytes = 0
        self.dropped = 0

    def keep(self, slot: Slot, old: Content, *, count: int) -> None:
        """Keep a state that has just been replaced, and `count` replaced ones of its slot at most.

        Over the limits the oldest of all slots goes first.
        """
        if count <= 0 or not old.version:
            return
        states = self._by_slot.setdefault(slot, deque())
        states.append(old)
        self._order[slot, old.version] = None
        self.bytes += _own_bytes(old)
        while len(states) > count:
            self._forget(slot)
        while self.bytes > self._bytes_max or len(self._order) > RETAINED_STATES_MAX:
            self.forget_oldest()

    def __len__(self) -> int:
        return len(self._order)

    def __contains__(self, version: tuple[Slot, int]) -> bool:
        return version in self._order

    def states(self) -> Iterator[Content]:
        """Yield all of them."""
        return chain.from_iterable(self._by_slot.values())

    def forget_oldest(self) -> Content:
        """Forget the version that was replaced first, before its time, and return it."""
        self.dropped += 1
        return self._forget(next(iter(self._order))[0])

    def _forget(self, slot: Slot) -> Content:
        """Forget the oldest version of a slot."""
        states = self._by_slot[slot]
        old = states.popleft()
        del self._order[slot, old.version]
        self.bytes -= _own_bytes(old)
        if not states:
            del self._by_slot[slot]
        return old

    def drop(self, context: str) -> None:
        """Forget all versions of a context."""
        for slot in [slot for slot in self._by_slot if slot.context == context]:
            while slot in self._by_slot:
                self._forget(slot)

    def of(self, slot: Slot) -> Iterable[Content]:
        """Return the replaced versions of a slot, oldest first."""
        return self._by_slot.get(slot, ())

    def captured(self, slot: Slot, captured_ns: int, *, version_max: int) -> Content | None:
        """Return the newest replaced version up to `version_max` that was captured then."""
        for old in reversed(self._by_slot.get(slot, ())):
            captured = old.datum is not None and old.datum.stamp_ns == captured_ns
            if captured and old.version <= version_max:
                return old
        return None

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        kept = [(slot, old) for slot, states in self._by_slot.items() for old in states]
        assert {(slot, old.version) for slot, old in kept} == set(self._order)
        assert self.bytes == sum(_own_bytes(old) for _, old in kept)
        for states in self._by_slot.values():
            versions = [old.version for old in states]
            assert versions == sorted(versions), versions


def _own_bytes(old: Content) -> int:
    """Return the bytes that a state holds in the memory of the shard alone."""
    return old.datum.size if old.datum is not None and not old.datum.file else 0
