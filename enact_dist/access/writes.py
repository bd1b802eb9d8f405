"""What a lock writes: data on their way into their shards' memory, and what they were made of.

Large data are written there at once (see `link.memory.payload_client`), small ones, and those of
shards that share no memory with this process, travel with the commit.  `blank` returns memory to
fill in place.  Once the block ends, the program cannot change it any more, not even through a view
that it kept or by `setflags`: large memory is detached (see `Draft.close`), small memory is copied.

A commit names as its causes, for `Cell.why`, the data that its lock read:

===================  ==========================================================================
request              counts as read
===================  ==========================================================================
`Read`, `View`       always, null too: the lock was asked for because of it
`ReadEach`,          the data that the block looked at; all that were there, where it looked at
`ViewEach`           the mapping alone, as `keys()` and `len` do
`Write`,             the replaced data that the block looked at; one that is null, or that it
`WriteEach`          overwrites unseen, has no part in the new one
===================  ==========================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias, cast

import numpy as np

from enact_dist.access.reads import ReceivedValue, changeable, misfit, null_error
from enact_dist.core.protocol.datum import Datum, Slot
from enact_dist.core.protocol.messages import WriteItem
from enact_dist.core.protocol.parts import READS_MAX
from enact_dist.errors import DatumTypeError, MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Access
from enact_dist.wire.limits import BODY_BYTES_MAX, ITEMS_MAX, PAYLOAD_BYTES_MIN
from enact_dist.wire.payload import decode_datum, decode_to_fill, encode_parts, joined
from enact_dist.wire.shapes import ArrayOf, RecordOf, shape_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence

    from numpy.typing import DTypeLike, NDArray

    from enact_dist.access.reads import EachData, Readings
    from enact_dist.core.protocol.messages import DatumRead
    from enact_dist.link.memory.payload_client import Draft, SharedPayloads
    from enact_dist.terms import Aspect, LockRequest
    from enact_dist.wire.payload import Encoded
    from enact_dist.wire.shapes import Shape

    ShapeLike: TypeAlias = int | Sequence[int]
    ShapesLike: TypeAlias = ShapeLike | Mapping[str, ShapeLike]
    DTypesLike: TypeAlias = DTypeLike | Mapping[str, DTypeLike] | None


def reads_of(
    readings: Readings,
    single: Iterable[Slot],
    each: Mapping[LockRequest[Any], EachData[Any]],
) -> tuple[tuple[DatumRead, ...], int]:
    """Return what a lock has read, and how many further data a commit does not name.

    Where there are too many, those that were named one by one go first, then what was looked at.

    Args:
        readings: What it was shown, and what of it was looked at.
        single: The data that it asked for one by one, not to write them.
        each: The mappings of its patterns that were used.
    """
    looked_at = readings.looked_at
    slots = dict.fromkeys(single)
    slots.update(dict.fromkeys(looked_at))
    for request, data in each.items():
        if not request.access.writes:
            shown = data.slots()
            if looked_at.keys().isdisjoint(shown):
                slots.update(dict.fromkeys(shown))
    if not slots:
        return (), 0
    reads = readings.versions(slots)
    return reads[:READS_MAX], max(0, len(reads) - READS_MAX)


_write_of: Final = partial(tuple.__new__, WriteItem)


NAMED_MAX: Final = 4
"""So many slots are named in one error."""


def refuse_changed(
    shown: Mapping[Slot, ReceivedValue],
    assigned: Mapping[Slot, ReceivedValue],
    written: Mapping[Slot, Datum | None],
    requests: Collection[LockRequest[Any]],
) -> None:
    """Raise `MisuseError` if what a block could have written was changed and not assigned."""
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


def _was_changed(shown: ReceivedValue) -> bool:
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


class _Written(NamedTuple):
    """One datum of a lock, where it lies, and the arrays that were handed out to be filled."""

    datum: Datum
    draft: Draft | None
    arrays: tuple[NDArray[Any], ...] = ()


class Asked(NamedTuple):
    """What a datum that is to be filled shall look like.

    Attributes:
        like: A datum that looks so, or None.
        shape: In its place: of the array; of each array by field where the type is a dataclass.
        dtype: Of the array, or of all, or of each by field; None takes what the type is annotated
            with, float64 where it is not.
    """

    datum_type: Any
    like: object
    shape: ShapesLike | None
    dtype: DTypesLike
    stamp_ns: int


class Writing:
    """The data that one lock writes, by slot.

    Args:
        payloads: The memory that shards share with this process.

    Attributes:
        data: What the commit sets; None writes null.
        drafts: Of these the ones in memory of a shard, or that were handed out to be filled.
        edits: How often that was changed.
        looked_at: What of it was handed out since it was set, and can be changed in place.
    """

    __slots__ = ("_bytes", "_payloads", "data", "drafts", "edits", "looked_at")

    def __init__(self, payloads: SharedPayloads) -> None:
        self._payloads = payloads
        self.drafts: dict[Slot, _Written] = {}
        self._bytes = 0
        self.data: dict[Slot, Datum | None] = {}
        self.edits = 0
        self.looked_at: dict[Slot, ReceivedValue] = {}

    def by_shard(
        self, shard_of: Callable[[Slot], str], only: str = ""
    ) -> Mapping[str, Sequence[WriteItem]]:
        """Return what each shard has to set; `only` names the one that has all, if one has."""
        if only:
            return {only: tuple(map(_write_of, self.data.items()))} if self.data else {}
        by_shard: dict[str, list[WriteItem]] = {}
        for slot, datum in self.data.items():
            by_shard.setdefault(shard_of(slot), []).append(WriteItem(slot, datum))
        return by_shard

    def put(self, slot: Slot, encoded: Encoded, shard_of: Callable[[Slot], str]) -> None:
        """Set a slot to a value, whose bytes are copied once.

        Raises:
            MisuseError: It is more than one lock may write.
            NoRoomError: The shard's cap is reached.
        """
        size = encoded.size
        if size or slot in self.drafts or slot in self.data or len(self.data) >= ITEMS_MAX:
            size = self._size_with(slot, size)
            self._note(slot, self._written(slot, encoded, shard_of), size)
        else:  # a number or a short text, for the first time
            self.data[slot] = encoded.datum()
            self.edits += 1

    def written(self, slot: Slot, aspect: Aspect[Any]) -> Any:
        """Return the value that a slot was set to.

        Raises:
            NullDatumError: It was set to null.
        """
        datum, datum_type = self.data[slot], aspect.datum_type
        if datum is None:
            raise null_error(slot, None)
        shown = self.looked_at.get(slot)
        if shown is not None:
            return shown.value
        value = decode_datum(datum, datum_type)
        if changeable(datum_type):
            self.looked_at[slot] = ReceivedValue(value, datum, datum_type)
        return value

    def delete(self, slot: Slot) -> None:
        """Set a slot to null."""
        self._note(slot, None, self._size_with(slot, 0))

    def _size_with(self, slot: Slot, size: int) -> int:
        """Return the bytes of all data once a slot is set to one of `size`.

        Raises:
            MisuseError: It is more than one lock may write; nothing was made or given up for it.
        """
        old = self.data.get(slot)
        size += self._bytes - (old.size if old else 0)
        if slot not in self.data and len(self.data) >= ITEMS_MAX:
            raise MisuseError(
                f"one lock writes at most {ITEMS_MAX} data, including those of patterns;"
                " use several locks, each atomic by itself, or put related data into one datum"
            )
        if size > BODY_BYTES_MAX:
            raise MisuseError(
                f"the writes of one lock have {size} bytes; at most {BODY_BYTES_MAX}: use several"
                " locks"
            )
        return size

    def _note(self, slot: Slot, written: _Written | None, size: int) -> None:
        """Let something take the place of what was written to a slot; `size` as `_size_with`."""
        if slot in self.drafts:
            self._forget(slot)
        if written is not None and (written.draft is not None or written.arrays):
            self.drafts[slot] = written
        self.data[slot] = written.datum if written is not None else None
        self.looked_at.pop(slot, None)
        self._bytes = size
        self.edits += 1

    def _written(self, slot: Slot, encoded: Encoded, shard_of: Callable[[Slot], str]) -> _Written:
        """Return the datum of a value, and its location."""
        if encoded.size <= PAYLOAD_BYTES_MIN:
            return _Written(encoded.datum(), None)
        draft = self._payloads.draft(shard_of(slot), encoded.size)
        body = self._payloads.filled(draft, encoded.parts) if draft is not None else None
        if draft is None or body is None:
            return _Written(encoded.datum(), None)
        return _Written(encoded.over(body, draft.file), draft)

    def new(self, slot: Slot, asked: Asked, shard_of: Callable[[Slot], str]) -> Any:
        """Set a slot to a value whose arrays are to be filled, and return it.

        Raises:
            DatumTypeError: What was asked is not of the type, or has no array.
            MisuseError: The size exceeds what one lock may write, or this slot has a blank already.
            NoRoomError: The shard's cap is reached.
        """
        held = self.drafts.get(slot)
        if held is not None and held.arrays:
            raise MisuseError(
                f"new() has handed out a datum of {slot.entity}/{slot.aspect} in this block"
                " already, and a second one would take its place with nothing in it: fill the"
                " first, or give it up with `del lock[request]` (of a pattern"
                " `del lock[request][entity]`) before you ask for another"
            )
        try:
            return self._blank(slot, asked, shard_of)
        except DatumTypeError as error:
            raise misfit(slot, "is not set", error) from error.__cause__

    def _blank(self, slot: Slot, asked: Asked, shard_of: Callable[[Slot], str]) -> Any:
        like, datum_type = template(asked), asked.datum_type
        encoded = encode_parts(like, datum_type, stamp_ns=asked.stamp_ns)
        size = self._size_with(slot, encoded.size)
        draft, memory, shown = self._memory(shard_of(slot), encoded)
        encoded.put_texts(memory)
        value, arrays = decode_to_fill(encoded.encoding, memory, datum_type)
        if not arrays:
            if draft is not None:
                self._drop(draft)
            raise DatumTypeError(
                f"new() hands out arrays to be filled, and {type(like).__name__} has none; put()"
                " takes any datum"
            )
        datum = encoded.over(shown, draft.file if draft is not None else "")
        self._note(slot, _Written(datum, draft, arrays), size)
        if changeable(datum_type):
            self.looked_at[slot] = ReceivedValue(value, datum, datum_type)
        return value

    def _memory(self, shard: str, encoded: Encoded) -> tuple[Draft | None, memoryview, memoryview]:
        """Return memory to be filled, where it lies, and the same bytes read-only."""
        draft = self._payloads.draft(shard, encoded.size)
        memory = self._payloads.memory(draft) if draft is not None else None
        if memory is not None:
            return draft, memory, memory.toreadonly()
        nameless = self._payloads.nameless(shard, encoded.size)
        if nameless is not None:
            return nameless
        memory = _plain(encoded)
        return None, memory, memory.toreadonly()

    def _drop(self, draft: Draft) -> None:
        draft.close()
        if draft.file:
            self._payloads.drop(draft.shard, draft.file)

    def _forget(self, slot: Slot) -> None:
        """Drop what was written to a slot: something else takes its place."""
        old = self.drafts.pop(slot, None)
        if old is not None:
            _fix(old)
            if old.draft is not None:
                self._drop(old.draft)

    def fix(self) -> None:
        """Make all of it read-only: it is about to be committed."""
        for slot, written in self.drafts.items():
            for array in written.arrays:
                array.flags.writeable = False
            datum = written.datum
            if self._payloads.inside and written.draft is None and self.data.get(slot) is datum:
                self.data[slot] = replace(datum, body=joined([datum.body], datum.size))

    def end(self, *, committed: bool) -> None:
        """Release it after the lock has ended."""
        for slot in list(self.drafts):
            if committed:
                _fix(self.drafts.pop(slot))
            else:
                self._forget(slot)
        self.data.clear()
        self.looked_at.clear()


def _fix(written: _Written) -> None:
    for array in written.arrays:
        array.flags.writeable = False
    if written.draft is not None:
        written.draft.close()


def _plain(encoded: Encoded) -> memoryview:
    """Return memory of this process that starts as arrays of any type may."""
    import numpy as np

    from enact_dist.wire.limits import ALIGNMENT

    raw = np.zeros(
        encoded.size + ALIGNMENT, np.uint8
    )  # zeros: parts left unfilled are published, too
    start = -raw.ctypes.data % ALIGNMENT
    return memoryview(raw.data)[start : start + encoded.size]


def template(asked: Asked) -> object:
    """Return what a datum that is to be filled looks like, without memory of its own.

    Raises:
        MisuseError: Both ways to say it were taken, or none.
        DatumTypeError: The type has other fields, or fields that are no arrays, or takes none of
            these shapes, or numpy knows no such shape or dtype.
    """
    datum_type, like, shape, dtype, _ = asked
    if (like is None) == (shape is None) or (like is not None and dtype is not None):
        raise MisuseError("new() takes either shape and dtype, or like=…")
    if shape is None:
        return like
    wanted = shape_of(datum_type)
    if not isinstance(shape, Mapping):
        return _empty("the array", wanted, shape, dtype)
    arrays = _arrays_of(wanted, datum_type, shape)
    assert isinstance(wanted, RecordOf)
    by_field = cast("Mapping[str, DTypeLike]", dtype) if isinstance(dtype, Mapping) else None
    dtypes = by_field if by_field is not None else dict.fromkeys(arrays, dtype)
    unknown = sorted(set(dtypes) - set(arrays))
    if unknown:
        raise DatumTypeError(f"dtypes of {unknown} were given; the fields are {sorted(arrays)}")
    made = {
        name: _empty(name, kind, shape[name], dtypes.get(name), zeros=True)
        for name, kind in arrays.items()
    }
    return _record(wanted.kind, made)


def _record(kind: type[Any], arrays: Mapping[str, NDArray[Any]]) -> object:
    """Return a dataclass of arrays, which its own checks see filled with zeros."""
    try:
        return kind(**arrays)
    except Exception as error:
        raise DatumTypeError(
            f"{kind.__qualname__} takes no arrays of these shapes, all zeros: {error!r:.200}; give"
            " like=… a datum that looks like the new one"
        ) from error


def _arrays_of(
    wanted: Shape, datum_type: object, shape: Mapping[str, ShapeLike]
) -> dict[str, Shape]:
    """Return the fields of a dataclass of arrays, each of which must have been given a shape."""
    fields = dict(wanted.fields) if isinstance(wanted, RecordOf) else {}
    if not fields or not all(isinstance(kind, ArrayOf) for kind in fields.values()):
        raise DatumTypeError(
            f"shapes by field were given, but {datum_type} is no dataclass of arrays alone; give"
            " like=… a datum that looks like the new one"
        )
    if set(fields) != set(shape):
        raise DatumTypeError(
            f"shapes of {sorted(shape)} were given; the fields of {datum_type} are {sorted(fields)}"
        )
    return fields


def _empty(
    name: str, wanted: Shape, shape: ShapeLike, dtype: DTypesLike, *, zeros: bool = False
) -> NDArray[Any]:
    import numpy as np

    if dtype is None and isinstance(wanted, ArrayOf):
        dtype = wanted.dtype
    try:
        return (np.zeros if zeros else np.empty)(shape, cast("DTypeLike", dtype))
    except (TypeError, ValueError, OverflowError, MemoryError) as error:
        raise DatumTypeError(
            f"{name}: no array of shape {shape!r:.80} and dtype {dtype!r:.80}: {error}"
        ) from None
