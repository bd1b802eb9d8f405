"""Small wrong edits of commits over shards and of views over shards; the simulator catches each."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mutant_parts import forgets_what_ended

from enact_dist.core.client.cut import Cut
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import Finished
from enact_dist.core.protocol.records import Persist, PreparedEnded, Reply
from enact_dist.core.shard import on_prepare as prepares
from enact_dist.core.shard.on_prepare import PrepareHandler
from enact_dist.core.shard.on_view import ViewHandler
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.decisions import Decisions
from enact_dist.core.state.tenure import Tenure
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def prepared_locks_expire(patch: Patch) -> None:
    """A lease, a release or a keep-alive ends a prepared lock."""
    patch(Tenure, "bound", property(lambda tenure: tenure.committing))
    forgets_what_ended(patch)


def promises_before_it_is_kept(patch: Patch) -> None:
    """Prepared is answered while the disk still works on the record."""
    on_prepare = PrepareHandler.on_prepare

    def wrong(self: PrepareHandler, message: Any, reply_to: int) -> Any:
        for effect in on_prepare(self, message, reply_to):
            if isinstance(effect, Persist):
                work = self._at_store[message.lock]
                replies, work.replies = work.replies, []
                for reply in replies:
                    yield Reply(reply, prepares._prepared(work.record))
            yield effect

    patch(PrepareHandler, "on_prepare", wrong)


def aborts_what_is_open(patch: Patch) -> None:
    """A primary that has not decided yet says that it never will."""
    resolved = PrepareHandler._resolved

    def wrong(self: PrepareHandler, message: Any) -> Any:
        answer = resolved(self, message)
        return replace(answer, kind="aborted") if answer.kind == "open" else answer

    patch(PrepareHandler, "_resolved", wrong)


def forgets_decisions_at_a_restart(patch: Patch) -> None:
    """A restarted primary knows neither decisions nor outcomes."""
    patch(Commits, "position_of", lambda _self, _lock: None)


def loses_prepared_at_a_restart(patch: Patch) -> None:
    """A restarted participant has forgotten what it has prepared."""
    init = PrepareHandler.__init__

    def wrong(self: PrepareHandler, state: Any, _recovered: Any, *others: Any) -> None:
        init(self, state, (), *others)

    patch(PrepareHandler, "__init__", wrong)


def never_tells_participants(patch: Patch) -> None:
    """Neither a decision is told nor is it asked for."""
    patch(Decisions, "tell", lambda _self, _now_ns: iter(()))
    patch(PrepareHandler, "ask", lambda _self: iter(()))


def commits_without_votes(patch: Patch) -> None:
    """A client commits though a participant has not prepared yet."""

    def wrong(self: MultiLock) -> None:
        if self.finishing is not None and self.finishing.primary:
            self.phase = Phase.COMMITTING
        else:
            after_votes(self)

    after_votes = MultiLock._after_votes
    patch(MultiLock, "_after_votes", wrong)


def expects_beside_writers(patch: Patch) -> None:
    """An expected view does not mind that another lock holds the slot for writing."""
    patch(Commits, "_in_the_way", lambda _self, _slot, _lock: False)


def takes_the_first_views(patch: Patch) -> None:
    """Views over several shards are taken as they come, of one cut or not."""

    def wrong(cut: Cut, _epoch: Any, **_options: Any) -> Any:
        return {shard: answer.viewed for shard, answer in cut._answers.items()}

    patch(Cut, "settled", wrong)


def views_do_not_wait_for_the_undecided(patch: Patch) -> None:
    """A view promises to be current though a prepared commit may come before its end."""
    patch(ViewHandler, "_undecided_ns", lambda _handler, _items: 1 << 62)


def promises_may_be_lost(patch: Patch) -> None:
    """What is prepared is written, but not forced to the disk."""
    persist = PrepareHandler._persist

    def wrong(self: PrepareHandler, work: Any, records: Any) -> Any:
        return [replace(one, durability=Durability.OS) for one in persist(self, work, records)]

    patch(PrepareHandler, "_persist", wrong)


def decisions_may_be_lost(patch: Patch) -> None:
    """A decision is kept as its own data ask for, though others rely on it."""
    patch(Commits, "_strictest", lambda _commits, _commit: Durability.OS)


def promises_are_not_forgotten(patch: Patch) -> None:
    """The end of a promise is not recorded, so a restart takes it for open again."""
    persist = PrepareHandler._persist

    def wrong(self: PrepareHandler, work: Any, records: Any) -> Any:
        kept = tuple(record for record in records if not isinstance(record, PreparedEnded))
        return persist(self, work, kept)

    patch(PrepareHandler, "_persist", wrong)


def finishes_before_it_is_kept(patch: Patch) -> None:
    """A participant says finished while the disk still works on it."""
    on_finish = PrepareHandler.on_finish

    def wrong(self: PrepareHandler, message: Any, reply_to: int) -> Any:
        yield from on_finish(self, message, reply_to)
        for work in self._at_store.values():
            if work.record.lock == message.lock:
                replies, work.replies = work.replies, []
                for reply in replies:
                    yield Reply(reply, Finished(message.lock))

    patch(PrepareHandler, "on_finish", wrong)


def forgets_decisions_too_early(patch: Patch) -> None:
    """A primary forgets its decision when the first participant has finished."""
    finished = Decisions.finished

    def wrong(self: Decisions, lock: Any, shard: str) -> Any:
        if lock in self.by_lock:
            self.by_lock[lock].left = {shard: None}
        yield from finished(self, lock, shard)

    patch(Decisions, "finished", wrong)


def aborts_what_the_disk_works_on(patch: Patch) -> None:
    """A primary says that it never will while its disk works on the decision."""
    resolved = PrepareHandler._resolved

    def wrong(self: PrepareHandler, message: Any) -> Any:
        answer = resolved(self, message)
        tenure = self._state.tenures.by_lock.get(message.lock)
        if answer.kind == "open" and tenure is not None and tenure.committing:
            return replace(answer, kind="aborted")
        return answer

    patch(PrepareHandler, "_resolved", wrong)


def stamps_before_what_was_promised(patch: Patch) -> None:
    """A participant's stamp may lie before what its views were told."""
    finish = PrepareHandler._finish

    def wrong(self: PrepareHandler, tenure: Any, position: Any, replies: Any) -> Any:
        record = tenure.prepared
        tenure.prepared = replace(record, stamp_ns=0)
        yield from finish(
            self, tenure, position._replace(stamp_ns=record.stamp_ns - 10**6), replies
        )

    patch(PrepareHandler, "_finish", wrong)
