"""A world context as its user sees it: data to begin with, views, watches, its past, its forks.

A world context W maps (entity, aspect) to a datum or null (ENACT 3.2); `WorldContext` is the
handle, the map itself lies on the shards.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, overload

from enact_dist.access.arguments import (
    Moment,
    When,
    check_argument,
    check_pattern,
    check_viewable,
    checked_each,
    stamp_of,
)
from enact_dist.access.lock import Lock, refuse_inside_lock
from enact_dist.access.snapshot import Snapshot, raw_datum, survey_states, take_snapshot
from enact_dist.access.watch import Watch
from enact_dist.errors import MisuseError
from enact_dist.terms import Aspect, Context, Entities, Entity, Write
from enact_dist.world.forks import fork_world
from enact_dist.world.history import Version, versions_of
from enact_dist.world.listings import SlotInfo, slot_info
from enact_dist.world.past import PastContext

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.access.session import Session
    from enact_dist.access.together import Together
    from enact_dist.compare.diff import Diff
    from enact_dist.compare.two_worlds import Viewable
    from enact_dist.compare.watch_diff import DiffWatch
    from enact_dist.terms import LockRequest

T = TypeVar("T")


class WorldContext(Context):
    """A named map from (entity, aspect) to a datum; made by `Cell.world`."""

    __slots__ = ("session",)

    def __init__(self, name: str, session: Session) -> None:
        super().__init__(name)
        self.session = session

    def init(self, entity: Entity, aspect: Aspect[T], datum: T) -> bool:
        """Set a datum that is null; afterwards it changes only through a lock (ENACT 3.3).

        Args:
            entity: The entity; it exists from here on.
            aspect: The aspect.
            datum: The initial value; arrays are copied, since the caller keeps references to them.

        Returns:
            Whether this call set it; False leaves the existing datum.  A datum that was deleted,
            or lost with a volatile shard, is set again.

        Raises:
            LockHeldError: This thread holds a lock.
            DatumTypeError: The datum is not of the aspect's type.
        """
        refuse_inside_lock("init")
        request = Write(self, entity, aspect)
        with Lock(request) as lock:
            if not lock.is_null(request):
                return False
            lock[request] = datum
        return True

    def view(self, *requests: LockRequest[Any] | Together[Any]) -> Snapshot:
        """Read committed data without a lock.

        All data are of one moment, over shards too: every commit is shown whole or not at all.

        Args:
            requests: `View`s and `ViewEach`es of this cell, and at most one `Together`: then the
                newest set of it that is complete is shown, and the rest as it is now.

        Raises:
            LockHeldError: This thread holds a lock; name the views in it instead.
            LockTimeoutError: No consistent view came within `patience_s`: shards keep
                restarting, or constantly written data are locked for long.
            MisuseError: A request locks.
            NullDatumError: The `Together` has no complete set.
            ShardUnreachableError: A shard does not answer.
        """
        refuse_inside_lock("view")
        return take_snapshot(requests)

    def watch(self, entities: Entities | Entity | str, *aspects: Aspect[Any]) -> Watch:
        """Follow the changes of matching slots: the present data, then every change in order.

        Args:
            entities: A pattern or one entity.
            aspects: Which aspects; none means all.

        Raises:
            LockHeldError: This thread holds a lock.
            TypeError: An argument is of another type.
        """
        refuse_inside_lock("watch")
        check_pattern("watch(entities, *aspects)", "entities", entities)
        checked_each("watch(entities, *aspects)", "aspects", aspects, Aspect)
        return self.watch_all((str(entities),), aspects)

    def watch_all(self, patterns: Iterable[str], aspects: Iterable[Aspect[Any]]) -> Watch:
        """Follow several patterns with one watch; as `watch`, for the framework."""
        self.session.client.check_usable()
        aspects = tuple(aspects)
        if aspects:
            self.session.look_up(aspects)
        names = tuple(aspect.name for aspect in aspects)
        return Watch(self.session.client, (self.name,), tuple(patterns), names)

    def diff(
        self,
        other: Viewable,
        entities: Entities | Entity | str = "**",
        aspects: Iterable[Aspect[Any] | str] | None = None,
    ) -> Diff:
        """Compare this world context (left) with another one (right), datum by datum.

        Both are seen as one cut; one that is past, as it was.  Data are compared by the comparator
        of their aspect, exactly where it names none; an aspect whose type is not known in this
        process is compared without it, dataclasses as dicts.  What is one version on both sides
        is not fetched.

        Args:
            other: A world context, also a past one; of another cell, too, and then seen as a cut
                of its own.
            entities: A pattern or one entity.
            aspects: Aspects, or their names; None means all.

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

    def watch_diff(
        self,
        other: Viewable,
        entities: Entities | Entity | str = "**",
        *aspects: Aspect[Any],
    ) -> DiffWatch:
        """Follow where this world context and another one of the cell differ: a standing diff.

        First come the slots that differ now, then each whose comparison crosses its tolerance, in
        either direction, or that comes or goes on one side; see `DiffWatch`.

        Args:
            other: A world context of the same connection; also a past one, as a reference.
            entities: A pattern or one entity.
            aspects: Which aspects; none means all.

        Raises:
            LockHeldError: This thread holds a lock.
            ForgottenError: A past context is beyond retention.
            TypeError: An argument is of another type.
            MisuseError: The two cannot be watched together.
            UnknownWorldError: The cell no longer has one of them.
            ShardUnreachableError: A shard does not answer.
        """
        from enact_dist.compare.watch_diff import DiffWatch

        refuse_inside_lock("watch_diff")
        check_viewable("watch_diff(other, entities, *aspects)", other)
        check_pattern("watch_diff(other, entities, *aspects)", "entities", entities)
        checked_each("watch_diff(other, entities, *aspects)", "aspects", aspects, Aspect, str)
        return DiffWatch(self, other, str(entities), aspects)

    def survey(
        self, entities: Entities | str = "**", aspects: tuple[str, ...] = ()
    ) -> tuple[SlotInfo, ...]:
        """List the slots that match, null ones too, without their data.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        check_pattern("survey(entities, aspects)", "entities", entities)
        names = checked_each("survey(entities, aspects)", "aspects", aspects, str)
        found = survey_states(self.session, self.name, str(Entities(str(entities))), names)
        infos = [slot_info(shard, state) for shard, state in found]
        return tuple(sorted(infos, key=lambda info: (info.entity, info.aspect)))

    def entities(self, pattern: Entities | str = "**") -> tuple[Entity, ...]:
        """Return the entities that have some datum here."""
        infos = self.survey(pattern)
        return tuple(sorted({info.entity for info in infos if not info.null_reason}))

    def raw(self, entity: Entity, aspect: str) -> object:
        """Return a datum without knowing its Python type: dataclasses come as dicts.

        Raises:
            NullDatumError: It is null.
            MisuseError: No such aspect is registered.
        """
        return raw_datum(self, self.session, entity, aspect)

    # ---------------------------------------------------------------- in time

    def history(
        self,
        entity: Entity,
        aspect: Aspect[T],
        *,
        since: When | None = None,
        count: int | None = None,
    ) -> tuple[Version[T], ...]:
        """List the versions of a datum that are still known, the oldest first, without their data.

        Whatever this process has committed is among them.

        Args:
            entity: The entity.
            aspect: The aspect; ``Aspect(name, object)`` where its type is not known.
            since: Only versions that were current after this moment; None: all.
            count: Only the newest so many; None: all.

        Raises:
            UnknownWorldError: The cell no longer has this world context.
            TypeError: `entity` or `aspect` is of another type.
            MisuseError: `since` is not a past moment, or `count` is not above 0.
            ShardUnreachableError: The entity's shard does not answer.
        """
        check_argument("history(entity, aspect)", "entity", entity, Entity)
        check_argument("history(entity, aspect)", "aspect", aspect, Aspect)
        if count is not None and (type(count) is not int or count < 1):
            raise MisuseError(f"count is {count!r}; it must be a number of versions above 0")
        since_ns = stamp_of(since, seen_ns=self._seen_ns) if since is not None else 0
        return versions_of(self, entity, aspect, since_ns=since_ns, count=count or 0)

    @overload
    def at(self, when: When, /) -> PastContext: ...
    @overload
    def at(self, when: None = None, /, *, stamp_ns: int, nearest: bool = False) -> PastContext: ...
    def at(
        self, when: When | None = None, /, *, stamp_ns: int | None = None, nearest: bool = False
    ) -> PastContext:
        """Return a read-only handle of this world context as it was; contacts no shard yet.

        Args:
            when: As of this moment: the `Position` of a commit (this one included), an aware
                `datetime` or seconds since 1970.
            stamp_ns: In its place: each datum as it was captured at this stamp (`lock.put(…,
                stamp_ns=…)`), its newest such version; null where none is known.
            nearest: Of each datum the version whose capture stamp lies nearest to `stamp_ns`, of
                two as near the later one.

        Raises:
            MisuseError: The moment is invalid or in the future, or both or neither are given.
        """
        if when is not None and stamp_ns is None and not nearest:
            moment = Moment(stamp_of(when, seen_ns=self._seen_ns))
        elif when is None and type(stamp_ns) is int and 0 < stamp_ns < 1 << 63:
            moment = Moment(0, stamp_ns, nearest)
        else:
            raise MisuseError(
                "at(…) takes a moment, or stamp_ns=… (a capture stamp, nanoseconds above 0; with it"
                f" nearest=True), not {when!r} with stamp_ns={stamp_ns!r} and nearest={nearest!r}"
            )
        return PastContext(self.name, self.session, moment)

    @property
    def _seen_ns(self) -> int:
        return self.session.client.core.seen_stamp_ns

    def fork(self, name: str, *, at: When | None = None) -> WorldContext:
        """Make another world context with the data of this one; a write to either stays there.

        Copies pointers, not data, in one step on each shard, and of one cut over all of them.

        Args:
            name: Name of the new context; it must not exist yet.
            at: As of this moment, as in `at`; None: as it is now, every reported commit included.

        Returns:
            The fork.  Repeated with the same `at`, the existing one.

        Raises:
            ForgottenError: A state of that moment is beyond retention; no fork is made.
            MisuseError: The context exists, or the name or the moment is invalid.
            UnknownWorldError: The cell no longer has this world context.
            LockHeldError: This thread holds a lock.
            ShardUnreachableError: A shard does not answer; the message says how to go on.
            LinkError: A commit stamped before stays undecided; the message says how to go on.
        """
        refuse_inside_lock("fork")
        self.session.client.check_usable()
        at_ns = stamp_of(at, seen_ns=self._seen_ns) if at is not None else 0
        fork_world(self.session, self.name, name, at_ns=at_ns)
        return WorldContext(name, self.session)

    @property
    def forked_from(self) -> tuple[str, int] | None:
        """The context that it was forked from, and the timestamp (ns since 1970); None: no fork.

        Answers from what this connection last learned; contacts no shard.
        """
        entry = self.session.client.worlds().get(self.name)
        return (entry.source, entry.at_ns) if entry is not None and entry.source else None
