"""Locks at the shard's door: acquire, fetch, release."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import unknown_world, wrong_access
from enact_dist.core.protocol.datum import Column, Datum, LockId, Slot
from enact_dist.core.protocol.messages import (
    DAMAGED,
    ITEMS_MAX,
    NEWER_TYPE,
    OVERLOAD,
    UNKNOWN_ASPECT,
    VALUE,
    Acquire,
    Answer,
    EpochChanged,
    Fetch,
    Gone,
    Item,
    Refused,
    Release,
    Released,
    Slice,
    Stale,
    WrongShard,
)
from enact_dist.core.protocol.records import Effect, Reply
from enact_dist.core.shard import owners
from enact_dist.core.state.sessions import LANES_MAX, Lane, SessionState
from enact_dist.core.state.tenure import Shape, Tenure, shape_of
from enact_dist.terms import ACCESSES

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from enact_dist.core.shard.on_prepare import PrepareHandler
    from enact_dist.core.shard.state import ShardState

LOCKS_MAX: Final = 100_000
"""Locks, granted or waiting, at one shard."""
LOOKED_MAX: Final = 1_000_000
"""Slots that the patterns of one lock or view may have to look at, if there are several."""


class LockHandler:
    """Everything about who gets which lock, and the data that come with it."""

    def __init__(self, state: ShardState, prepares: PrepareHandler) -> None:
        self._state = state
        self._prepares = prepares

    def on_acquire(self, message: Acquire, reply_to: int) -> Iterable[Effect]:
        """Queue a lock, or continue with one that is already queued or granted."""
        state, lock, items = self._state, message.lock, message.items
        tenures = state.tenures
        session = state.sessions.by_id.get(lock.session)
        if message.epoch != state.epoch or session is None or not session.present:
            return [Reply(reply_to, state.epoch_changed(message.epoch))]
        shape = tenures.shapes.get(items)
        refusal = self.refused(message.map_version, items, shape)
        if refusal is not None:
            return [Reply(reply_to, refusal)]
        if session.observer:
            text = "this session only observes and cannot lock; connect without observer=True"
            return [Reply(reply_to, Refused(VALUE, text))]
        session.renew(state.now_ns, message.count)
        tenure = tenures.by_lock.get(lock)
        if tenure is None:
            return self._admit(message, shape, session, reply_to)
        effects: list[Effect] = []
        self._grant_or_park(tenure, message, reply_to, effects)
        return effects

    def _admit(
        self, message: Acquire, shape: Shape | None, session: SessionState, reply_to: int
    ) -> Iterable[Effect]:
        """Give a new lock its place in the queue, unless it is kept out or waits for news."""
        state, tenures, lock = self._state, self._state.tenures, message.lock
        refused = self._kept_out(message, session, reply_to)
        if refused is not None:
            return refused
        effects: list[Effect] = []
        if lock.session in tenures.by_session or state.pins.by_session:
            effects += self._supersede(lock)
        if message.seen and not self._has_news(message):
            effects += self._park_standing(message, reply_to, session)
            return effects
        session.lanes[lock.lane].top = lock.seq
        if shape is None:
            shape = tenures.shapes.get(message.items) or shape_of(message.items)
        tenure = tenures.enqueue(message, shape, session, now_ns=state.now_ns, at_once=state.grants)
        if tenure.token is None and tenures.kept.by_number:
            tenures.recall_for(tenure, now_ns=state.now_ns)
        if tenures.table.ready:
            effects += state.grant_ready()
        self._grant_or_park(tenure, message, reply_to, effects)
        return effects

    def _grant_or_park(
        self, tenure: Tenure, message: Acquire, reply_to: int, effects: list[Effect]
    ) -> None:
        """Answer a request with the grant, or keep it until there is one."""
        state, tenures = self._state, self._state.tenures
        if tenure.token is not None:
            stamp_ns = state.stamps.now(wall_ns=state.wall_ns, seen_ns=message.seen_stamp_ns)
            granted = tenures.granted(tenure, now_ns=state.now_ns, stamp_ns=stamp_ns)
            effects += (Reply(reply_to, granted),)
        else:
            state.count("lock_waits")
            effects += tenures.park(
                tenure, reply_to=reply_to, wait_ns=message.wait_ns, now_ns=state.now_ns
            )

    # ---------------------------------------------------------------- locks that wait for news

    def _park_standing(
        self, message: Acquire, reply_to: int, session: SessionState
    ) -> Iterable[Effect]:
        """Keep a request until there is news, unless it cannot or its identity has too many."""
        state, standing = self._state, self._state.standing
        locked = {(item.context, item.entity, item.aspect) for item in message.items}
        strange = [seen.slot for seen in message.seen if tuple(seen.slot) not in locked]
        if strange:
            text = f"{strange[0]} was seen and is not requested; a lock waits for news of its data"
            return [Reply(reply_to, Refused(VALUE, text))]
        identity = session.identity
        if identity and standing.count_of(identity) >= owners.WAITERS_MAX:
            bound = f"{owners.WAITERS_MAX} locks that wait for news"
            return state.quotas.refuse(reply_to, identity, bound)
        return standing.park(message, reply_to=reply_to, now_ns=state.now_ns, owner=identity)

    def _has_news(self, message: Acquire) -> bool:
        """Whether a slot shows a datum that is not the one which the client has seen."""
        slots = self._state.slots
        for slot, version, stamp_ns in message.seen:
            newest = slots[slot]
            known = (newest.version, newest.stamp_ns) == (version, stamp_ns)
            if newest.datum is not None and not known:
                return True
        return False

    def begin_standing(self, changed: Iterable[Slot]) -> list[Effect]:
        """Let the locks that wait for news of these slots enter the queue."""
        state, effects = self._state, list[Effect]()
        for waiting in state.standing.take(changed):
            reply_to, left_ns = waiting.reply_to, max(0, waiting.until_ns - state.now_ns)
            message = replace(waiting.message, wait_ns=left_ns)
            session = state.sessions.by_id.get(message.lock.session)
            if session is None or not session.present:
                effects += (Reply(reply_to, state.epoch_changed(message.epoch)),)
            elif not self._has_news(message):
                effects += self._park_standing(message, reply_to, session)
            else:
                shape = state.tenures.shapes.get(message.items)
                refusal = self.refused(message.map_version, message.items, shape)
                if refusal is not None:
                    effects += (Reply(reply_to, refusal),)
                    continue
                effects += self._admit(message, shape, session, reply_to)
                if message.lock in state.tenures.by_lock:
                    state.count("standing_locks_begun")
        return effects

    def _kept_out(
        self, message: Acquire, session: SessionState, reply_to: int
    ) -> Iterable[Effect] | None:
        """Return why a new lock gets no place in the queue, None if it gets one in its lane."""
        state, lock = self._state, message.lock
        if message.successions != state.catalogue.successions:  # not the usual case
            missed = self._missed_type(message)
            if missed is not None:
                state.count("newer_types_missed")
                return [Reply(reply_to, missed)]
        lanes, tenures = session.lanes, state.tenures
        if state.standing.by_lane and state.standing.newer(lock):
            state.count("stale")
            return [Reply(reply_to, Stale(lock, state.epoch))]
        if lock.lane not in lanes:
            if len(lanes) >= LANES_MAX:
                return [Reply(reply_to, Refused(OVERLOAD, f"{LANES_MAX} lanes in one session"))]
        elif lock.seq <= lanes[lock.lane].top:
            state.count("stale")
            return [Reply(reply_to, Stale(lock, state.epoch))]
        if len(tenures.by_lock) >= owners.WAITERS_MAX and self._has_its_share(session):
            bound = f"{owners.WAITERS_MAX} locks held or awaited"
            return state.quotas.refuse(reply_to, session.identity, bound)
        if session.identity and tenures.waiting_of.get(session.identity, 0) >= (
            owners.ITEMS_WAITING_MAX
        ):
            bound = f"{owners.ITEMS_WAITING_MAX} requests in locks that wait"
            return state.quotas.refuse(reply_to, session.identity, bound)
        if lock.lane not in lanes:
            lanes[lock.lane] = Lane()
        return None

    def _missed_type(self, message: Acquire) -> Refused | None:
        """Refuse to let a client write an aspect whose type it has perhaps not compared yet."""
        catalogue = self._state.catalogue
        for item in message.items:
            if ACCESSES[item.access].writes:
                entry = catalogue.newer_type(item.aspect, message.successions)
                if entry is not None:
                    text = f"aspect {item.aspect!r} has the datum type {entry.fingerprint} now"
                    return Refused(NEWER_TYPE, text)
        return None

    def _has_its_share(self, session: SessionState) -> bool:
        """Whether the identity of a session has as many locks as one may have."""
        if not session.identity:
            return False
        tenures = self._state.tenures
        mine = self._state.sessions.of(session.identity)
        return sum(len(tenures.by_session.get(one, ())) for one in mine) >= owners.WAITERS_MAX

    def _supersede(self, lock: LockId) -> Iterator[Effect]:
        """A newer lock of a lane ends the older ones: their release was lost."""
        for tenure in self._state.tenures.of_session(lock.session):
            older = tenure.lock.lane == lock.lane and tenure.lock.seq < lock.seq
            if older and not tenure.bound and not tenure.kept:
                self._state.count("superseded")
                yield from self._state.tenures.take_away(
                    tenure, "a newer lock of its thread", now_ns=self._state.now_ns
                )
        self._state.pins.drop_older(lock.session, {lock.lane: lock.seq})

    def refused(
        self, map_version: int, items: tuple[Item, ...], shape: Shape | None
    ) -> Answer | None:
        """Return why this shard cannot grant these items, None if it can."""
        state = self._state
        if map_version != state.settings.placement.version:
            state.count("wrong_shard")
            return WrongShard(state.settings.placement)
        if len(state.tenures.by_lock) >= LOCKS_MAX:
            return Refused(OVERLOAD, f"{LOCKS_MAX} locks are held or awaited here")
        if shape is None or shape.patterns > 1:
            if len(items) > ITEMS_MAX:
                return Refused(VALUE, f"{len(items)} requests in one lock; at most {ITEMS_MAX}")
            wrong = wrong_access(items) or self._too_much_to_look_at(items)
            if wrong is not None:
                return wrong
            state.tenures.remember(items)
        worlds, aspects = state.catalogue.worlds, state.catalogue.aspects
        for item in items:
            if item.context not in worlds:
                return unknown_world(item.context, worlds)
            if item.aspect not in aspects and ACCESSES[item.access].writes:
                # Reading an unregistered aspect is no fault: its slots are null.
                return Refused(UNKNOWN_ASPECT, f"aspect {item.aspect!r} is not registered here")
        return None

    def _too_much_to_look_at(self, items: tuple[Item, ...]) -> Refused | None:
        """Refuse many patterns over many slots: everybody else waits while they are matched."""
        column = self._state.slots.of_column
        columns = [Column(i.context, i.aspect) for i in items if ACCESSES[i.access].each]
        looked = sum([len(column(one)) for one in columns]) if len(columns) > 1 else 0
        if looked <= LOOKED_MAX:
            return None
        return Refused(
            VALUE,
            f"{len(columns)} patterns in one lock would look at {looked} slots; at most"
            f" {LOOKED_MAX}; ask for the entities by name, or with fewer patterns",
        )

    def on_fetch(self, message: Fetch, reply_to: int) -> Iterator[Effect]:
        """Hand out a part of a large datum that a lock pins, or that is current."""
        if self._state.session_in_epoch(message.lock.session, message.epoch) is None:
            yield Reply(reply_to, EpochChanged(self._state.epoch))
            return
        datum, refusal = self._pinned(message), None
        if datum is None:
            guard = self._state.guard
            refusal = guard.may_not_read(message.slot) if guard is not None else None
            content = self._state.slots[message.slot]
            datum = content.datum if content.version == message.version else None
        if refusal is not None:
            yield Reply(reply_to, refusal)
            return
        if datum is None:
            self._state.count("fetches_gone")
            yield Reply(reply_to, Gone(message.slot, message.version))
            return
        fault = datum.fault() if datum.fault is not None else ""
        if fault:
            self._state.count("fetches_damaged")
            yield Reply(reply_to, _damaged(message, fault))
            return
        length = min(message.length, self._state.settings.fetch_bytes_max)
        body = memoryview(datum.body)[message.offset : message.offset + length]
        part = Datum(b"", body, len(body))
        self._state.count("bytes_fetched", len(body))
        yield Reply(
            reply_to,
            Slice(
                message.slot,
                message.version,
                datum.encoding,
                datum.stamp_ns,
                datum.size,
                message.offset,
                part,
            ),
        )

    def _pinned(self, message: Fetch) -> Datum | None:
        tenure = self._state.tenures.by_lock.get(message.lock)
        key = (message.slot, message.version)
        for pins in (tenure.pins if tenure else {}, self._state.pins.get(message.lock)):
            if key in pins:
                return pins[key]
        return None

    def on_release(self, message: Release, reply_to: int) -> Iterable[Effect]:
        """Give up a lock, its place and its pins; always answered."""
        state, lock = self._state, message.lock
        tenure = state.tenures.by_lock.get(lock)
        effects: list[Effect] = []
        if tenure is not None and not tenure.bound:
            effects += state.tenures.remove(tenure, now_ns=state.now_ns)
        elif tenure is not None:
            self._prepares.hint(lock)
        elif state.tenures.kept.has(lock.session):
            session = state.sessions.by_id[lock.session]
            if lock.lane in session.lanes or len(session.lanes) < LANES_MAX:
                lane = session.lane(lock.lane)
                lane.top = max(lane.top, lock.seq)  # a late copy of its commit is fenced
        if lock.session in state.pins.by_session:
            state.pins.drop(lock)
        if state.standing.by_lane and state.standing.has(lock):
            effects += state.standing.drop(lock)
            lane = state.sessions.by_id[lock.session].lane(lock.lane)
            lane.top = max(lane.top, lock.seq)  # a late copy of its request is stale
        effects += (Reply(reply_to, Released()),)
        return effects


def _damaged(message: Fetch, fault: str) -> Refused:
    return Refused(
        DAMAGED,
        f"version {message.version} of {message.slot} was asked and cannot be read: {fault};"
        " restore the folder of its shard from a backup, or do without this version",
    )
