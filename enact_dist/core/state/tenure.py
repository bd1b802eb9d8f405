"""One lock at a shard, and the grants that stay with their session between two blocks.

A session that locks the same data again and again may keep its grant: the next block begins without
a message.  Client and shard agree through a page of shared memory and a file lock of the kernel
(`UseMarks`)::

    client   begins: takes the mark, then looks at the cell      ends: gives it back, looks again
    shard    recalls: clears the cell, then asks for the mark    not taken: over at once
                                                                 taken: over with that block

Where they share no memory, a session that listens for recalls (`KeepAlive.wait_ns`) may keep a
grant, too, which is then a lock that it still holds.  A recall sends word, and the client gives
the grant back once no block uses it; if it does not, the end of its lease, or of the hold limit,
ends it as any lock.

Rules a change must keep
  * The cell is cleared first, and the mark asked for afterwards.  In the other order a recall
    between a client's look and the return of its mark would be missed by both.
  * The cell is cleared at every end of a kept grant: cells outlive the shard's process.
  * Under a kept grant a commit is accepted only with a higher seq than its lane has used.
  * A grant is kept only while no lock waits for what it holds, so no lock is overtaken.
  * The hold limit of a far grant is longer by a lease: a client that has not heard of the recall
    may begin a block as long as it believes in its lease, and believe in the block as long again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.core.protocol.datum import Column, Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import FAR, NOT_KEPT, PLACES, Item
from enact_dist.core.state.lock_table import Claim, Mode, Resource, join
from enact_dist.patterns import pattern_matches
from enact_dist.terms import ACCESSES, Access

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.core.protocol.records import PreparedRecord

_IS, _IX, _S, X = Mode.IS, Mode.IX, Mode.S, Mode.X
KEPT_ITEMS_MAX: Final = 16
"""A lock of more requests is not kept: its grant would stand in the way of many."""
KEPT_MAX: Final = 4096
KEPT_OF_SESSION_MAX: Final = 64
"""Grants that one shard lets its sessions keep, and each of them."""
ROW_MIN: Final = 2
ROW_MAX: Final = 64
"""A grant stays after so many blocks of the same data in a row; each recall doubles the number."""
USES_TO_HALVE: Final = 64
"""After so many commits under one kept grant the number is halved."""
HABITS_MAX: Final = 4096
"""Sets of data, by session, of which a shard remembers how often they were locked in a row."""
CAUSES_MAX: Final = 256
"""Ends of kept grants whose cause is remembered, for the next message of the client."""


@dataclass(slots=True, eq=False)
class Tenure:
    """One lock at this shard.

    Attributes:
        named: The slots of `items` where none of these is a pattern.
        alone: It holds and views nothing at other shards: its commit decides in one step.
        committing: The store works on its commit, its preparation or its end.
        prepared: What another shard decides about.
        owner: The identity of its session (see `core.shard.owners`).
        keepable: Whether its grant may stay with the session.
        kept: What the answer said when its grant stayed; 0 while it was not.
        recalled: Another lock waits for a kept grant in use: it ends with that block.
        unheard_ns: How long its session may begin blocks after a recall that it did not hear of.
    """

    lock: LockId
    claim: Claim
    items: tuple[Item, ...]
    hold_ns: int
    asked_ns: int
    named: tuple[Slot, ...] = ()
    alone: bool = False
    keepable: bool = False
    token: Token | None = None
    granted_ns: int = 0
    hold_end_ns: int = 0
    committing: bool = False
    prepared: PreparedRecord | None = None
    parked: int | None = None
    owner: str = ""
    kept: int = NOT_KEPT
    recalled: bool = False
    unheard_ns: int = 0
    pins: dict[tuple[Slot, int], Datum] = field(default_factory=dict)

    @property
    def bound(self) -> bool:
        """Whether neither its client nor time can end it."""
        return self.committing or self.prepared is not None

    def covers(self, slot: Slot) -> bool:
        """Whether this lock may write `slot`."""
        if self.claim.wants.get(slot) is X:
            return True
        return any(
            item.access == Access.WRITE_EACH
            and (item.context, item.aspect) == (slot.context, slot.aspect)
            and pattern_matches(item.entity, slot.entity)
            for item in self.items
        )


@dataclass(slots=True, eq=False)
class Shape:
    """What follows from a set of requested items alone.

    Attributes:
        wants: Which resources they use, and how.
        named: Their slots where none of them is a pattern, else none.
        patterns: How many are patterns.
        keepable: Whether a grant of them may stay with its session (see `is_keepable`).
    """

    wants: dict[Resource, Mode]
    named: tuple[Slot, ...]
    patterns: int
    keepable: bool


def wants_of(items: Iterable[Item]) -> dict[Resource, Mode]:
    """Return which resources a set of requested items uses, and how."""
    wants: dict[Resource, Mode] = {}
    for item in items:
        access = ACCESSES[item.access]
        if not access.locks:
            continue
        column = Column(item.context, item.aspect)
        if access.each:
            wants[column] = join(wants.get(column), X if access.writes else _S)
        else:
            slot = Slot(item.context, item.entity, item.aspect)
            wants[slot] = join(wants.get(slot), X if access.writes else _S)
            wants[column] = join(wants.get(column), _IX if access.writes else _IS)
    return wants


def is_keepable(items: tuple[Item, ...]) -> bool:
    """Whether a grant of these may stay: few named slots that are all locked, none viewed."""
    if len(items) > KEPT_ITEMS_MAX:
        return False
    accesses = [ACCESSES[item.access] for item in items]
    return all(access.locks and not access.each for access in accesses) and not any(
        item.captured_ns for item in items
    )


def shape_of(items: tuple[Item, ...]) -> Shape:
    """Return what follows from a set of requested items alone."""
    patterns = sum(ACCESSES[item.access].each for item in items)
    named = () if patterns else tuple([Slot(i.context, i.entity, i.aspect) for i in items])
    return Shape(wants_of(items), named, patterns, is_keepable(items))


class UseMarks(Protocol):
    """What client and shard of one host can see of the use of kept grants; never blocks."""

    def keep(self, session: str, number: int) -> int:
        """Put a grant's number into a free cell of its session's page.

        Returns:
            What the answer says: `PLACES` and more is the cell; below, why there is none.
        """

    def recall(self, session: str, number: int) -> bool:
        """Clear a grant's cell, then return whether no block uses it."""

    def used(self, session: str, number: int) -> bool:
        """Whether a block uses the grant now."""

    def over(self, session: str, number: int) -> None:
        """Clear a grant's cell; another grant may have it."""

    def drop(self, session: str) -> None:
        """Forget the page of a session that has ended."""


class _NoMarks:
    """No memory in common with any client: nothing is kept."""

    def keep(self, session: str, number: int) -> int:
        del session, number
        return NOT_KEPT

    def recall(self, session: str, number: int) -> bool:
        raise AssertionError(f"grant {number} of {session} was never kept")

    def used(self, session: str, number: int) -> bool:
        raise AssertionError(f"grant {number} of {session} was never kept")

    def over(self, session: str, number: int) -> None:
        raise AssertionError(f"grant {number} of {session} was never kept")

    def drop(self, session: str) -> None:
        del session


@dataclass(slots=True)
class _Habit:
    """How often a session has locked the same data in a row, and how often it must have."""

    row: int = 0
    needed: int = ROW_MIN
    uses: int = 0


class KeptGrants:
    """The kept grants of one shard.

    Attributes:
        by_number: All, by the number of their token.
        recalled: Those in use for which another lock waits.
        marks: What client and shard of one host can see of each other.
        listening: The sessions that listen for recalls now, each with its TTL.
        untold: Sessions of which a far grant was recalled or taken, and no word was sent yet.
        closed: The shard lets no more grants stay: it is about to stop, or was started so.
    """

    __slots__ = (
        "_causes",
        "_counters",
        "_end",
        "_habits",
        "_of",
        "by_number",
        "closed",
        "listening",
        "marks",
        "recalled",
        "untold",
    )

    def __init__(self, counters: dict[str, int], end: Callable[[Tenure], object]) -> None:
        self.by_number: dict[int, Tenure] = {}
        self.recalled: dict[int, Tenure] = {}
        self.marks: UseMarks = _NoMarks()
        self.listening: dict[str, int] = {}
        self.untold: dict[str, None] = {}
        self.closed = False
        self._counters, self._end = counters, end
        self._of: dict[str, dict[int, Tenure]] = {}
        self._habits: dict[tuple[str, tuple[Slot, ...]], _Habit] = {}
        self._causes: dict[int, str] = {}

    def find(self, lock: LockId, token: Token) -> Tenure | None:
        """Return the kept grant that a later block of its session names by its token."""
        tenure = self.by_number.get(token.number)
        if tenure is None or tenure.token != token or tenure.lock.session != lock.session:
            return None
        return tenure

    def told(self, lock: LockId, token: Token) -> int:
        """Return what a repeated answer says: whether the grant lives, recalled or not."""
        tenure = self.find(lock, token)
        return tenure.kept if tenure is not None else NOT_KEPT

    def has(self, session: str) -> bool:
        """Whether a session keeps a grant here."""
        return session in self._of

    def stays(self, tenure: Tenure, *, awaited: bool, now_ns: int) -> int:
        """Decide whether a grant stays after a block that ended well.

        Args:
            tenure: The grant; bound no more.
            awaited: Whether another lock waits for what it holds.
            now_ns: The present.

        Returns:
            What the answer to the client says; below `PLACES` the grant is over.
        """
        habit = self._habit(tenure)
        if awaited or tenure.recalled or self.closed:
            habit.row = 0
            return NOT_KEPT
        if tenure.kept:
            habit.uses += 1
            if habit.uses % USES_TO_HALVE == 0:
                habit.needed = max(ROW_MIN, habit.needed // 2)
            return tenure.kept
        habit.row += 1
        if habit.row < habit.needed:
            return NOT_KEPT
        assert tenure.token is not None
        number, session = tenure.token.number, tenure.lock.session
        if not self._has_room(session, now_ns):
            told = NOT_KEPT
        elif session in self.listening:
            told, tenure.unheard_ns = FAR, self.listening[session]
        else:
            told = self.marks.keep(session, number)
        if told < PLACES:
            self._counters["grants_not_kept"] += 1
            return told
        tenure.kept = told
        self.by_number[number] = self._of.setdefault(session, {})[number] = tenure
        self._counters["grants_kept"] += 1
        return told

    def _has_room(self, session: str, now_ns: int) -> bool:
        """Whether one more grant may be kept; the oldest idle one of a session makes room."""
        mine = self._of.get(session, {})
        if len(mine) >= KEPT_OF_SESSION_MAX:
            for number, tenure in mine.items():
                busy = tenure.committing or tenure.recalled
                if not busy and (tenure.kept == FAR or not self.marks.used(session, number)):
                    self.recall(tenure, now_ns=now_ns)
                    break
        return len(mine) < KEPT_OF_SESSION_MAX and len(self.by_number) < KEPT_MAX

    def _habit(self, tenure: Tenure) -> _Habit:
        key = tenure.lock.session, tenure.named
        habit = self._habits.get(key)
        if habit is None:
            if len(self._habits) >= HABITS_MAX:
                del self._habits[next(iter(self._habits))]
            habit = self._habits[key] = _Habit()
        return habit

    def recall(self, tenure: Tenure, *, now_ns: int) -> None:
        """Take a kept grant back, if that was not done before.

        It is over, or a block uses it: then it ends with that block, whose hold limit begins.  A
        far one ends when its client has heard, or with a block.
        """
        if tenure.recalled:
            return
        assert tenure.token is not None
        number = tenure.token.number
        habit = self._habit(tenure)
        habit.row, habit.needed = 0, min(2 * habit.needed, ROW_MAX)
        if tenure.kept == FAR:
            unused, self.untold[tenure.lock.session] = False, None
        else:
            unused = self.marks.recall(tenure.lock.session, number)
        if unused and not tenure.committing:
            self._counters["grants_revoked"] += 1
            self._end(tenure)
            return
        tenure.recalled = True
        tenure.hold_end_ns = now_ns + tenure.hold_ns + tenure.unheard_ns
        self.recalled[number] = tenure
        self._counters["grants_recalled"] += 1

    def is_unused(self, tenure: Tenure) -> bool:
        """Whether a grant is kept, not far, and no block uses it now."""
        if tenure.kept in (NOT_KEPT, FAR) or tenure.bound or tenure.token is None:
            return False
        return not self.marks.used(tenure.lock.session, tenure.token.number)

    def end_unused(self) -> None:
        """End the recalled grants that no block uses any more: word of their end was lost."""
        for tenure in list(self.recalled.values()):
            if self.is_unused(tenure):
                self._end(tenure)

    def in_use(self) -> list[Tenure]:
        """Return the recalled grants whose hold limit may end them."""
        return [tenure for tenure in self.recalled.values() if not tenure.committing]

    def over(self, tenure: Tenure) -> None:
        """Forget a kept grant that ends, however it does."""
        assert tenure.token is not None
        number, session = tenure.token.number, tenure.lock.session
        if tenure.kept != FAR:
            self.marks.over(session, number)
        tenure.kept, tenure.recalled = NOT_KEPT, False
        del self.by_number[number]
        self.recalled.pop(number, None)
        mine = self._of[session]
        del mine[number]
        if not mine:
            del self._of[session]

    def taken(self, tenure: Tenure, cause: str) -> None:
        """Remember why a kept grant was taken away, for the next message that names it."""
        assert tenure.token is not None
        if tenure.kept == FAR:
            self.untold[tenure.lock.session] = None
        self._causes[tenure.token.number] = cause
        if len(self._causes) > CAUSES_MAX:
            del self._causes[next(iter(self._causes))]

    def cause(self, token: Token) -> str | None:
        """Return why a kept grant was taken away, as far as remembered."""
        return self._causes.get(token.number)

    def session_ended(self, session: str) -> None:
        """Forget what is known of a session: its page, and its habits.

        What is bound still ends with its commit, and is kept no more.
        """
        for tenure in list(self._of.get(session, {}).values()):
            self.over(tenure)
        self.marks.drop(session)
        for key in [key for key in self._habits if key[0] == session]:
            del self._habits[key]

    def left_by(self, session: str) -> list[Tenure]:
        """Return the far grants of a session that says goodbye: it uses none of them."""
        mine = self._of.get(session, {}).values()
        return [tenure for tenure in mine if tenure.kept == FAR and not tenure.bound]

    def recalled_of(self, session: str) -> set[int]:
        """Return the numbers of the recalled far grants of a session."""
        mine = self._of.get(session, {})
        return {number for number, one in mine.items() if one.kept == FAR and one.recalled}

    def assert_invariants(self, by_lock: dict[LockId, Tenure]) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        kept = {t.token.number: t for t in by_lock.values() if t.kept and t.token is not None}
        assert kept == self.by_number, (kept, self.by_number)
        assert self.recalled == {n: t for n, t in kept.items() if t.recalled}
        assert sum(map(len, self._of.values())) == len(kept)
        for tenure in kept.values():
            assert tenure.claim.granted
            assert tenure.prepared is None
            assert tenure.keepable
