"""The grants that this session keeps between two locks of the same data; see `core.state.tenure`.

::

    take ── mark, cell ── begin_kept ──> HELD ── Commit(token) or nothing ──> mark back, cell ── put

Who drives a lock does what touches the page of marks, in this order; the rest is decided here.

A shard without memory in common says `FAR`: its grant has neither mark nor cell.  The steps of a
block are then steps of this core alone, and an answer to a keep-alive says that it is recalled:
what no block uses is given back at once, what one uses with its end.

Rules a change must keep
  * A lock begins only after the mark was taken and the cell found to hold the grant's number.
  * The mark is given back before the cell is looked at again; only then may the grant be put back.
  * A grant stays only after a clear answer, or where nothing was sent.
  * A far grant goes from idle to in use, and back, in one step: word of a recall finds it in one.
  * What a grant shows is what it was given with, or what its session has committed since.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import FAR, NOT_KEPT, PLACES, Release
from enact_dist.core.protocol.records import Content
from enact_dist.core.state.slots import state_of
from enact_dist.terms import NullReason

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.client.plan import Part, Plan, Reading
    from enact_dist.core.protocol.datum import LockId, Slot, Token
    from enact_dist.core.protocol.messages import GrantLeft, Item, SlotState, SlotVersion, WriteItem


@dataclass(slots=True, eq=False)
class KeptGrant:
    """A grant of this session at one shard that no thread uses now.

    Attributes:
        items: The requests under which it is found again.
        plan: The plan of its first lock.
        origin: Its first lock, under which the shard lists and releases it.
        place: The cell of the page that holds its number as long as it lives.
        hold_ns: The hold limit that it was granted with.
        states: What its slots are, in the order of the plan.
        count: The session's message counter when it was granted.
        until_ns: Until when it may be believed in (CLOCK_BOOTTIME).
        values: What its blocks have decoded, by slot; not looked at here.
        far: It has no cell: client and shard share no memory.
        rested: A far one was in no use since it was last asked.
    """

    items: tuple[Item, ...]
    plan: Plan
    origin: LockId
    token: Token
    place: int
    hold_ns: int
    states: tuple[SlotState, ...]
    count: int
    until_ns: int
    values: dict[Slot, Any] = field(default_factory=dict)
    far: bool = False
    rested: bool = False

    @property
    def shard(self) -> str:
        """The shard that granted it."""
        return self.plan.locks[0][0]

    def committed(
        self, writes: Iterable[WriteItem], versions: Sequence[SlotVersion], stamp_ns: int
    ) -> None:
        """Show from now on what this session has just written."""
        written = {
            slot: state_of(slot, Content(version, stamp_ns, datum, NullReason.DELETED))
            for (slot, datum), (_, version) in zip(writes, versions, strict=True)
        }
        self.states = tuple([written.get(state.slot, state) for state in self.states])


class OwnGrants:
    """The kept grants of one session, none of them in use; by what was requested.

    Attributes:
        by_items: The grants.
        recalled: The far grants in use of which word has come, by shard and number.
        given_back: The releases of far grants, to be sent.
    """

    __slots__ = ("by_items", "given_back", "recalled")

    def __init__(self) -> None:
        self.by_items: dict[tuple[Item, ...], KeptGrant] = {}
        self.recalled: set[tuple[str, Token]] = set()
        self.given_back: list[tuple[str, Release]] = []

    def take(self, items: tuple[Item, ...]) -> KeptGrant | None:
        """Return the grant of these requests for one thread alone; None if there is none."""
        return self.by_items.pop(items, None)

    def put_back(self, grant: KeptGrant) -> None:
        """Keep a grant for the next lock; it lived when its cell was looked at."""
        self.by_items[grant.items] = grant

    def drop(self, shard: str) -> None:
        """Forget what a shard granted: it restarted, or forgot this session."""
        self.recalled = {each for each in self.recalled if each[0] != shard}
        for items, grant in list(self.by_items.items()):
            if grant.shard == shard:
                self.by_items.pop(items, None)

    def alive(self, shard: str, left: dict[Token, GrantLeft], *, asked: int, until_ns: int) -> None:
        """Take from a keep-alive which grants live.

        Args:
            shard: Whose answer it is.
            left: What the shard lists.
            asked: The message counter of the keep-alive.
            until_ns: Until when what it lists may be believed in.
        """
        for items, grant in list(self.by_items.items()):
            if grant.shard != shard:
                continue
            if grant.token in left:
                grant.until_ns = max(grant.until_ns, until_ns)
            elif grant.count < asked:
                self.by_items.pop(items, None)

    def hear(self, shard: str, left: Iterable[GrantLeft], used: set[Token | None]) -> None:
        """Give back the far grants that no block uses and that are recalled, or not known here.

        Args:
            shard: Whose word it is.
            left: What the shard lists.
            used: The tokens there of the locks that are not at rest.
        """
        idle = {g.token: items for items, g in self.by_items.items() if g.shard == shard}
        for lock, token, _, far, recalled in left:
            if not far or (not recalled and (token in idle or token in used)):
                continue
            if token in used:
                self.recalled.add((shard, token))
                continue
            if token in idle:
                del self.by_items[idle[token]]
            self.given_back.append((shard, Release(lock)))

    def heard(self, shard: str) -> tuple[int, ...]:
        """Return the numbers of a shard's grants in use of whose recall it need not say more."""
        return tuple(sorted(token.number for one, token in self.recalled if one == shard))

    def settle(self, keeping: Keeping) -> None:
        """Take a far grant from its block: it is put back, or given back if it was recalled."""
        grant = keeping.take_grant()
        assert grant is not None
        if (grant.shard, grant.token) in self.recalled:
            self.give_back(grant)
        else:
            grant.rested = False
            self.put_back(grant)

    def give_back(self, grant: KeptGrant) -> None:
        """Give a grant back that is in no table."""
        self.given_back.append((grant.shard, Release(grant.origin)))

    def rest(self, shard: str) -> None:
        """Give back the far grants of a shard that were in no use since this was last called."""
        for items, grant in list(self.by_items.items()):
            if grant.far and grant.shard == shard:
                if grant.rested:
                    self.give_back(self.by_items.pop(items))
                grant.rested = True


@dataclass(slots=True, eq=False)
class Keeping:
    """What one lock has to do with a kept grant: it may use one, and may leave one.

    Attributes:
        items: The requests under which its grant is to be kept.
        grant: The kept grant that it uses, or may keep.
        begun_ns: When it began under a kept grant (0: it was asked for).
        said: What the shard has said of its grant; see `Committed`.
        values: What its blocks have decoded and did not write; goes with the grant.
    """

    items: tuple[Item, ...]
    grant: KeptGrant | None = None
    begun_ns: int = 0
    said: int = NOT_KEPT
    values: dict[Slot, Any] = field(default_factory=dict)

    def used_ns(self, now_ns: int) -> int:
        """Return how long the block under a kept grant has lasted; 0 under any other."""
        return now_ns - self.begun_ns if self.begun_ns else 0

    def ends(self, phase: Phase, part: Part, *, sent: bool) -> bool:
        """Take in how the lock ends; return whether nothing is left to report to the shard."""
        if self.grant is not None:
            self.grant.until_ns = max(self.grant.until_ns, part.until_ns)
        if self.grant is None or phase is Phase.COMMITTED:
            return False
        if sent or phase is not Phase.RELEASED:
            self.grant = None  # nothing clear is known of it: the next lock asks
        return not sent

    def told(self, said: int, lock: KeptLock) -> None:
        """Take in whether the grant of a lock stays with this session."""
        self.said, part = said, lock.parts[0]
        if said < PLACES or part.token is None:
            self.grant = None
        elif self.grant is None and not self.begun_ns:
            self.grant = KeptGrant(
                self.items,
                lock.plan,
                lock.lock,
                part.token,
                said - PLACES,
                lock.hold_ns,
                tuple([reading.state for reading in lock.states]),
                part.granted_count,
                part.until_ns,
                far=said == FAR,
            )

    def take_grant(self) -> KeptGrant | None:
        """Return the grant that stays, for its mark to be given back and its cell looked at."""
        grant, self.grant = self.grant, None
        if grant is not None:
            grant.values = self.values
        return grant


class KeptLock(Protocol):
    """What a kept grant is made of: the lock that was granted."""

    lock: LockId
    plan: Plan
    hold_ns: int
    parts: list[Part]
    states: list[Reading]
