"""A real shard, driven by hand: time moves when told, the disk is done when told.

`ask` sends a request and returns its answer, or None while it is parked.  Sessions are short
strings; `hello` opens one.  `restart` builds the next epoch from what the disk has kept.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING

from enact_dist.core.offline.ledger import Ledger
from enact_dist.core.protocol.datum import Datum, LockId, Slot, Token
from enact_dist.core.protocol.messages import (
    START,
    Acquire,
    Answer,
    AspectEntry,
    Commit,
    Goodbye,
    Granted,
    Hello,
    Item,
    KeepAlive,
    LaneView,
    ListPlaces,
    PlacementMap,
    Register,
    Request,
    ShardEntry,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    Call,
    LogEvent,
    Persist,
    Persisted,
    Publish,
    Record,
    Recovered,
    Reply,
    Tick,
)
from enact_dist.core.shard.shard import Shard
from enact_dist.core.shard.state import ShardSettings
from enact_dist.terms import Access

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.protocol.records import Event

MS = 1_000_000
S = 1_000 * MS
TTL_NS = 2 * S
PLACEMENT = PlacementMap(1, (ShardEntry("s0", ()), ShardEntry("far", ())), ())
ASPECTS = (
    AspectEntry("count", "int", "durable"),
    AspectEntry("note", "int", "os"),
    AspectEntry("frame", "int", "volatile"),
)
WALL_NS = 1_800_000_000 * S


def slot(entity: str = "piece", aspect: str = "count", context: str = "online") -> Slot:
    """Return a slot of the test cell."""
    return Slot(context, entity, aspect)


def item(access: Access, entity: str = "piece", aspect: str = "count", *, known: int = 0) -> Item:
    """Return one line of a lock."""
    return Item(access, "online", entity, aspect, known)


def datum(text: str = "1") -> Datum:
    """Return a small datum."""
    return Datum(b"t", text.encode(), len(text))


def lock_id(session: str = "ann", lane: int = 0, seq: int = 1) -> LockId:
    """Return the identity of a lock."""
    return LockId(session, lane, seq)


def pages_of(bench: ShardBench, request: Request) -> list[Answer]:
    """Return all pages of a listing."""
    listed = [bench.ask(request)]
    while listed[-1].more != START:
        listed.append(bench.ask(replace(request, after=listed[-1].more)))
    return listed


class ShardBench:
    """One shard with its disk."""

    def __init__(
        self,
        *,
        recovered: Recovered | None = None,
        name: str = "s0",
        placement: PlacementMap = PLACEMENT,
        register: bool = True,
    ) -> None:
        self.settings = ShardSettings(name, placement, worlds=("online", "training"))
        self.now_ns, self.wall_ns = 1_000 * S, WALL_NS
        self.disk_is_done = True
        self.log: list[Record] = []
        self.pending: list[Persist] = []
        self.notices: list[object] = []
        self.stories: list[LogEvent] = []
        self.calls: list[tuple[str, object]] = []
        self.calls_about_places: list[tuple[str, object]] = []
        self.answers: dict[int, Answer] = {}
        self._handles = count(1)
        self._counts: dict[str, count[int]] = {}
        self.identity = ""
        self._boot(recovered or Recovered(1))
        if register and recovered is None:
            self.register(*ASPECTS)

    def _boot(self, recovered: Recovered) -> None:
        self.shard = Shard(self.settings, recovered, now_ns=self.now_ns, wall_ns=self.wall_ns)

    def register(self, *aspects: AspectEntry) -> Answer | None:
        """Register aspects by a session that leaves nothing behind."""
        self.ask(Hello("admin", 0, TTL_NS, "admin", "host", 1, observer=True))
        answer = self.ask(Register("admin", (), aspects))
        self.ask(Goodbye("admin"))
        return answer

    # ---------------------------------------------------------------- messages

    def send(self, message: Request) -> int:
        """Send a request; return the handle under which its answer will be in `answers`."""
        handle = next(self._handles)
        self._give(message, handle)
        return handle

    def ask(self, message: Request) -> Answer | None:
        """Send a request and return its answer, if there is one yet."""
        return self.answers.get(self.send(message))

    def ask_as(self, identity: str, message: Request) -> Answer | None:
        """Ask under an identity, as a transport does; everything else is the process's own word."""
        self.identity = identity
        try:
            return self.ask(message)
        finally:
            self.identity = ""

    def event(self, event: Event) -> None:
        """Tell the shard of an event of its host."""
        self._give(event, 0)

    def _give(self, message: Request | Event, handle: int) -> None:
        effects = self.shard.handle(
            message,
            reply_to=handle,
            identity=self.identity if handle else "",
            now_ns=self.now_ns,
            wall_ns=self.wall_ns,
        )
        self.shard.assert_invariants()
        for effect in effects:
            if isinstance(effect, Reply):
                assert effect.reply_to not in self.answers, "answered twice"
                self.answers[effect.reply_to] = effect.answer
            elif isinstance(effect, Persist):
                self.pending.append(effect)
            elif isinstance(effect, Call):
                about_places = isinstance(effect.request, ListPlaces)
                calls = self.calls_about_places if about_places else self.calls
                calls.append((effect.shard, effect.request))
            elif isinstance(effect, Publish):
                self.notices.append(effect.notice)
            elif isinstance(effect, LogEvent):
                self.stories.append(effect)
        if self.disk_is_done:
            self.finish_disk()

    def finish_disk(self) -> None:
        """Let the disk keep and report everything it was asked for."""
        while self.pending:
            persist = self.pending.pop(0)
            self.log += persist.records
            if persist.ticket:
                self._give(Persisted(persist.ticket), 0)

    # ---------------------------------------------------------------- time

    def wait(self, ns: int, *, keep: Iterable[str] = ()) -> None:
        """Let time pass in steps that no shard would call a stall; `keep` stay alive."""
        end_ns = self.now_ns + ns
        while self.now_ns < end_ns:
            step_ns = min(100 * MS, end_ns - self.now_ns)
            self.now_ns += step_ns
            self.wall_ns += step_ns
            for session in keep:
                self.keep_alive(session)
            self.event(Tick())

    def restart(self, *, lose_pending: bool = True, epoch: int = 0) -> None:
        """Die and start again with what the disk has kept."""
        if not lose_pending:
            for persist in self.pending:
                self.log += persist.records
        self.pending.clear()
        self.answers.clear()
        self._boot(self.recovered(epoch or self.shard.epoch + 1))

    def recovered(self, epoch: int) -> Recovered:
        """Return what a store would give back."""
        return Ledger(self.log).recovered(epoch)

    # ---------------------------------------------------------------- common requests

    def next_count(self, session: str) -> int:
        """Return the next message counter of a session."""
        return next(self._counts.setdefault(session, count(1)))

    def hello(self, *sessions: str, known_epoch: int = 0, ttl_ns: int = TTL_NS) -> None:
        """Open sessions."""
        for session in sessions:
            self.ask(Hello(session, known_epoch, ttl_ns, session, "host", 1, False))

    def keep_alive(
        self, session: str, *, epoch: int | None = None, view: dict[int, int] | None = None
    ) -> Answer | None:
        """Renew a session; `view` is the lowest seq per lane that it still wants."""
        lanes = tuple(LaneView(lane, seq) for lane, seq in (view or {}).items())
        epoch = self.shard.epoch if epoch is None else epoch
        return self.ask(KeepAlive(session, epoch, self.next_count(session), lanes, b""))

    def acquire_request(
        self,
        lock: LockId,
        *items: Item,
        wait_ns: int = 900 * MS,
        hold_ns: int = 60 * S,
        epoch: int | None = None,
        alone: bool = True,
    ) -> Acquire:
        """Return the request for a lock that lies on this shard alone, or not."""
        epoch = self.shard.epoch if epoch is None else epoch
        counter = self.next_count(lock.session)
        return Acquire(lock, epoch, 1, counter, items, wait_ns, hold_ns, 0, alone=alone)

    def acquire(self, lock: LockId, *items: Item, **options: int) -> Answer | None:
        """Ask for a lock; None while the request is parked."""
        return self.ask(self.acquire_request(lock, *items, **options))

    def granted(self, lock: LockId, *items: Item, **options: int) -> Granted:
        """Get a lock that nobody stands in the way of."""
        answer = self.acquire(lock, *items, **options)
        assert isinstance(answer, Granted), answer
        return answer

    def commit(
        self,
        lock: LockId,
        token: Token,
        *writes: tuple[Slot, str | None],
        expects: dict[Slot, int] | None = None,
    ) -> Answer | None:
        """Commit values under a lock."""
        items = tuple(WriteItem(s, None if text is None else datum(text)) for s, text in writes)
        versions = tuple(SlotVersion(*pair) for pair in (expects or {}).items())
        return self.ask(Commit(lock, token, items, 0, versions))

    def write(self, session: str, seq: int, value: str, *, to: Slot | None = None) -> Answer | None:
        """Set a slot under a lock of its own."""
        to = to or slot()
        lock = lock_id(session, 9, seq)
        grant = self.granted(lock, Item(Access.WRITE, *to))
        return self.commit(lock, grant.token, (to, value))

    def value(self, of: Slot | None = None) -> str | None:
        """Return the committed value of a slot."""
        found = self.shard.state.slots[of or slot()].datum
        return None if found is None else bytes(found.body).decode()

    def counter(self, name: str) -> int:
        """Return one of the shard's statistics."""
        return self.shard.counters.get(name, 0)
