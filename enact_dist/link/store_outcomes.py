"""Tracks which outcomes a store keeps: those of an ended session for one more day."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Final

from enact_dist.link.store_rows import Key, Kind, key_of, outcome_key

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.core.datum import LockId

OUTCOMES_KEPT_NS: Final = 24 * 3600 * 1_000_000_000
"""How long the outcomes of an ended session can be asked for."""


class Outcomes:
    """The lanes with a stored outcome, and when their sessions ended.

    Args:
        locks: Locks with stored outcomes.
        ended: When sessions ended, wall clock in ns.
    """

    __slots__ = ("_ended", "_lanes")

    def __init__(self, locks: Iterable[LockId], ended: Mapping[str, int]) -> None:
        # A plain dict would skip over all entries deleted at its front each time.
        self._ended = OrderedDict(sorted(ended.items(), key=lambda entry: entry[1]))
        self._lanes: dict[str, set[int]] = {}
        for lock in locks:
            self.add(lock)

    def add(self, lock: LockId) -> None:
        """Record that a lock's outcome is stored."""
        self._lanes.setdefault(lock.session, set()).add(lock.lane)

    def came_back(self, session: str) -> bool:
        """Record that a session lives; return whether it had ended."""
        return self._ended.pop(session, None) is not None

    def ended(self, session: str, wall_ns: int) -> None:
        """Record the end of a session."""
        self._ended[session] = wall_ns

    def expired(self, wall_ns: int) -> Iterator[Key]:
        """Yield the rows of sessions that ended long before `wall_ns`, and drop them."""
        while self._ended:
            session, ended_ns = next(iter(self._ended.items()))
            if ended_ns > wall_ns - OUTCOMES_KEPT_NS:
                return
            del self._ended[session]
            yield key_of(Kind.ENDED, session)
            for lane in self._lanes.pop(session, ()):
                yield outcome_key(session, lane)
