"""`Together`: data of several slots that bear the same capture stamp, seen as one set.

::

    masks = Together([View(online, camera, MASK) for camera in CAMERAS], by="stamp")

    class Fusion(Actor):
        masks = masks                      # with World roles, as all requests of an actor
        triggers = (masks,)                # one update per complete set
        def update(self, lock): left, right, *others = lock[self.masks]

    online.view(masks)[masks]              # the newest complete set

A comprehension in the body of a class sees no name of that body but in its first ``in …``: with
``online = World("online")`` inside `Fusion`, the list above raises `NameError`.  So roles and sets
stand before the class, as here.

The stamps are those of `lock.put(request, datum, stamp_ns=…)`.  While the slots move on, a set is
found again among the versions that its aspects retain (`Aspect(…, retention=n)` or `cell.toml`):
retain as many as may be under way at once.  All data of a set are of one consistent cut, over
shards too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from enact_dist.core.messages import Survey, Surveyed
from enact_dist.errors import ProtocolError
from enact_dist.reading import slot_of
from enact_dist.terms import Entity, View

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.core.datum import Slot
    from enact_dist.session import Session

T_co = TypeVar("T_co", covariant=True)

OPEN_MAX: Final = 16
"""Sets that an actor follows at once, unless `Together` says otherwise."""
OPEN_LIMIT: Final = 256


class Together(Generic[T_co]):
    """Views whose data belong together, by the stamp at which they were captured.

    Args:
        requests: Two or more `View`s of single entities; their order is that of the data.
        by: "stamp": the capture stamp is what the data of a set have in common.
        open_max: How many sets an actor follows at once.  Of more than that the oldest is given
            up as incomplete, or, if it is complete and still waits for its update, as skipped.

    Raises:
        TypeError: A request is no `View` of one entity.
        ValueError: Fewer than two requests, one named twice, another `by`, an `open_max` outside
            1 to 256.
    """

    __slots__ = ("by", "open_max", "requests")

    def __init__(
        self, requests: Iterable[View[T_co]], *, by: str = "stamp", open_max: int = OPEN_MAX
    ) -> None:
        self.requests: Final = tuple(requests)
        self.by: Final = by
        self.open_max: Final = open_max
        for request in self.requests:
            if not isinstance(request, View) or not isinstance(request.entity, Entity):
                raise TypeError(
                    f"Together(…) takes a View of one entity each, not {request!r}: what is"
                    " missing from a set can only be told of entities that are known by name"
                )
        if len(self.requests) < 2 or len(set(self.requests)) < len(self.requests):
            raise ValueError(f"Together({list(self.requests)}) needs two or more different Views")
        if by != "stamp":
            raise ValueError(f"Together(…, by={by!r}): data belong together by 'stamp' only")
        if type(open_max) is not int or not 1 <= open_max <= OPEN_LIMIT:
            raise ValueError(f"open_max is {open_max!r}; it must lie between 1 and {OPEN_LIMIT}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Together):
            return NotImplemented
        return self.requests == other.requests

    def __hash__(self) -> int:
        return hash(self.requests)

    def __repr__(self) -> str:
        return f"Together({', '.join(map(repr, self.requests))}, by={self.by!r})"


class Captured(NamedTuple):
    """One version of a slot: when it was committed and when its datum was captured.

    `captured_ns` is 0 where the writer did not say; `null` versions have no datum at all.
    """

    version: int
    committed_ns: int
    captured_ns: int
    null: bool = False


def captured_versions(session: Session, requests: Sequence[View[Any]]) -> list[list[Captured]]:
    """Return the retained versions of each request's slot, oldest first, the newest included.

    Whatever this process has committed is among them; else it is no cut.

    Raises:
        ShardUnreachableError: A shard does not answer, or does not show our commit in time.
    """
    slots = [slot_of(request) for request in requests]
    message = Survey(
        tuple(dict.fromkeys(slot.context for slot in slots)),
        tuple(dict.fromkeys(slot.entity for slot in slots)),
        tuple(dict.fromkeys(slot.aspect for slot in slots)),
        retained=True,
    )
    found: dict[Slot, list[Captured]] = {slot: [] for slot in slots}
    shards = sorted(session.shards_of(requests))
    for shard in shards:
        session.settle(shard)
    for answer in session.client.call_all([(shard, message) for shard in shards]):
        if not isinstance(answer, Surveyed):
            raise ProtocolError(f"{type(answer).__name__} came as the answer to Survey")
        for state in answer.states:
            if state.slot in found and state.version:
                found[state.slot].append(
                    Captured(
                        state.version, state.stamp_ns, state.captured_ns, bool(state.null_reason)
                    )
                )
    return [found[slot] for slot in slots]


def newest_set_ns(versions: Sequence[Sequence[Captured]]) -> int:
    """Return the largest capture stamp that all of them have, 0 if there is none."""
    stamps = [{one.captured_ns for one in each if one.captured_ns} for each in versions]
    return max(set.intersection(*stamps), default=0)
