"""Small wrong edits of what keeps grants between two locks; the simulator must catch each.

Those of the clients' steps replace what the simulated client does in the place of
`link.client.locks`; the shard's are edits of the real core and of the real `ShardMarks`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.client.client import Client
from enact_dist.core.client.kept import Keeping, KeptGrant, OwnGrants
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import FAR
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.grants import Tenures
from enact_dist.core.state.tenure import KeptGrants
from enact_dist.link.memory.use_marks import ShardMarks
from enact_dist.verify.simulation.hosts.keeping import KeptLocks, SimulatedMarks

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def revokes_what_is_in_use(patch: Patch) -> None:
    """A shard takes a kept grant back without asking for its mark."""

    def wrong(self: ShardMarks, session: str, number: int) -> bool:
        self.over(session, number)
        return True

    patch(ShardMarks, "recall", wrong)


def asks_before_it_clears(patch: Patch) -> None:
    """A shard asks for the mark, and clears the cell afterwards."""

    def wrong(self: ShardMarks, session: str, number: int) -> bool:
        used = self.used(session, number)
        self.over(session, number)
        return not used

    patch(ShardMarks, "recall", wrong)


def begins_without_a_look(patch: Patch) -> None:
    """A client takes the mark of a kept grant and does not look at its cell."""
    patch(KeptLocks, "_may_begin", staticmethod(lambda _grant, _page: True))


def stays_without_a_look(patch: Patch) -> None:
    """A client does not look at the cell after a block, nor does its shard look again."""
    patch(KeptLocks, "_may_stay", staticmethod(lambda _grant, _page: True))
    patch(KeptGrants, "end_unused", lambda _kept: None)


def begins_without_belief(patch: Patch) -> None:
    """A client begins a lock under a kept grant whose lease may have ended."""
    begin_kept = Client.begin_kept

    def wrong(self: Client, lane: int, grant: KeptGrant, *, now_ns: int, hold_ns: int) -> Any:
        until_ns = grant.until_ns
        grant.until_ns = max(until_ns, now_ns + 1)
        lock = begin_kept(self, lane, grant, now_ns=now_ns, hold_ns=hold_ns)
        grant.until_ns = until_ns
        if lock is not None:
            lock.parts[0].until_ns = until_ns
        return lock

    patch(Client, "begin_kept", wrong)


def takes_late_copies(patch: Patch) -> None:
    """Under a kept grant any seq commits, also one that is older than its lane's newest."""
    fence = Commits._fence

    def wrong(self: Commits, lock: Any, token: Any, tenure: Any) -> Any:
        if tenure is not None and tenure.kept and tenure.token == token:
            session = self._sessions.by_id.get(lock.session)
            if session is not None and session.present:
                return None
        return fence(self, lock, token, tenure)

    patch(Commits, "_fence", wrong)


def stays_after_no_answer(patch: Patch) -> None:
    """A client keeps its grant after a commit of which it has heard nothing."""

    def wrong(self: Keeping, phase: Phase, *_: Any, sent: bool) -> bool:
        return self.grant is not None and phase is not Phase.COMMITTED and not sent

    patch(Keeping, "ends", wrong)


def keeps_from_who_waits(patch: Patch) -> None:
    """A grant stays though somebody waits for what it holds."""
    stays = KeptGrants.stays

    def wrong(self: KeptGrants, tenure: Any, **options: Any) -> int:
        return stays(self, tenure, **{**options, "awaited": False})

    patch(KeptGrants, "stays", wrong)


def shows_what_it_has_overwritten(patch: Patch) -> None:
    """A client's own commit does not change what its kept grant shows."""
    patch(KeptGrant, "committed", lambda _grant, _writes, _versions, _stamp_ns: None)


def keeps_grants_of_an_old_epoch(patch: Patch) -> None:
    """Kept grants, and the pages where they are looked up, outlive a restart of their shard."""
    begin_kept, page = Client.begin_kept, KeptLocks.page
    old: dict[tuple[int, str, int], Any] = {}

    def wrong(self: Client, lane: int, grant: KeptGrant, **options: Any) -> Any:
        peer = self.peer(grant.shard)
        epoch, peer.epoch = peer.epoch, grant.token.epoch
        lock = begin_kept(self, lane, grant, **options)
        peer.epoch = epoch
        return lock

    def looked_up(self: KeptLocks, shard: str, epoch: int) -> Any:
        found = page(self, shard, epoch)
        return (
            old.setdefault((id(self), shard, epoch), found)
            if found
            else old.get((id(self), shard, epoch))
        )

    patch(OwnGrants, "drop", lambda _kept, _shard: None)
    patch(Client, "begin_kept", wrong)
    patch(KeptLocks, "page", looked_up)
    leaves_pages_of_an_earlier_start(patch)


def leaves_pages_of_an_earlier_start(patch: Patch) -> None:
    """A shard that starts does not clear the cells of the start before."""
    patch(SimulatedMarks, "sweep", lambda marks: setattr(marks, "gone", True))


def leaves_cells_set(patch: Patch) -> None:
    """A kept grant that ends otherwise than by a recall leaves its cell as it was."""
    patch(ShardMarks, "over", lambda _marks, _session, _number: None)


def takes_kept_grants_for_work(patch: Patch) -> None:
    """The drafts of a session stay as long as it keeps a grant, used or not."""
    patch(Tenures, "works", lambda tenures, session: session in tenures.by_session)


def word_ends_what_a_block_uses(patch: Patch) -> None:
    """A client that hears of a recall gives a far grant back under its block."""
    hear = OwnGrants.hear
    patch(OwnGrants, "hear", lambda kept, shard, left, _used: hear(kept, shard, left, set()))


def far_grants_are_revoked(patch: Patch) -> None:
    """A shard takes far grants back at once, as if it could see whether a block uses them."""
    recall = KeptGrants.recall

    def wrong(kept: KeptGrants, tenure: Any, *, now_ns: int) -> None:
        recall(kept, tenure, now_ns=now_ns)
        if tenure.recalled and tenure.kept == FAR and not tenure.committing:
            kept._end(tenure)

    patch(KeptGrants, "recall", wrong)


def gives_back_and_keeps(patch: Patch) -> None:
    """A client gives back what it has heard of, and begins further blocks under it."""
    hear = OwnGrants.hear

    def wrong(kept: OwnGrants, shard: str, left: Any, used: Any) -> None:
        before = dict(kept.by_items)
        hear(kept, shard, left, used)
        kept.by_items.update(before)

    patch(OwnGrants, "hear", wrong)
