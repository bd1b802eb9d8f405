"""Locks on the client's side: drives `core.MultiLock` over a carrier until it rests.

A lock's calls run in the caller's own thread.  Rules a change must keep:

  * The mutex of the session guards the pure core and is never held during a call.
  * However a thread leaves this module, even by an interrupt, no shard keeps its lock forever, and
    its lane is returned exactly once.
  * A commit that was sent ends with an answer or a `CommitUnknownError`.
"""

from __future__ import annotations

import logging
import random
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.backoff import CALLED_NS_MAX, CALLED_NS_MIN, Backoff
from enact_dist.core.client.kept import Keeping
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import AwaitedNews, Phase
from enact_dist.core.protocol.messages import (
    NEWER_TYPE,
    OUTCOME_COMMITTED,
    OUTCOME_PENDING,
    OUTCOME_UNSEEN,
    UNKNOWN_ASPECT,
    Commit,
    Explain,
    Outcome,
    OutcomeIs,
    Prepare,
    Refused,
    Release,
    Versions,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.state.clock import is_kept
from enact_dist.errors import CommitUnknownError, EnactError, MisuseError
from enact_dist.link.client.calls import BYTES_PER_S_MIN, CALL_S, attempt_timeout_s, bytes_with
from enact_dist.link.client.kept import WantedLock
from enact_dist.link.client.lanes import name_of, read_name
from enact_dist.link.client.session import (
    CALLS_S_MAX,
    FINISH_S,
    LEARNT,
    SessionClient,
)
from enact_dist.link.client.transfer import UNSTAGED_BYTES_MAX, drop_staged, stage
from enact_dist.link.refusals import error_of, not_committed, not_granted
from enact_dist.terms import ACCESSES
from enact_dist.wire.limits import COMMIT_BYTES_MAX

if TYPE_CHECKING:
    import threading
    from collections.abc import Iterable, Mapping, Sequence

    from enact_dist.core.client.plan import Plan
    from enact_dist.core.protocol.datum import Position
    from enact_dist.core.protocol.messages import DatumRead, Item, Request, SlotVersion, WriteItem

_WITH_DATA: Final = (Commit, Prepare)
INTERRUPTIBLE_SLICE_NS: Final = 120_000_000
"""How long one call of an interruptible lock is parked where its thread cannot look meanwhile."""
STOPS: Final = ("socket", "call")
"""Transports whose waiting thread looks at an interrupt."""
RESTARTS_AT_ONCE: Final = 1
"""Retries without a pause for a lock that was lost before it was held."""
RESTART_S_MAX: Final = 0.3
REGISTRATIONS_MAX: Final = 3
"""How often one lock registers its aspects again with a shard that does not know them."""

_log = logging.getLogger("enact.link")


class CellClient(SessionClient):
    """One session of this process with one cell, and its locks."""

    def acquire(
        self,
        items: Iterable[Item],
        *,
        wait_s: float,
        hold_s: float,
        interrupt: threading.Event | None = None,
        begun: list[MultiLock] | None = None,
        past_ns: int = 0,
        keep: tuple[Item, ...] = (),
        after: tuple[DatumRead, ...] = (),
    ) -> MultiLock:
        """Acquire a lock; it rests in HELD when this returns.

        Args:
            items: What to lock and view.
            wait_s: How long to wait for the grant; 0 asks each shard once.
            hold_s: Hold limit after the last grant.
            interrupt: Ends the waiting within 0.2 s once it is set.
            begun: Receives the lock before the first request, so that its caller can release it if
                an exception comes between the return and the assignment.
            past_ns: All items are views, as of this timestamp.
            keep: The requests under which this session may keep the grant for the next lock of
                them; empty: it may not.
            after: Data that were seen: the lock enters the queue once one of their slots shows a
                newer datum, and `wait_s` counts from then on.  Only if `stands_alone(items)`.

        Raises:
            LockTimeoutError: Not granted in time; nothing is held.
            ForgottenError: A state as of `past_ns` is beyond retention.
            ShardUnreachableError: A shard did not answer.
            MisuseError: Too many threads hold or await locks.
            EnactError: The shard refused the request.
        """
        if self.forked or self.closed:
            self.check_usable()
        begun = [] if begun is None else begun
        started_ns = self._now_ns()
        give_up_ns = started_ns + int(min(wait_s, CALLS_S_MAX) * 1e9)
        asked = WantedLock(
            tuple(items), give_up_ns, int(hold_s * 1e9), past_ns, keep, interrupt, begun, after
        )
        if started_ns >= self.renewal.used_until_ns:
            self.renewal.used()
        try:
            lane = self._lanes.free.pop()
        except IndexError:
            lane = self._lanes.take()
        try:
            kept = self._kept.begin(lane, asked) if keep in self.core.kept.by_items else None
            return kept or self._ask(lane, asked)
        except BaseException:
            live = self._release_of(lane)
            if live is not None and live not in begun:
                for before in begun[-1:]:
                    before.lane_free = True  # the lane is that of the lock that was not recorded
            lock = live or (begun[-1] if begun else None)
            if lock is not None:
                self.release(lock)
            else:
                self._lanes.free.append(lane)
            raise

    def _ask(self, lane: int, asked: WantedLock) -> MultiLock:
        """Ask for a lock, as often as it takes, until it is held or cannot be."""
        core, begun, interrupt = self.core, asked.begun, asked.interrupt
        lock_views, started_ns, give_up_ns = False, self._now_ns(), asked.give_up_ns
        allowed_ns, attempt = max(0, give_up_ns - started_ns), -1
        while True:
            attempt += 1
            with self._mutex:
                plan = core.plan(asked.items, lock_views=lock_views, past_ns=asked.past_ns)
                now_ns = self._now_ns()
                wait_ns, hold_ns = max(0, give_up_ns - now_ns), asked.hold_ns
                lock = core.begin(lane, plan, now_ns=now_ns, wait_ns=wait_ns, hold_ns=hold_ns)
                if asked.after and len(plan.locks) == 1 and not plan.views:
                    lock.news = AwaitedNews(asked.after, allowed_ns)
                begun.append(lock)
                keeps = asked.keep and plan.keepable and not lock_views
                if keeps and self._kept.keeps(plan.locks[0][0]):
                    lock.keeping = Keeping(asked.keep)
                for before in begun[-2:-1]:
                    before.lane_free = True  # the next lock takes over the lane
            if interrupt is not None and not self._can_stop(plan):
                lock.slice_ns = INTERRUPTIBLE_SLICE_NS
            self._drive(lock, interrupt=interrupt)
            if lock.phase is Phase.HELD:
                return lock
            if lock.news is not None:  # its time begins when it enters the queue
                attempt = 0 if lock.news.outside else attempt
                started_ns = self._now_ns() if lock.news.outside else lock.give_up_ns - allowed_ns
                give_up_ns = started_ns + allowed_ns
            over = attempt > 0 and self._now_ns() >= give_up_ns
            if over or not self._begins_anew(lock, attempt):
                break
            lock_views = lock.no_cut and not core.observer and not asked.past_ns
            if lock_views:
                self.count("views_locked")
        waited_s = (self._now_ns() - started_ns) / 1e9
        raise not_granted(lock, waited_s, self.carrier, asked.items)

    def stands_alone(self, items: tuple[Item, ...]) -> bool:
        """Whether a lock of these lies on one shard, so that it can wait there for news."""
        placement = self.core.placement
        if len(placement.shards) == 1:
            return True
        if any(ACCESSES[item.access].each for item in items):
            return False
        return len({shard_of(item.entity, placement) for item in items}) == 1

    def _can_stop(self, plan: Plan) -> bool:
        """Whether a call may be parked for long because its thread can look at an interrupt."""
        return len(plan.locks) == 1 and self.carrier.transport_of(plan.locks[0][0]) in STOPS

    def _release_of(self, lane: int) -> MultiLock | None:
        """Release the lock of a lane, even one that an interrupt kept from being recorded.

        Otherwise keep-alives would name it forever, and a lost release would never be repaired.

        Returns:
            The lock, whose mark is still to be given back; None if there is none.
        """
        live = None
        with self._mutex:
            for lock in self.core.live_locks():
                if lock.lock.lane == lane:
                    lock.release()
                    live = lock
        return live

    def _begins_anew(self, lock: MultiLock, attempt: int) -> bool:
        """Whether to request a resting lock once more; pauses first."""
        if lock.phase in (Phase.LOST, Phase.MISPLACED):
            if attempt >= RESTARTS_AT_ONCE:
                self._pause(min(0.02 * 2 ** min(attempt, 8), RESTART_S_MAX))
            return True
        code = lock.refusal.code if isinstance(lock.refusal, Refused) else ""
        if code not in (UNKNOWN_ASPECT, NEWER_TYPE) or attempt >= REGISTRATIONS_MAX:
            return False
        shards = {shard for shard, _ in (*lock.plan.locks, *lock.plan.views)}
        if code == NEWER_TYPE:
            self.greet(shards)  # the caller sees the lapse and compares the types again
            return True
        # A shard without a folder has restarted: its catalogue is empty again.
        named = {i.aspect for _, its in (*lock.plan.locks, *lock.plan.views) for i in its}
        for shard in shards:
            self.catalogue.forget(shard)
        aspects = self.catalogue.wanted(named)
        self.register(aspects=aspects, needed=lambda: shards)
        return bool(aspects)

    def _pause(self, pause_s: float) -> None:
        """Wait before a retry; raise if the cell is closed meanwhile."""
        if self.pauses.rest(pause_s):
            self.check_usable()

    def _drive(self, lock: MultiLock, *, interrupt: threading.Event | None = None) -> None:
        """Make the lock's calls until it rests."""
        far, returns = None, self.pauses.returns
        try:
            while lock.phase.busy or interrupt is not None:
                with self._mutex:
                    if interrupt is not None and interrupt.is_set():
                        lock.release()
                    calls, wait_until_ns = lock.next_calls(self._now_ns())
                if not calls:
                    if not lock.phase.busy:
                        return
                    if lock.silent_shard and self.carrier.away(lock.silent_shard):
                        far = far or Backoff(CALLED_NS_MIN, CALLED_NS_MAX, random.random)
                        later_ns = self._now_ns() + far.pause_ns()
                        wait_until_ns = min(max(wait_until_ns, later_ns), lock.give_up_ns)
                    self._wait_until(lock, wait_until_ns, returns, interrupt)
                    continue
                returns = self.pauses.returns
                if lock.unnamed and not self.carrier.inside:
                    calls = [(shard, self._sendable(shard, request)) for shard, request in calls]
                if len(calls) == 1 and not self._further.doubted:
                    shard, request = calls[0]
                    timeout_s = attempt_timeout_s(request)
                    answer = self.carrier.request(
                        shard, request, timeout_s=timeout_s, interrupt=interrupt
                    )
                    answers = [answer]
                else:
                    answers = self._send(calls)
                with self._mutex:
                    for (shard, request), answer in zip(calls, answers, strict=True):
                        if type(answer) in LEARNT:
                            self._learn(shard, answer)  # type: ignore[arg-type]  # one of these
                        lock.answered(shard, request, answer, self._now_ns())
                if self.core.placement is not self._further.linked:
                    self._further.follow(self.core.placement)
        except BaseException:
            with self._mutex:
                lock.release()
            raise
        finally:
            if lock.releases:
                self._send_releases(lock)

    def _wait_until(
        self, lock: MultiLock, until_ns: int, returns: int, interrupt: threading.Event | None
    ) -> None:
        """Wait before a lock asks again, until a shard returns or the lock is given up."""
        while True:
            left_ns = max(1_000_000, until_ns - self._now_ns())
            if interrupt is not None:
                left_ns = min(left_ns, lock.slice_ns)
            if self.pauses.rest(left_ns / 1e9, returns):
                self.check_usable()
            interrupted = interrupt is not None and interrupt.is_set()
            if interrupted or self.pauses.returns != returns or self._now_ns() >= until_ns:
                return

    def _sendable(self, shard: str, request: Request) -> Request:
        """Return a request ready to send, staging again any data that a shard has lost."""
        if not isinstance(request, _WITH_DATA) or bytes_with(request.writes) <= COMMIT_BYTES_MAX:
            return request
        named = stage(self, {shard: request.writes}, self.check_usable)
        return replace(request, writes=tuple(named[shard]))

    def _send_releases(self, lock: MultiLock) -> None:
        """Send the releases of a lock that rests; keep-alives repair lost ones."""
        with self._mutex:
            releases = lock.take_releases()
        try:
            self.carrier.request_all(releases, timeout_s=CALL_S)
        except EnactError as error:
            self.count("releases_unsent")
            _log.info("lock %s was not released by message: %s", lock.lock, error)

    def finish(
        self,
        lock: MultiLock,
        writes: Mapping[str, Sequence[WriteItem]],
        expects: Sequence[SlotVersion] = (),
        reads: tuple[DatumRead, ...] = (),
        reads_left_out: int = 0,
    ) -> None:
        """Publish `writes` and release the lock.

        Args:
            lock: The held lock.
            writes: What to set, by shard.
            expects: Viewed versions that must still be the newest.
            reads: Inputs of the writes, for their lineage.
            reads_left_out: How many further inputs there were.

        Raises:
            ChangedError: An expected slot has changed; nothing was written.
            LeaseLostError: The lock was lost; nothing was written.
            CommitUnknownError: The commit was sent but never answered.
            ShardUnreachableError: A shard does not answer; nothing was written.
        """
        started_ns = self._now_ns()
        named, size = writes, 0
        try:
            if not writes and not expects and self._kept.finish(lock):
                return
            if writes and lock.phase is Phase.HELD:
                size = sum(map(bytes_with, writes.values()))
                if size > UNSTAGED_BYTES_MAX:
                    self._check_open(lock)
                    named = stage(self, writes, lambda: self._check_held(lock))
                    started_ns, size = self._now_ns(), sum(map(bytes_with, named.values()))
            with self._mutex:
                if self.forked or self.closed:
                    self._check_open(lock)
                if lock.phase is Phase.HELD:
                    finish_s = FINISH_S + size / BYTES_PER_S_MIN
                    give_up_ns = started_ns + int(finish_s * 1e9)
                    lock.finish(
                        named,
                        give_up_ns=give_up_ns,
                        expects=expects,
                        reads=reads,
                        reads_left_out=reads_left_out,
                    )
            try:
                self._drive(lock)
            except EnactError as error:
                if lock.phase is not Phase.RELEASED or not lock.sent_commit:
                    raise
                # The cell was closed, or the answer could not be read: the commit may stand.
                lock.phase, lock.cause = Phase.UNKNOWN, f"then: {error}"
                raise self._not_committed(lock, started_ns) from error
            if lock.phase is not Phase.COMMITTED:
                if lock.phase is not Phase.UNKNOWN:
                    drop_staged(self, named)
                raise self._not_committed(lock, started_ns)
        finally:
            self.release(lock)  # only the lane, unless something broke in between

    def _check_held(self, lock: MultiLock) -> None:
        """Raise if a lock was lost while its data were being sent."""
        self.check_usable()
        if lock.phase is not Phase.HELD:
            self._ask_cause(lock)
            raise not_committed(lock, FINISH_S, self.carrier)

    def _check_open(self, lock: MultiLock) -> None:
        if self.forked or self.closed:
            with self._mutex:
                lock.release()
            self.check_usable()

    def _not_committed(self, lock: MultiLock, started_ns: int) -> EnactError:
        waited_s = (self._now_ns() - started_ns) / 1e9
        self._ask_cause(lock)
        self._ask_who(lock)
        return not_committed(lock, waited_s, self.carrier, name=name_of(lock))

    def outcome(self, name: str, *, timeout_s: float) -> Position | None:
        """Ask for the outcome of a commit; see `Cell.outcome`."""
        lock, shard, known_in = read_name(name)
        if shard not in self.shards():
            raise MisuseError(f"{name!r} names shard {shard}; there are {', '.join(self.shards())}")
        deadline_ns = self._now_ns() + int(timeout_s * 1e9)
        # After this, a copy of the commit still in flight finds nothing to commit.
        released = self.call(shard, Release(lock), timeout_s=timeout_s)
        while True:
            left_s = max(0.0, (deadline_ns - self._now_ns()) / 1e9)
            answer = self.call(shard, Outcome(lock), timeout_s=left_s)
            kind = answer.kind if isinstance(answer, OutcomeIs) else ""
            if isinstance(answer, OutcomeIs) and kind == OUTCOME_COMMITTED:
                return answer.position
            if (
                isinstance(answer, OutcomeIs)
                and kind == OUTCOME_UNSEEN
                and (known_in == answer.epoch or (not known_in and is_kept(answer.epoch)))
            ):
                if isinstance(released, Refused):  # its session lives, so it may still be sent
                    raise error_of(released)
                return None
            if kind != OUTCOME_PENDING or self._now_ns() >= deadline_ns:
                why = "still works on it" if kind == OUTCOME_PENDING else "no longer knows it"
                raise CommitUnknownError(
                    f"shard {shard} {why}: whether commit {name} took effect is unknown; read"
                    " its data",
                    lock_id=name,
                )
            self._pause(0.02)

    def release(self, lock: MultiLock) -> None:
        """Release the lock without writing, and free its lane; idempotent.

        Never raises for a lock or cell already lost.
        """
        if lock.lane_free:
            return
        try:
            if lock.phase is not Phase.COMMITTED:  # which only this thread can bring about
                with self._mutex:
                    lock.release()
            if lock.keeping is not None:
                self._kept.leave(lock)
            if lock.releases:
                self._send_releases(lock)
        finally:
            lock.lane_free = True
            if lock.phase is Phase.UNKNOWN:
                self._lanes.keep(lock.lock.lane)
            else:
                self._lanes.free.append(lock.lock.lane)

    def valid(self, lock: MultiLock) -> bool:
        """Whether the lock's lease still holds by the local clock, without a network call."""
        if self.forked or self.closed:
            return False
        with self._mutex:
            valid = lock.valid(self._now_ns())
        if not valid and lock.phase is Phase.HELD and self._renewer is None:
            self.renew_once()
            with self._mutex:
                valid = lock.valid(self._now_ns())
        return valid

    def check(self, lock: MultiLock) -> None:
        """Make sure that the lock is held, asking its shards if its lease may have ended.

        Raises:
            LeaseLostError: It is lost.
            ShardUnreachableError: A shard does not answer, so the state of the lock is unknown.
        """
        self.check_usable()
        if self.valid(lock):
            return
        if lock.phase is Phase.HELD:
            with self._mutex:
                now_ns = self._now_ns()
                shards = [part.shard for part in lock.parts]
                calls = [(shard, self.core.keep_alive(shard, now_ns)) for shard in shards]
            self.call_all(calls)
        if lock.phase is not Phase.HELD:
            self._ask_cause(lock)
            raise not_committed(lock, FINISH_S, self.carrier)

    def _ask_cause(self, lock: MultiLock) -> None:
        """Ask the shard why a lock ended whose loss a keep-alive has revealed."""
        call = lock.ask_cause()
        if call is not None:
            try:
                lock.told_cause(self.call_once([call])[0])
            except EnactError as error:
                _log.info("cannot ask why lock %s was lost: %s", lock.lock, error)

    def _ask_who(self, lock: MultiLock) -> None:
        """Ask the shard who committed an unexpected change."""
        moved = lock.moved
        if moved is None:
            return
        try:
            answer = self.call_once([(self.shard_of(moved.slot.entity), Explain((moved,)))])[0]
        except EnactError as error:
            _log.info("cannot ask who changed %s: %s", moved.slot, error)
            return
        for entry in answer.entries if isinstance(answer, Versions) else ():
            if entry.cause is not None:
                by = entry.cause
                lock.cause += f", by {by.actor or 'client'}@{by.host} pid {by.pid}"
