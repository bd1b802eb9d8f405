"""Detects data that a block changes in place, which its commit would miss.

What a commit publishes is what was assigned.  Arrays are read-only, so that numpy says so at once;
a list or dict can be changed all the same, also one inside a dataclass.  So what a block has looked
at of such data, and might have written, is compared with its bytes before the commit.  Numbers,
texts and arrays cost nothing: they are not remembered.  Nor is what has a value of a codec in it:
a codec may write the same value in other bytes each time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from enact_dist.core.datum import Datum
from enact_dist.errors import DatumTypeError, MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access
from enact_dist.wire import codecs
from enact_dist.wire.payload import decode_datum, encode_parts
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
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from enact_dist.core.datum import Slot
    from enact_dist.terms import LockRequest
    from enact_dist.wire.payload import Encoded
    from enact_dist.wire.shapes import Shape

NAMED_MAX: Final = 4
"""So many slots are named in one error."""

_changeable: dict[Any, bool] = {}
codecs.changed.append(_changeable.clear)


class Shown(NamedTuple):
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


def refuse_changed(
    shown: Mapping[Slot, Shown],
    assigned: Mapping[Slot, Shown],
    written: Mapping[Slot, Datum | None],
    requests: Collection[LockRequest[Any]],
) -> None:
    """Raise `MisuseError` if what a block could have written was changed and not assigned.

    Args:
        shown: What the block has looked at, as it was granted.
        assigned: What it has looked at of its own writes, since it wrote them.
        written: What it sets.
        requests: Those of the lock.
    """
    looked_at = {slot: one for slot, one in shown.items() if slot not in written} | {**assigned}
    if not looked_at:
        return
    single = {one.address: one for one in requests if one.access.writes and not one.access.each}
    each = [one for one in requests if one.access.writes and one.access.each]
    changed = {}
    for slot, one in looked_at.items():
        request = single.get(slot) or _allowing(each, slot)
        if request is not None and _was_changed(one):
            changed[slot] = request
    if changed:
        slot, request = next(iter(changed.items()))
        names = [f"{slot.entity}/{slot.aspect} in {slot.context}" for slot in changed]
        more = f" and {len(names) - NAMED_MAX} more" if len(names) > NAMED_MAX else ""
        at = f"lock[{request!r}]"
        if request.access is Access.WRITE_EACH:
            at += f"[Entity({slot.entity!r})]"
        raise MisuseError(
            f"{', '.join(names[:NAMED_MAX])}{more} was changed in place, which publishes nothing;"
            f" nothing was written: change the value, then assign it: {at} = value"
        )


def _allowing(each: Iterable[LockRequest[Any]], slot: Slot) -> LockRequest[Any] | None:
    """Return the pattern that allows to write a slot, None where none does."""
    for request in each:
        context, pattern, aspect = request.address
        if (context, aspect) == (slot.context, slot.aspect) and pattern_matches(
            pattern, slot.entity
        ):
            return request
    return None


def _was_changed(shown: Shown) -> bool:
    """Whether a value is another one than its datum's."""
    now = _encoded(shown.value, shown.datum_type)
    datum = shown.datum
    if now is not None and not now.size and not datum.size and now.encoding == datum.encoding:
        return False
    # Not with its bytes themselves, which another release may have written in another way.
    before = _encoded(decode_datum(datum, shown.datum_type), shown.datum_type)
    if now is None or before is None:
        return before is not None
    if now.encoding != before.encoding or len(now.parts) != len(before.parts):
        return True
    return not all(map(_same_bytes, now.parts, before.parts))


def _encoded(value: object, datum_type: Any) -> Encoded | None:
    """Return a value's bytes; None where it is no datum (any more)."""
    try:
        return encode_parts(value, datum_type)
    except DatumTypeError:
        return None


def _same_bytes(left: Any, right: Any) -> bool:
    """Whether two parts are the same; arrays over the same memory are not gone through."""
    one, other = np.frombuffer(left, np.uint8), np.frombuffer(right, np.uint8)
    same_place = one.ctypes.data == other.ctypes.data and one.size == other.size
    return same_place or np.array_equal(one, other)
