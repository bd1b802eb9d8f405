"""The lock, one per thread: data held at once until its `with` block ends (ENACT 3.3, RAII).

::

    with Lock(Read(online, piece, MESH), Write(online, bench, CONTACTS)) as lock: ...

Clean exit publishes all writes at once; an exception publishes nothing.  The requests may name
several world contexts and shards.  Departures from the paper: the request itself is the index (no
order-coupled list), data are immutable values, and a lock is a lease.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

from enact_dist.access.arguments import HOLD_S_MAX, check_hold, check_seconds
from enact_dist.access.each import Block, WritableEach
from enact_dist.access.reads import EachData, Readings, check_requested, misfit, slot_of
from enact_dist.access.session import bind, bound_before
from enact_dist.access.together import Together
from enact_dist.access.trigger import LockStatistics, Triggered
from enact_dist.access.writes import Asked, Writing, reads_of, refuse_changed
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import SlotVersion
from enact_dist.core.state.clock import device_token
from enact_dist.errors import (
    DatumTypeError,
    LockHeldError,
    LockReleasedError,
    MisuseError,
    ReadonlyError,
)
from enact_dist.terms import Access
from enact_dist.wire.payload import encode_parts

if TYPE_CHECKING:
    from enact_dist.access.session import Session
    from enact_dist.access.writes import DTypesLike, ShapesLike
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Position, Slot
    from enact_dist.core.protocol.messages import DatumRead, Item
    from enact_dist.terms import (
        Aspect,
        LockRequest,
        LockRequestEach,
        LockRequestOne,
        View,
        Write,
        WriteEach,
    )

T = TypeVar("T")
R = TypeVar("R", bound="LockRequest[Any]")

_NO_READS: tuple[tuple[DatumRead, ...], int] = (), 0
_thread = threading.local()


def refuse_inside_lock(what: str) -> None:
    """Raise `LockHeldError` if this thread holds a lock: `what` waits, and so could wait for it.

    A lock that was left in another thread, or that a forked child inherited, is not held here.
    """
    held: Lock | None = getattr(_thread, "lock", None)
    if held is not None and held.running:
        if held._is_abandoned():  # noqa: SLF001 - of this module
            held.__exit__(KeyboardInterrupt, None, None)
            return
        raise LockHeldError(
            f"{what} inside a lock would hold and wait; this thread holds {held!r};"
            " leave its block first"
        )


class Lock(Triggered):
    """A set of data, granted together or not granted.

    An array arrives read-only: ``lock[joints] += 1`` works on it in place, which numpy refuses
    ("output array is read-only").  Write ``lock[joints] = lock[joints] + 1``.

    Only what is assigned is published: assign a list or dict anew after changing it in place
    (``lock[flags] = {**lock[flags], "b": True}``).  An assignment takes the value of that moment.

    Args:
        requests: What to read, write and view, in any contexts and shards of one cell: at most
            4,096 requests and 4,096 written data.  All writes become visible, or none.
        wait_s: How long to wait for the grant.
        hold_s: How long it may be held at most after the grant.

    Entering raises:
        LockTimeoutError: Not granted within `wait_s`; nothing is held.
        LockHeldError: This thread holds a lock already.
        ShardUnreachableError: A shard does not answer.

    Leaving raises (after a clean block):
        LeaseLostError: The lock was lost; nothing was written.
        ChangedError: An expected view has changed; nothing was written.
        MisuseError: A list or dict that may be written was changed in place and not assigned;
            nothing was written.
        CommitUnknownError: The commit was sent but never answered.

    Attributes:
        position: Position of the commit, after the block; None before or without writes.
        entity: In an actor's `update`, the entity that triggered it.
    """

    def __init__(
        self, *requests: LockRequest[Any], wait_s: float = 10.0, hold_s: float = 60.0
    ) -> None:
        self._bound = bound_before(requests) or bind(requests)
        if type(wait_s) is not float or not wait_s >= 0.0:
            check_seconds("wait_s", wait_s)
        if type(hold_s) is not float or not 0.0 < hold_s <= HOLD_S_MAX:
            check_hold("hold_s", hold_s)
        self._kept = requests  # so that the ids in `_bound` stay theirs
        self._requests = dict(zip(requests, requests, strict=True))
        self._session: Session = requests[0].world.session  # type: ignore[attr-defined]  # bound
        self._wait_s, self._hold_s = wait_s, hold_s
        self._lock: MultiLock | None = None
        self._asking = self._over = False
        self._interrupt: threading.Event | None = None
        self._after: tuple[DatumRead, ...] = ()
        self._shown: tuple[Reading, ...] = ()
        self._readings: Readings
        self._each: dict[LockRequest[Any], EachData[Any]] = {}
        self._writing = Writing(self._session.client.payloads)
        self._expects: dict[Slot, SlotVersion] = {}
        self._asked_s = self._granted_s = self._ended_s = 0.0
        self.position: Position | None = None

    # ---------------------------------------------------------------- the block

    @property
    def running(self) -> bool:
        """Whether the lock is asked for or held in this process."""
        asked = self._asking or self._lock is not None
        return asked and not self._over and not self._session.client.forked

    def __enter__(self) -> Self:
        if getattr(_thread, "lock", None) is not None:
            refuse_inside_lock("a second lock")
        if self._lock is not None or self._asking:
            raise LockReleasedError(f"{self!r} was used already; make a new lock")
        session, client = self._session, self._session.client
        prepared = session.prepare_bound(self._bound, self._requests, wait_s=self._wait_s)
        begun: list[MultiLock] = []
        self._asked_s = time.monotonic()
        try:
            self._asking = True
            _thread.lock = self
            lock = client.acquire(
                self._items(),
                wait_s=self._wait_s,
                hold_s=self._hold_s,
                interrupt=self._interrupt,
                begun=begun,
                keep=() if self._after else self._bound.items,
                after=self._after,
            )
            lock.states += self._shown
            if session.unknown or client.catalogue.lapses != prepared:
                session.check_shown(lock.states, self._requests, prepared)
            self._granted_s = time.monotonic()
            self._readings = Readings(client, session.cache, lock.lock, lock.states, self._use)
            self._readings.asked = self._requests
            self._readings.take_over(lock.keeping, self._bound.single.values())
            self._lock = lock
            self._asking = False
        except BaseException:
            _thread.lock = self._lock = None
            self._asking = False
            if begun:
                client.release(begun[-1])  # only does something if interrupted after the grant
            raise
        return self

    def _items(self) -> tuple[Item, ...]:
        if self._session.cache.known.keys().isdisjoint(self._bound.slots):
            return self._bound.items
        return tuple(map(self._session.item_of, self._requests))

    def _leave(self, kind: type[BaseException] | None, *_: object) -> None:
        """Leave the block: the work of `__exit__`, see `Leaves`."""
        lock, client = self._lock, self._session.client
        if lock is None or self._over:
            raise LockReleasedError(f"{self!r} is not held, so it cannot be left")
        try:
            self._over = True
            self._ended_s = time.monotonic()
            if getattr(_thread, "lock", None) is self:
                _thread.lock = None
            if kind is None:
                if client.forked or client.closed:
                    client.check_usable()
                readings, writing = self._readings, self._writing
                if readings.changeable or writing.looked_at:
                    shown, assigned = readings.changeable, writing.looked_at
                    refuse_changed(shown, assigned, writing.data, self._requests)
                if writing.drafts:
                    writing.fix()
                readings.pass_on(lock.keeping, self._bound.single.values(), writing.data)
                only = lock.parts[0].shard if len(lock.parts) == 1 else ""
                writes = writing.by_shard(lock.shard_of, only)
                read = reads_of(readings, self._bound.reads, self._each) if writes else _NO_READS
                client.finish(lock, writes, tuple(self._expects.values()), *read)
                self.position = lock.position
        finally:
            # A commit leaves nothing to release; after an exception or interrupt this releases all.
            if not client.forked:
                if not lock.lane_free:
                    client.release(lock)
                self._writing.end(committed=lock.phase in (Phase.COMMITTED, Phase.UNKNOWN))
            self._let_go()

    def _let_go(self) -> None:
        """Free the data with the block: what refers to this lock would form a cycle with it."""
        self._readings.end()
        self._each.clear()
        if (lock := self._lock) is not None:
            lock.states.clear()
            lock.cut = None

    def _use(self) -> None:
        """Raise unless the block is running and the lock not known to be lost."""
        if self._lock is None or self._over:
            raise LockReleasedError(f"{self!r} is used outside its `with` block")
        self._session.client.check_usable()
        if self._lock.phase is not Phase.HELD:
            self.check()

    # ---------------------------------------------------------------- data

    @overload
    def __getitem__(self, request: Together[T]) -> tuple[T, ...]: ...
    @overload
    def __getitem__(self, request: WriteEach[T]) -> WritableEach[T]: ...
    @overload
    def __getitem__(self, request: LockRequestEach[T]) -> EachData[T]: ...
    @overload
    def __getitem__(self, request: LockRequestOne[T]) -> T: ...
    def __getitem__(self, request: Any) -> Any:
        """Return the datum; for a pattern, the data by entity; for an actor's set, all its data.

        Raises:
            NullDatumError: The world context does not know it.
            NotRequestedError: The lock did not ask for it.
            LeaseLostError: The lock is lost.
        """
        found = self._bound.single.get(id(request)) if self._held() else None
        if found is None:
            request = self._check(request)
            if request.access.each:
                return self._each_data(request)
            return self._value(slot_of(request), request.aspect)
        return self._value(found[0], found[1])

    def _held(self) -> bool:
        """Whether the block runs and nothing is known against the lock: the usual case."""
        lock, client = self._lock, self._session.client
        return (
            lock is not None
            and lock.phase is Phase.HELD
            and not (self._over or client.forked or client.closed)
        )

    def _value(self, slot: Slot, aspect: Aspect[Any]) -> Any:
        if slot in self._writing.data:
            return self._writing.written(slot, aspect)
        return self._readings.value(slot, aspect)

    def _each_data(self, request: LockRequest[T]) -> EachData[T]:
        """Return the mapping of a pattern, made once: `lock[each][entity]` is used in loops."""
        data = self._each.get(request)
        if data is None:
            writable = request.access is Access.WRITE_EACH
            data = (
                WritableEach(self._block(), self._readings, request)
                if writable
                else EachData(self._readings, request)
            )
            self._each[request] = data
        if isinstance(data, WritableEach):
            data.follow()
        return data

    def _block(self) -> Block:
        return Block(self._writing, self._use, self._put, self._stamp, self._shard)

    @overload
    def get(self, request: LockRequestOne[T]) -> T | None: ...
    @overload
    def get(self, request: LockRequestOne[T], default: T) -> T: ...
    def get(self, request: LockRequestOne[T], default: T | None = None) -> T | None:
        """Return the datum, or `default` where the world context does not know it."""
        request = self._check(request)
        slot = slot_of(request)
        if self._is_null(slot):
            return default
        value: T = self._value(slot, request.aspect)
        return value

    def is_null(self, request: LockRequestOne[Any]) -> bool:
        """Whether the datum is null; fetches nothing."""
        return self._is_null(slot_of(self._check(request)))

    def _is_null(self, slot: Slot) -> bool:
        if slot in self._writing.data:
            return self._writing.data[slot] is None
        state = self._readings.state(slot)
        return state is None or bool(state.null_reason)

    def put(self, request: Write[T], datum: T, *, stamp_ns: int | None = None) -> None:
        """Set the datum when the block ends cleanly.

        Args:
            request: A `Write` of this lock.
            datum: A value of the aspect's type; arrays are copied.
            stamp_ns: When it was captured, nanoseconds since 1970; 0 where that has no meaning.
                Left out, it is that of what triggered the update of an actor, see `Actor`, else 0.

        Raises:
            ReadonlyError: The request does not allow writing.
            DatumTypeError: The datum is not of the aspect's type.
            NoRoomError: The shard's cap of shared memory is reached.
        """
        found = self._bound.single.get(id(request)) if self._held() else None
        if found is None or not found[2]:
            request = self._check_writable(request)
            found = slot_of(request), request.aspect, True
        self._put(found[0], found[1], datum, stamp_ns)

    __setitem__ = put

    def _put(self, slot: Slot, aspect: Aspect[T], datum: T, stamp_ns: int | None) -> None:
        try:
            encoded = encode_parts(datum, aspect.datum_type, stamp_ns=self._stamp(stamp_ns))
        except DatumTypeError as error:
            raise misfit(slot, "is not set", error) from error.__cause__
        self._writing.put(slot, encoded, self._shard)

    def _shard(self, slot: Slot) -> str:
        assert self._lock is not None
        return self._lock.shard_of(slot)

    @overload
    def new(
        self,
        request: Write[T],
        shape: ShapesLike,
        dtype: DTypesLike = None,
        *,
        stamp_ns: int | None = None,
    ) -> T: ...
    @overload
    def new(self, request: Write[T], *, like: T, stamp_ns: int | None = None) -> T: ...
    def new(
        self,
        request: Write[T],
        shape: ShapesLike | None = None,
        dtype: DTypesLike = None,
        *,
        like: T | None = None,
        stamp_ns: int | None = None,
    ) -> T:
        """Return a datum whose arrays are to be filled in place; committing it copies nothing.

        It counts as written; after the block its arrays are read-only.  One block hands out one for
        each slot; `put` may still take its place.

        Args:
            request: A `Write` of this lock.
            shape: Of the array; for a dataclass of arrays ``{field: shape}``, whose own checks see
                them filled with zeros.
            dtype: Of the array, or ``{field: dtype}``; as annotated, else float64, if left out.
            like: In place of both: a datum, its arrays of the shapes, dtypes and orders wanted.
            stamp_ns: As in `put`.

        Raises:
            ReadonlyError: The request does not allow writing.
            DatumTypeError: What was asked is not of the aspect's type, or has no array.
            MisuseError: This block has one of this slot already.
            NoRoomError: As `put`.
        """
        request = self._check_writable(request)
        asked = Asked(request.aspect.datum_type, like, shape, dtype, self._stamp(stamp_ns))
        value: T = self._writing.new(slot_of(request), asked, self._shard)
        return value

    def __delitem__(self, request: Write[Any]) -> None:
        """Write null when the block ends cleanly."""
        self._writing.delete(slot_of(self._check_writable(request)))

    def expect(self, view: View[Any]) -> None:
        """Let the commit fail with `ChangedError` if the viewed slot has moved on by then.

        It fails too if another lock holds the slot for writing at that moment and might yet
        commit before this one.  What is expected counts as read: two locks that each expect what
        the other writes never both commit, on whatever shards the slots lie.

        Raises:
            MisuseError: Not a `View` of this lock.
        """
        view = self._check(view)
        if view.access is not Access.VIEW:
            raise MisuseError(f"{view!r} is held or a pattern; only a View can be expected")
        slot = slot_of(view)
        state = self._readings.state(slot)
        self._expects[slot] = SlotVersion(slot, state.version if state is not None else 0)

    def _resolve(self, request: R) -> R:
        """Return which request of this lock is meant by `request`."""
        return request

    def _check(self, request: R) -> R:
        self._use()
        request = self._resolve(request)
        check_requested(request, self._requests, "lock")
        return request

    def _check_writable(self, request: R) -> R:
        request = self._check(request)
        if request.access is Access.WRITE_EACH:
            raise MisuseError(
                f"set one entity at a time: lock[{request!r}][entity] = …, or .new(entity, …) of it"
            )
        if request.access is not Access.WRITE:
            raise ReadonlyError(
                f"{request!r} does not allow writing; ask with Write(…) instead of"
                f" {type(request).__name__}(…)"
            )
        return request

    # ---------------------------------------------------------------- state

    def version(self, request: LockRequestOne[Any]) -> int:
        """Return the version of the datum as granted (0: never set)."""
        state = self._readings.state(slot_of(self._check(request)))
        return state.version if state is not None else 0

    def stamp_ns(self, request: LockRequestOne[Any] | Together[Any]) -> int:
        """Return when the datum, or an actor's set, was captured (0: its writer did not tell)."""
        if isinstance(request, Together):
            raise MisuseError(f"{request!r} is no part of this lock; an actor's trigger can be")
        slot = slot_of(self._check(request))
        if slot in self._writing.data:
            datum = self._writing.data[slot]
            return datum.stamp_ns if datum is not None else 0
        state = self._readings.state(slot)
        return state.captured_ns if state is not None else 0

    def valid(self) -> bool:
        """Whether this process may still believe that it holds the lock; contacts no shard."""
        return self._lock is not None and not self._over and self._session.client.valid(self._lock)

    def check(self) -> None:
        """Make sure that the lock is held; asks the shards whose lease may be over.

        Raises:
            LeaseLostError: It is lost.
            LockReleasedError: The block is not running.
            ShardUnreachableError: A shard does not answer, so the state of the lock is unknown.
        """
        if self._lock is None or self._over:
            raise LockReleasedError(f"{self!r} is used outside its `with` block")
        self._session.client.check(self._lock)

    @property
    def token(self) -> tuple[tuple[str, int, int], ...]:
        """Fencing numbers (shard, epoch, number), for outside devices that compare them.

        Of two grants of one shard the later has the larger (epoch, number); blocks may share one.
        If the shard has no folder, that holds while its host's clock is not set back.
        """
        parts = self._lock.parts if self._lock is not None else []
        return tuple((p.shard, *device_token(p.token)) for p in parts if p.token)

    def statistics(self) -> LockStatistics:
        """Return what the lock went through so far."""
        granted = self._lock is not None
        end_s = self._ended_s or time.monotonic()
        return LockStatistics(
            granted=granted,
            waited_s=self._granted_s - self._asked_s if granted else 0.0,
            held_s=end_s - self._granted_s if granted else 0.0,
            shards=tuple(part.shard for part in self._lock.parts) if self._lock else (),
            fetched=self._readings.decoded if granted else 0,
        )

    def __repr__(self) -> str:
        return f"Lock({', '.join(map(repr, self._requests))})"
