"""The lock of one update: indexed by what the actor class declares.

`update` says `lock[self.observed]`; the lock itself is made of bound requests, which name a world
context instead of a role and the triggering entity instead of a pattern.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

from enact_dist.access.lock import Lock
from enact_dist.access.reads import slot_of
from enact_dist.access.together import Together
from enact_dist.access.writes import Asked, Writing
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.errors import LeaseLostError, MisuseError
from enact_dist.terms import Aspect, Entity, LockRequest, LockRequestOne, View, World, Write
from enact_dist.wire.payload import Encoded, decode_datum

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from enact_dist.access.trigger import Newer
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.messages import DatumRead, Item
    from enact_dist.outcome import Outcome


R = TypeVar("R", bound=LockRequest[Any])


class ActorLock(Lock):
    """A lock that translates the requests of an actor class into its own.

    Only requests that name a role are translated: by name alone a role `online` that is bound to
    the context `training` could not be distinguished from the context `online`.

    Args:
        bound: Each declared request with its bound form in this update.
        entity: The triggering entity, if there is one.
        wait_s: As for `Lock`.
        hold_s: As for `Lock`.
        stop: Ends the waiting for the lock within 0.2 s once it is set.
        together: The set that triggers the actor, if one does.
        members: The capture stamp of each of its data, 0 of those that are missing.
        tick_ns: The tick of `every_s` that it is for, 0 if it is for none.
        triggers: The declared requests that trigger the actor.
        after: What the actor has seen: the lock waits until one of these slots shows a newer datum.
        shown: All that it views, as notices have shown it, so that it needs no call.
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
        members: Sequence[int] = (),
        tick_ns: int = 0,
        triggers: Sequence[LockRequest[Any]] = (),
        after: tuple[DatumRead, ...] = (),
        shown: tuple[Reading, ...] = (),
    ) -> None:
        super().__init__(*bound.values(), wait_s=wait_s, hold_s=hold_s)
        self._after = after
        # While this refers to the maps of large data, they can be looked at without a call.
        self._maps = self._mapped(shown) if shown else ()
        self._shown = shown if self._maps is not None else ()
        self._interrupt = stop
        self._entity = entity
        self._declared = bound
        self._together = together
        self._captured_ns = min(filter(None, members), default=0)
        self._tick_ns = tick_ns
        self._triggers = triggers
        stamps = together.stamps(members) if together is not None else {}
        self._in_set: dict[Any, int] = {bound[view]: stamp for view, stamp in stamps.items()}

    def __enter__(self) -> Self:
        super().__enter__()
        if self._after and self._lock is not None:  # the time before the news is no waiting
            self._asked_s = self._granted_s - self._lock.waited_ns / 1e9
        return self

    def _mapped(self, shown: Sequence[Reading]) -> tuple[memoryview, ...] | None:
        """Return maps of those of the data that are only named; None if one is gone."""
        maps, payloads = list[memoryview](), self._session.client.payloads
        for shard, epoch, state in shown:
            if state.large and state.datum is not None:
                body = payloads.mapped(shard, epoch, state.datum.file, state.size)
                if body is None:
                    return None
                maps.append(body)
        return tuple(maps)

    def _let_go(self) -> None:
        self._maps = ()
        super()._let_go()

    def _items(self) -> tuple[Item, ...]:
        if self._shown:
            return ()
        if not self._in_set:
            return super()._items()
        of, stamps = self._session.item_of, self._in_set
        return tuple([of(request, stamps.get(request, 0)) for request in self._requests])

    @property
    def missing(self) -> tuple[View[Any], ...]:
        """The data of the actor's set that it runs without, as declared; see `Together`."""
        if self._together is None:
            return super().missing
        return tuple(self._together.requests[index] for index in self.absent())

    def absent(self) -> list[int]:
        """Return which data of the set are null at the grant, by their index."""
        return [index for index, view in enumerate(self._in_set) if self._is_null(slot_of(view))]

    def _stamp(self, stamp_ns: int | None) -> int:
        if stamp_ns is not None:
            return stamp_ns
        return self._captured_ns or self._tick_ns or self._stamp_of_triggers()

    def _stamp_of_triggers(self) -> int:
        """Return the newest capture stamp of the data that trigger this update; 0 of none."""
        states = map(self._readings.state, map(self._slot_of_trigger, self._triggers))
        return max((state.captured_ns for state in states if state is not None), default=0)

    def _slot_of_trigger(self, declared: LockRequest[Any]) -> Slot:
        request = self._resolve(declared)
        if isinstance(request.entity, Entity):
            return slot_of(request)
        context, _, aspect = request.address
        return Slot(context, self.entity.name, aspect)

    def _resolve(self, request: R) -> R:
        """Return the bound form of a declared request in this update."""
        if isinstance(request, LockRequest) and isinstance(request.world, World):
            return cast("R", self._declared.get(request, request))
        return request

    def granted_states(self, declared: LockRequest[Any]) -> dict[Entity, tuple[int, int]]:
        """Return version and commit stamp (ns) of what a declared request showed at the grant."""
        request = self._resolve(declared)
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
            absent = set(self.absent())
            return tuple(
                [
                    None if index in absent else super(ActorLock, self).__getitem__(view)
                    for index, view in enumerate(self._in_set)
                ]
            )
        return super().__getitem__(request)

    def stamp_ns(self, request: LockRequestOne[Any] | Together[Any]) -> int:
        """`Lock.stamp_ns` of a declared request, or the capture stamp of the set."""
        if isinstance(request, Together) and request == self._together:
            return self._captured_ns
        return super().stamp_ns(request)


class _Collected(Writing):
    """What an update writes while it holds no lock: kept until the outcome is written."""

    def put(self, slot: Slot, encoded: Encoded, shard_of: Callable[[Slot], str]) -> None:
        """Keep a value for the outcome's commit."""
        self.data[slot] = encoded.datum()

    def delete(self, slot: Slot) -> None:
        """Keep that a slot is to be null."""
        self.data[slot] = None

    def new(self, slot: Slot, asked: Asked, shard_of: Callable[[Slot], str]) -> Any:
        """Refuse to hand out memory of a shard: no lock holds it."""
        raise MisuseError(
            f"new() of {slot.entity}/{slot.aspect}: an update with once = True holds no lock, so it"
            " cannot fill a datum in place; create an array and put() it"
        )


class OnceLock(ActorLock):
    """The lock of an update that acts at most once: held only while a version is claimed.

    While it is held it is the lock of any update; `begin` is called after its commit, and from
    there on the same object shows what was seen at the grant, holds nothing, and collects what is
    written.
    """

    _outcome: Write[Outcome] | None = None
    _taken: Outcome | None = None
    _keeps = _lost = False

    def own(self, declared: Write[Outcome]) -> Write[Outcome]:
        """Return the bound form of the declared request of the outcomes."""
        return self._resolve(declared)

    def keep(self) -> None:
        """Fetch all that the update may look at; called while the lock is held."""
        self._keeps = True
        for request in self._requests:
            if request.access.each:
                dict(self[request])
            elif not self._is_null(slot_of(request)):
                self[request]

    def begin(self, outcome: Write[Outcome], taken: Outcome, newer: Newer) -> None:
        """Let `update` act on the claimed version; the lock has been released."""
        self._outcome, self._taken, self._newer = outcome, taken, newer
        self._writing = _Collected(self._session.client.payloads)

    def end(self) -> None:
        """Free the data: the update has ended, or the version was not claimed."""
        self._taken = None
        if self._lock is not None:  # else it was never granted
            super()._let_go()

    def written(self) -> Iterator[tuple[Write[Any], Any, int]]:
        """Yield what the update has written: request, value or None for null, capture stamp."""
        requests = {slot_of(one): one for one in self._requests if isinstance(one, Write)}
        for slot, datum in self._writing.data.items():
            request = requests[slot]
            if datum is None:
                yield request, None, 0
            else:
                yield request, _value(datum, request.aspect), datum.stamp_ns

    def _let_go(self) -> None:
        if not self._keeps:
            super()._let_go()

    def _use(self) -> None:
        if self._taken is None:
            super()._use()

    def _put(self, slot: Slot, aspect: Aspect[Any], datum: Any, stamp_ns: int | None) -> None:
        if self._taken is not None and self._outcome is not None and slot == slot_of(self._outcome):
            raise MisuseError(
                f"the framework writes {self._outcome!r} when the update ends; raise an exception"
                " to report a failure, and write other results to another aspect"
            )
        super()._put(slot, aspect, datum, stamp_ns)

    def expect(self, view: Any) -> None:
        """Refuse: an update with ``once = True`` does not commit under this lock."""
        if self._taken is not None:
            raise MisuseError("an update with once = True holds no lock and cannot expect a View")
        super().expect(view)

    def valid(self) -> bool:
        """Whether the actor may go on, as far as is known; while it is held, as `Lock.valid`."""
        return not self._lost if self._taken is not None else super().valid()

    def check(self) -> None:
        """Ask the shard whether this process still holds the version.

        Raises:
            LeaseLostError: Another process concluded that this one had ended, and wrote an outcome.
        """
        if self._taken is None or self._outcome is None:
            super().check()
            return
        view = View(self._outcome.world, self._outcome.entity, self._outcome.aspect)
        with Lock(view, wait_s=self._wait_s) as lock:
            found = lock.get(view)
        if found != self._taken:
            self._lost = True
            raise LeaseLostError(f"{self._outcome!r} is now {found!r}", cause="taken over")


def _value(datum: Datum, aspect: Aspect[Any]) -> Any:
    return decode_datum(datum, aspect.datum_type)
