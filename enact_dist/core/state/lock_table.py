"""Who may touch what: fair, all-or-nothing reader/writer locks over many resources.

Laws
  1. A claim names all its resources at once and is granted at once or not at all.
  2. A claim is granted when, at each of its resources, its mode agrees with every mode held there
     and with every mode that an *earlier* claim still waits for.  No claim overtakes a conflicting
     earlier one, so wide claims and writers do not starve; adjacent readers go together.
  3. Waits-for edges lead only to holders and earlier claims, so there is no cycle: no deadlock.

Resources are slots (a reader takes S, a writer X) and columns, the set of all slots of an aspect
in a context.  A pattern locks the column (S or X); a slot lock takes an intention mode there
(IS or IX).  Modes and their conflicts are those of multi-granularity locking (Gray et al. 1976).

Cost: O(resources of the claim) to enqueue, grant or release, independent of how many wait.  That
needs per-resource queues kept per mode: the first waiting ticket of each conflicting mode bounds
who is eligible, so no queue is ever scanned.  (A plain scan costs 1.5 ms per hand-over with 1,000
waiters.)  Being eligible at a resource never ends before the grant, because only later claims are
added and a grant replaces a waiting mode by the same held one; so a counter per claim suffices.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from enact_dist.core.protocol.datum import Column, LockId, Slot

Resource = Slot | Column


class Mode(enum.IntEnum):
    """How a claim uses a resource."""

    IS = 0
    """Intends to read some slot of the column."""
    IX = 1
    """Intends to write some slot of the column."""
    S = 2
    """Reads the slot, or all slots of the column."""
    SIX = 3
    """Reads all slots of the column and intends to write some."""
    X = 4
    """Writes the slot, or any slot of the column."""


_AGREES: Final = {
    Mode.IS: (Mode.IS, Mode.IX, Mode.S, Mode.SIX),
    Mode.IX: (Mode.IS, Mode.IX),
    Mode.S: (Mode.IS, Mode.S),
    Mode.SIX: (Mode.IS,),
    Mode.X: (),
}
_MODES: Final = range(len(Mode))  # looping over an enumeration costs 5 us
CONFLICTS: Final = tuple(tuple(m for m in Mode if m not in _AGREES[mode]) for mode in Mode)
"""For each mode, the modes it cannot stand beside."""

_JOIN: Final = {
    frozenset((Mode.IX, Mode.S)): Mode.SIX,
    frozenset((Mode.IX, Mode.SIX)): Mode.SIX,
    frozenset((Mode.S, Mode.SIX)): Mode.SIX,
}


def join(one: Mode | None, other: Mode) -> Mode:
    """Return the weakest mode that allows what both do."""
    if one is None or one is other:
        return other
    return _JOIN.get(frozenset((one, other)), max(one, other))


@dataclass(slots=True, eq=False)
class Claim:
    """One lock's place in the table.

    Attributes:
        ticket: Order of arrival at this shard; also the number shown to people.
        blocked: At how many resources something stands in the way (0 when granted).
    """

    lock: LockId
    ticket: int
    wants: Mapping[Resource, Mode]
    blocked: int = 0
    granted: bool = False


_NOBODY: Final[dict[LockId, Claim]] = {}
_NO_WAITERS: Final = [_NOBODY] * len(_MODES)
_NO_HOLDERS: Final = [0] * len(_MODES)
SPARE_MAX: Final = 64
"""Queues without holders and waiters that are kept for the next resources."""


@dataclass(slots=True, eq=False)
class _Queue:
    """Holders and waiters of one resource.

    Invariants: `held_modes[m]` counts `held` values; `pending[m]` is the not yet eligible part of
    `waiting[m]`, and `waiters` counts all of it; all dicts are in ticket order.  A mode without any
    waiter so far has `_NOBODY` in both, which stays empty.
    """

    held: dict[LockId, Mode] = field(default_factory=dict)
    held_modes: list[int] = field(default_factory=_NO_HOLDERS.copy)
    waiting: list[dict[LockId, Claim]] = field(default_factory=_NO_WAITERS.copy)
    pending: list[dict[LockId, Claim]] = field(default_factory=_NO_WAITERS.copy)
    waiters: int = 0

    def add_waiting(self, claim: Claim, mode: Mode, *, eligible: bool) -> None:
        self.waiters += 1
        waiting = self.waiting[mode]
        if waiting is _NOBODY:
            self.waiting[mode] = {claim.lock: claim}
        else:
            waiting[claim.lock] = claim
        if not eligible:
            if self.pending[mode] is _NOBODY:
                self.pending[mode] = {}
            self.pending[mode][claim.lock] = claim

    def admits(self, mode: Mode) -> bool:
        """Whether a newcomer of `mode` would conflict with no claim here."""
        held_modes, waiting = self.held_modes, self.waiting
        for other in CONFLICTS[mode]:  # noqa: SIM110 - a generator takes twice as long
            if held_modes[other] or waiting[other]:
                return False
        return True

    def newly_eligible(self) -> Iterable[Claim]:
        """Remove and return the waiters that nothing here blocks any more."""
        found: list[Claim] = []
        for mode in _MODES:
            pending = self.pending[mode]
            if not pending or any(self.held_modes[other] for other in CONFLICTS[mode]):
                continue
            limit = self._first_conflicting_ticket(mode)
            count = len(found)
            for claim in pending.values():
                if claim.ticket > limit:
                    break
                found.append(claim)
            for claim in found[count:]:
                del pending[claim.lock]
        return found

    def _first_conflicting_ticket(self, mode: int) -> int:
        """Return the ticket up to which waiters of `mode` have no earlier conflicting waiter."""
        tickets = [
            _first(self.waiting[other]).ticket for other in CONFLICTS[mode] if self.waiting[other]
        ]
        return min(tickets, default=_NO_LIMIT)

    def empty(self) -> bool:
        return not self.held and not self.waiters


_NO_LIMIT: Final = 1 << 63


def _first(claims: dict[LockId, Claim]) -> Claim:
    return next(iter(claims.values()))


class LockTable:
    """The table of one shard.  Pure bookkeeping: leases and tokens live in `core.state.grants`.

    Attributes:
        claims: All claims, granted or waiting.
        ready: Those that may be granted.
    """

    __slots__ = ("_queues", "_spare", "_ticket", "claims", "ready")

    def __init__(self) -> None:
        self.claims: dict[LockId, Claim] = {}
        self._queues: dict[Resource, _Queue] = {}
        self._spare: list[_Queue] = []
        self.ready: dict[LockId, Claim] = {}
        self._ticket = 0

    def enqueue(
        self, lock: LockId, wants: Mapping[Resource, Mode], *, at_once: bool = False
    ) -> Claim:
        """Add a claim behind all others; `take_ready` tells when it may be granted.

        With `at_once` it is granted here if nothing stands in its way and no other claim is ready.
        """
        assert lock not in self.claims, lock
        self._ticket += 1
        claim = self.claims[lock] = Claim(lock, self._ticket, wants)
        queues, spare = self._queues, self._spare
        for resource, mode in wants.items():
            queue = queues.get(resource)
            if queue is None:
                queues[resource] = spare.pop() if spare else _Queue()
            elif not queue.admits(mode):
                claim.blocked += 1
        if at_once and not claim.blocked and not self.ready:
            claim.granted = True
            for resource in wants:
                queue, mode = queues[resource], wants[resource]
                queue.held[lock] = mode
                queue.held_modes[mode] += 1
            return claim
        for resource, mode in wants.items():
            queue = queues[resource]
            queue.add_waiting(claim, mode, eligible=not claim.blocked or queue.admits(mode))
        if not claim.blocked:
            self.ready[lock] = claim
        return claim

    def take_ready(self) -> list[Claim]:
        """Grant every claim that may be granted and return them in order of arrival."""
        if not self.ready:
            return []
        ready = list(self.ready.values())
        if len(ready) > 1:
            ready.sort(key=lambda claim: claim.ticket)
        self.ready.clear()
        for claim in ready:
            claim.granted = True
            for resource, mode in claim.wants.items():
                queue = self._queues[resource]
                del queue.waiting[mode][claim.lock]
                queue.waiters -= 1
                queue.held[claim.lock] = mode
                queue.held_modes[mode] += 1
        return ready

    def remove(self, lock: LockId) -> Claim | None:
        """Forget a claim, granted or waiting, and make the claims eligible that it kept out."""
        claim = self.claims.pop(lock, None)
        if claim is None:
            return None
        granted, queues = claim.granted, self._queues
        if not granted:
            self.ready.pop(lock, None)
        for resource, mode in claim.wants.items():
            queue = queues[resource]
            if granted:
                del queue.held[lock]
                queue.held_modes[mode] -= 1
            else:
                del queue.waiting[mode][lock]
                queue.waiters -= 1
                queue.pending[mode].pop(lock, None)
            if queue.waiters:
                for eligible in queue.newly_eligible():
                    eligible.blocked -= 1
                    if not eligible.blocked:
                        self.ready[eligible.lock] = eligible
            elif not queue.held:
                del queues[resource]
                if len(self._spare) < SPARE_MAX:
                    self._spare.append(queue)
        return claim

    def awaited(self, claim: Claim) -> bool:
        """Whether another lock waits for what a granted claim holds."""
        for resource, mode in claim.wants.items():
            queue = self._queues[resource]
            if queue.waiters and any(queue.waiting[other] for other in CONFLICTS[mode]):
                return True
        return False

    def holders_against(self, claim: Claim) -> list[Claim]:
        """Return the granted claims that a waiting one has to wait for."""
        found: dict[LockId, Claim] = {}
        for resource, mode in claim.wants.items():
            queue = self._queues[resource]
            if any(queue.held_modes[other] for other in CONFLICTS[mode]):
                for lock, held in queue.held.items():
                    if held in CONFLICTS[mode]:
                        found[lock] = self.claims[lock]
        return list(found.values())

    def writers_of(self, slot: Slot) -> list[LockId]:
        """Return the holder that may write a slot, alone or with its whole column."""
        found: list[LockId] = []
        for resource in (slot, Column(slot.context, slot.aspect)):
            queue = self._queues.get(resource)
            if queue is not None and queue.held_modes[Mode.X]:
                found += [lock for lock, mode in queue.held.items() if mode is Mode.X]
        return found

    def overtook(self, claim: Claim) -> bool:
        """Whether a conflicting earlier claim still waits: never, by law 2; counted still."""
        for resource, mode in claim.wants.items():
            waiting = self._queues[resource].waiting
            for other in CONFLICTS[mode]:
                if waiting[other] and _first(waiting[other]).ticket < claim.ticket:
                    return True
        return False

    def blockers(self, claim: Claim, *, count_max: int) -> list[Claim]:
        """Return up to `count_max` claims that `claim` waits for, holders first."""
        found: dict[LockId, Claim] = {}
        if claim.granted:
            return []
        for resource, mode in claim.wants.items():
            queue = self._queues[resource]
            for lock, held in queue.held.items():
                if held in CONFLICTS[mode]:
                    found[lock] = self.claims[lock]
                    if len(found) >= count_max:
                        return list(found.values())
        for resource, mode in claim.wants.items():
            for other in CONFLICTS[mode]:
                for lock, waiter in self._queues[resource].waiting[other].items():
                    if waiter.ticket >= claim.ticket or len(found) >= count_max:
                        break
                    found[lock] = waiter
        return list(found.values())

    def place(self, claim: Claim) -> int:
        """Return the place of a waiting claim among the waiters of its resources, from 1."""
        ahead: set[LockId] = set()
        for resource, mode in claim.wants.items():
            for other in CONFLICTS[mode]:
                for lock, waiter in self._queues[resource].waiting[other].items():
                    if waiter.ticket >= claim.ticket or len(ahead) >= PLACE_MAX:
                        break
                    ahead.add(lock)
        return len(ahead) + 1

    def assert_invariants(self) -> None:
        """Assert the laws over the whole table.  Slow: for tests and simulation."""
        for resource, queue in self._queues.items():
            modes = list(queue.held.values())
            for index, mode in enumerate(modes):
                assert not any(m in CONFLICTS[mode] for m in modes[:index]), (resource, queue.held)
            assert queue.waiters == sum(map(len, queue.waiting)), resource
            assert queue.held_modes == [modes.count(mode) for mode in Mode], resource
            assert not queue.empty(), resource
        for claim in self.claims.values():
            if claim.granted:
                continue
            blocked = sum(self._conflicts_at(claim, resource) for resource in claim.wants)
            assert blocked == claim.blocked, (claim, blocked)
            assert (not blocked) == (claim.lock in self.ready), claim

    def _conflicts_at(self, claim: Claim, resource: Resource) -> bool:
        queue, conflicts = self._queues[resource], CONFLICTS[claim.wants[resource]]
        return any(held in conflicts for held in queue.held.values()) or any(
            waiter.ticket < claim.ticket
            for mode in conflicts
            for waiter in queue.waiting[mode].values()
        )


PLACE_MAX: Final = 1000
"""Places beyond this are reported as this one: people need no longer count."""
