"""Data that a lock or a view has named: found by request, fetched and decoded on first use.

`Readings` is the part that `Lock` and `Snapshot` share.  A datum is decoded once; arrays in it are
read-only views of the received bytes.

A commit publishes what was assigned, and would miss data that the block changed in place.  Arrays
are read-only, so that numpy says so at once; a list or dict can be changed all the same, also one
inside a dataclass.  So what a block has looked at of such data, and might have written, is compared
with its bytes before the commit (`writes.refuse_changed`).  Numbers, texts and arrays cost nothing:
they are not remembered.  Nor is what has a value of a codec in it: a codec may write the same value
in other bytes each time.
"""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, Mapping, ValuesView
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from enact_dist.config.table import suggestion
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import DatumRead
from enact_dist.errors import (
    DatumTypeError,
    LockReleasedError,
    MisuseError,
    NotRequestedError,
    NullDatumError,
)
from enact_dist.link.client.fetch import CACHED_BYTES_MIN, fetch_all
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access, Aspect, Entity, LockRequest, NullReason
from enact_dist.wire import codecs
from enact_dist.wire.payload import decode_datum
from enact_dist.wire.shapes import (
    CodecOf,
    DictOf,
    ListOf,
    OptionalOf,
    Plain,
    RecordOf,
    TupleOf,
    shape_of,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from enact_dist.core.client.kept import Keeping
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum, LockId, Slot
    from enact_dist.core.protocol.messages import SlotState
    from enact_dist.link.client.fetch import DatumCache
    from enact_dist.link.client.locks import CellClient
    from enact_dist.terms import Aspect, LockRequest

    Single = tuple[Slot, Aspect[Any], bool]
    from enact_dist.wire.shapes import Shape

_changeable: dict[Any, bool] = {}
_lasting: dict[Any, bool] = {}
codecs.changed.append(_changeable.clear)
codecs.changed.append(_lasting.clear)


class ReceivedValue(NamedTuple):
    """A value that a block received, and its datum."""

    value: Any
    datum: Datum
    datum_type: Any


def changeable(datum_type: Any) -> bool:
    """Whether a value of this type can be changed in place: it is, or has, a list or dict."""
    known = _changeable.get(datum_type)
    if known is None:
        parts = list(_parts(shape_of(datum_type)))
        known = any(map(_is_container, parts)) and not any(
            isinstance(part, CodecOf) for part in parts
        )
        _changeable[datum_type] = known
    return known


def _lasts(datum_type: Any) -> bool:
    """Whether no value of this type can be changed at all: a codec may make what can."""
    known = _lasting.get(datum_type)
    if known is None:
        parts = list(_parts(shape_of(datum_type)))
        known = not any(_is_container(part) or isinstance(part, CodecOf) for part in parts)
        _lasting[datum_type] = known
    return known


def _is_container(shape: Shape) -> bool:
    if isinstance(shape, Plain):
        return shape.kind in (list, dict, object)
    return isinstance(shape, ListOf | DictOf)


def _parts(shape: Shape) -> Iterator[Shape]:
    """Yield a shape and all that it is made of."""
    yield shape
    match shape:
        case ListOf(inner) | DictOf(_, inner) | OptionalOf(inner):
            yield from _parts(inner)
        case TupleOf(parts, _):
            for part in parts:
                yield from _parts(part)
        case RecordOf(_, fields):
            for _, part in fields:
                yield from _parts(part)


T = TypeVar("T")

UNSET: Any = object()
_slot_at: Final = partial(tuple.__new__, Slot)
_read_of: Final = partial(tuple.__new__, DatumRead)
"""Make them of parts that were looked at before, in a third of the time."""
AHEAD_BYTES_MAX: Final = 64 << 20
"""Bytes that are fetched before the data are individually requested."""


class Readings:
    """The states that a grant or view showed, by slot.

    Args:
        client: The session they came by.
        cache: Where fetched data are kept by version.
        lock: The lock or view that pins them.
        readings: The states.
        usable: Raises if the lock is over or lost; called before every access.

    Attributes:
        decoded: How many data were decoded so far.
        looked_at: Those that are here still.
        changeable: Of these the ones that can be changed in place, with their bytes.
        asked: The requests they were asked for with, where not all may be read.
    """

    def __init__(
        self,
        client: CellClient,
        cache: DatumCache,
        lock: LockId,
        readings: Iterable[Reading],
        usable: Callable[[], None],
    ) -> None:
        self._client = client
        self._cache = cache
        self._lock = lock
        self._readings: dict[Slot, Reading] = {}
        for reading in readings:
            self._readings[reading.state.slot] = reading
        self.looked_at: dict[Slot, Any] = {}
        self.changeable: dict[Slot, ReceivedValue] = {}
        self._kept: dict[Slot, Datum] = {}
        self._fetched_alone = 0
        self.asked: Iterable[LockRequest[Any]] = ()
        self.usable = usable
        self.decoded = 0

    def end(self) -> None:
        """Forget all data: the lock is over, as every later look at them says."""
        self.usable = partial(_refuse_released, self.asked)
        self._readings.clear()
        self.looked_at.clear()
        self.changeable.clear()
        self._kept.clear()

    def take_over(self, keeping: Keeping | None, single: Collection[Single]) -> None:
        """Take over what an earlier block of the same kept grant has decoded."""
        for slot, aspect, _ in single if keeping is not None and keeping.values else ():
            datum_type, value = keeping.values.get(slot, (None, None))  # type: ignore[union-attr]
            if datum_type is not None and datum_type is aspect.datum_type:
                self.looked_at[slot] = value

    def pass_on(
        self, keeping: Keeping | None, single: Collection[Single], written: Collection[Slot]
    ) -> None:
        """Leave to the next block of the same grant what it need not decode, with its type."""
        if keeping is not None:
            keeping.values = {
                slot: (aspect.datum_type, self.looked_at[slot])
                for slot, aspect, _ in single
                if slot in self.looked_at and slot not in written and _lasts(aspect.datum_type)
            }

    def state(self, slot: Slot) -> SlotState | None:
        """Return the state of a slot, or None if it was not shown (a pattern, and null)."""
        reading = self._readings.get(slot)
        return reading.state if reading is not None else None

    def shown(self) -> Iterator[tuple[str, SlotState]]:
        """Yield every state that is not null, with the shard that showed it."""
        for reading in self._readings.values():
            if not is_null(reading.state):
                yield reading.shard, reading.state

    def versions(self, slots: Iterable[Slot]) -> tuple[DatumRead, ...]:
        """Return which version of each of these slots was shown, of those that were."""
        found = map(self._readings.get, slots)
        return tuple([_read_of(reading.state[:3]) for reading in found if reading is not None])

    def shard(self, slot: Slot) -> str:
        """Return the shard that showed the slot."""
        return self._readings[slot].shard

    def datum(self, slot: Slot) -> Datum:
        """Return the encoded datum of a slot that is not null, fetching it where needed."""
        kept = self._kept.get(slot)
        if kept is not None:
            return kept
        shard, epoch, state = self._readings[slot]
        if state.datum is not None and not state.large:
            self._cache.put(slot, shard, epoch, state.version, state.datum)
            return state.datum
        if not self._is_to_come(slot):
            return self._fetched([slot])[slot]
        self._fetched_alone += 1
        others = self._asked_alone() if self._fetched_alone > 1 else []
        # A program that has read two of them is likely to read the others, too.
        self.fetch(ahead(slot, others, self.bytes_to_come) if slot in others else [slot])
        return self._kept[slot]

    def _asked_alone(self) -> list[Slot]:
        """Return the slots that the lock's requests name one by one, to be read."""
        reads = (Access.READ, Access.VIEW)
        return [slot_of(request) for request in self.asked if request.access in reads]

    def fetch(self, slots: Iterable[Slot]) -> None:
        """Fetch those of these data that are not here, all at once, and keep them."""
        to_come = [slot for slot in slots if self._is_to_come(slot)]
        if to_come:
            self._kept.update(self._fetched(to_come))

    def _fetched(self, slots: Iterable[Slot]) -> dict[Slot, Datum]:
        readings = [self._readings[slot] for slot in slots]
        return fetch_all(self._client, self._cache, self._lock, readings, self.usable)

    def bytes_to_come(self, slot: Slot) -> int:
        """Return how long a datum is that would have to be fetched, 0 for all others."""
        return self._readings[slot].state.size if self._is_to_come(slot) else 0

    def _is_to_come(self, slot: Slot) -> bool:
        reading = self._readings.get(slot)
        return reading is not None and reading.state.large and slot not in self._kept

    def keep_all(self) -> None:
        """Fetch all data now, so that they can be read after the lock or view is over."""
        states = (reading.state for reading in self._readings.values())
        named = [state.slot for state in states if state.large or state.same]
        self._kept.update(self._fetched(named))

    def value(self, slot: Slot, aspect: Aspect[T]) -> T:
        """Return the decoded datum of a slot; the caller has made sure that it is `usable`.

        Raises:
            NullDatumError: The slot is null.
        """
        value: T = self.looked_at.get(slot, UNSET)
        if value is UNSET:
            reading = self._readings.get(slot)
            if reading is None or reading.state.null_reason:
                raise self.null_error(slot)
            state, datum_type = reading.state, aspect.datum_type
            datum = state.datum
            if datum is None or state.large or datum.size >= CACHED_BYTES_MIN or self._kept:
                datum = self.datum(slot)
            try:
                value = decode_datum(datum, datum_type)
            except DatumTypeError as error:
                raise misfit(slot, "cannot be read", error) from error.__cause__
            self.looked_at[slot] = value
            self.decoded += 1
            if changeable(datum_type):
                self.changeable[slot] = ReceivedValue(value, datum, datum_type)
        return value

    def null_error(self, slot: Slot) -> NullDatumError:
        """Return the error for reading a slot that was null or not shown."""
        return null_error(slot, self.state(slot), self._client.aspect_entries())

    def readings(self) -> Iterable[Reading]:
        """Return what was shown of every slot."""
        return self._readings.values()

    def matching(self, request: LockRequest[Any]) -> list[Slot]:
        """Return the slots of a pattern request that are not null, in order of their names."""
        context, pattern, aspect = request.address
        return sorted(
            slot
            for slot, reading in self._readings.items()
            if slot.context == context
            and slot.aspect == aspect
            and not is_null(reading.state)
            and pattern_matches(pattern, slot.entity)
        )


def ahead(first: Slot, others: Iterable[Slot], bytes_of: Callable[[Slot], int]) -> list[Slot]:
    """Return `first` and as many of the others as may be fetched with it."""
    found, size = [first], bytes_of(first)
    for slot in others:
        if slot != first:
            size += bytes_of(slot)
            if size > AHEAD_BYTES_MAX:
                break
            found.append(slot)
    return found


def is_null(state: SlotState) -> bool:
    """Whether the slot holds no datum."""
    return bool(state.null_reason)


def null_error(
    slot: Slot, state: SlotState | None, aspects: Collection[str] | None = None
) -> NullDatumError:
    """Return the error for reading a null slot, with the reason."""
    reason = NullReason[state.null_reason].value if state else NullReason.NEVER_SET.value
    unknown = ""
    if aspects is not None and slot.aspect not in aspects:
        unknown = f"; no shard knows an aspect {slot.aspect!r}{suggestion(slot.aspect, aspects)}"
    elif reason == NullReason.DELETED.value:
        unknown = f": enact why {slot.context} {slot.entity}/{slot.aspect} says by whom"
    return NullDatumError(
        f"{slot.entity}/{slot.aspect} is null in {slot.context} ({reason}{unknown});"
        " use .get(request, default) where that is expected",
        reason=reason,
    )


def misfit(slot: Slot, what: str, error: DatumTypeError) -> DatumTypeError:
    """Return the error for a datum of another type, with the slot that it is in."""
    return DatumTypeError(f"{slot.context}:{slot.entity}/{slot.aspect} {what}: {error}")


def slot_of(request: LockRequest[Any]) -> Slot:
    """Return the slot that a request for one entity names."""
    return _slot_at(request.address)


class EachData(Mapping[Entity, T]):
    """The data of a pattern request by entity; decoded when they are looked at.

    A single look-up fetches one datum.  An iteration, by `values()` or otherwise, fetches those
    that follow as well.
    """

    def __init__(self, readings: Readings, request: LockRequest[T]) -> None:
        self._data = readings
        self._request = request
        self._slots = {Entity(slot.entity): slot for slot in readings.matching(request)}
        self._next = -1

    def __getitem__(self, entity: Entity) -> T:
        slot = self._slots.get(entity)
        if slot is None:
            raise KeyError(entity)
        self._data.usable()
        if self._data.bytes_to_come(slot):
            self._fetch(slot)
        return self._data.value(slot, self._request.aspect)

    def __contains__(self, entity: object) -> bool:
        """Say whether there is a datum, without looking at it."""
        return entity in self._slots

    def stamp_ns(self, entity: Entity) -> int:
        """Return when an entity's datum was captured (0: its writer did not tell); fetches nothing.

        Raises:
            KeyError: There is no such datum.
        """
        self._data.usable()
        state = self._data.state(self._slots[entity])
        return state.captured_ns if state is not None else 0

    def _fetch(self, slot: Slot) -> None:
        """Fetch a datum, and those behind it where the one before it was fetched last."""
        order = list(self._slots.values())
        at, to_come = order.index(slot), self._data.bytes_to_come
        in_order = 0 <= self._next <= at and not any(map(to_come, order[self._next : at]))
        slots = ahead(slot, order[at + 1 :], to_come) if in_order else [slot]
        self._data.fetch(slots)
        self._next = at + len(slots)

    def slots(self) -> Collection[Slot]:
        """Return the slots that hold the data."""
        return self._slots.values()

    def values(self) -> ValuesView[T]:
        """Return the data in the order of their entities; large ones come together."""
        self._next = 0
        return super().values()

    def items(self) -> ItemsView[Entity, T]:
        """Return the entities with their data; large ones come together."""
        self._next = 0
        return super().items()

    def __iter__(self) -> Iterator[Entity]:
        return iter(self._slots)

    def __len__(self) -> int:
        return len(self._slots)

    def __repr__(self) -> str:
        return f"<data of {self._request!r}: {len(self)} entities>"


def check_requested(
    request: object, requests: Mapping[LockRequest[Any], LockRequest[Any]], what: str
) -> None:
    """Raise unless `request` is one of those that the lock or view was made with.

    Raises:
        NotRequestedError: The lock does not have this request.
        MisuseError: It is not a request.
    """
    if not isinstance(request, LockRequest):
        raise MisuseError(
            f"a {what} is indexed by the request it was made with, not by {request!r}"
        )
    if request not in requests:
        asked = ", ".join(map(repr, requests)) or "nothing"
        raise NotRequestedError(f"{request!r} was not asked for; this {what} asked for {asked}")


def _refuse_released(requests: Iterable[LockRequest[Any]]) -> None:
    raise LockReleasedError(
        f"Lock({', '.join(map(repr, requests))}) is used outside its `with` block"
    )
