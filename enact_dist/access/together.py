"""`Together`: data of several slots that bear the same capture stamp, seen as one set.

::

    masks = Together([View(online, camera, MASK) for camera in CAMERAS], by="stamp")

    class Fusion(Actor):
        masks = masks                      # with World roles, as all requests of an actor
        triggers = (masks,)                # one update per complete set
        def update(self, lock): left, right, *others = lock[self.masks]

    online.view(masks)[masks]              # the newest complete set

    Together(views, within_s=0.02)         # cameras without a common clock: stamps that are near
    Together(views, least=6)               # runs without up to two of eight, 0.1 s after the first
    Together(views, newest_only=True)      # an actor that falls behind goes on with the newest set

A comprehension in the body of a class sees no name of that body but in its first ``in …``: with
``online = World("online")`` inside `Fusion`, the list above raises `NameError`.  So roles and sets
stand before the class, as here.

The stamps are those of `lock.put(request, datum, stamp_ns=…)`.  While the slots move on, a set is
found again among the versions that its aspects retain (`Aspect(…, retention=n)` or `cell.toml`):
retain as many as may be under way at once.  All data of a set are of one consistent cut, over
shards too.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from enact_dist.access.reads import slot_of
from enact_dist.access.sets import Capture, PendingSets, newest_set_ns
from enact_dist.core.protocol.messages import Survey, Surveyed
from enact_dist.errors import ProtocolError
from enact_dist.terms import Entity, View

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.access.session import Session
    from enact_dist.core.protocol.datum import Slot

T_co = TypeVar("T_co", covariant=True)

OPEN_MAX: Final = 16
"""Sets that an actor follows at once, unless `Together` says otherwise."""
OPEN_LIMIT: Final = 256
LEAST_AFTER_S: Final = 0.1
"""How long after its first datum a set runs with `least` of them, unless `Together` says it."""


class Together(Generic[T_co]):
    """Views whose data belong together, by the stamp at which they were captured.

    Args:
        requests: Two or more `View`s of single entities; their order is that of the data.
        by: "stamp": the data of a set share their capture timestamp.
        within_s: How far the stamps of one set may lie apart, seconds; less than half the period at
            which they come, else sets cannot be distinguished.  The stamp of a set is the oldest of
            its data.
        least: The least number of data with which a set runs: as soon as it is certain that the
            others do not come, or `least_after_s` after the first of them has arrived.  The missing
            ones are None in ``lock[together]``, null for the `View` of each, and named by
            `lock.missing`.  None: with all of them.
        least_after_s: See `least`, seconds.
        open_max: How many sets an actor follows at once.  Of more than that the oldest is given
            up as incomplete, or, if it is complete and still waits for its update, as skipped.

    Raises:
        TypeError: A request is no `View` of one entity.
        ValueError: Fewer than two requests, one named twice, another `by`, an `open_max` outside
            1 to 256, a `least` outside 1 to their number, a negative or infinite time.
    """

    __slots__ = (
        "by", "least", "least_after_s", "newest_only", "open_max", "requests", "within_s",
    )  # fmt: skip
    remedy = (
        "to lock what belongs to a set, make it the trigger of an Actor; to see the newest"
        " complete set without a lock, world.view(together)"
    )
    """What to do in place of passing it as a lock request."""

    def __init__(
        self,
        requests: Iterable[View[T_co]],
        *,
        by: str = "stamp",
        within_s: float = 0.0,
        least: int | None = None,
        least_after_s: float = LEAST_AFTER_S,
        open_max: int = OPEN_MAX,
        newest_only: bool = False,
    ) -> None:
        self.requests: Final = tuple(requests)
        self.by: Final = by
        self.within_s: Final = within_s
        self.least: Final = len(self.requests) if least is None else least
        self.least_after_s: Final = least_after_s
        self.open_max: Final = open_max
        self.newest_only: Final = newest_only
        for request in self.requests:
            if not isinstance(request, View) or not isinstance(request.entity, Entity):
                raise TypeError(
                    f"Together(…) takes a View of one entity each, not {request!r}: what"
                    " is missing from a set is only defined for named entities"
                )
        if len(self.requests) < 2 or len(set(self.requests)) < len(self.requests):
            raise ValueError(f"Together({list(self.requests)}) needs two or more different Views")
        if by != "stamp":
            raise ValueError(f"Together(…, by={by!r}): data belong together by 'stamp' only")
        for name, value in (("within_s", within_s), ("least_after_s", least_after_s)):
            if not isinstance(value, int | float) or not 0.0 <= value < math.inf:
                raise ValueError(f"{name} is {value!r}; it must be 0 or more seconds")
        if type(self.least) is not int or not 1 <= self.least <= len(self.requests):
            raise ValueError(
                f"least is {least!r}; it must lie between 1 and {len(self.requests)}, the number of"
                " the requests"
            )
        if type(open_max) is not int or not 1 <= open_max <= OPEN_LIMIT:
            raise ValueError(f"open_max is {open_max!r}; it must lie between 1 and {OPEN_LIMIT}")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Together):
            return NotImplemented
        return self.requests == other.requests and self._how() == other._how()

    def __hash__(self) -> int:
        return hash(self.requests)

    def __repr__(self) -> str:
        more = f", within_s={self.within_s:g}" if self.within_s else ""
        more += f", least={self.least}" if self.least < len(self.requests) else ""
        more += ", newest_only=True" if self.newest_only else ""
        return f"Together({', '.join(map(repr, self.requests))}, by={self.by!r}{more})"

    def _how(self) -> tuple[float, int, float, bool]:
        return self.within_s, self.least, self.least_after_s, self.newest_only

    def pending(self, names: Sequence[str]) -> PendingSets:
        """Return an empty account of its sets."""
        first = self.requests[0].entity
        assert isinstance(first, Entity)
        return PendingSets(
            names,
            entity=first,
            open_max=self.open_max,
            within_ns=round(self.within_s * 1e9),
            least=self.least,
            least_after_ns=round(self.least_after_s * 1e9),
            newest_only=self.newest_only,
        )

    def stamps(self, members: Sequence[int]) -> dict[View[Any], int]:
        """Return by which stamp each datum of a set is asked for; of missing ones by the set's."""
        oldest_ns = min(filter(None, members), default=0)
        return {
            request: stamp_ns or oldest_ns
            for request, stamp_ns in zip(self.requests, members, strict=True)
        }

    def newest(self, versions: Sequence[Sequence[Capture]]) -> tuple[int, ...]:
        """Return the capture stamp of each datum of the newest set; None if there is none."""
        if not self.within_s and self.least == len(self.requests):
            stamp_ns = newest_set_ns(versions)
            return (stamp_ns,) * len(self.requests) if stamp_ns else ()
        sets = self.pending([""] * len(self.requests))
        sets.start(versions)
        trigger = sets.take(0)
        return trigger.members if trigger is not None else ()


def captured_versions(session: Session, requests: Sequence[View[Any]]) -> list[list[Capture]]:
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
    found: dict[Slot, list[Capture]] = {slot: [] for slot in slots}
    shards = sorted(session.shards_of(requests))
    for shard in shards:
        session.settle(shard)
    for answer in session.client.call_all([(shard, message) for shard in shards]):
        if not isinstance(answer, Surveyed):
            raise ProtocolError(f"{type(answer).__name__} came as the answer to Survey")
        for state in answer.states:
            if state.slot in found and state.version:
                found[state.slot].append(
                    Capture(
                        state.version, state.stamp_ns, state.captured_ns, bool(state.null_reason)
                    )
                )
    return [found[slot] for slot in slots]
