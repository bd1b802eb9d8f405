"""Parts of the tests about kept grants: marks that a test sets, and the steps to a kept grant."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from shard_bench import ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.messages import (
    NOT_KEPT,
    PLACES,
    Commit,
    Committed,
    Item,
    SlotVersion,
    Validate,
    WriteItem,
)
from enact_dist.core.state.tenure import ROW_MIN
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.datum import LockId, Slot, Token

FRAME = slot(aspect="frame")


class FakeMarks:
    """What the shard sees of the use of kept grants, as a test says.

    As strict as the pages of a host: whoever has no page is not asked about.

    Attributes:
        cells: The cells that hold a number, by session.
        in_use: The grants that blocks use: session and number.
        says: What `keep` says in place of a cell.
        meanwhile: Called between the two steps of a recall.
        log: What was done, in order.
    """

    def __init__(self) -> None:
        self.cells: dict[str, dict[int, int]] = {}
        self.in_use: set[tuple[str, int]] = set()
        self.says: int | None = None
        self.meanwhile: Callable[[], None] = lambda: None
        self.log: list[tuple[str, int]] = []

    def keep(self, session: str, number: int) -> int:
        if self.says is not None:
            return self.says
        cells = self.cells.setdefault(session, {})
        cells[number] = min(set(range(len(cells) + 1)) - set(cells.values()))
        self.log.append(("kept", number))
        return PLACES + cells[number]

    def recall(self, session: str, number: int) -> bool:
        self.over(session, number)
        self.meanwhile()
        return not self.used(session, number)

    def used(self, session: str, number: int) -> bool:
        assert session in self.cells
        self.log.append(("asked", number))
        return (session, number) in self.in_use

    def over(self, session: str, number: int) -> None:
        self.cells[session].pop(number, None)
        self.log.append(("cleared", number))

    def drop(self, session: str) -> None:
        self.cells.pop(session, None)
        self.in_use = {use for use in self.in_use if use[0] != session}


class Kept(NamedTuple):
    """A kept grant: its first lock, its token and what was said of its cell."""

    lock: LockId
    token: Token
    said: int


class KeepingBench(ShardBench):
    """A shard that sees the use of its grants."""

    def __init__(self) -> None:
        super().__init__()
        self.marks = FakeMarks()
        self.shard.state.tenures.kept.marks = self.marks
        self.seqs: dict[tuple[str, int], int] = {}

    def next_lock(self, session: str = "ann", lane: int = 0) -> LockId:
        """Return the next lock of a lane."""
        seq = self.seqs[session, lane] = self.seqs.get((session, lane), 0) + 1
        return lock_id(session, lane, seq)

    def end(
        self,
        lock: LockId,
        token: Token,
        text: str | None = "1",
        *,
        to: Slot = FRAME,
        keep: bool = True,
        held_ns: int = 0,
        expects: dict[Slot, int] | None = None,
    ):
        """End a block with a value."""
        writes = (WriteItem(to, None if text is None else datum(text)),)
        versions = tuple(SlotVersion(*pair) for pair in (expects or {}).items())
        message = Commit(lock, token, writes, 0, versions, keep=keep, held_ns=held_ns)
        return self.ask(message)

    def block(
        self, session: str = "ann", *items: Item, lane: int = 0, to: Slot = FRAME, **options
    ) -> Kept:
        """Lock by asking for it, and write; return what became of the grant."""
        lock = self.next_lock(session, lane)
        grant = self.granted(lock, *(items or (Item(Access.WRITE, *to),)))
        answer = self.end(lock, grant.token, to=to, **options)
        assert isinstance(answer, Committed), answer
        return Kept(lock, grant.token, answer.kept)

    def keep(
        self, session: str = "ann", *items: Item, lane: int = 0, to: Slot = FRAME, hold_ns=None
    ) -> Kept:
        """Lock the same data in a row until the grant stays."""
        for _ in range(ROW_MIN - 1):
            assert self.block(session, *items, lane=lane, to=to).said == NOT_KEPT
        if hold_ns is None:
            kept = self.block(session, *items, lane=lane, to=to)
        else:
            lock = self.next_lock(session, lane)
            grant = self.granted(lock, *(items or (Item(Access.WRITE, *to),)), hold_ns=hold_ns)
            kept = Kept(lock, grant.token, self.end(lock, grant.token, to=to).kept)
        assert kept.said >= PLACES
        return kept

    def use(self, kept: Kept, *, on: bool = True) -> None:
        """A block takes, or gives back, the mark of a grant."""
        mark = (kept.lock.session, kept.token.number)
        (self.marks.in_use.add if on else self.marks.in_use.discard)(mark)

    def waiter(self, session: str = "bob", *, to: Slot = FRAME) -> tuple[LockId, int]:
        """Ask for what a grant holds; return the lock and the handle of its answer."""
        lock = self.next_lock(session)
        return lock, self.send(self.acquire_request(lock, Item(Access.WRITE, *to)))

    def lives(self, kept: Kept) -> bool:
        """Whether a grant is held, and its number in a cell or not accordingly."""
        tenure = self.shard.state.tenures.by_lock.get(kept.lock)
        alive = tenure is not None and tenure.token == kept.token
        in_cell = kept.token.number in self.marks.cells.get(kept.lock.session, {})
        recalled = tenure is not None and tenure.recalled
        assert in_cell == (alive and bool(tenure.kept) and not recalled)
        return alive

    def validate(self, lock: LockId, token: Token, *, keep: bool = True):
        """End a block without writes."""
        return self.ask(Validate(lock, token, (), keep))


def reads(entity: str = "piece") -> Item:
    """Return a request that only reads."""
    return item(Access.READ, entity, "frame")
