"""Grants that stay with their session between two blocks, from their definition.

A grant stays if its block asks for it, if it names few slots of this shard alone, if nobody waits
for any of them, and from the second block of the same data in a row on.  Later locks of its session
then name its token, each with a higher seq than its lane has used.  Whoever comes to wait for it
takes it back: at once if no block uses it, else with that block.

A session that listens when its grant stays shares no memory with the shard: another lock of
such a grant waits until it is given back, and those that listen are told.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from reference_parts import Lane, Row
from reference_table import conflict

from enact_dist.core.protocol.datum import Slot

if TYPE_CHECKING:
    from reference_parts import Life

    from enact_dist.core.protocol.datum import LockId, Token

ROW_MIN, ROW_MAX, USES = 2, 64, 64
SLICE_NS = 1_000_000_000
LOOK_AGAIN_NS = 20_000_000


class ReferenceKeeping:
    """What a shard does about grants that stay; a part of `ReferenceSessions`.

    Attributes:
        rows: Per session and data, the blocks in a row.
        used: The marks: session and number of each grant that a block uses.
        listening: The sessions that listen: where their answer goes, and when at the latest.
        untold: The sessions that lost, or are to give back, a grant since they were told.
    """

    rows: dict[tuple[str, tuple[Slot, ...]], Row]
    used: set[tuple[str, int]]
    listening: dict[str, tuple[int, int]]
    untold: set[str]

    def listen(self, m, handle: int) -> None:
        """Keep a question for recalls, unless there is one to tell of."""
        self.answer_listener(m.session)
        mine = [life for life in self.of(m.session) if life.far and life.recalled]
        if self.draining or {life.token.number for life in mine} - set(m.heard):
            self.answer(handle, *self.alive_of(m.session))
        else:
            self.listening[m.session] = handle, self.now_ns + min(m.wait_ns, SLICE_NS)

    def answer_listener(self, session: str) -> None:
        """Answer a session, if it listens."""
        if session in self.listening:
            handle, _ = self.listening.pop(session)
            gone = session not in self.people
            self.answer(handle, *(("epoch", self.epoch) if gone else self.alive_of(session)))

    def tell_untold(self) -> None:
        """At the end of a step, tell of what became of far grants in it."""
        for session in self.untold:
            self.answer_listener(session)
        self.untold.clear()

    def alive_of(self, session: str) -> tuple:
        """Return what a keep-alive is answered."""
        left = {
            (life.lock, max(0, life.hold_end_ns - self.now_ns), life.far and life.recalled)
            for life in self.of(session)
            if life.held
        }
        return "alive", self.people[session].count, frozenset(left)

    def row_of(self, life: Life) -> Row:
        """Return the row of the data of a lock."""
        slots = tuple(Slot(item.context, item.entity, item.aspect) for item in life.items)
        return self.rows.setdefault((life.lock.session, slots), Row())

    def kept_under(self, session: str, token: Token) -> Life | None:
        """Return the grant of a session that stays and has this token."""
        for life in self.lives.values():
            if life.kept and life.token == token and life.lock.session == session:
                return life
        return None

    def lives_still(self, lock: LockId, token: Token) -> bool:
        """Whether the grant that a lock names stays, as of now."""
        return self.kept_under(lock.session, token) is not None

    def is_used(self, life: Life) -> bool:
        """Whether a block uses a grant."""
        return (life.lock.session, life.token.number) in self.used

    def stays(self, life: Life) -> bool:
        """Decide at the end of a block; False: the grant is over."""
        if not (life.asks_to_keep and life.keepable):
            return False
        row = self.row_of(life)
        awaited = any(conflict(wanted, life.lines) for _, wanted in self.table.queue)
        if awaited or life.recalled or self.draining:
            row.blocks = 0
        elif life.kept:
            row.uses += 1
            if row.uses % USES == 0:
                row.needed = max(ROW_MIN, row.needed // 2)
            return True
        else:
            row.blocks += 1
            life.kept = row.blocks >= row.needed
            life.far = life.kept and life.lock.session in self.listening
            return life.kept
        return False

    def take_back(self, life: Life) -> None:
        """Somebody wants what a grant holds that stays."""
        if not life.kept or life.recalled:
            return
        row = self.row_of(life)
        row.blocks, row.needed = 0, min(2 * row.needed, ROW_MAX)
        if life.far:
            self.untold.add(life.lock.session)
            ttl_ns = self.people[life.lock.session].ttl_ns
            life.recalled, life.hold_end_ns = True, self.now_ns + life.hold_ns + ttl_ns
        elif self.is_used(life) or life.bound:
            life.recalled, life.hold_end_ns = True, self.now_ns + life.hold_ns
        else:
            self.end(life, "taken")

    def end_unused(self) -> None:
        """Whoever was recalled and does not use its grant any more has lost it."""
        for life in list(self.lives.values()):
            if life.recalled and not (life.far or life.bound or self.is_used(life)):
                self.end(life, "taken")

    def session_over(self, session: str) -> None:
        """What is bound ends with its commit; nothing stays."""
        for life in self.of(session):
            life.kept = life.far = life.recalled = life.keepable = False
        self.rows = {key: row for key, row in self.rows.items() if key[0] != session}
        self.used = {use for use in self.used if use[0] != session}

    def behind(self, life: Life, lock: LockId) -> bool:
        """Whether a lock under a grant that stays is one that its lane has left behind."""
        lane = self.lane_of(lock)
        return life.kept and lane is not None and lock.seq <= lane.top

    def lane_for(self, lock: LockId) -> Lane:
        """Return the lane of a lock, made on first use."""
        return self.lanes.setdefault(lock.session, {}).setdefault(lock.lane, Lane())

    def use_of(self, life: Life) -> str:
        """Return how a grant that stays is used, for people."""
        if not life.kept:
            return ""
        used = life.bound or self.is_used(life)
        if life.recalled or life.far:
            return "recalled" if life.recalled else "far"
        return "used" if used else "unused"

    def user(self, lock: LockId) -> Life | None:
        """Return the life under which a lock has a commit, a promise or a grant."""
        found = [life for life in self.lives.values() if life.user == lock]
        return next((life for life in found if life.bound), found[0] if found else None)
