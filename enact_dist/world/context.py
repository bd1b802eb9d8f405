"""A world context as its user sees it: initial data, views, watches, history, past and forks.

A world context W maps (entity, aspect) to a datum or null (ENACT 3.2); `WorldContext` is the
handle, the map itself lies on the shards.

::

    for version in online.history(piece, LOWEST, count=5):
        print(version.version, version.position, version.datum())

A history carries no data: `Version.datum` fetches one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, overload

from enact_dist.access.arguments import (
    Moment,
    When,
    check_argument,
    check_pattern,
    check_viewable,
    checked_each,
    stamp_of,
)
from enact_dist.access.asking import listed
from enact_dist.access.lock import Lock, refuse_inside_lock
from enact_dist.access.reads import null_error
from enact_dist.access.snapshot import (
    Snapshot,
    reason_of,
    take_snapshot,
    take_view,
    untyped_datum,
)
from enact_dist.access.watch import Change, Watch
from enact_dist.core.protocol.datum import Position, Slot
from enact_dist.errors import ForgottenError, MisuseError, NullDatumError
from enact_dist.link.client.fetch import at_hand
from enact_dist.link.refusals import moment_name
from enact_dist.terms import Aspect, Entities, Entity, FormerNames, LockRequest, View, Write
from enact_dist.wire.payload import decode_datum, decode_untyped
from enact_dist.world.forks import fork_world
from enact_dist.world.past import CellContext, PastContext

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.access.together import Together
    from enact_dist.compare.two_worlds import Viewable
    from enact_dist.compare.watch_diff import DiffWatch
    from enact_dist.core.protocol.messages import Cause, VersionEntry

T = TypeVar("T")


class WorldContext(CellContext):
    """A named map from (entity, aspect) to a datum; made by `Cell.world`."""

    __slots__ = ()

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
            requests: `View`s and `ViewEach`es of this cell, and at most one `Together`, whose
                newest complete set is shown; everything else is shown as it is now.

        Raises:
            LockHeldError: This thread holds a lock; name the views in it instead.
            LockTimeoutError: No consistent view came within `request_timeout_s`: shards keep
                restarting, or data that are written all the time stay locked for long.
            MisuseError: A request locks.
            NullDatumError: The `Together` has no complete set.
            ShardUnreachableError: A shard does not answer.
        """
        refuse_inside_lock("view")
        return take_snapshot(requests)

    def watch(
        self, entities: Entities | Entity | str, *aspects: Aspect[Any], data: bool = False
    ) -> Watch:
        """Follow matching slots: first their present data, then every change in order.

        Args:
            entities: A pattern or one entity.
            aspects: Which aspects; none means all.
            data: Whether notices bring the data, for `Watch.value`: up to 4 kB, or shared memory.

        Raises:
            LockHeldError: This thread holds a lock.
            TypeError: An argument is of another type.
        """
        refuse_inside_lock("watch")
        check_pattern("watch(entities, *aspects)", "entities", entities)
        checked_each("watch(entities, *aspects)", "aspects", aspects, Aspect)
        return watch_patterns(self, (str(entities),), aspects, data=data)

    def watch_diff(
        self,
        other: Viewable,
        entities: Entities | Entity | str = "**",
        *aspects: Aspect[Any] | str,
    ) -> DiffWatch:
        """Follow where this world context and another one of the cell differ: a continuous diff.

        First come the slots that differ now.  Then comes each slot whose comparison crosses its
        tolerance, in either direction, or that appears or disappears on one side; see `DiffWatch`.

        Args:
            other: A world context of the same connection; also a past one, as a reference.
            entities: A pattern or one entity.
            aspects: Which aspects, or their names; none means all.

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

        All commits of this process are included.

        Args:
            entity: The entity.
            aspect: The aspect; ``Aspect(name, object)`` if its type is not known.
            since: Only versions that were current after this moment; None: all.
            count: At most this many, the newest ones; None: all.

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
        client = self.session.client
        client.check_usable()
        shard = client.shard_of(entity.name)
        self.session.settle(shard)
        slot = Slot(self.name, entity.name, aspect.name)
        entries = listed(client, shard, slot, since_ns=since_ns, count=count or 0)
        if not entries:
            self.session.check_world(self.name)
        return tuple(Version.of(shard, self, aspect, entry) for entry in entries)

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
            stamp_ns: Instead of `when`: each datum as it was captured at this stamp
                (`lock.put(…, stamp_ns=…)`), its newest such version; null if none is known.
            nearest: Take of each datum the version whose capture stamp is nearest to `stamp_ns`;
                if two are equally near, the later one.

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
        """Make another world context with the data of this one; later writes stay in their own.

        Copies pointers, not data, in one step on each shard, from one consistent snapshot of all.

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
            LinkError: A commit with an earlier timestamp stays undecided; the message says how to
                go on.
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


def watch_patterns(
    context: WorldContext,
    patterns: Iterable[str],
    aspects: Iterable[Aspect[Any]],
    *,
    data: bool = False,
) -> Watch:
    """Follow several patterns with one watch; see `WorldContext.watch`."""
    session = context.session
    session.client.check_usable()
    aspects = tuple(aspects)
    if aspects:
        session.look_up(aspects)
    names = tuple(aspect.name for aspect in aspects)
    known = {aspect.name: aspect for aspect in aspects}
    read = partial(_value_of, context, known) if data else None
    return Watch(session.client, (context.name,), tuple(patterns), names, read=read)


def _value_of(context: WorldContext, aspects: Mapping[str, Aspect[Any]], change: Change) -> Any:
    """Return the datum that a change brought, or else the newest; see `Watch.value`."""
    refuse_inside_lock("value")
    aspect, session = aspects.get(change.aspect), context.session
    if change.carried is not None:
        datum = at_hand(session.client, session.cache, change.carried)
        if datum is not None:
            return (
                decode_untyped(datum) if aspect is None else decode_datum(datum, aspect.datum_type)
            )
    try:
        if aspect is None:
            return untyped_datum(context, session, change.entity, change.aspect)
        request = View(context, change.entity, aspect)
        return context.view(request)[request]
    except NullDatumError:  # deleted meanwhile
        return None


@dataclass(frozen=True, slots=True)
class Version(FormerNames, Generic[T]):
    """One version of a datum, without it.

    Attributes:
        world: Its world context.
        entity: Its entity.
        aspect: Its aspect; of the type `object` if the program has not named the aspect's type.
        version: Its number, counted from 1 by slot.
        position: Position of its commit.
        until_ns: Stamp of the version that replaced it; 0: it is the newest one.
        stamp_ns: When the datum was captured; 0: unknown.
        size_bytes: Length of the datum's body: arrays, texts and bytes over 256 B, long lists; 0
            for everything else.
        null_reason: Why it is null, or the empty string.
        pinned: The labels that pin it.
        cause: Its writer and inputs; None if unknown.
    """

    world: WorldContext
    entity: Entity
    aspect: Aspect[T]
    version: int
    position: Position
    until_ns: int
    stamp_ns: int
    size_bytes: int
    null_reason: str
    pinned: tuple[str, ...]
    cause: Cause | None
    former: ClassVar[Mapping[str, str]] = {"kept": "pinned"}

    @classmethod
    def of(
        cls, shard: str, world: WorldContext, aspect: Aspect[T], entry: VersionEntry
    ) -> Version[T]:
        """Return a version as its shard has listed it."""
        state = entry.state
        return cls(
            world,
            Entity(state.slot.entity),
            aspect,
            state.version,
            Position(state.stamp_ns, shard),
            entry.until_ns,
            state.captured_ns,
            state.size,
            reason_of(state),
            entry.kept,
            entry.cause,
        )

    @property
    def slot(self) -> Slot:
        """What it is a version of."""
        return Slot(self.world.name, self.entity.name, self.aspect.name)

    def datum(self) -> T:
        """Fetch the datum; if the aspect is of no known type, as `get_untyped` returns it.

        Raises:
            ForgottenError: It has left its retention since it was listed, or its context is gone.
            NullDatumError: The version is null.
            DatumTypeError: It is of another type than the aspect.
            ShardUnreachableError: Its shard does not answer.
        """
        past = PastContext(self.world.name, self.world.session, Moment(self.position.stamp_ns))
        request = View(past, self.entity, self.aspect)
        untyped = self.aspect.datum_type is object
        readings, _ = take_view((request,), register=not untyped)
        state = readings.state(self.slot)
        shown = (state.version, state.stamp_ns) if state is not None else (0, 0)
        if shown != (self.version, self.position.stamp_ns):
            raise ForgottenError(
                f"version {self.version} of {self.slot}, committed at"
                f" {moment_name(self.position.stamp_ns)}, is not known any more; list the history"
                " again"
            )
        if self.null_reason:
            raise null_error(self.slot, state)
        slot, aspect = self.slot, self.aspect
        datum: Any = (
            decode_untyped(readings.datum(slot)) if untyped else readings.value(slot, aspect)
        )
        return datum  # type: ignore[no-any-return]  # of the aspect's type, or the aspect has none

    def __repr__(self) -> str:
        null = f", null: {self.null_reason}" if self.null_reason else ""
        return f"Version({self.slot} v{self.version} at {self.position.stamp_ns}{null})"
