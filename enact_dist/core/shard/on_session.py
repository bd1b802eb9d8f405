"""Sessions at the shard's door: hello, catalogue, keep-alive, goodbye, expiry."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.checks import wrong_aspect, wrong_name
from enact_dist.core.protocol.messages import (
    DATUM_TYPE,
    FAR,
    OVERLOAD,
    REPORT_BYTES_MAX,
    Alive,
    Answer,
    EpochChanged,
    Goodbye,
    GrantLeft,
    Hello,
    KeepAlive,
    Refused,
    Register,
    Registered,
    Released,
    Welcome,
    WorldEntry,
)
from enact_dist.core.protocol.records import (
    AspectRecord,
    Effect,
    LogEvent,
    Persist,
    Record,
    Reply,
    SessionBarred,
    SessionDied,
    SessionEnded,
    SessionRecord,
    SessionSeen,
    WorldRecord,
)
from enact_dist.core.rights.rules import UNPROVEN
from enact_dist.core.shard import owners
from enact_dist.core.state.clock import DueTimes
from enact_dist.core.state.grants import WAIT_SLICE_NS_MAX
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator

    from enact_dist.core.shard.state import ShardState
    from enact_dist.core.state.sessions import SessionState

TTL_NS_MIN: Final = 100_000_000
"""Leases shorter than this would be lost to ordinary scheduling delays."""


class SessionHandler:
    """Everything about who is alive."""

    def __init__(self, state: ShardState) -> None:
        self._state = state
        self._unanswered: dict[int, list[Reply]] = {}
        self._recording: dict[str, SessionState] = {}
        self._listening: dict[str, int] = {}
        self._ends = DueTimes[str]()
        self._count = 0

    def on_hello(self, message: Hello, reply_to: int) -> Iterator[Effect]:
        """Open a session, or take its acknowledgement of this epoch."""
        known = self._state.sessions.by_id.get(message.session)
        if known is None:
            sessions, asker = self._state.sessions, self._state.asker
            if asker and len(sessions.of(asker)) >= owners.SESSIONS_MAX:
                bound = f"{owners.SESSIONS_MAX} sessions"
                yield from self._state.quotas.refuse(reply_to, asker, bound)
                return
            if sessions.full(self._state.now_ns) and not (yield from self._make_room()):
                yield Reply(reply_to, Refused(OVERLOAD, f"{len(sessions.by_id)} sessions are open"))
                return
        ttl_ns = max(TTL_NS_MIN, min(message.ttl_ns, self._state.settings.ttl_ns_max))
        session, unrecorded = self._state.sessions.hello(
            message,
            identity=self._state.asker,
            epoch=self._state.epoch,
            ttl_ns=ttl_ns,
            now_ns=self._state.now_ns,
        )
        self._state.sessions.end_grace_if_all_acknowledged(self._state.now_ns)
        shown = self._state.catalogue.shown()
        welcome = Welcome(
            self._state.settings.name,
            self._state.epoch,
            not self._state.sessions.in_grace(self._state.now_ns),
            session.ttl_ns,
            self._state.wall_ns,
            self._state.commits.notice_number,
            self._state.settings.placement,
            shown.worlds,
            shown.aspects,
            self._state.settings.shared,
            self._state.settings.shared_nonce,
            shown.forks,
        )
        if unrecorded and session.session not in self._recording:
            # A session that a restart would not know could lose its grants without the grace, so
            # it may do nothing before its record is durable.
            record = SessionRecord(session.session, session.ttl_ns, session.identity)
            self._recording[session.session] = session
            yield from self.answer_when_durable(reply_to, welcome, (record,), session=session)
        else:
            session.present = session.present or not unrecorded
            yield from self.answer_when_durable(reply_to, welcome, ())

    def _make_room(self) -> Generator[Effect, None, bool]:
        """End the oldest session without a request since its hello; False if there is none."""
        for session in self._state.sessions.unproven(self._state.now_ns):
            if session.session not in self._state.tenures.by_session:
                self._state.count("sessions_displaced")
                yield from self.end(session.session, "it made room for another session")
                return True
        return False

    def answer_when_durable(
        self,
        reply_to: int,
        answer: Answer,
        records: tuple[Record, ...],
        durability: Durability = Durability.DURABLE,
        session: SessionState | None = None,
    ) -> Iterator[Effect]:
        """Answer when `records` are kept, and all before them that the answer may tell of.

        Without records it waits for what an earlier answer waits for.  `session` is durable with
        its record.
        """
        reply = Reply(reply_to, answer)
        if records:
            self._count += 1
            self._unanswered[self._count] = [reply]
            then = partial(self._durable, self._count, session)
            yield from self._state.persist(records, durability, then)
        elif self._unanswered:
            next(reversed(self._unanswered.values())).append(reply)
        else:
            yield reply

    def _durable(self, number: int, session: SessionState | None, _: int) -> Iterable[Effect]:
        """Answer: the records are kept."""
        if session is not None and self._recording.get(session.session) is session:
            del self._recording[session.session]
            session.durable = session.present = True
        return self._unanswered.pop(number)

    def on_register(self, message: Register, reply_to: int) -> Iterator[Effect]:
        """Create world contexts and register aspects, all or none."""
        catalogue, guard = self._state.catalogue, self._state.guard
        if self._state.sessions.known(message.session) is None:
            yield Reply(reply_to, EpochChanged(self._state.epoch))
            return
        before = catalogue.entries(entry.name for entry in message.aspects)
        size = catalogue.bytes
        missing = [name for name in message.worlds if name not in catalogue.worlds]
        for name in missing:
            wrong = wrong_name("world context", name, slashes=False) or self._state.busy_world(name)
            if wrong is not None:
                yield Reply(reply_to, wrong)
                return
        records: list[Record] = [WorldRecord(name) for name in missing]
        for entry in message.aspects:
            wrong = wrong_aspect(entry)
            alters = guard is None or not entry.reads or guard.may_alter(entry.name)
            registered = catalogue.register(entry, alters=alters) if wrong is None else wrong
            if isinstance(registered, str):
                registered = Refused(DATUM_TYPE, registered)
            if isinstance(registered, Refused):
                catalogue.put_back(before)
                yield Reply(reply_to, registered)
                return
            if registered[1]:
                records.append(AspectRecord(registered[0]))
        for name in missing:
            catalogue.add_world(WorldEntry(name))
        refusal = catalogue.refusal(len(missing), before, size)
        if refusal is not None:
            for name in missing:
                catalogue.drop_world(name)
            catalogue.put_back(before)
            self._state.count("overloads")
            yield Reply(reply_to, refusal)
            return
        succeeded = [
            record.entry
            for record in records
            if isinstance(record, AspectRecord)
            and (known := before[record.entry.name]) is not None
            and record.entry.older != known.older
        ]
        for entry in succeeded:
            self._state.count("types_succeeded")
            told = f"aspect {entry.name!r} has the datum type {entry.fingerprint} from now on"
            yield LogEvent("aspect.type", f"{told}, which succeeds {entry.older[-1]}")
        answer = Registered(*catalogue.shown()[:3])
        yield from self.answer_when_durable(reply_to, answer, tuple(records))

    def on_keep_alive(self, message: KeepAlive, reply_to: int) -> Iterator[Effect]:
        """Renew a session and free what it does not want any more."""
        session = self._state.session_in_epoch(message.session, message.epoch)
        if session is None:
            yield Reply(reply_to, EpochChanged(self._state.epoch))
            return
        session.renew(self._state.now_ns, message.count)
        if len(message.report) > REPORT_BYTES_MAX:
            session.report = b""
            self._state.count("reports_too_long")
        elif message.report:
            session.report = message.report
        guard = self._state.guard
        proven = guard is None or guard.subject != UNPROVEN  # what ends locks has to be
        lowest = {view.lane: view.seq for view in message.view if proven}
        for tenure in self._state.tenures.of_session(message.session):
            unwanted = tenure.lock.seq < lowest.get(tenure.lock.lane, 0)
            if unwanted and not (tenure.bound or tenure.kept):
                self._state.count("orphans_freed")
                told = self._state.tenures.told(tenure, self._state.now_ns)
                yield LogEvent("lock.orphan", f"{told}, freed: its client no longer wants it")
                yield from self._state.tenures.remove(tenure, now_ns=self._state.now_ns)
        self._state.pins.drop_older(message.session, lowest)
        if self._state.standing.by_lane:
            yield from self._state.standing.drop_session(message.session, lowest)
        if message.wait_ns > 0 and proven:
            yield from self._listen(message, session, reply_to)
        else:
            yield Reply(reply_to, self._alive(session))

    def _alive(self, session: SessionState) -> Alive:
        """Return which grants of a session live, and which of them are recalled."""
        state = self._state
        grants = [
            GrantLeft(
                tenure.lock,
                tenure.token,
                max(0, tenure.hold_end_ns - state.now_ns),
                far := tenure.kept == FAR,
                far and tenure.recalled,
            )
            for tenure in state.tenures.of_session(session.session)
            if tenure.token is not None
        ]
        number, stamp_ns = state.commits.notice_number, state.stamp()
        return Alive(state.epoch, session.count_seen, number, stamp_ns, tuple(grants))

    # ---------------------------------------------------------------- word of recalls

    def _listen(self, message: KeepAlive, session: SessionState, reply_to: int) -> Iterator[Effect]:
        """Keep the question of a session that keeps grants without memory in common with us."""
        state, name = self._state, message.session
        kept = state.tenures.kept
        yield from self._tell((name,))
        if state.draining or not kept.recalled_of(name).issubset(message.heard):
            yield Reply(reply_to, self._alive(session))
            return
        self._listening[name], kept.listening[name] = reply_to, session.ttl_ns
        self._ends.put(name, state.now_ns + min(message.wait_ns, WAIT_SLICE_NS_MAX))

    def _tell(self, sessions: Iterable[str]) -> Iterator[Effect]:
        """Answer those of these sessions that listen."""
        for name in sessions:
            reply_to = self._listening.pop(name, None)
            if reply_to is not None:
                self._ends.drop(name)
                self._state.tenures.kept.listening.pop(name)
                session = self._state.sessions.by_id.get(name)
                yield Reply(
                    reply_to,
                    EpochChanged(self._state.epoch) if session is None else self._alive(session),
                )

    def tell_recalled(self) -> list[Effect]:
        """Send word of the far grants that were recalled or taken, to those that listen."""
        kept = self._state.tenures.kept
        untold, kept.untold = kept.untold, {}
        return list(self._tell(untold))

    def end_slices(self, now_ns: int) -> Iterator[Effect]:
        """Answer those that have listened for a slice."""
        yield from self._tell(self._ends.take(now_ns))

    def end_all(self) -> Iterator[Effect]:
        """Answer all that listen: this shard ends."""
        yield from self._tell(list(self._listening))

    def next_deadline_ns(self) -> int | None:
        """Return when the next slice of listening ends."""
        return self._ends.next_ns()

    def assert_invariants(self) -> None:
        """Assert the bookkeeping of those that listen.  For tests and simulation."""
        kept = self._state.tenures.kept
        assert self._listening.keys() == kept.listening.keys() == self._ends.due.keys()
        assert not kept.untold

    # ---------------------------------------------------------------- ends

    def on_goodbye(self, message: Goodbye, reply_to: int) -> Iterator[Effect]:
        """End a session at its own wish."""
        for tenure in self._state.tenures.kept.left_by(message.session):
            yield from self._state.tenures.remove(tenure, now_ns=self._state.now_ns)
        yield from self.end(message.session, "its session said goodbye")
        yield Reply(reply_to, Released())

    def on_session_died(self, message: SessionDied, _: int) -> Iterator[Effect]:
        """End a session whose process is proven to be gone, so no client believes in its locks."""
        found = self._state.sessions.by_id.get(message.session)
        if found is not None:
            self._state.count("sessions_died")
            who = f"{found.actor or 'client'}@{found.host} pid {found.pid}"
            yield LogEvent("session.died", f"the process of {who} ended, session {found.session}")
            yield from self.end(message.session, "its process died")

    def on_session_barred(self, message: SessionBarred, _: int) -> Iterator[Effect]:
        """End a session whose name is none of the cell any more."""
        found = self._state.sessions.by_id.get(message.session)
        if found is not None:
            self._state.count("sessions_barred")
            yield LogEvent("session.barred", f"{found.identity} is barred, session {found.session}")
            yield from self.end(message.session, "its name may not use this shard any more")

    def end(self, session: str, cause: str) -> Iterator[Effect]:
        """End a session: free its locks, forget its pins, keep its outcomes."""
        found = self._state.sessions.by_id.get(session)
        if found is None:
            return
        tenures = self._state.tenures.of_session(session)
        for tenure in tenures:
            if not tenure.bound:
                yield from self._state.tenures.take_away(tenure, cause, now_ns=self._state.now_ns)
            tenure.keepable = False
        self._state.pins.drop_session(session)
        yield from self._state.standing.drop_session(session)
        self._state.sessions.forget(session)
        yield from self._tell((session,))
        self._state.tenures.session_ended(session)
        self._state.tenures.kept.session_ended(session)
        self._state.sessions.end_grace_if_all_acknowledged(self._state.now_ns)
        recording = self._recording.pop(session, None)
        if found.durable or recording is not None:
            yield Persist(0, (SessionEnded(session, self._state.wall_ns),), Durability.OS)

    def on_session_seen(self, message: SessionSeen, _: int) -> Iterator[Effect]:
        """Note that a liveliness token appeared or vanished."""
        mine = self._state.sessions.token_seen(
            message.session,
            message.present,
            identity=message.identity,
            now_ns=self._state.now_ns,
        )
        if mine and not message.present:
            # Its waiters lose their place: a lock must not be granted to a dead process while
            # living ones wait.  A client that was only cut off asks again with the same id.
            for tenure in self._state.tenures.of_session(message.session):
                if tenure.token is None:
                    self._state.count("waiters_dropped")
                    yield from self._state.tenures.remove(tenure, now_ns=self._state.now_ns)
                    self._state.forget_top(tenure.lock)
            yield from self._state.standing.drop_session(message.session)
