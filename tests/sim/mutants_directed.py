"""Small wrong edits of the core that only a directed test of `tests/core` catches.

An honest client under the simulator's faults seldom or never gets there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mutant_parts import forgets_what_ended

from enact_dist.core.client.cut import Cut
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.own_commits import Unsettled
from enact_dist.core.protocol.messages import Granted
from enact_dist.core.protocol.records import Persist, PreparedEnded
from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.shard.on_view import ViewHandler
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.grants import Tenures
from enact_dist.core.state.retention import SlotHistory
from enact_dist.core.state.sessions import SessionState, SessionTable
from enact_dist.core.state.slots import SlotMap
from enact_dist.core.state.tenure import KeptGrants
from enact_dist.terms import Durability

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def takes_grants_of_an_old_epoch(patch: Patch) -> None:
    """A client believes in a late grant of an epoch that is over."""
    on_acquiring = MultiLock._on_acquiring

    def wrong(self: MultiLock, shard: str, answer: Any, now_ns: int) -> None:
        if isinstance(answer, Granted):
            answer = replace(answer, epoch=self.client.epoch(shard))
        on_acquiring(self, shard, answer, now_ns)

    patch(MultiLock, "_on_acquiring", wrong)


def leases_end_late(patch: Patch) -> None:
    """A lease ends one nanosecond after its TTL (`<` for `<=`)."""
    lease_end_ns = SessionState.lease_end_ns
    patch(SessionState, "lease_end_ns", lambda session, now_ns: lease_end_ns(session, now_ns) + 1)


def compares_no_token(patch: Patch) -> None:
    """The fence looks whether the lock is held, not under which token."""
    fence = Commits._fence

    def wrong(self: Commits, lock: Any, token: Any, tenure: Any) -> Any:
        held = tenure is not None and tenure.token is not None
        return fence(self, lock, tenure.token if held else token, tenure)

    patch(Commits, "_fence", wrong)


def stalls_count(patch: Patch) -> None:
    """A shard that stood still takes everybody's lease for its own stall."""
    patch(SessionTable, "stalled", lambda _table, _gap_ns: None)
    patch(Tenures, "stalled", lambda _tenures, _gap_ns: None)


def releases_end_a_commit_in_flight(patch: Patch) -> None:
    """A late release takes the lock of a commit that the disk works on."""
    on_release = LockHandler.on_release

    def wrong(self: LockHandler, message: Any, reply_to: int) -> Any:
        tenure = self._state.tenures.by_lock.get(message.lock)
        if tenure is not None and tenure.prepared is None:
            tenure.committing = False
        yield from on_release(self, message, reply_to)

    patch(LockHandler, "on_release", wrong)


def releases_end_what_is_prepared(patch: Patch) -> None:
    """A client's release aborts what is prepared, though its primary may have committed."""
    on_release = LockHandler.on_release

    def wrong(self: LockHandler, message: Any, reply_to: int) -> Any:
        tenure = self._state.tenures.by_lock.get(message.lock)
        if tenure is not None and tenure.prepared is not None and not tenure.committing:
            yield Persist(0, (PreparedEnded(message.lock),), Durability.OS)
            tenure.prepared = None
        yield from on_release(self, message, reply_to)

    patch(LockHandler, "on_release", wrong)
    forgets_what_ended(patch)


def shows_the_present_for_the_past(patch: Patch) -> None:
    """The history shares what it remembers with the present."""
    patch(SlotMap, "at", lambda _slots, _slot, content, _at_ns: content)


def views_do_not_renew(patch: Patch) -> None:
    """A view is counted as seen, but does not lengthen the lease."""
    on_take_view = ViewHandler.on_take_view

    def wrong(self: ViewHandler, message: Any, reply_to: int) -> Any:
        session = self._state.sessions.by_id.get(message.lock.session)
        renewed_ns = session.renewed_ns if session is not None else 0
        yield from on_take_view(self, message, reply_to)
        if session is not None:
            session.renewed_ns = renewed_ns

    patch(ViewHandler, "on_take_view", wrong)


def mixes_past_and_present(patch: Patch) -> None:
    """A view of one shard as of a stamp counts as one of now, whatever it mixes."""
    settled = Cut.settled

    def wrong(self: Cut, *args: Any, **options: Any) -> Any:
        if len(self.items) == 1:
            self.at_ns = 0
        return settled(self, *args, **options)

    patch(Cut, "settled", wrong)


def shows_the_future_by_stamp(patch: Patch) -> None:
    """A view by stamp shows a version that came after the moment of the view."""
    captured = SlotHistory.captured

    def wrong(self: SlotHistory, captured_ns: int, **_options: Any) -> Any:
        return captured(self, captured_ns, version_max=1 << 62)

    patch(SlotHistory, "captured", wrong)


def keeps_captures_of_what_is_gone(patch: Patch) -> None:
    """What has left its retention stays in the index by capture stamp, for ever."""
    patch(SlotHistory, "unindex", lambda _history, _content: None)


def forgets_a_later_commit_of_its_own(patch: Patch) -> None:
    """A client that is told of two commits in the other order waits for the earlier one only."""

    def wrong(self: Unsettled, shard: str, slots: Any, stamp_ns: int) -> None:
        for other in self._slots.setdefault(shard, {}):
            self._slots[shard][other] = stamp_ns
        self._slots[shard].update(dict.fromkeys(slots, stamp_ns))

    patch(Unsettled, "committed", wrong)


def far_hold_limits_count_from_the_recall(patch: Patch) -> None:
    """A shard does not wait for blocks that begin before their client hears of a recall."""
    recall = KeptGrants.recall

    def wrong(kept: KeptGrants, tenure: Any, *, now_ns: int) -> None:
        tenure.unheard_ns = 0
        recall(kept, tenure, now_ns=now_ns)

    patch(KeptGrants, "recall", wrong)


DIRECTED = {
    takes_grants_of_an_old_epoch: "test_grant_of_an_epoch_that_is_over_is_not_taken",
    leases_end_late: "test_lease_ends_exactly_with_its_ttl",
    compares_no_token: "test_forged_token_is_fenced",
    stalls_count: "test_stalled_shard_takes_no_lease_for_its_own_stall",
    releases_end_a_commit_in_flight: "test_lease_does_not_end_a_commit_in_flight",
    releases_end_what_is_prepared: (
        "test_prepared_lock_stays_when_its_client_or_an_operator_ends_it"
    ),
    shows_the_present_for_the_past: "test_view_as_of_the_past_shows_the_past",
    mixes_past_and_present: "test_one_shard_as_of_a_stamp_may_mix_past_and_present",
    shows_the_future_by_stamp: (
        "test_view_as_of_a_commit_stamp_does_not_see_what_was_captured_later"
    ),
    forgets_a_later_commit_of_its_own: (
        "test_own_commit_is_shown_though_an_earlier_one_was_told_later"
    ),
    keeps_captures_of_what_is_gone: "test_history_agrees_with_a_plain_list",
    views_do_not_renew: "test_everything_that_is_counted_renews",
    far_hold_limits_count_from_the_recall: "test_hold_limit_is_longer_by_a_lease",
}
"""Each with the test of `tests/core` that catches it."""
