"""Views without a lock: a consistent snapshot over all shards, read like the data of a lock.

A `Snapshot` has its data from the start; those of a `HeldView` are fetched on demand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar, overload

from enact_dist.access.arguments import Moment, check_argument
from enact_dist.access.asking import ask_all
from enact_dist.access.reads import EachData, Readings, check_requested, slot_of
from enact_dist.access.session import session_of, unknown_aspect
from enact_dist.access.together import Together, captured_versions
from enact_dist.access.watch import Closing
from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import Survey, Surveyed
from enact_dist.errors import LeaseLostError, MisuseError, NullDatumError
from enact_dist.link.client.fetch import fetch_all
from enact_dist.terms import Aspect, Entity, NullReason, View
from enact_dist.wire.limits import ITEMS_MAX
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from enact_dist.access.session import Session
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Item, SlotState
    from enact_dist.terms import Context, LockRequest, LockRequestEach, LockRequestOne

T = TypeVar("T")

NOW: Final = Moment(0)

VIEW_S = 10.0
"""How long a view may last."""
VIEWS_MAX = 3
"""Retries of a view whose data were removed before they were fetched."""


def take_snapshot(asked: tuple[LockRequest[Any] | Together[Any], ...]) -> Snapshot:
    """Take a view of the requested data, and keep it with what was requested."""
    together, requests = _spread(asked)
    readings, captured_ns = take_view(requests, together)
    return Snapshot(readings, requests, captured_ns)


def take_view(
    requests: tuple[LockRequest[Any], ...],
    together: Together[Any] | None = None,
    *,
    register: bool = True,
) -> tuple[Readings, int]:
    """Take a view of the requested data; large data are fetched before this returns.

    Args:
        requests: What to view, with the requests of a set.
        together: The set.
        register: Whether the aspects are checked, and registered where they are new.

    Returns:
        The data, and the capture stamp of the set.
    """
    if not requests:
        raise MisuseError("a view of nothing: name at least one View or ViewEach")
    if len(requests) > ITEMS_MAX:
        raise MisuseError(
            f"a view with {len(requests)} requests; at most {ITEMS_MAX} are allowed. A ViewEach"
            " counts as one request and shows all matching data"
        )
    session = session_of(requests, view=True)
    session.client.check_usable()
    for request in requests:
        if request.access.locks:
            raise MisuseError(f"{request!r} locks; view(…) takes View and ViewEach, or use Lock(…)")
    moment = _moment_of(requests, together)
    prepared = session.prepare(requests) if register else 0
    for attempt in range(1, VIEWS_MAX + 1):
        try:
            members = _newest_set(session, together) if together is not None else ()
            captured_ns = min(filter(None, members), default=0)
            items = _items(session, requests, moment, together, members)
            readings = take_readings(session, items, past_ns=moment.at_ns)
            if register:
                session.check_shown(readings.readings(), requests, prepared)
            if attempt == VIEWS_MAX or together is None or _has_set(readings, together):
                return readings, captured_ns  # what has left retention just now is null in it
        except LeaseLostError:
            # A shard restarted, or the session rested too long, between the view and its data.
            if attempt == VIEWS_MAX:
                raise
    raise AssertionError("a view ends in its data or an error")


def _has_set(readings: Readings, together: Together[Any]) -> bool:
    """Whether a set has as many data as it requires."""
    states = [readings.state(slot_of(view)) for view in together.requests]
    there = sum(state is not None and not state.null_reason for state in states)
    return there >= together.least


def _moment_of(requests: tuple[LockRequest[Any], ...], together: Together[Any] | None) -> Moment:
    """Return the one moment that all requests name.

    Raises:
        MisuseError: They name several, or a set of the past.
    """
    moments: dict[Moment, LockRequest[Any]] = {}
    for request in requests:
        moments.setdefault(getattr(request.world, "moment", NOW), request)
    if len(moments) > 1:
        raise MisuseError(
            "one view shows one moment; take views of their own for"
            f" {' and '.join(repr(request.world) for request in moments.values())}"
        )
    (moment,) = moments
    if together is not None and moment != NOW:
        raise MisuseError(
            f"{together!r} asks for the newest set, which is not past; see an older one with"
            " world.at(stamp_ns=…)"
        )
    return moment


def _items(
    session: Session,
    requests: tuple[LockRequest[Any], ...],
    moment: Moment,
    together: Together[Any] | None,
    members: tuple[int, ...],
) -> list[Item]:
    """Return the protocol's lines for all requests; those of a set ask for its capture stamp."""
    in_set: Mapping[Any, int] = together.stamps(members) if together is not None else {}
    items: list[Item] = []
    for request in requests:
        captured_ns = in_set.get(request, moment.captured_ns)
        if captured_ns and request.access.each:
            items += _items_of_each(session, request, moment)
        else:
            items.append(session.item_of(request, captured_ns, nearest=moment.nearest))
    return items


def _items_of_each(session: Session, request: LockRequest[Any], moment: Moment) -> Iterator[Item]:
    """Yield the lines for a pattern by capture stamp, which is asked slot by slot."""
    context, pattern, aspect = request.address
    for _, state in slot_states(session, context, pattern, (aspect,)):
        view = View(request.world, Entity(state.slot.entity), request.aspect)
        yield session.item_of(view, moment.captured_ns, nearest=moment.nearest)


@dataclass(frozen=True, slots=True)
class SlotInfo:
    """One slot of a world context, without its datum.

    Attributes:
        size_bytes: Length of the datum's body: arrays, texts and bytes over 256 B, long lists; 0
            for everything else.
        null_reason: Why it is null, or the empty string.
        shard: The shard that stores it.
    """

    entity: Entity
    aspect: str
    version: int
    position: Position
    size_bytes: int
    null_reason: str
    shard: str


def slot_info(shard: str, state: SlotState) -> SlotInfo:
    """Return a shard's description of a slot."""
    return SlotInfo(
        Entity(state.slot.entity),
        state.slot.aspect,
        state.version,
        Position(state.stamp_ns, shard),
        state.size,
        reason_of(state),
        shard,
    )


def reason_of(state: SlotState) -> str:
    """Return why a slot is null, as `NullReason` words it; "" if it is not."""
    return NullReason[state.null_reason].value if state.null_reason else ""


def slot_states(
    session: Session, context: str, pattern: str, aspects: tuple[str, ...] = ()
) -> list[tuple[str, SlotState]]:
    """Return the newest states of matching slots, each with its shard, without their data.

    Raises:
        UnknownWorldError: The cell has no such world context.
        ShardUnreachableError: A shard does not answer.
    """
    answers = ask_all(session.client, Surveyed, Survey((context,), (pattern,), aspects))
    found = [(shard, state) for shard, answer in answers for state in answer.states]
    if not found:
        session.check_world(context)
    return found


def _spread(
    asked: tuple[LockRequest[Any] | Together[Any], ...],
) -> tuple[Together[Any] | None, tuple[LockRequest[Any], ...]]:
    """Return the requested set, and all requests, with those of the set at its place."""
    sets = [request for request in asked if isinstance(request, Together)]
    if len(sets) > 1:
        raise MisuseError(f"one view shows one set; take {sets[1]!r} in a view of its own")
    requests: list[LockRequest[Any]] = []
    for request in asked:
        requests += request.requests if isinstance(request, Together) else (request,)
    return (sets[0] if sets else None), tuple(requests)


def _newest_set(session: Session, together: Together[Any]) -> tuple[int, ...]:
    """Return the capture stamps of the data of the newest set that may run; 0 of those missing."""
    versions = captured_versions(session, together.requests)
    members = together.newest(versions)
    if not members:
        found = "; ".join(
            f"{slot_of(request)} has {sorted({one.captured_ns for one in each})[-3:] or 'none'}"
            for request, each in zip(together.requests, versions, strict=True)
        )
        raise NullDatumError(
            f"no capture stamp is common to all {len(versions)} data (newest stamps, 0 is unknown:"
            f" {found}); write with lock.put(…, stamp_ns=…), and let the aspects retain as many"
            " versions as are under way at once",
            reason=NullReason.OUTSIDE_RETENTION.value,
        )
    return members


def take_readings(
    session: Session, items: list[Item], *, past_ns: int = 0, data: bool = True
) -> Readings:
    """Take one view, as of a timestamp if one is given, and fetch its large `data`."""
    client = session.client
    lock = client.acquire(items, wait_s=client.request_timeout_s, hold_s=VIEW_S, past_ns=past_ns)
    try:
        readings = Readings(client, session.cache, lock.lock, lock.states, lambda: None)
        if data:
            readings.keep_all()
        client.finish(lock, {})
    finally:
        client.release(lock)
    return readings


class HeldView(Closing):
    """Slots as of one moment; their data can be fetched until it is closed.  Used by one thread.

    Small data arrive with the states (up to 8 MiB per shard), large ones are fetched on demand,
    even if newer ones are committed meanwhile.

    Args:
        session: The session that takes the view.
        items: The slots and patterns to view.
        past_ns: The timestamp to view; 0 is the present.

    Attributes:
        states: What was found, each with its shard and epoch.
        locks: Whether read locks replaced a consistent snapshot, because commits came too fast.

    Raises:
        ForgottenError: A state as of `past_ns` has left its retention.
        LockTimeoutError: No consistent view came within `request_timeout_s`, or a commit with an
            earlier timestamp is still undecided.
        ShardUnreachableError: A shard does not answer.
    """

    def __init__(self, session: Session, items: Iterable[Item], *, past_ns: int = 0) -> None:
        client = session.client
        self.session = session
        self._lock = client.acquire(
            items, wait_s=client.request_timeout_s, hold_s=VIEW_S, past_ns=past_ns
        )
        self.states: tuple[Reading, ...] = tuple(self._lock.states)
        self.locks = bool(self._lock.parts)

    def fetch(self, readings: Iterable[Reading]) -> dict[Slot, Datum]:
        """Return the data of some of the states that are not null.

        Raises:
            LeaseLostError: A shard restarted, or the session rested too long: view again.
            ShardUnreachableError: A shard does not answer.
        """
        client, lock = self.session.client, self._lock.lock
        return fetch_all(client, self.session.cache, lock, readings, client.check_usable)

    def close(self) -> None:
        """Release the data; twice is harmless."""
        self.session.client.release(self._lock)


class Snapshot:
    """Data as of one view, indexed by the requests it was made with.

    Attributes:
        captured_ns: The capture stamp of its `Together`; 0 if none was requested.
    """

    def __init__(
        self,
        readings: Readings,
        requests: tuple[LockRequest[Any], ...],
        captured_ns: int = 0,
    ) -> None:
        self._readings = readings
        self._requests = {request: request for request in requests}
        self.captured_ns = captured_ns

    @overload
    def __getitem__(self, request: Together[T]) -> tuple[T, ...]: ...
    @overload
    def __getitem__(self, request: LockRequestEach[T]) -> EachData[T]: ...
    @overload
    def __getitem__(self, request: LockRequestOne[T]) -> T: ...
    def __getitem__(self, request: LockRequest[Any] | Together[Any]) -> Any:
        """Return the datum; for a pattern, the data by entity; for a set, its data in order.

        Raises:
            NullDatumError: The world context does not know it.
            NotRequestedError: The view did not ask for it.
        """
        if isinstance(request, Together):
            whole = request.least == len(request.requests)
            return tuple(self[one] if whole else self.get(one) for one in request.requests)
        check_requested(request, self._requests, "view")
        if request.access.each:
            return EachData(self._readings, request)
        return self._readings.value(slot_of(request), request.aspect)

    @overload
    def get(self, request: LockRequestOne[T]) -> T | None: ...
    @overload
    def get(self, request: LockRequestOne[T], default: T) -> T: ...
    def get(self, request: LockRequestOne[T], default: T | None = None) -> T | None:
        """Return the datum, or `default` if the world context does not know it."""
        try:
            return self[request]
        except NullDatumError:
            return default

    def version(self, request: LockRequestOne[Any]) -> int:
        """Return the version of the viewed datum (0: never set)."""
        check_requested(request, self._requests, "view")
        state = self._readings.state(slot_of(request))
        return state.version if state is not None else 0

    def __repr__(self) -> str:
        return f"Snapshot({', '.join(map(repr, self._requests))})"


def untyped_datum(context: Context, session: Session, entity: Entity, aspect: str) -> object:
    """Return a datum without knowing its Python type; see `WorldContext.get_untyped`."""
    check_argument("get_untyped(entity, aspect)", "entity", entity, Entity)
    check_argument("get_untyped(entity, aspect)", "aspect", aspect, str)
    if aspect not in session.client.aspect_entries():
        session.client.greet()
    known = session.client.aspect_entries()
    if aspect not in known:
        raise unknown_aspect(aspect, known)
    request = View(context, entity, Aspect(aspect, object))
    readings, _ = take_view((request,), register=False)
    slot = slot_of(request)
    state = readings.state(slot)
    if state is None or state.null_reason:
        raise readings.null_error(slot)
    return decode_untyped(readings.datum(slot))
