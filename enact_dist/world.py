"""A world context as its user sees it: initial data, views without locks, watches, listings.

A world context W maps (entity, aspect) to a datum or null (ENACT 3.2); `WorldContext` is the
handle, the map itself lies on the shards.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, overload

from enact_dist.core.datum import Position
from enact_dist.core.messages import Survey, Surveyed
from enact_dist.errors import LeaseLostError, MisuseError, NullDatumError, ProtocolError
from enact_dist.lock import Lock, refuse_inside_lock
from enact_dist.reading import EachData, Readings, check_requested, null_error, slot_of
from enact_dist.session import session_of
from enact_dist.terms import Aspect, Context, Entities, Entity, NullReason, View, Write
from enact_dist.together import Together, captured_versions, newest_set_ns
from enact_dist.watch import Watch
from enact_dist.wire.limits import ITEMS_MAX

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.core.messages import Item, SlotState
    from enact_dist.session import Session
    from enact_dist.terms import LockRequest, LockRequestEach, LockRequestOne

T = TypeVar("T")

VIEW_WAIT_S = 10.0
"""How long a view waits for its shards before they count as unreachable."""
VIEWS_MAX = 3
"""How often a view is taken anew when its data are gone before they were fetched."""


@dataclass(frozen=True, slots=True)
class SlotInfo:
    """One slot of a world context, without its datum.

    Attributes:
        size_bytes: Length of the datum's buffers; 0 for null and for plain numbers.
        null_reason: Why it is null, or the empty string.
        shard: Where it lies.
    """

    entity: Entity
    aspect: str
    version: int
    position: Position
    size_bytes: int
    null_reason: str
    shard: str


class WorldContext(Context):
    """A named map from (entity, aspect) to a datum; made by `Cell.world`."""

    __slots__ = ("session",)

    def __init__(self, name: str, session: Session) -> None:
        super().__init__(name)
        self.session = session

    def init(self, entity: Entity, aspect: Aspect[T], datum: T) -> bool:
        """Set a datum where there is none; from here on only through a lock (ENACT 3.3).

        Args:
            entity: The entity; it exists from here on.
            aspect: The aspect.
            datum: The initial value; arrays are copied, as nobody can take them away in Python.

        Returns:
            Whether this call set it; False leaves the datum that was there.  One that was deleted,
            or lost with a volatile shard, is set anew.

        Raises:
            LockHeldError: This thread holds a lock.
            DatumTypeError: The datum is not of the aspect's type.
        """
        refuse_inside_lock("init")
        request = Write(self, entity, aspect)
        with Lock(request) as lock:
            if not lock.is_null(request):
                return False
            lock[request] = datum
        return True

    def view(self, *requests: LockRequest[Any] | Together[Any]) -> Snapshot:
        """Read committed data without a lock.

        All data are of one moment, over shards too: every commit is shown whole or not at all.

        Args:
            requests: `View`s and `ViewEach`es of this cell, and at most one `Together`: then the
                newest set of it that is complete is shown, and the rest as it is now.

        Raises:
            LockHeldError: This thread holds a lock; name the views in it instead.
            MisuseError: A request locks.
            NullDatumError: The `Together` has no complete set.
        """
        refuse_inside_lock("view")
        return take_snapshot(requests)

    def watch(self, entities: Entities | Entity | str, *aspects: Aspect[Any]) -> Watch:
        """Follow the changes of matching slots: what is there now, then every change in order.

        Args:
            entities: A pattern or one entity.
            aspects: Which aspects; none means all.

        Raises:
            LockHeldError: This thread holds a lock.
        """
        refuse_inside_lock("watch")
        return self.watch_all((str(entities),), aspects)

    def watch_all(self, patterns: Iterable[str], aspects: Iterable[Aspect[Any]]) -> Watch:
        """Follow several patterns with one watch; as `watch`, for the framework."""
        self.session.client.check_usable()
        aspects = tuple(aspects)
        if aspects:
            self.session.register_aspects(aspects)
        names = tuple(aspect.name for aspect in aspects)
        return Watch(self.session.client, (self.name,), tuple(patterns), names)

    def survey(
        self, entities: Entities | str = "**", aspects: tuple[str, ...] = ()
    ) -> tuple[SlotInfo, ...]:
        """List the slots that match, null ones too, without their data.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        client = self.session.client
        request = Survey((self.name,), (str(Entities(str(entities))),), tuple(aspects))
        shards = client.shards()
        found = []
        answers = client.call_all([(shard, request) for shard in shards])
        for shard, answer in zip(shards, answers, strict=True):
            if not isinstance(answer, Surveyed):
                raise ProtocolError(f"{type(answer).__name__} came as the answer to Survey")
            found += [_info(state, shard) for state in answer.states]
        return tuple(sorted(found, key=lambda info: (info.entity, info.aspect)))

    def entities(self, pattern: Entities | str = "**") -> tuple[Entity, ...]:
        """Return the entities that have some datum here."""
        infos = self.survey(pattern)
        return tuple(sorted({info.entity for info in infos if not info.null_reason}))

    def raw(self, entity: Entity, aspect: str) -> object:
        """Return a datum without knowing its Python type: dataclasses come as dicts.

        Raises:
            NullDatumError: It is null.
            MisuseError: No such aspect is registered.
        """
        from enact_dist.wire.payload import decode_untyped

        if aspect not in self.session.client.aspect_entries():
            self.session.client.greet()
        known = self.session.client.aspect_entries()
        if aspect not in known:
            raise MisuseError(
                f"no aspect {aspect!r} is registered; known: {', '.join(sorted(known)) or 'none'}"
            )
        request = View(self, entity, Aspect(aspect, object))
        # Its shard may never have held this aspect; then the datum is null, not the aspect unknown.
        client = self.session.client
        client.register(aspects=[known[aspect]], needed=lambda: self.session.shards_of((request,)))
        snapshot = take_snapshot((request,), register=False)
        return decode_untyped(snapshot.encoded(request))


def _info(state: SlotState, shard: str) -> SlotInfo:
    reason = NullReason[state.null_reason].value if state.null_reason else ""
    return SlotInfo(
        Entity(state.slot.entity),
        state.slot.aspect,
        state.version,
        Position(state.stamp_ns, shard),
        state.size,
        reason,
        shard,
    )


def take_snapshot(
    asked: tuple[LockRequest[Any] | Together[Any], ...], *, register: bool = True
) -> Snapshot:
    """Take a view of what is asked; large data are fetched before this returns."""
    together, requests = _spread(asked)
    if not requests:
        raise MisuseError("a view of nothing: name at least one View or ViewEach")
    if len(requests) > ITEMS_MAX:
        raise MisuseError(f"a view of {len(requests)} requests; at most {ITEMS_MAX}: use ViewEach")
    session = session_of(requests)
    session.client.check_usable()
    for request in requests:
        if request.access.locks:
            raise MisuseError(f"{request!r} locks; view(…) takes View and ViewEach, or use Lock(…)")
    if register:
        aspects = {request.aspect.name: request.aspect for request in requests}
        session.register_aspects(aspects.values(), requests=requests)
    for attempt in range(1, VIEWS_MAX + 1):
        try:
            captured_ns = _newest_set_ns(session, together) if together is not None else 0
            snapshot = Snapshot(
                _view(session, requests, together, captured_ns), requests, together, captured_ns
            )
            if together is None or attempt == VIEWS_MAX or snapshot.has_set():
                return snapshot  # what has left retention just now is null in it
        except LeaseLostError:
            # A shard restarted, or the session rested too long, between the view and its data.
            if attempt == VIEWS_MAX:
                raise
    raise AssertionError("a view ends in its data or an error")


def _spread(
    asked: tuple[LockRequest[Any] | Together[Any], ...],
) -> tuple[Together[Any] | None, tuple[LockRequest[Any], ...]]:
    """Return the set that is asked for, and all requests, those of the set in its place."""
    sets = [request for request in asked if isinstance(request, Together)]
    if len(sets) > 1:
        raise MisuseError(f"one view shows one set; take {sets[1]!r} in a view of its own")
    requests: list[LockRequest[Any]] = []
    for request in asked:
        requests += request.requests if isinstance(request, Together) else (request,)
    return (sets[0] if sets else None), tuple(requests)


def _newest_set_ns(session: Session, together: Together[Any]) -> int:
    """Return the capture stamp of the newest complete set."""
    versions = captured_versions(session, together.requests)
    captured_ns = newest_set_ns(versions)
    if not captured_ns:
        found = "; ".join(
            f"{slot_of(request)} has {sorted({one.captured_ns for one in each})[-3:] or 'none'}"
            for request, each in zip(together.requests, versions, strict=True)
        )
        raise NullDatumError(
            f"no capture stamp is common to all {len(versions)} data (newest stamps, 0 is unsaid:"
            f" {found}); write with lock.put(…, stamp_ns=…), and let the aspects retain as many"
            " versions as are under way at once",
            reason=NullReason.OUTSIDE_RETENTION.value,
        )
    return captured_ns


def _view(
    session: Session,
    requests: tuple[LockRequest[Any], ...],
    together: Together[Any] | None,
    captured_ns: int,
) -> Readings:
    """Take one view and fetch what is large."""
    client = session.client
    in_set = together.requests if together is not None else ()
    items: list[Item] = [
        session.item_of(request, captured_ns if request in in_set else 0) for request in requests
    ]
    lock = client.acquire(items, wait_s=VIEW_WAIT_S, hold_s=VIEW_WAIT_S)
    try:
        readings = Readings(client, session.cache, lock.lock, lock.states, lambda: None)
        readings.keep_all()
        client.finish(lock, {})
    finally:
        client.release(lock)
    return readings


class Snapshot:
    """Data as of one view, indexed by the requests it was made with.

    Attributes:
        captured_ns: The capture stamp of its `Together`, 0 where none was asked for.
    """

    def __init__(
        self,
        readings: Readings,
        requests: tuple[LockRequest[Any], ...],
        together: Together[Any] | None = None,
        captured_ns: int = 0,
    ) -> None:
        self._readings = readings
        self._requests = {request: request for request in requests}
        self._together = together
        self.captured_ns = captured_ns

    def has_set(self) -> bool:
        """Whether no datum of the `Together` is null."""
        requests = self._together.requests if self._together is not None else ()
        states = [self._readings.state(slot_of(request)) for request in requests]
        return all(state is not None and not state.null_reason for state in states)

    @overload
    def __getitem__(self, request: Together[T]) -> tuple[T, ...]: ...
    @overload
    def __getitem__(self, request: LockRequestEach[T]) -> Mapping[Entity, T]: ...
    @overload
    def __getitem__(self, request: LockRequestOne[T]) -> T: ...
    def __getitem__(self, request: LockRequest[Any] | Together[Any]) -> Any:
        """Return the datum; for a pattern, the data by entity; for a set, its data in order.

        Raises:
            NullDatumError: The world context does not know it.
            NotRequestedError: The view did not ask for it.
        """
        if isinstance(request, Together):
            return tuple(self[one] for one in request.requests)
        check_requested(request, self._requests, "view")
        if request.access.each:
            return EachData(self._readings, request)
        return self._readings.value(slot_of(request), request.aspect)

    @overload
    def get(self, request: LockRequestOne[T]) -> T | None: ...
    @overload
    def get(self, request: LockRequestOne[T], default: T) -> T: ...
    def get(self, request: LockRequestOne[T], default: T | None = None) -> T | None:
        """Return the datum, or `default` where the world context does not know it."""
        try:
            return self[request]
        except NullDatumError:
            return default

    def version(self, request: LockRequestOne[Any]) -> int:
        """Return the version of the viewed datum (0: never set)."""
        check_requested(request, self._requests, "view")
        state = self._readings.state(slot_of(request))
        return state.version if state is not None else 0

    def encoded(self, request: LockRequest[Any]) -> Any:
        """Return the encoded datum of one request.

        Raises:
            NullDatumError: The world context does not know it.
        """
        check_requested(request, self._requests, "view")
        slot = slot_of(request)
        state = self._readings.state(slot)
        if state is None or state.null_reason:
            raise null_error(slot, state)
        return self._readings.datum(slot)

    def __repr__(self) -> str:
        return f"Snapshot({', '.join(map(repr, self._requests))})"
