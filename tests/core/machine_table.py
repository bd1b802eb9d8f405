"""The lock table beside its reference, step by step: any requests, cancelled and released anyhow.

Cells are counted by what a newcomer meets at each resource: its mode there, against each mode that
is held or waited for; and by what happens to a claim in which state.
"""

from __future__ import annotations

from typing import ClassVar

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from machine_coverage import Coverage
from reference_table import ReferenceTable, lines_of

from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.messages import Item
from enact_dist.core.state.lock_table import LockTable, Mode
from enact_dist.core.state.tenure import wants_of
from enact_dist.terms import Access

ENTITIES = ("a", "tray/1", "tray/2")
PATTERNS = ("**", "tray/*", "none/*")
ASPECTS = ("count", "note")

ACCESSES = (Access.READ, Access.WRITE, Access.READ_EACH, Access.WRITE_EACH, Access.VIEW)


SCAN = [
    Item(Access.READ_EACH, "online", "tray/*", "count"),
    Item(Access.WRITE, "online", "tray/1", "count"),
]
"""Reads a whole column and writes one slot of it: the mixed mode."""


def request_of(number: int) -> list[Item]:
    """Return one to three lines of a lock; each number below 2**20 is about as likely."""
    if number % 10 == 0:
        return SCAN
    items = []
    number, more = divmod(number, 3)
    for _ in range(more + 1):
        number, access = divmod(number, 5)
        number, entity = divmod(number, 3)
        names = PATTERNS if ACCESSES[access].each else ENTITIES
        aspect = ASPECTS[number % 5 == 0]
        items.append(Item(ACCESSES[access], "online", names[entity], aspect))
    return items


REQUEST = st.integers(0, (1 << 20) - 1).map(request_of)
CLAIMS_MAX = 10
"""More waiters at once say nothing new and cost the reference their square."""

NEWCOMERS = [f"wants {mode.name}" for mode in Mode]
THERE = [f"{how} {mode.name}" for how in ("held", "awaited") for mode in Mode] + ["nobody"]
CLAIMS = ["absent", "waiting", "eligible", "granted"]
ACTS = ["enqueue", "remove", "take", "left behind by a wake-up"]
UNREACHABLE = {
    **{(c, "enqueue"): "a lock is in the table once" for c in CLAIMS[1:]},
    ("absent", "take"): "who is not there is not granted",
    ("absent", "left behind by a wake-up"): "who is not there does not wait",
    ("eligible", "left behind by a wake-up"): "whatever is eligible is taken together",
    ("granted", "left behind by a wake-up"): "who is granted does not wait",
    ("granted", "take"): "a claim is granted once",
    ("waiting", "take"): "who is not eligible is not granted",
}


class TableMachine(RuleBasedStateMachine):
    """Enqueue, cancel, release and grant in any order; the reference must agree after each step."""

    meetings: ClassVar[Coverage]
    claims: ClassVar[Coverage]
    own_assertions: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self.table, self.reference = LockTable(), ReferenceTable()
        self.number = 0
        self.steps = -1

    # ---------------------------------------------------------------- rules

    @precondition(lambda self: len(self.table.claims) < CLAIMS_MAX)
    @rule(items=REQUEST, take=st.booleans())
    def enqueue(self, items, take):
        """A request arrives."""
        self._enqueue(items)
        if take:
            self._take()
        self.compare()

    @precondition(lambda self: len(self.table.claims) < CLAIMS_MAX - 3)
    @rule(first=REQUEST, second=REQUEST, third=REQUEST)
    def enqueue_three(self, first, second, third):
        """Three requests arrive before anybody is granted."""
        for items in (first, second, third):
            self._enqueue(items)
        self.compare()

    @precondition(lambda self: self.table.claims)
    @rule(pick=st.integers(0, 1 << 16), take=st.booleans())
    def remove(self, pick, take):
        """A holder releases, or a waiter gives up."""
        self._remove(sorted(self.table.claims)[pick % len(self.table.claims)])
        if take:
            self._take()
        self.compare()

    @precondition(lambda self: self.reference.held)
    @rule(pick=st.integers(0, 1 << 16), count=st.integers(1, 3))
    def release(self, pick, count):
        """Holders release and whoever may goes on."""
        for _ in range(min(count, len(self.reference.held))):
            self._remove(sorted(self.reference.held)[pick % len(self.reference.held)])
        self._take()
        self.compare()

    @rule()
    def take(self):
        """Whoever may go on goes on."""
        self._take()
        self.compare()

    @rule(number=st.integers(0, 40))
    def remove_who_is_absent(self, number):
        """A removal of what is not there changes nothing."""
        lock = LockId("s", 0, self.number + number + 1)
        assert self.table.remove(lock) is None
        self.claims.hit("absent", "remove")
        self.compare()

    # ---------------------------------------------------------------- both sides

    def _enqueue(self, items):
        self.number += 1
        lock = LockId("s", 0, self.number)
        wants = wants_of(items)
        for resource, mode in wants.items():
            there = {f"held {m.name}" for m in self._modes(resource, granted=True)}
            there |= {f"awaited {m.name}" for m in self._modes(resource, granted=False)}
            for who in there or {"nobody"}:
                self.meetings.hit(f"wants {mode.name}", who)
        self.claims.hit("absent", "enqueue")
        claim = self.table.enqueue(lock, wants)
        self.reference.enqueue(lock, lines_of(items))
        assert claim.ticket == self.number, "numbers count arrivals"

    def _modes(self, resource, *, granted):
        claims = self.table.claims.values()
        return {c.wants[resource] for c in claims if c.granted is granted and resource in c.wants}

    def _remove(self, lock):
        self.claims.hit(self._state(lock), "remove")
        before = self.reference.may_go_on()
        claim = self.table.remove(lock)
        self.reference.remove(lock)
        assert claim is not None
        after = self.reference.may_go_on()
        if set(after) - set(before):
            for waiting, _ in self.reference.queue:
                if waiting not in after:
                    self.claims.hit("waiting", "left behind by a wake-up")

    def _take(self):
        taken = [claim.lock for claim in self.table.take_ready()]
        for _ in taken:
            self.claims.hit("eligible", "take")
        assert taken == self.reference.grant(), "everybody eligible goes on, in order of arrival"
        for lock in taken:
            assert not self.table.overtook(self.table.claims[lock]), "nobody is overtaken"

    def _state(self, lock):
        if lock in self.reference.held:
            return "granted"
        return "waiting" if any(self.reference.in_the_way(lock)) else "eligible"

    def compare(self):
        """The same holders with the same rights, the same queue, and the same reasons to wait."""
        table, reference = self.table, self.reference
        if self.own_assertions:
            table.assert_invariants()
        claims = table.claims.values()
        assert {c.lock for c in claims if c.granted} == set(reference.held)
        waiting = sorted((c for c in claims if not c.granted), key=lambda c: c.ticket)
        assert [c.lock for c in waiting] == [lock for lock, _ in reference.queue]
        assert not reference.conflicting_holders()
        for claim in waiting:
            holders, earlier = reference.in_the_way(claim.lock)
            blockers = [b.lock for b in table.blockers(claim, count_max=1000)]
            assert set(blockers[: len(holders)]) == set(holders), "holders are told first"
            assert set(blockers[len(holders) :]) == set(earlier)
            assert len(blockers) == len(holders) + len(earlier)
            assert table.place(claim) == len(earlier) + 1
        for entity in ENTITIES:
            slot = Slot("online", entity, "count")
            assert set(table.writers_of(slot)) == reference.guards_of(slot)

    @invariant()
    def count_the_step(self):
        """Called after each step, and once before the first."""
        self.steps += 1

    def teardown(self):
        """Whatever waits is granted in the end, and nothing is kept of who has left."""
        self.claims.count_run(self.steps)
        for _ in range(len(self.table.claims) + 1):
            self._take()
            for lock in list(self.reference.held):
                self._remove(lock)
        assert not self.table.claims, "somebody waits in vain"
        assert not self.table._queues, "an empty queue is kept"
