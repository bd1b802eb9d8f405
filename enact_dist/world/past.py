"""A world context as it was: what `WorldContext.at` returns.

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

from enact_dist.access.arguments import check_pattern, checked_each
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.access.snapshot import raw_datum, survey_states, take_readings, take_snapshot
from enact_dist.core.protocol.messages import Item
from enact_dist.errors import MisuseError
from enact_dist.link.refusals import moment_name
from enact_dist.terms import Access, Context, Entities, Entity
from enact_dist.world.listings import SlotInfo, slot_info

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.access.arguments import Moment
    from enact_dist.access.session import Session
    from enact_dist.access.snapshot import Snapshot
    from enact_dist.compare.diff import Diff
    from enact_dist.compare.two_worlds import Viewable
    from enact_dist.terms import Aspect, LockRequest


class PastContext(Context):
    """A world context as of a moment, read-only; made by `WorldContext.at`.

    Requests name it as they do a world context: ``View(past, entity, ASPECT)``.  All views of one
    call name the same moment; they may name several contexts of it.

    Attributes:
        moment: What is shown.
    """

    __slots__ = ("moment", "session")
    past: ClassVar[bool] = True

    def __init__(self, name: str, session: Session, moment: Moment) -> None:
        super().__init__(name)
        self.session = session
        self.moment = moment

    @property
    def at_ns(self) -> int:
        """The timestamp that it shows; 0: data are shown by their capture timestamp."""
        return self.moment.at_ns

    @property
    def stamp_ns(self) -> int:
        """The capture stamp of the data that are shown, 0 where it does not matter."""
        return self.moment.captured_ns

    def view(self, *requests: LockRequest[Any]) -> Snapshot:
        """Read past data; allowed inside a lock, since no lock can block it.

        Args:
            requests: `View`s and `ViewEach`es of this moment.

        Raises:
            ForgottenError: A state of then has left its retention; never shown as another one.
            MisuseError: A request locks, or names another moment.
            ClockSkewError: The moment lies in the future of a shard's clock.
            LockTimeoutError: A commit stamped before stays undecided.
            ShardUnreachableError: A shard does not answer.
        """
        for request in requests:
            if getattr(getattr(request, "world", None), "moment", None) != self.moment:
                raise MisuseError(
                    f"{request!r} does not name {self!r}; write View(past, …) with the context"
                    " whose view is taken"
                )
        return take_snapshot(requests)

    def survey(
        self, entities: Entities | str = "**", aspects: tuple[str, ...] = ()
    ) -> tuple[SlotInfo, ...]:
        """List the data that matched then, without them; what was null is left out.

        Raises:
            ForgottenError: A state of then has left its retention.
            UnknownWorldError: The cell has no such world context any more.
            ShardUnreachableError: A shard does not answer.
        """
        check_pattern("survey(entities, aspects)", "entities", entities)
        aspects = checked_each("survey(entities, aspects)", "aspects", aspects, str)
        client, pattern = self.session.client, str(Entities(str(entities)))
        client.check_usable()
        client.greet()
        known = client.aspect_entries()
        asked = [name for name in (aspects or known) if name in known]
        items = [Item(int(Access.VIEW_EACH), self.name, pattern, name) for name in asked]
        if self.stamp_ns:
            items = [
                Item(int(Access.VIEW), *state.slot, 0, self.stamp_ns, self.moment.nearest)
                for _, state in survey_states(self.session, self.name, pattern, tuple(asked))
            ]
        readings = take_readings(self.session, items, past_ns=self.at_ns, data=False)
        infos = [slot_info(shard, state) for shard, state in readings.shown()]
        return tuple(sorted(infos, key=lambda info: (info.entity, info.aspect)))

    def entities(self, pattern: Entities | str = "**") -> tuple[Entity, ...]:
        """Return the entities that had some datum then; raises as `survey`."""
        return tuple(sorted({info.entity for info in self.survey(pattern)}))

    def raw(self, entity: Entity, aspect: str) -> object:
        """Return a datum of then without knowing its Python type: dataclasses come as dicts.

        Raises:
            NullDatumError: It was null.
            ForgottenError: It has left its retention.
            MisuseError: No such aspect is registered.
        """
        return raw_datum(self, self.session, entity, aspect)

    def diff(
        self,
        other: Viewable,
        entities: Entities | Entity | str = "**",
        aspects: Iterable[Aspect[Any] | str] | None = None,
    ) -> Diff:
        """Compare this world context as it was (left) with another one; as `WorldContext.diff`."""
        from enact_dist.compare.diff import diff

        refuse_inside_lock("diff")
        return diff(self, other, entities, aspects)

    # ---------------------------------------------------------------- what only the present has

    def init(self, *_: object) -> NoReturn:
        """Refuse: what was cannot be set.

        Raises:
            MisuseError: Always.
        """
        self._refuse("init", f"set it in cell.world({self.name!r}), or in a fork of it: world.fork")

    def watch(self, *_: object) -> NoReturn:
        """Refuse: what was does not change.

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
