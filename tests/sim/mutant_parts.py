"""What wrong edits of several files share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.shard.on_prepare import PrepareHandler

if TYPE_CHECKING:
    from collections.abc import Callable

    Patch = Callable[[Any, str, Any], None]


def forgets_what_ended(patch: Patch) -> None:
    """Keep the handler that asks primaries from stumbling over locks that a mutant ended."""
    for name in ("ask", "undecided"):
        patch(PrepareHandler, name, _without_ended(getattr(PrepareHandler, name)))


def _without_ended(method: Any) -> Any:
    def wrong(self: PrepareHandler) -> Any:
        tenures = self._state.tenures.by_lock
        for lock in [lock for lock in self._ask_ns if lock not in tenures]:
            del self._ask_ns[lock]
        return method(self)

    return wrong
