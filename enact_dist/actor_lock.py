"""The lock of one update: indexed by what the actor class declares.

`update` says `lock[self.observed]`; the lock itself is made of bound requests, which name a world
context instead of a role and the triggering entity instead of a pattern.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from enact_dist.lock import Lock
from enact_dist.reading import slot_of
from enact_dist.terms import Entity, LockRequest, World
from enact_dist.together import Together

if TYPE_CHECKING:
    import threading
    from collections.abc import Mapping

    from enact_dist.core.messages import Item

T = TypeVar("T")


class ActorLock(Lock):
    """A lock that translates the requests of an actor class into its own.

    Only requests that name a role are translated: by name alone a role `online` that is bound to
    the context `training` could not be told from the context `online`.

    Args:
        bound: Each declared request with what it stands for in this update.
        entity: The triggering entity, if there is one.
        wait_s: As for `Lock`.
        hold_s: As for `Lock`.
        stop: Ends the waiting for the lock within 0.2 s once it is set.
        together: The set that triggers the actor, if one does.
        captured_ns: Its capture stamp.
    """

    def __init__(
        self,
        bound: Mapping[LockRequest[Any], LockRequest[Any]],
        *,
        entity: Entity | None,
        wait_s: float,
        hold_s: float,
        stop: threading.Event | None = None,
        together: Together[Any] | None = None,
        captured_ns: int = 0,
    ) -> None:
        super().__init__(*bound.values(), wait_s=wait_s, hold_s=hold_s)
        self._interrupt = stop
        self._entity = entity
        self._bound = bound
        self._together = together
        self._captured_ns = captured_ns
        views = together.requests if together is not None else ()
        self._in_set: dict[Any, None] = {bound[view]: None for view in views}

    def _item_of(self, request: LockRequest[Any]) -> Item:
        captured_ns = self._captured_ns if request in self._in_set else 0
        return self._session.item_of(request, captured_ns)

    def missing(self) -> list[int]:
        """Return which data of the set were outside retention at the grant, by their index."""
        return [index for index, view in enumerate(self._in_set) if self._is_null(slot_of(view))]

    def _own(self, request: Any) -> Any:
        if isinstance(request, LockRequest) and isinstance(request.world, World):
            return self._bound.get(request, request)
        return request

    def granted_states(self, declared: LockRequest[Any]) -> dict[Entity, tuple[int, int]]:
        """Return version and commit stamp (ns) of what a declared request showed at the grant."""
        request = self._own(declared)
        slots = self._readings.matching(request) if request.access.each else [slot_of(request)]
        states = {slot: self._readings.state(slot) for slot in slots}
        return {
            Entity(slot.entity): (state.version, state.stamp_ns)
            for slot, state in states.items()
            if state is not None
        }

    def __getitem__(self, request: Any) -> Any:
        if isinstance(request, Together) and request == self._together:
            self._use()
            self._readings.fetch(slot_of(view) for view in self._in_set)  # all are asked for
            return tuple([super(ActorLock, self).__getitem__(view) for view in self._in_set])
        return super().__getitem__(self._own(request))

    def get(self, request: LockRequest[Any], default: Any = None) -> Any:
        """`Lock.get` of a declared request."""
        return super().get(self._own(request), default)

    def put(self, request: LockRequest[T], datum: T, *, stamp_ns: int = 0) -> None:
        """`Lock.put` of a declared request."""
        super().put(self._own(request), datum, stamp_ns=stamp_ns)

    def __delitem__(self, request: LockRequest[Any]) -> None:
        super().__delitem__(self._own(request))

    def expect(self, view: LockRequest[Any]) -> None:
        """`Lock.expect` of a declared request."""
        super().expect(self._own(view))

    def is_null(self, request: LockRequest[Any]) -> bool:
        """`Lock.is_null` of a declared request."""
        return super().is_null(self._own(request))

    def version(self, request: LockRequest[Any]) -> int:
        """`Lock.version` of a declared request."""
        return super().version(self._own(request))

    def stamp_ns(self, request: LockRequest[Any] | Together[Any]) -> int:
        """`Lock.stamp_ns` of a declared request, or the capture stamp of the set."""
        if isinstance(request, Together) and request == self._together:
            return self._captured_ns
        return super().stamp_ns(self._own(request))
