"""World contexts of a cell: what present and past ones have in common, and the past ones.

`WorldContext.at` returns a past one.

::

    before = online.at(position)                       # or a datetime, or seconds since 1970
    lowest = View(before, piece, LOWEST)
    before.view(lowest)[lowest]

Making one contacts no shard.  Each view through it is a consistent snapshot of all shards at its
timestamp: it contains every commit up to that timestamp and none after, even if shards restart in
between.  Reading the past never waits for a lock.  It waits at most a moment, until the commits
under way that bear an earlier timestamp are decided.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

from enact_dist.access.arguments import Moment, check_pattern, checked_each
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.access.snapshot import (
    SlotInfo,
    Snapshot,
    slot_info,
    slot_states,
    take_readings,
    take_snapshot,
    untyped_datum,
)
from enact_dist.core.protocol.messages import Item, SlotState
from enact_dist.errors import MisuseError
from enact_dist.link.refusals import moment_name
from enact_dist.terms import Access, Aspect, Context, Entities, Entity, FormerNames, LockRequest

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.access.session import Session
    from enact_dist.compare.diff import Diff
    from enact_dist.compare.two_worlds import Viewable


class CellContext(FormerNames, Context):
    """A world context of a cell, present or past: its slots, data without a type, differences."""

    __slots__ = ("session",)
    former: ClassVar[Mapping[str, str]] = {"raw": "get_untyped", "survey": "list_slots"}

    def __init__(self, name: str, session: Session) -> None:
        super().__init__(name)
        self.session = session

    def list_slots(
        self, entities: Entities | str = "**", aspects: tuple[str, ...] = ()
    ) -> tuple[SlotInfo, ...]:
        """List the slots that match, without their data.

        Of a present context null slots are listed, too; of a past one they are left out.

        Raises:
            ForgottenError: A past state has left its retention.
            UnknownWorldError: The cell does not have this world context any more.
            ShardUnreachableError: A shard does not answer.
        """
        check_pattern("list_slots(entities, aspects)", "entities", entities)
        names = checked_each("list_slots(entities, aspects)", "aspects", aspects, str)
        states = self._states(str(Entities(str(entities))), names)
        infos = [slot_info(shard, state) for shard, state in states]
        return tuple(sorted(infos, key=lambda info: (info.entity, info.aspect)))

    def _states(self, pattern: str, aspects: tuple[str, ...]) -> Iterable[tuple[str, SlotState]]:
        return slot_states(self.session, self.name, pattern, aspects)

    def entities(self, pattern: Entities | str = "**") -> tuple[Entity, ...]:
        """Return the entities that have some datum here; raises as `list_slots`."""
        infos = self.list_slots(pattern)
        return tuple(sorted({info.entity for info in infos if not info.null_reason}))

    def get_untyped(self, entity: Entity, aspect: str) -> object:
        """Return a datum without knowing its Python type: dataclasses come as dicts.

        Raises:
            NullDatumError: It is null.
            ForgottenError: A past datum has left its retention.
            MisuseError: No such aspect is registered.
        """
        return untyped_datum(self, self.session, entity, aspect)

    def diff(
        self,
        other: Viewable,
        entities: Entities | Entity | str = "**",
        *aspects: Aspect[Any] | str,
    ) -> Diff:
        """Compare this world context (left) with another one (right), datum by datum.

        Both are read in one consistent snapshot, a past one as of its moment.  Data are compared by
        the comparator of their aspect, exactly if it has none.  If the type of an aspect is not
        known in this process, its data are compared without it, dataclasses as dicts.  Data that
        are one version on both sides are not fetched.

        Args:
            other: A present or past world context.  If it is of another cell, it is read in a
                snapshot of its own.
            entities: A pattern or one entity.
            aspects: Which aspects, or their names; none means all.

        Raises:
            LockHeldError: This thread holds a lock.
            ForgottenError: A past context is beyond retention.
            TypeError: An argument is of another type.
            MisuseError: No program has registered one of the named aspects.
            UnknownWorldError: The cell no longer has one of them.
            DatumTypeError: An aspect is registered with another type.
            ShardUnreachableError: A shard does not answer.
        """
        from enact_dist.compare.diff import diff

        refuse_inside_lock("diff")
        return diff(self, other, entities, aspects)


class PastContext(CellContext):
    """A world context as of a moment, read-only; made by `WorldContext.at`.

    Requests name it as they do a world context: ``View(past, entity, ASPECT)``.  All views of one
    call name the same moment; they may name several contexts of it.

    Attributes:
        moment: What is shown.
    """

    __slots__ = ("moment",)
    past: ClassVar[bool] = True

    def __init__(self, name: str, session: Session, moment: Moment) -> None:
        super().__init__(name, session)
        self.moment = moment

    @property
    def at_ns(self) -> int:
        """The timestamp that it shows; 0: data are shown by their capture stamps."""
        return self.moment.at_ns

    @property
    def stamp_ns(self) -> int:
        """The capture stamp of the data that are shown; 0: data are shown by their commits."""
        return self.moment.captured_ns

    def view(self, *requests: LockRequest[Any]) -> Snapshot:
        """Read past data; allowed inside a lock, since no lock can block it.

        Args:
            requests: `View`s and `ViewEach`es of this moment.

        Raises:
            ForgottenError: A state of that moment has left its retention; it is never shown as
                another one.
            MisuseError: A request locks, or names another moment.
            ClockSkewError: The moment lies in the future of a shard's clock.
            LockTimeoutError: A commit with an earlier timestamp stays undecided.
            ShardUnreachableError: A shard does not answer.
        """
        for request in requests:
            if getattr(getattr(request, "world", None), "moment", None) != self.moment:
                raise MisuseError(
                    f"{request!r} does not name {self!r}; write View(past, …) with the context"
                    " whose view is taken"
                )
        return take_snapshot(requests)

    def _states(self, pattern: str, aspects: tuple[str, ...]) -> Iterable[tuple[str, SlotState]]:
        client = self.session.client
        client.check_usable()
        client.greet()
        known = client.aspect_entries()
        asked = tuple(name for name in (aspects or known) if name in known)
        items = [Item(int(Access.VIEW_EACH), self.name, pattern, name) for name in asked]
        if self.stamp_ns:
            items = [
                Item(int(Access.VIEW), *state.slot, 0, self.stamp_ns, self.moment.nearest)
                for _, state in slot_states(self.session, self.name, pattern, asked)
            ]
        return take_readings(self.session, items, past_ns=self.at_ns, data=False).shown()

    def init(self, *_: object) -> NoReturn:
        """Refuse: the past cannot be set.

        Raises:
            MisuseError: Always.
        """
        self._refuse("init", f"set it in cell.world({self.name!r}), or in a fork of it: world.fork")

    def watch(self, *_: object) -> NoReturn:
        """Refuse: the past does not change.

        Raises:
            MisuseError: Always.
        """
        self._refuse("watch", f"watch cell.world({self.name!r}), or read world.history(…)")

    def _refuse(self, what: str, remedy: str) -> NoReturn:
        raise MisuseError(f"{what} on {self!r}, which is past and only to be viewed; {remedy}")

    def __repr__(self) -> str:
        if self.at_ns:
            return f"PastContext({self.name!r} at {moment_name(self.at_ns)})"
        nearest = ", nearest" if self.moment.nearest else ""
        return f"PastContext({self.name!r}, captured at {self.stamp_ns}{nearest})"
