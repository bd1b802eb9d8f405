"""Small wrong edits of locks that wait for news; the simulator must catch each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.shard.on_lock import LockHandler
from enact_dist.core.shard.state import StandingLocks
from enact_dist.verify.simulation.work.standing import StandingActors

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def parks_without_a_look(patch: Patch) -> None:
    """A shard compares at changes only, not when a request comes."""
    begin_standing, has_news = LockHandler.begin_standing, LockHandler._has_news
    at_change: list[LockHandler] = []

    def begins(self: LockHandler, changed: Any) -> Any:
        at_change.append(self)
        effects = begin_standing(self, changed)
        at_change.clear()
        return effects

    patch(LockHandler, "begin_standing", begins)
    patch(
        LockHandler,
        "_has_news",
        lambda handler, message: handler in at_change and has_news(handler, message),
    )


def grants_without_news(patch: Patch) -> None:
    """A lock that waits for news enters the queue at once."""
    patch(LockHandler, "_has_news", lambda _handler, _message: True)


def counts_lost_updates_as_seen(patch: Patch) -> None:
    """What an actor has seen counts as seen, whatever became of its update."""

    def wrong(entry: Any, slot: Any, seen: tuple[int, int]) -> tuple[int, int]:
        states = entry.lock.states if entry is not None else ()
        shown = [(s.state.version, s.state.stamp_ns) for s in states if s.state.slot == slot]
        return shown[0] if shown else seen

    patch(StandingActors, "_shown", staticmethod(wrong))


def leaves_requests_parked(patch: Patch) -> None:
    """A slice of waiting does not end, and a client that hears nothing asks again for ever."""
    patch(StandingLocks, "end_slices", lambda _standing, _now_ns: iter(()))
    patch(StandingLocks, "_end", lambda _standing, _lane: iter(()))
