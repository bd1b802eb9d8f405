"""Data that a lock or a view has named: found by request, fetched and decoded on first use.

`Readings` is the part that `Lock` and `Snapshot` share.  A datum is decoded once; arrays in it are
read-only views of the received bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, cast

from enact_dist.core.datum import Slot
from enact_dist.errors import MisuseError, NotRequestedError, NullDatumError
from enact_dist.terms import Aspect, Entity, NullReason, pattern_matches

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.core.datum import Datum, LockId
    from enact_dist.core.lock_parts import Reading
    from enact_dist.core.messages import SlotState
    from enact_dist.link.client import CellClient
    from enact_dist.link.fetching import DatumCache
    from enact_dist.terms import LockRequest

T = TypeVar("T")

UNSET: Any = object()


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
        self._readings = {reading.state.slot: reading for reading in readings}
        self._values: dict[Slot, object] = {}
        self._kept: dict[Slot, Datum] = {}
        self.usable = usable
        self.decoded = 0

    def end(self, usable: Callable[[], None]) -> None:
        """Forget all data: the lock is over, which `usable` says from now on."""
        self.usable = usable
        self._readings.clear()
        self._values.clear()
        self._kept.clear()

    def state(self, slot: Slot) -> SlotState | None:
        """Return the state of a slot, or None if it was not shown (a pattern, and null)."""
        reading = self._readings.get(slot)
        return reading.state if reading is not None else None

    def shard(self, slot: Slot) -> str:
        """Return the shard that showed the slot."""
        return self._readings[slot].shard

    def datum(self, slot: Slot) -> Datum:
        """Return the encoded datum of a slot that is not null, fetching it where needed."""
        from enact_dist.link.fetching import fetch

        kept = self._kept.get(slot)
        if kept is not None:
            return kept
        reading = self._readings[slot]
        return fetch(
            self._client, self._cache, self._lock, reading.shard, reading.epoch, reading.state
        )

    def keep(self, slot: Slot) -> None:
        """Fetch a datum now, so that it can be read after the lock or view is over."""
        self._kept[slot] = self.datum(slot)

    def value(self, slot: Slot, aspect: Aspect[T]) -> T:
        """Return the decoded datum of a slot.

        Raises:
            NullDatumError: The slot is null.
        """
        from enact_dist.wire.payload import decode_datum

        self.usable()
        value = self._values.get(slot, UNSET)
        if value is UNSET:
            state = self.state(slot)
            if state is None or is_null(state):
                raise null_error(slot, state)
            value = self._values[slot] = decode_datum(self.datum(slot), aspect.datum_type)
            self.decoded += 1
        return cast("T", value)

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


def is_null(state: SlotState) -> bool:
    """Whether the slot holds no datum."""
    return bool(state.null_reason)


def null_error(slot: Slot, state: SlotState | None) -> NullDatumError:
    """Return the error for reading a null slot, with the reason."""
    reason = NullReason[state.null_reason].value if state else NullReason.NEVER_SET.value
    return NullDatumError(
        f"{slot.entity}/{slot.aspect} is null in {slot.context} ({reason});"
        " use .get(request, default) where that is expected",
        reason=reason,
    )


def slot_of(request: LockRequest[Any]) -> Slot:
    """Return the slot that a request for one entity names."""
    context, entity, aspect = request.address
    return Slot(context, entity, aspect)


class EachData(Mapping[Entity, T]):
    """The data of a pattern request by entity; decoded when they are looked at."""

    def __init__(self, readings: Readings, request: LockRequest[T]) -> None:
        self._data = readings
        self._request = request
        self._slots = {Entity(slot.entity): slot for slot in readings.matching(request)}

    def __getitem__(self, entity: Entity) -> T:
        if entity not in self._slots:
            raise KeyError(entity)
        return self._data.value(self._slots[entity], self._request.aspect)

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
        NotRequestedError: It is another request.
        MisuseError: It is no request at all.
    """
    from enact_dist.terms import LockRequest

    if not isinstance(request, LockRequest):
        raise MisuseError(
            f"a {what} is indexed by the request it was made with, not by {request!r}"
        )
    if request not in requests:
        asked = ", ".join(map(repr, requests)) or "nothing"
        raise NotRequestedError(f"{request!r} was not asked for; this {what} asked for {asked}")
