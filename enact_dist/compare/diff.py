"""Two world contexts compared datum by datum: `WorldContext.diff`.

one snapshot of both -> versions -> the data of those that differ, batch by batch -> comparators

Rules a change must keep: the compared data are of one moment if both contexts are of one cell and
one time; a version that both sides share, in the same slot or by a fork, is equal without its
data being fetched; no more than `BATCH_BYTES_MAX` of data, or one pair, are held at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from enact_dist.access.arguments import check_pattern, check_viewable, checked_each
from enact_dist.access.snapshot import slot_info
from enact_dist.compare.two_worlds import aspects_of, both_sides, origins, same_datum
from enact_dist.comparing import EQUAL, EXACT, Difference
from enact_dist.errors import LeaseLostError
from enact_dist.terms import Aspect, Entities, Entity
from enact_dist.wire.payload import decode_datum

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.compare.two_worlds import Place, SideView, Viewable
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Datum

BATCH_BYTES_MAX: Final = 64 << 20
"""Most bytes of data that are fetched and compared together."""
BATCH_PAIRS_MAX: Final = 1024
ATTEMPTS_MAX: Final = 3
"""Attempts of a comparison when data were removed before they were fetched."""

T = TypeVar("T")


class DiffKind(StrEnum):
    """How the two sides of a slot compare."""

    ONLY_LEFT = "only left"
    ONLY_RIGHT = "only right"
    CHANGED = "changed"
    EQUAL = "equal"
    """Equal, or apart by no more than the tolerance, or null on both sides."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One slot in two world contexts.

    Attributes:
        left: The version on the left side; None if it is null.
        right: The version on the right side; None if it is null.
        difference: How far the data are apart; None if a side is null.
    """

    entity: Entity
    aspect: str
    kind: DiffKind
    left: SlotInfo | None
    right: SlotInfo | None
    difference: Difference | None

    def to_json(self) -> dict[str, object]:
        """Return it in a form that JSON can carry; an infinite number becomes null."""
        found = self.difference or EQUAL
        return {
            "entity": self.entity.name,
            "aspect": self.aspect,
            "kind": self.kind.value,
            "left": _side_json(self.left),
            "right": _side_json(self.right),
            "distance": _finite(found.distance),
            "tolerance": _finite(found.tolerance),
            "unit": found.unit,
            "where": found.where,
            "what": found.what,
        }


@dataclass(frozen=True, slots=True)
class Diff:
    """How two world contexts differ: true if they do; iterates over its rows.

    Attributes:
        left: Name of the left world context.
        right: Name of the right one.
        rows: The slots that differ by more than their tolerance, in order of their names.
        equal: How many slots have equal data.
        same: How many of these are one version on both sides, whose data were not compared.
        within: How many slots differ by no more than their tolerance.
    """

    left: str
    right: str
    rows: tuple[Comparison, ...]
    equal: int
    same: int
    within: int

    def __bool__(self) -> bool:
        return bool(self.rows)

    def __iter__(self) -> Iterator[Comparison]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def of(self, kind: DiffKind) -> tuple[Comparison, ...]:
        """Return the rows of one kind."""
        return tuple(row for row in self.rows if row.kind is kind)

    def to_json(self) -> dict[str, object]:
        """Return it in a form that JSON can carry."""
        return {
            "left": self.left,
            "right": self.right,
            "equal": self.equal,
            "same": self.same,
            "within": self.within,
            "rows": [row.to_json() for row in self.rows],
        }


def diff(
    left: Viewable,
    right: Viewable,
    entities: Entities | Entity | str = "**",
    aspects: Sequence[Aspect[Any] | str] = (),
) -> Diff:
    """Compare two world contexts; see `WorldContext.diff`."""
    call = "diff(other, entities, *aspects)"
    check_viewable(call, right)
    check_pattern(call, "entities", entities)
    checked_each(call, "aspects", aspects, Aspect, str)
    types = aspects_of((left, right), aspects or None)
    places = [(str(Entities(str(entities))), name) for name in types]
    return diff_places(left, right, places, types, each=True)


def diff_places(
    left: Viewable,
    right: Viewable,
    places: Sequence[Place],
    types: Mapping[str, Aspect[Any]],
    *,
    each: bool = False,
) -> Diff:
    """Compare some slots of two world contexts."""

    def compare() -> Diff:
        with both_sides(left, right, places, each=each) as (first, second):
            pairs = pairs_of(first.of(left.name), second.of(right.name))
            return _counted(left.name, right.name, compared(pairs, first, second, types))

    return repeated(compare)


def repeated(compare: Callable[[], T], before_retry: Callable[[], None] = lambda: None) -> T:
    """Compare; repeat if data were removed before they were fetched.

    That happens when a shard restarts, or the session rests too long, between the two.

    Raises:
        LeaseLostError: The data were removed in each of `ATTEMPTS_MAX` attempts.
    """
    for _ in range(ATTEMPTS_MAX - 1):
        try:
            return compare()
        except LeaseLostError:
            before_retry()
    return compare()


def _counted(left: str, right: str, found: Iterable[tuple[Comparison, bool]]) -> Diff:
    rows: list[Comparison] = []
    equal = same = within = 0
    for row, is_same in found:
        if row.kind is not DiffKind.EQUAL:
            rows.append(row)
        elif row.difference is not None and row.difference.excess:
            within += 1
        else:
            equal, same = equal + 1, same + is_same
    return Diff(left, right, tuple(rows), equal, same, within)


# ---------------------------------------------------------------- pair by pair


class Pair(NamedTuple):
    """One slot on both sides; None: null."""

    place: Place
    left: Reading | None
    right: Reading | None


class _Whole(NamedTuple):
    """One slot that is null on neither side."""

    place: Place
    left: Reading
    right: Reading


def pairs_of(left: Mapping[Place, Reading], right: Mapping[Place, Reading]) -> Iterator[Pair]:
    """Yield every slot that is not null on both sides, in the order of their names."""
    for place in sorted(left.keys() | right.keys()):
        yield Pair(place, left.get(place), right.get(place))


def compared(
    pairs: Iterable[Pair], first: SideView, second: SideView, types: Mapping[str, Aspect[Any]]
) -> Iterator[tuple[Comparison, bool]]:
    """Yield how the two sides of each pair compare, and whether they are one version; in order.

    Raises:
        LeaseLostError: Data were removed: try again.
        DatumTypeError: A datum is not of its aspect's type, or the type has changed.
    """
    typed = [one for one in types.values() if one.datum_type is not object]
    for session in dict.fromkeys((first.session, second.session)):
        session.look_up(typed)
    for batch in _batches(pairs):
        whole = [_Whole(*pair) for pair in batch if pair.left and pair.right]  # type: ignore[arg-type]
        same = _same_versions(whole, first, second)
        differ = [pair for pair in whole if pair.place not in same]
        left = first.fetch([pair.left for pair in differ])
        right = second.fetch([pair.right for pair in differ])
        found = dict.fromkeys(same, EQUAL)
        for pair in differ:
            data = left[pair.left.state.slot], right[pair.right.state.slot]
            found[pair.place] = _difference(pair.place, types[pair.place[1]], *data)
        for each in batch:
            yield _comparison(each, found.get(each.place)), each.place in same


def _batches(pairs: Iterable[Pair]) -> Iterator[list[Pair]]:
    """Yield pairs in batches whose data fit into `BATCH_BYTES_MAX`."""
    batch: list[Pair] = []
    size = 0
    for pair in pairs:
        more = sum(side.state.size for side in (pair.left, pair.right) if side is not None)
        if batch and (size + more > BATCH_BYTES_MAX or len(batch) >= BATCH_PAIRS_MAX):
            yield batch
            batch, size = [], 0
        batch.append(pair)
        size += more
    if batch:
        yield batch


def _same_versions(pairs: Sequence[_Whole], first: SideView, second: SideView) -> set[Place]:
    """Return the slots whose two sides are one version, so that their data are the same.

    Two versions are one if slot and timestamp agree.  If a context is a fork, data of equal size
    are followed back to the context where they were written.
    """
    if first.session is not second.session:
        return set()  # another cell may have the same names and stamps
    same = {pair.place for pair in pairs if _written(pair.left) == _written(pair.right)}
    if first.forked or second.forked:
        asked = [
            pair
            for pair in pairs
            if pair.place not in same and pair.left.state.size == pair.right.state.size
        ]
        left = origins(first.session, [pair.left for pair in asked])
        right = origins(first.session, [pair.right for pair in asked])
        same |= {
            pair.place
            for pair in asked
            if left[pair.left.state.slot] == right[pair.right.state.slot]
        }
    return same


def _written(reading: Reading) -> tuple[object, int]:
    return reading.state.slot, reading.state.stamp_ns


def _difference(place: Place, aspect: Aspect[Any], left: Datum, right: Datum) -> Difference:
    if same_datum(left, right):
        return EQUAL
    comparator = aspect.compare or EXACT
    try:
        return comparator(
            decode_datum(left, aspect.datum_type), decode_datum(right, aspect.datum_type)
        )
    except Exception as error:
        error.add_note(f"while the two data of {'/'.join(place)} were compared")
        raise


def _comparison(pair: Pair, found: Difference | None) -> Comparison:
    if pair.left is None and pair.right is None:
        kind = DiffKind.EQUAL
    elif pair.right is None:
        kind = DiffKind.ONLY_LEFT
    elif pair.left is None:
        kind = DiffKind.ONLY_RIGHT
    else:
        kind = DiffKind.CHANGED if found is not None and found.crossed else DiffKind.EQUAL
    entity, aspect = pair.place
    return Comparison(Entity(entity), aspect, kind, _side(pair.left), _side(pair.right), found)


def _side(reading: Reading | None) -> SlotInfo | None:
    return slot_info(reading.shard, reading.state) if reading is not None else None


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _side_json(side: SlotInfo | None) -> dict[str, object] | None:
    if side is None:
        return None
    return {
        "version": side.version,
        "stamp_ns": side.position.stamp_ns,
        "size_bytes": side.size_bytes,
        "shard": side.shard,
    }
