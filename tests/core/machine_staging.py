"""How a lock gets into each state, by the shortest honest way: what rare cells are met with.

Each recipe is the way from one state to the next; `bring` walks them until the lock is where it is
wanted, or gives up where the world does not allow it just now.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from machine_messages import MS, Pick
from machine_pair import SLOTS
from reference_table import conflict, lines_of

from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.messages import Item
from enact_dist.terms import Access

LONG_NS = 60_000 * MS
"""A hold limit that does not end by itself while other things are tried."""


ROWS_TRIED = 8
"""Blocks in a row after which a grant that others took back too often is given up."""


def write(slot) -> Item:
    """Return the request that writes a slot."""
    return Item(Access.WRITE, *slot)


def _needed(rows, session: str, item: Item) -> int:
    row = rows.get((session, (Slot(item.context, item.entity, item.aspect),)))
    return row.needed - row.blocks if row is not None else 2


class Staging:
    """The half of the machine that brings locks into states; see `ShardMachine` for the other."""

    def bring(self, state: str, choice: Pick) -> LockId | None:
        """Return a lock in this state, an old one or a new one; None if that cannot be now."""
        locks = [lock for lock, now in self._locks().items() if now == state]
        if locks and (state == "unseen" or choice.below(3)):
            return choice.one(locks)
        if self.reference.draining or self.reference.in_grace:
            self._open(choice)
        lock = self._recipes[state](self, choice)
        return lock if lock is not None and self.reference.state_of(lock) == state else None

    def _greet(self, session: str) -> None:
        """A session says hello as it should: it knows this epoch."""
        lock = LockId(session, 0, 0)
        message = self.plans.hello(lock, Pick(0))
        self._say("hello", lock, replace(message, known_epoch=self.reference.epoch))

    def _open(self, choice: Pick) -> None:
        if self.reference.draining:
            self._crash(choice, "kill")
        self._hello_all()

    # ---------------------------------------------------------------- one way for each state

    def _lane(self, choice: Pick) -> tuple[str, int]:
        """Choose a thread, one that holds and awaits nothing if there is one."""
        busy = {life.lock[:2] for life in self.reference.lives.values() if not life.bound}
        lanes = [lane for lane in self.tops if lane not in busy] or list(self.tops)
        lane = choice.one(lanes)
        if self.reference.known(lane[0]) is None:
            self._greet(lane[0])
            self._report(len(self.pair.kept))
        return lane

    def _another(self, lock: LockId, choice: Pick) -> tuple[str, int]:
        """Choose another thread than that of a lock, of a session that may ask."""
        lane = choice.one([lane for lane in self.tops if lane != lock[:2]])
        if self.reference.known(lane[0]) is None:
            self._greet(lane[0])
            self._report(len(self.pair.kept))
        return lane

    def _ask(self, lane, items, *, wait_ns: int, alone: bool, choice: Pick) -> LockId:
        lock = self._next(lane)
        self.plans.items[lock], self.plans.alone[lock] = tuple(items), alone
        message = self.plans.acquire(lock, choice)
        message = replace(
            message, wait_ns=wait_ns, hold_ns=choice.one((300 * MS, 300 * MS, LONG_NS))
        )
        self._say("acquire", lock, message)
        return lock

    def _parked(self, choice: Pick) -> LockId | None:
        return self._behind(choice, choice.one((90 * MS, 1000 * MS, 1000 * MS)))

    def _granted(self, choice: Pick, *, kept: bool = False, alone: bool = False) -> LockId | None:
        """Get a lock that nobody stands in the way of; `kept` asks for data that a disk keeps."""
        wanted = [line for life in self.reference.lives.values() for line in life.lines]
        free = []
        for slot in SLOTS:
            item = write(slot)
            if not conflict(lines_of([item]), frozenset(wanted)):
                free.append(item)
        if kept:
            free = [item for item in free if item.aspect != "frame"]
        if not free:
            self._make_room()
            return None
        lane = self._lane(choice)
        return self._ask(lane, [choice.one(free)], wait_ns=0, alone=alone, choice=choice)

    def _kept(self, choice: Pick) -> LockId | None:
        """Lock the same data in a row until the grant stays."""
        lane = self._lane(choice)
        wanted = frozenset(line for life in self.reference.lives.values() for line in life.lines)
        free = [item for slot in SLOTS if not conflict(lines_of([item := write(slot)]), wanted)]
        if not free:
            self._make_room()
            return None
        rows = self.reference.rows
        first = choice.below(len(free))
        items = [min(free[first:] + free[:first], key=lambda i: _needed(rows, lane[0], i))]
        for _ in range(ROWS_TRIED):
            lock = self._ask(lane, items, wait_ns=0, alone=True, choice=choice)
            if self.reference.state_of(lock) != "granted":
                return None
            waiter = None
            if choice.below(6) == 0:
                lane_of_it = self._another(lock, choice)
                waiter = self._ask(lane_of_it, items, wait_ns=0, alone=True, choice=choice)
            self._event("keep", lock, choice)
            self._report_of(lock)
            if waiter is not None:
                self._event("release", waiter, choice)
            if self.reference.state_of(lock) == "kept":
                return lock
        return None

    def _recalled(self, choice: Pick) -> LockId | None:
        """A block uses a grant that another lock waits for."""
        kept = self.bring("kept", choice)
        if kept is None:
            return None
        self._event("used", kept, choice)
        lane = self._another(kept, choice)
        if self.reference.state_of(kept) == "kept":
            items = self.plans.items[kept]
            self._ask(lane, items, wait_ns=1000 * MS, alone=False, choice=choice)
        return kept

    def _make_room(self) -> None:
        """Whoever may gives back what it holds; the disk and the far primary do their part."""
        self._report(len(self.pair.kept))
        for lock, life in list(self.reference.lives.items()):
            if life.phase == "prepared":
                self._event(
                    "told aborted" if self.plans.far.get(lock) is None else "finish", lock, Pick(0)
                )
            elif lock in self.reference.lives:
                self._event("release", lock, Pick(0))

    def _behind(self, choice: Pick, wait_ns: int) -> LockId | None:
        """Ask for what somebody holds."""
        held = [life for life in self.reference.lives.values() if life.held and life.lines]
        if not held:
            lock = self._granted(choice)
            held = [self.reference.lives[lock]] if lock in self.reference.lives else []
        if not held:
            return None
        before = choice.one(held)
        lane = self._another(before.lock, choice)
        if before.lock not in self.reference.lives:
            return None
        line = min(before.lines)
        access = Access.WRITE_EACH if line.each else Access.WRITE
        item = Item(access, line.context, line.entity, line.aspect)
        return self._ask(lane, [item], wait_ns=wait_ns, alone=False, choice=choice)

    def _untold(self, choice: Pick) -> LockId | None:
        """Wait without listening until whoever is in the way has gone."""
        before = self._granted(choice)
        if before not in self.reference.lives:
            return None
        lane = self._another(before, choice)
        items = self.plans.items[before]
        lock = self._ask(lane, items, wait_ns=0, alone=False, choice=choice)
        self._event("release", before, choice)
        return lock

    def _after(self, state: str, event: str, choice: Pick) -> LockId | None:
        """Bring a lock into a state and let one event happen to it."""
        lock = self.bring(state, choice)
        if lock is not None:
            self._event(event, lock, choice)
        return lock

    def _at_disk(self, event: str, choice: Pick) -> LockId | None:
        """Get a lock whose data a disk keeps, and begin to end it."""
        lock = self._granted(choice, kept=True, alone=event == "commit" and choice.below(2) == 0)
        if lock is not None:
            self._event(event, lock, choice)
        return lock

    def _forgotten(self, choice: Pick) -> LockId | None:
        """Commit twice in one thread: only the newer one is remembered."""
        lock = self._after("committing", "persisted", choice)
        if lock is None or self.reference.state_of(lock) != "committed":
            return None
        items = self.plans.items.get(lock)
        if items is None:  # an earlier step has made its thread go on already
            return None
        newer = self._ask(lock[:2], items, wait_ns=0, alone=True, choice=choice)
        self._event("commit", newer, choice)
        self._event("persisted", newer, choice)
        return lock

    def _aborted(self, choice: Pick) -> LockId | None:
        """Abort by the primary's word, or by hand though it had committed."""
        if choice.below(2):
            return self._after("alarm", "persisted", choice)
        return self._after("prepared", "told aborted", choice)

    def _lost(self, choice: Pick) -> LockId | None:
        lock = self._granted(choice)
        self._crash(choice, "kill")
        return lock

    _recipes: ClassVar = {
        "unseen": lambda m, c: m._next(m._lane(c)),
        "waiting": lambda m, c: m._behind(c, 0),
        "parked": lambda m, c: m._parked(c),
        "untold": lambda m, c: m._untold(c),
        "granted": lambda m, c: m._granted(c),
        "kept": lambda m, c: m._kept(c),
        "recalled": lambda m, c: m._recalled(c),
        "committing": lambda m, c: m._at_disk("commit", c),
        "deciding": lambda m, c: m._at_disk("decide", c),
        "preparing": lambda m, c: m._at_disk("prepare", c),
        "prepared": lambda m, c: m._after("preparing", "persisted", c),
        "finishing": lambda m, c: m._after("prepared", "finish", c),
        "aborting": lambda m, c: m._after("prepared", "force abort", c),
        "decided": lambda m, c: m._after("deciding", "persisted", c),
        "committed": lambda m, c: m._after("committing", "persisted", c),
        "forgotten": lambda m, c: m._forgotten(c),
        "finished": lambda m, c: m._after("finishing", "persisted", c),
        "forced": lambda m, c: m._after("aborting", "persisted", c),
        "alarm": lambda m, c: m._after("forced", "finish", c),
        "aborted": lambda m, c: m._aborted(c),
        "taken": lambda m, c: m._after("granted", "broken", c),
        "given back": lambda m, c: m._after("granted", "release", c),
        "validated": lambda m, c: m._after("granted", "validate", c),
        "dropped": lambda m, c: m._after("waiting", "token gone", c),
        "lost": lambda m, c: m._lost(c),
    }
