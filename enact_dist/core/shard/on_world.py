"""World contexts that are forked and dropped, each in one step of its shard.

::

    Fork ──> waits for undecided commits of the source ──> its slots as of then ──┐
    DropWorld ──> no lock is left in it ────> out of the catalogue ───────────────┤
                       slots made or gone, watchers told, answered <── Persist ───┘

Rules a change must keep
  * A fork copies no data: its slots share the data of the source's versions, in memory and, by
    `same_as`, on the disk.  The work is per slot, whatever the size of the data.
  * All slots of a fork bear the stamp that it was forked as of, on every shard: so a view shows all
    of the fork or nothing of it, although each shard makes its part by itself.
  * While the store works on it the name is not usable: a new context is usable once it is
    stored, and no request begins in one that is being dropped.
  * A dropped context never uses a version again: the null that its watchers get counts as
    the last version of each slot, and later slots of that name start above all of them.
  * Each fork or drop that a session asks for is done once.  A late copy does nothing, even if the
    context has been dropped or made since.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import unknown_world, wrong_name
from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.core.protocol.messages import (
    CLOCK_SKEW,
    FAR,
    HELD,
    OVERLOAD,
    PROTOCOL,
    VALUE,
    Cause,
    DatumRead,
    Dropped,
    DropWorld,
    Forgotten,
    Fork,
    Forked,
    Refused,
    SlotChange,
    SlotVersion,
    WorldEntry,
)
from enact_dist.core.protocol.parts import CAUSE_FORK
from enact_dist.core.protocol.records import (
    NOTHING,
    Content,
    KeptRecord,
    LogEvent,
    Record,
    Reply,
    SlotRecord,
    WorldDropped,
    WorldRecord,
)
from enact_dist.core.state.clock import AHEAD_NS_MAX
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from enact_dist.core.protocol.messages import Answer
    from enact_dist.core.protocol.records import Effect
    from enact_dist.core.shard.on_prepare import PrepareHandler
    from enact_dist.core.shard.state import ShardState

FORK_WAIT_NS: Final = 400_000_000
"""How long a fork waits for undecided commits; then it is refused, and may be asked again."""
WAITING_MAX: Final = 64
"""Forks that wait at one shard; further ones are refused, and may be asked again."""
CHANGES_MAX: Final = 512
"""Changes in one notice about a context that was made or has gone."""


@dataclass(slots=True)
class _Act:
    """A fork or a drop that is not answered yet.

    Attributes:
        asked: By whom: each request for it, and where its answer goes.
        wait_end_ns: When a fork has waited enough.
        made: The slots of a fork that the store works on.
    """

    message: Fork | DropWorld
    asked: list[tuple[Fork | DropWorld, int]]
    wait_end_ns: int = 0
    made: tuple[tuple[Slot, Content], ...] = ()


class WorldHandler:
    """Everything about world contexts that are made of others, and about their end.

    Attributes:
        waits: The forks that wait for undecided commits.
    """

    def __init__(self, state: ShardState, prepares: PrepareHandler) -> None:
        self._state = state
        self._prepares = prepares
        self._waiting: dict[str, _Act] = {}
        self.waits: Collection[str] = self._waiting
        self._at_store: dict[str, _Act] = {}

    # ---------------------------------------------------------------- fork

    def on_fork(self, message: Fork, reply_to: int) -> Iterator[Effect]:
        """Make a context with the data of another one as of a stamp, or say why not."""
        answer = self._state.answered_before(message)
        under_way = self._under_way(message.world)
        if answer is None and under_way is not None and _same(under_way.message, message):
            under_way.asked.append((message, reply_to))
            return
        act = _Act(message, [(message, reply_to)], self._state.now_ns + FORK_WAIT_NS)
        answer = answer or self._fork_refused(message)
        if answer is not None:
            yield from self._told(act, answer)
            return
        if len(self._waiting) >= WAITING_MAX:
            text = f"{WAITING_MAX} forks wait for commits to be decided; ask again"
            yield from self._told(act, Refused(OVERLOAD, text))
            return
        self._state.stamp(message.at_ns)
        self._state.busy_worlds[message.world] = f"being forked from {message.source!r}"
        self._waiting[message.world] = act
        if self._undecided(message):
            self._state.count("forks_waited")
        else:
            yield from self._make(act)

    def _fork_refused(self, message: Fork) -> Answer | None:
        """Return the answer to a fork that must not be made; None if it may be made."""
        state, world = self._state, message.world
        wrong = wrong_name("world context", world, slashes=False) or state.busy_world(world)
        if wrong is not None:
            return wrong
        there = state.catalogue.worlds.get(world)
        if there == WorldEntry(world, message.source, message.at_ns):
            return self._forked(world)
        if there is not None:
            return Refused(
                VALUE,
                f"world context {world!r} was to be forked from {message.source!r} as of stamp"
                f" {message.at_ns}, and {_told_of(there)}; take another name, or drop it first",
            )
        if message.source not in state.catalogue.worlds:
            return unknown_world(message.source, state.catalogue.worlds)
        if message.at_ns <= 0:
            text = f"{message.source!r} was to be forked as of stamp {message.at_ns}, which is none"
            return Refused(PROTOCOL, text)
        full = state.catalogue.room_for_world(WorldEntry(*_fork_of(message)))
        if full is not None:
            return full
        if state.stamps.too_far_ahead(message.at_ns, wall_ns=state.wall_ns):
            ahead_s = (message.at_ns - state.wall_ns) / 1e9
            return Refused(
                CLOCK_SKEW,
                f"{message.source!r} was to be forked as of a stamp {ahead_s:.1f} s ahead of the"
                f" clock of shard {state.settings.name}, where at most {AHEAD_NS_MAX / 1e9:g} s are"
                " accepted; name a time that has passed, or set the clocks of both hosts",
                (str(ahead_s),),
            )
        return None

    def _undecided(self, message: Fork) -> bool:
        """Whether a commit on the source is undecided that may get a stamp up to the asked one."""
        return any(
            stamp_ns <= message.at_ns and any(w.slot.context == message.source for w in writes)
            for stamp_ns, writes in self._prepares.undecided()
        )

    def answer_waiting(self, *, decided: bool) -> Iterator[Effect]:
        """Make the forks that nothing undecided stands before now; refuse the others in time.

        Nothing was decided since the last time unless `decided`.
        """
        due_ns = self.next_deadline_ns()
        if not decided and not self._state.draining and (due_ns or 0) > self._state.now_ns:
            return
        for act in list(self._waiting.values()):
            message = act.message
            assert isinstance(message, Fork)
            if not self._undecided(message):
                yield from self._make(act)
            elif act.wait_end_ns <= self._state.now_ns or self._state.draining:
                self._end(act)
                text = f"commits on {message.source!r} up to stamp {message.at_ns} are undecided"
                yield from self._told(act, Refused(OVERLOAD, f"{text}; ask again"))

    def _make(self, act: _Act) -> Iterator[Effect]:
        """Hand a fork to the store."""
        message, slots = act.message, self._state.slots
        assert isinstance(message, Fork)
        del self._waiting[message.world]
        made: list[tuple[Slot, Content]] = []
        records: list[Record] = [WorldRecord(message.world, message.source, message.at_ns)]
        latest = slots.forgotten_aspect(message.source)
        unknown = latest.oldest_ns > message.at_ns  # no slot is left that would tell
        fork = _Making(self._state, message)
        for source, newest in slots.of_context(message.source):
            is_newest = newest.version > 0 and newest.stamp_ns <= message.at_ns
            content = newest if is_newest else slots.as_of(source, message.at_ns)
            since_ns = slots.known_since_ns(source, newest)
            if since_ns > latest.oldest_ns:
                latest = Forgotten(source, since_ns)  # from this timestamp on all are known
            if isinstance(content, int):
                unknown = True
            elif content is not NOTHING:
                slot, shared = fork.shared(source, content)
                made.append((slot, shared))
                records.append(fork.record(slot, shared, source, content))
        if unknown:
            self._end(act)
            yield from self._told(act, latest)
            return
        act.made = tuple(made)
        yield from self._persist(act, tuple(records))

    def _forked(self, world: str) -> Forked:
        slots = sum(1 for _ in self._state.slots.of_context(world))
        return Forked(world, slots, self._state.stamp())

    # ---------------------------------------------------------------- drop

    def on_drop(self, message: DropWorld, reply_to: int) -> Iterator[Effect]:
        """Forget a context with all that is in it, or say why not."""
        answer = self._state.answered_before(message)
        under_way = self._under_way(message.world)
        if answer is None and under_way is not None and _same(under_way.message, message):
            under_way.asked.append((message, reply_to))
            return
        act = _Act(message, [(message, reply_to)])
        answer = answer or self._drop_refused(message.world)
        if answer is not None:
            yield from self._told(act, answer)
            return
        state, world = self._state, message.world
        state.catalogue.drop_world(world)
        state.busy_worlds[world] = "being dropped"
        if state.asker:
            yield LogEvent("world.dropped", f"{state.asker} drops world context {world!r}")
        dropped = WorldDropped(world, state.slots.version_base(world))
        yield from self._persist(act, (dropped, *self._labels_without(world)))

    def _labels_without(self, world: str) -> Iterator[KeptRecord]:
        """Yield what the labels that keep versions of a context keep of others."""
        history = self._state.slots.history
        for label, versions in history.labels.items():
            left = [version for version in versions if version.slot.context != world]
            if len(left) < len(versions):
                yield KeptRecord(label, tuple(v for v in left if history.is_stored(v.slot)))

    def _drop_refused(self, world: str) -> Answer | None:
        """Return what a drop is answered where nothing is to be done, None where it is."""
        state = self._state
        asked = f"world context {world!r} was to be dropped"
        forks = [act.message for act in (*self._waiting.values(), *self._at_store.values())]
        fork = next((one for one in forks if isinstance(one, Fork) and one.source == world), None)
        if fork is not None:
            return Refused(OVERLOAD, f"{asked}, and is being forked to {fork.world!r}; ask again")
        if state.busy_world(world) is not None:
            return state.busy_world(world)
        if world not in state.catalogue.worlds:
            return Dropped(world, 0)
        if world in state.settings.worlds:
            return Refused(VALUE, f"{asked}, and stands in cell.toml; take it out there first")
        for tenure in list(state.tenures.kept.by_number.values()):
            if any(item.context == world for item in tenure.items):
                state.tenures.kept.recall(tenure, now_ns=state.now_ns)
                if tenure.kept == FAR:
                    told = state.tenures.told(tenure, state.now_ns)
                    return Refused(OVERLOAD, f"{asked}; {told} is recalled; ask again")
        for tenure in state.tenures.by_lock.values():
            item = next((item for item in tenure.items if item.context == world), None)
            if item is not None:
                holder = state.tenures.describe(tenure, state.now_ns)
                verb = "holds" if holder.granted else "waits for"
                return Refused(
                    HELD,
                    f"{asked}; lock {holder.number} of {holder.actor or 'client'}@{holder.host}"
                    f" pid {holder.pid} {verb} {item.entity}/{item.aspect} in it for"
                    f" {holder.age_ns / 1e9:.1f} s; wait for its end, or break it",
                )
        return None

    # ---------------------------------------------------------------- both

    def _persist(self, act: _Act, records: tuple[Record, ...]) -> list[Effect]:
        self._at_store[act.message.world] = act
        return self._state.persist(records, Durability.DURABLE, partial(self._persisted, act))

    def _persisted(self, act: _Act, _: int) -> Iterator[Effect]:
        """A fork or a drop survives: carry it out, tell who watches, answer."""
        message, state = act.message, self._state
        del self._at_store[message.world]
        self._end(act)
        if isinstance(message, Fork):
            state.catalogue.add_world(WorldEntry(*_fork_of(message)))
            for slot, content in act.made:
                state.slots.set(slot, content)
            state.count("worlds_forked")
            answer: Answer = self._forked(message.world)
            changes = [_change(slot, content) for slot, content in act.made]
        else:
            gone = state.slots.drop(message.world)
            stamp_ns = state.stamps.next(seen_ns=0, wall_ns=state.wall_ns)
            state.count("worlds_dropped")
            answer = Dropped(message.world, len(gone))
            changes = [
                SlotChange(slot, content.version + 1, stamp_ns, True)
                for slot, content in gone
                if content.datum is not None
            ]
        yield from self._told(act, answer)
        for first in range(0, len(changes), CHANGES_MAX):
            yield from state.commits.publish(changes[first : first + CHANGES_MAX])

    def _under_way(self, world: str) -> _Act | None:
        return self._waiting.get(world) or self._at_store.get(world)

    def _end(self, act: _Act) -> None:
        self._waiting.pop(act.message.world, None)
        del self._state.busy_worlds[act.message.world]

    def _told(self, act: _Act, answer: Answer) -> Iterator[Effect]:
        """Answer all requests for it, and repeated ones."""
        for message, reply_to in act.asked:
            self._state.remember_answer(message, answer)
            yield Reply(reply_to, answer)

    def next_deadline_ns(self) -> int | None:
        """Return when a fork has waited enough."""
        return min((act.wait_end_ns for act in self._waiting.values()), default=None)

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        acts = (*self._waiting.values(), *self._at_store.values())
        assert sorted(act.message.world for act in acts) == sorted(self._state.busy_worlds)
        assert not self._state.busy_worlds.keys() & self._state.catalogue.worlds.keys()


class _Making:
    """The slots of one fork, each sharing what it has with a version of its source."""

    def __init__(self, state: ShardState, message: Fork) -> None:
        session = state.sessions.by_id.get(message.session)
        who = (session.actor, session.host, session.pid) if session is not None else ("", "", 0)
        self._by = (LockId(message.session, 0, 0), CAUSE_FORK, *who, message.at_ns, 0)
        self._state, self._world, self._at_ns = state, message.world, message.at_ns
        self._version = state.slots.version_base(message.world) + 1

    def shared(self, source: Slot, content: Content) -> tuple[Slot, Content]:
        """Return a slot of the fork and what it has."""
        slot = Slot(self._world, source.entity, source.aspect)
        version = max(self._version, self._state.slots.next_version(slot))
        read = DatumRead(source, content.version, content.stamp_ns)
        cause = Cause(*self._by, (read,), 0, (SlotVersion(slot, version),))
        return slot, Content(version, self._at_ns, content.datum, content.null_reason, cause)

    def record(self, slot: Slot, shared: Content, source: Slot, content: Content) -> SlotRecord:
        """Return what the store is to keep of it; bytes that are there already are named."""
        state, datum, version = self._state, shared.datum, shared.version
        reason = "" if datum is not None else shared.null_reason.name
        if state.catalogue.durability(slot.aspect) is Durability.VOLATILE:
            return SlotRecord(slot, version, self._at_ns, None, reason, volatile=True)
        stored = datum is not None and state.slots.is_stored(source, content.version)
        same_as = SlotVersion(source, content.version) if stored else None
        return SlotRecord(
            slot, version, self._at_ns, datum, reason, cause=shared.cause, same_as=same_as
        )


def _fork_of(message: Fork) -> tuple[str, str, int]:
    return message.world, message.source, message.at_ns


def _same(one: Fork | DropWorld, other: Fork | DropWorld) -> bool:
    """Whether two requests ask for the same, from any sender."""
    if isinstance(one, Fork) and isinstance(other, Fork):
        return _fork_of(one) == _fork_of(other)
    return isinstance(one, DropWorld) and isinstance(other, DropWorld)


def _told_of(world: WorldEntry) -> str:
    if world.source:
        return f"it is there as a fork of {world.source!r} as of stamp {world.at_ns}"
    return "it is there and no fork"


def _change(slot: Slot, content: Content) -> SlotChange:
    datum = content.datum
    captured_ns = datum.stamp_ns if datum is not None else 0
    return SlotChange(slot, content.version, content.stamp_ns, datum is None, captured_ns)
