"""Small wrong edits of the shard, each of which the machine must notice.

A mutant replaces one decision of the core through `patch(owner, name, value)`; the shard's own
assertions are off meanwhile.  Those that the simulator catches too are in `tests/sim`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

sys.path.append(str(Path(__file__).parents[1] / "sim"))

from mutants_directed import leases_end_late
from mutants_one_shard import blind_acknowledgement, no_grace, shows_before_it_is_kept
from mutants_over_shards import (
    aborts_what_is_open,
    expects_beside_writers,
    forgets_decisions_at_a_restart,
    loses_prepared_at_a_restart,
    views_do_not_wait_for_the_undecided,
)
from mutants_readers import shows_the_newest_for_what_is_gone

from enact_dist.core.protocol.messages import NOT_KEPT, Fenced, Finished, Prepared
from enact_dist.core.protocol.records import Persist, Reply
from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.shard.on_prepare import PrepareHandler
from enact_dist.core.shard.on_session import SessionHandler
from enact_dist.core.shard.on_view import ViewHandler
from enact_dist.core.state.clock import Stamps
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.decisions import Decisions
from enact_dist.core.state.grants import Tenures
from enact_dist.core.state.history import History
from enact_dist.core.state.sessions import SessionTable
from enact_dist.core.state.tenure import KeptGrants, Tenure


def any_token_of_this_epoch(patch):
    """The fence compares the epoch and forgets the number."""
    fence = Commits._fence

    def wrong(self, lock, token, tenure):
        answer = fence(self, lock, token, tenure)
        return None if isinstance(answer, Fenced) and tenure and tenure.token else answer

    patch(Commits, "_fence", wrong)


def grants_a_seq_again(patch):
    """A released seq may be asked for once more."""
    on_release = LockHandler.on_release

    def wrong(self, message, reply_to):
        held = message.lock in self._state.tenures.by_lock
        yield from on_release(self, message, reply_to)
        if held:
            self._state.forget_top(message.lock)

    patch(LockHandler, "on_release", wrong)


def view_does_not_renew(patch):
    """A view is counted, and does not lengthen the lease."""
    on_take_view = ViewHandler.on_take_view

    def wrong(self, message, reply_to):
        session = self._state.sessions.known(message.lock.session)
        before_ns = session.renewed_ns if session else 0
        yield from on_take_view(self, message, reply_to)
        if session:
            session.renewed_ns = before_ns

    patch(ViewHandler, "on_take_view", wrong)


def prepared_locks_end_with_their_client(patch):
    """A release or the end of a lease frees what is prepared."""
    patch(Tenure, "bound", property(lambda tenure: tenure.committing))


def commits_in_flight_expire(patch):
    """A release or the end of a lease takes the lock of a commit at the disk."""
    patch(Tenure, "bound", property(lambda tenure: tenure.prepared is not None))


def _tells_early(patch, method, answer):
    wrapped = getattr(PrepareHandler, method)

    def wrong(self, *arguments):
        for effect in wrapped(self, *arguments):
            if isinstance(effect, Persist):
                work = next(reversed(self._at_store.values()))
                replies, work.replies = work.replies, []
                yield from (Reply(reply_to, answer(work.record)) for reply_to in replies)
            yield effect

    patch(PrepareHandler, method, wrong)


def promises_before_it_is_kept(patch):
    """Prepared is answered while the disk still works on it."""
    answer = lambda record: Prepared(record.lock, record.stamp_ns, record.versions)  # noqa: E731
    _tells_early(patch, "on_prepare", answer)


def finished_before_it_is_kept(patch):
    """The primary may forget before the end is on disk."""
    _tells_early(patch, "_finish", lambda record: Finished(record.lock))


def tells_participants_once(patch):
    """Who does not hear of a decision at once never does."""
    tell = Decisions.tell

    def wrong(self, now_ns):
        yield from tell(self, now_ns)
        for decision in self.by_lock.values():
            decision.due_ns = 1 << 62

    patch(Decisions, "tell", wrong)


def leases_pay_for_a_stall(patch):
    """A shard that stood still ends the leases that it did not hear renewed."""
    patch(SessionTable, "stalled", lambda _table, _gap_ns: None)


def hold_limits_pay_for_a_stall(patch):
    """A shard that stood still ends locks that were held too long only by its own fault."""
    patch(Tenures, "stalled", lambda _tenures, _gap_ns: None)


def validated_once(patch):
    """A repeated validation is told that the lock is gone."""
    validate = Commits.validate

    def wrong(self, message, **options):
        session = self._sessions.known(message.lock.session)
        lane = session.lanes.get(message.lock.lane) if session else None
        if lane is not None and lane.validated and lane.validated[0] == message.lock:
            lane.validated = None
        yield from validate(self, message, **options)

    patch(Commits, "validate", wrong)


def expects_what_was(patch):
    """An expected view is compared with what is visible, not with what is at the disk."""
    patch(Commits, "_newest_version", lambda self, slot: self._slots[slot].version)


def stamps_follow_the_wall_clock(patch):
    """Stamps are what the wall clock says, also when it was set back."""

    def wrong(self, *, seen_ns, wall_ns):
        self.last_ns = max(self.last_ns, wall_ns)
        return max(wall_ns, seen_ns + 1)

    patch(Stamps, "next", wrong)


def keep_alives_free_nothing(patch):
    """What a client does not want any more stays."""
    on_keep_alive = SessionHandler.on_keep_alive
    wrong = lambda self, message, to: on_keep_alive(self, replace(message, view=()), to)  # noqa: E731
    patch(SessionHandler, "on_keep_alive", wrong)


def vanished_waiters_keep_their_place(patch):
    """A lock is granted to a process that is gone."""

    def wrong(self, message, _):
        sessions, now_ns = self._state.sessions, self._state.now_ns
        sessions.token_seen(
            message.session, message.present, identity=message.identity, now_ns=now_ns
        )
        return iter(())

    patch(SessionHandler, "on_session_seen", wrong)


def welcomes_early(patch):
    """A session is welcomed before its record is on disk."""
    answer_when_durable = SessionHandler.answer_when_durable

    def wrong(self, reply_to, answer, records, *durability, **options):
        for effect in answer_when_durable(self, reply_to, answer, records, *durability, **options):
            yield effect
            if isinstance(effect, Persist):
                yield next(reversed(self._unanswered.values())).pop()

    patch(SessionHandler, "answer_when_durable", wrong)


def retains_one_version_more(patch):
    """A version stays readable for one commit too long."""
    append = History._append

    def wrong(self, found, old, limits):
        more = limits.versions + (limits.versions > 1)
        append(self, found, old, limits._replace(versions=more))

    patch(History, "_append", wrong)


def any_seq_under_a_kept_grant(patch):
    """A late copy is taken for a new block: what it was built on may be gone."""
    fence = Commits._fence

    def wrong(self, lock, token, tenure):
        kept = tenure.kept if tenure is not None else NOT_KEPT
        if kept:
            tenure.kept = NOT_KEPT
        answer = fence(self, lock, token, tenure)
        if kept:
            tenure.kept = kept
        return answer

    patch(Commits, "_fence", wrong)


def keeps_though_another_waits(patch):
    """Whoever waited when the grant stayed is never granted."""
    stays = KeptGrants.stays
    wrong = lambda self, tenure, **how: stays(self, tenure, **(how | {"awaited": False}))  # noqa: E731
    patch(KeptGrants, "stays", wrong)


def repeated_answer_says_that_it_is_over(patch):
    """A client that heard the first answer not at all forgets a grant that lives."""
    patch(KeptGrants, "told", lambda _self, _lock, _token: NOT_KEPT)


def nothing_is_revoked(patch):
    """Whoever comes to wait for an idle grant waits for its next block."""
    patch(Tenures, "recall_for", lambda _self, _waiter, **_: None)


def cell_is_not_cleared(patch):
    """A grant that ended stays in its cell, and is believed in."""
    over = KeptGrants.over

    def wrong(self, tenure):
        marks, self.marks = self.marks, SimpleNamespace(over=lambda *_: None)
        over(self, tenure)
        self.marks = marks

    patch(KeptGrants, "over", wrong)


def revokes_what_a_block_uses(patch):
    """A waiter is granted what a block still uses."""
    recall = KeptGrants.recall

    def wrong(self, tenure, *, now_ns):
        recall(self, tenure, now_ns=now_ns)
        if tenure.recalled and not tenure.committing:
            self._end(tenure)

    patch(KeptGrants, "recall", wrong)


def no_word_of_a_recall(patch):
    """A listening session hears of a recall when its slice ends."""
    patch(SessionHandler, "tell_recalled", lambda handler: list(handler._tell(())))


def no_lease_more_for_a_far_block(patch):
    """A far grant is over before a block that has not heard of its recall need be."""
    recall = KeptGrants.recall

    def wrong(self, tenure, *, now_ns):
        tenure.unheard_ns = 0
        recall(self, tenure, now_ns=now_ns)

    patch(KeptGrants, "recall", wrong)


ALL = (
    no_word_of_a_recall,
    no_lease_more_for_a_far_block,
    any_seq_under_a_kept_grant,
    keeps_though_another_waits,
    repeated_answer_says_that_it_is_over,
    nothing_is_revoked,
    cell_is_not_cleared,
    revokes_what_a_block_uses,
    retains_one_version_more,
    shows_the_newest_for_what_is_gone,
    leases_end_late,
    any_token_of_this_epoch,
    grants_a_seq_again,
    view_does_not_renew,
    prepared_locks_end_with_their_client,
    commits_in_flight_expire,
    promises_before_it_is_kept,
    finished_before_it_is_kept,
    aborts_what_is_open,
    forgets_decisions_at_a_restart,
    loses_prepared_at_a_restart,
    tells_participants_once,
    blind_acknowledgement,
    no_grace,
    leases_pay_for_a_stall,
    hold_limits_pay_for_a_stall,
    validated_once,
    expects_beside_writers,
    expects_what_was,
    views_do_not_wait_for_the_undecided,
    stamps_follow_the_wall_clock,
    keep_alives_free_nothing,
    vanished_waiters_keep_their_place,
    shows_before_it_is_kept,
    welcomes_early,
)
