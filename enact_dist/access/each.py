"""The writable data of a pattern: what `lock[WriteEach(…)]` is."""

from __future__ import annotations

from collections.abc import Callable, Iterator, MutableMapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, overload

from enact_dist.access.reads import EachData, Readings
from enact_dist.access.writes import Asked
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import MisuseError
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Entity

if TYPE_CHECKING:
    from enact_dist.access.writes import DTypesLike, ShapesLike, Writing
    from enact_dist.terms import Aspect, LockRequest

T = TypeVar("T")


class Block(NamedTuple):
    """What the data of a pattern need of the lock that holds them.

    Attributes:
        writing: The lock's writes, which they add to.
        use: Raises unless the block is running and the lock not known to be lost.
        put: Sets a slot to a value of an aspect with a capture stamp.
        stamp: Returns the capture stamp of a datum if the program names none.
        shard_of: Returns the shard that owns a slot.
    """

    writing: Writing
    use: Callable[[], None]
    put: Callable[[Slot, Aspect[Any], Any, int | None], None]
    stamp: Callable[[int | None], int]
    shard_of: Callable[[Slot], str]


class WritableEach(EachData[T], MutableMapping[Entity, T]):
    """The data of a `WriteEach` by entity; assigning one publishes it when the block ends.

    Assigning to an entity that did not exist creates it: the pattern is locked, so no other
    process can have created it.
    """

    def __init__(self, block: Block, readings: Readings, request: LockRequest[T]) -> None:
        super().__init__(readings, request)
        self._block = block
        self._followed = 0

    def follow(self) -> None:
        """Take over what was set through other requests of the lock since the last look."""
        if self._followed == self._block.writing.edits:
            return
        self._followed = self._block.writing.edits
        context, pattern, aspect = self._request.address
        for slot, datum in self._block.writing.data.items():
            same = (slot.context, slot.aspect) == (context, aspect)
            if same and pattern_matches(pattern, slot.entity):
                self._note(Entity(slot.entity), slot, null=datum is None)

    def _note(self, entity: Entity, slot: Slot, *, null: bool) -> None:
        if null:
            self._slots.pop(entity, None)
        else:
            self._slots[entity] = slot

    def _slot(self, entity: Entity) -> Slot:
        context, pattern, aspect = self._request.address
        if not isinstance(entity, Entity):
            raise MisuseError(f"a pattern's data are set by Entity, not by {entity!r}")
        if not pattern_matches(pattern, entity.name):
            raise MisuseError(f"{entity.name!r} does not match {pattern!r}, which is locked")
        return Slot(context, entity.name, aspect)

    def __getitem__(self, entity: Entity) -> T:
        slot = self._slots.get(entity)
        if slot is None:
            raise KeyError(entity)
        if slot in self._block.writing.data:
            value: T = self._block.writing.written(slot, self._request.aspect)
            return value
        return super().__getitem__(entity)

    def stamp_ns(self, entity: Entity) -> int:
        """Return when an entity's datum was captured, or what this lock says of it."""
        written = self._block.writing.data.get(self._slots[entity])
        return super().stamp_ns(entity) if written is None else written.stamp_ns

    def __setitem__(self, entity: Entity, datum: T) -> None:
        self.put(entity, datum)

    def put(self, entity: Entity, datum: T, *, stamp_ns: int | None = None) -> None:
        """Set one entity's datum when the block ends cleanly; see `Lock.put`."""
        self.follow()
        slot = self._slot(entity)
        self._block.use()
        self._block.put(slot, self._request.aspect, datum, stamp_ns)
        self._note(entity, slot, null=False)
        self._followed = self._block.writing.edits

    @overload
    def new(
        self,
        entity: Entity,
        shape: ShapesLike,
        dtype: DTypesLike = None,
        *,
        stamp_ns: int | None = None,
    ) -> T: ...
    @overload
    def new(self, entity: Entity, *, like: T, stamp_ns: int | None = None) -> T: ...
    def new(
        self,
        entity: Entity,
        shape: ShapesLike | None = None,
        dtype: DTypesLike = None,
        *,
        like: T | None = None,
        stamp_ns: int | None = None,
    ) -> T:
        """Return one entity's datum, whose arrays are to be filled in place; see `Lock.new`."""
        self.follow()
        slot = self._slot(entity)
        self._block.use()
        asked = Asked(
            self._request.aspect.datum_type, like, shape, dtype, self._block.stamp(stamp_ns)
        )
        value: T = self._block.writing.new(slot, asked, self._block.shard_of)
        self._note(entity, slot, null=False)
        self._followed = self._block.writing.edits
        return value

    def __delitem__(self, entity: Entity) -> None:
        self.follow()
        if entity not in self._slots:
            raise KeyError(entity)
        slot = self._slot(entity)
        self._block.use()
        self._block.writing.delete(slot)
        self._note(entity, slot, null=True)
        self._followed = self._block.writing.edits

    def __iter__(self) -> Iterator[Entity]:
        return iter(list(self._slots))
