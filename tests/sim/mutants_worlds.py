"""Small wrong edits of lineage, forks and drops; the simulator catches each."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from enact_dist.core.protocol.messages import DropWorld
from enact_dist.core.protocol.records import Persist, Publish
from enact_dist.core.shard import on_prepare as prepares
from enact_dist.core.shard.on_world import WorldHandler, _Making
from enact_dist.core.shard.state import ShardState
from enact_dist.core.state.commits import Commits
from enact_dist.core.state.sessions import SessionState
from enact_dist.core.state.slots import SlotMap

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


# ---------------------------------------------------------------- lineage


def names_the_lock_before(patch: Patch) -> None:
    """A version names the lock that committed before its own one."""
    cause_of, last = SessionState.cause, []

    def wrong(*args: Any) -> Any:
        last.append(cause_of(*args))
        return last[-2] if len(last) > 1 else last[0]

    patch(SessionState, "cause", wrong)


def leaves_out_a_read(patch: Patch) -> None:
    """The first datum that a lock has read is not told with its commit."""
    cause_of = SessionState.cause

    def wrong(*args: Any) -> Any:
        cause = cause_of(*args)
        return cause._replace(reads=cause.reads[1:])

    patch(SessionState, "cause", wrong)


def prepares_without_a_cause(patch: Patch) -> None:
    """What was prepared is written without saying why."""
    patch(prepares, "_decided_cause", lambda _record, **_options: None)


def causes_bear_the_stamp_of_the_promise(patch: Patch) -> None:
    """The cause of what was prepared has the stamp of its promise, not that of the decision."""
    patch(prepares, "_decided_cause", lambda record, **_options: record.cause)


def causes_are_not_kept(patch: Patch) -> None:
    """The disk keeps versions without their causes."""
    records = Commits.records

    def wrong(self: Commits, *args: Any) -> Any:
        kept = records(self, *args)
        return tuple(replace(r, cause=None) if hasattr(r, "cause") else r for r in kept)

    patch(Commits, "records", wrong)


# ---------------------------------------------------------------- forks and drops


def forks_the_present(patch: Patch) -> None:
    """A fork has the newest data of its source, as of whatever stamp it was asked."""
    patch(SlotMap, "as_of", lambda slots, slot, _at_ns: slots[slot])


def forks_before_the_undecided(patch: Patch) -> None:
    """A fork does not wait for commits that may still become a part of it."""
    patch(WorldHandler, "_undecided", lambda _handler, _message: False)


def forks_at_a_moment_of_its_own(patch: Patch) -> None:
    """Each shard stamps its part of a fork with its own present."""
    init = _Making.__init__

    def wrong(self: _Making, state: Any, message: Any) -> None:
        init(self, state, replace(message, at_ns=state.stamp()))

    patch(_Making, "__init__", wrong)


def tells_of_forks_too_early(patch: Patch) -> None:
    """A fork is used and told while the disk still works on it."""
    make = WorldHandler._make

    def wrong(self: WorldHandler, act: Any) -> Any:
        for effect in make(self, act):
            if isinstance(effect, Persist):
                yield replace(effect, ticket=0)
                yield from self._state.persisted(effect.ticket)
            else:
                yield effect

    patch(WorldHandler, "_make", wrong)


def forks_name_no_source(patch: Patch) -> None:
    """The lineage of a fork ends in itself."""
    shared = _Making.shared

    def wrong(self: _Making, source: Any, content: Any) -> Any:
        slot, new = shared(self, source, content)
        return slot, replace(new, cause=new.cause._replace(reads=()))

    patch(_Making, "shared", wrong)


def starts_versions_again(patch: Patch) -> None:
    """The versions of a context that was dropped start with 1 when it is made again."""
    patch(SlotMap, "version_base", lambda _slots, _context: 0)


def forgets_versions_at_a_restart(patch: Patch) -> None:
    """A restarted shard does not know which versions a dropped context has used."""
    init = SlotMap.__init__

    def wrong(self: SlotMap, *args: Any, **options: Any) -> None:
        init(self, *args, **{**options, "dropped": ()})

    patch(SlotMap, "__init__", wrong)


def drops_under_locks(patch: Patch) -> None:
    """A context is dropped though somebody has a lock in it."""
    refused = WorldHandler._drop_refused

    def wrong(self: WorldHandler, world: str) -> Any:
        answer = refused(self, world)
        return None if getattr(answer, "code", "") == "held" else answer

    patch(WorldHandler, "_drop_refused", wrong)


def drops_in_silence(patch: Patch) -> None:
    """Nobody who watches is told that a context has gone."""
    persisted = WorldHandler._persisted

    def wrong(self: WorldHandler, act: Any, now_ns: int) -> Any:
        commits, drop = self._state.commits, isinstance(act.message, DropWorld)
        number = commits.notice_number
        for effect in persisted(self, act, now_ns):
            if not (drop and isinstance(effect, Publish)):
                yield effect
        if drop:
            commits.notice_number = number

    patch(WorldHandler, "_persisted", wrong)


def drops_half_of_it(patch: Patch) -> None:
    """The slots of one aspect of a dropped context stay."""
    drop = SlotMap.drop

    def wrong(self: SlotMap, context: str) -> Any:
        stays = next((one for one in self.columns() if one.context == context), None)
        kept = self._columns.get(stays)
        gone = drop(self, context)
        if kept is not None:
            self._columns[stays] = kept
        return gone

    patch(SlotMap, "drop", wrong)


def carries_out_late_copies(patch: Patch) -> None:
    """A fork or drop that comes a second time is carried out a second time."""
    patch(ShardState, "answered_before", lambda _state, _message: None)
