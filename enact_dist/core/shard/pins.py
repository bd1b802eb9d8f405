"""What views without a lock keep fetchable: the large data that their answers have only named.

A client names a view by a lock of one of its lanes, and has at most `LANES_MAX` of these.  So a
session keeps no more than that many views here: an older view of the same lane goes first, then the
oldest of all.  What a client asks about costs by its own pins, never by those of others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.state.sessions import LANES_MAX

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from enact_dist.core.protocol.datum import Datum, LockId, Slot

    Pinned = dict[tuple[Slot, int], Datum]


class Pins:
    """The pinned data of all sessions, by lock, and of each by slot and version.

    Attributes:
        by_session: The data, by session first.
    """

    __slots__ = ("by_session",)

    def __init__(self) -> None:
        self.by_session: dict[str, dict[LockId, Pinned]] = {}

    def __bool__(self) -> bool:
        return bool(self.by_session)

    def __iter__(self) -> Iterator[LockId]:
        """Yield every lock that pins something."""
        for pinned in self.by_session.values():
            yield from pinned

    def get(self, lock: LockId) -> Mapping[tuple[Slot, int], Datum]:
        """Return what a lock pins."""
        return self.by_session.get(lock.session, {}).get(lock, {})

    def add(self, lock: LockId, data: Pinned) -> bool:
        """Pin more for a lock; return whether a view that may still be wanted had to go."""
        mine = self.by_session.setdefault(lock.session, {})
        displaced = False
        if lock not in mine and len(mine) >= LANES_MAX:
            self.drop_older(lock.session, {lock.lane: lock.seq})
            mine = self.by_session.setdefault(lock.session, {})
            displaced = len(mine) >= LANES_MAX
            if displaced:
                del mine[next(iter(mine))]
        # Added to: the client may have taken an answer to an earlier view of this lock.
        mine.setdefault(lock, {}).update(data)
        return displaced

    def drop(self, lock: LockId) -> None:
        """Forget what a lock pins."""
        mine = self.by_session.get(lock.session)
        if mine is not None and mine.pop(lock, None) is not None and not mine:
            del self.by_session[lock.session]

    def drop_older(self, session: str, lowest: Mapping[int, int]) -> None:
        """Forget what the locks of a session pin that come before the lowest seq of their lane."""
        mine = self.by_session.get(session, {})
        for lock in [lock for lock in mine if lock.seq < lowest.get(lock.lane, 0)]:
            self.drop(lock)

    def drop_session(self, session: str) -> None:
        """Forget everything that a session's views keep."""
        self.by_session.pop(session, None)
