"""A cell: the connection to its shards and the handles to its world contexts.

`connect` joins a running cell over the network; `local` runs one shard inside this process, with
the same core, the same locks and, given a folder, the same durability.
"""

from __future__ import annotations

import atexit
import contextlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from enact_dist.core.datum import Position
from enact_dist.core.messages import (
    AwaitStamp,
    Break,
    Broken,
    ForceAbort,
    ListLocks,
    ListSessions,
    Locks,
    Reached,
    Sessions,
)
from enact_dist.errors import EnactError, MisuseError, UnknownWorldError
from enact_dist.lock import refuse_inside_lock
from enact_dist.session import Session
from enact_dist.terms import checked_name
from enact_dist.world import WorldContext

if TYPE_CHECKING:
    from types import TracebackType

    from enact_dist.core.messages import Holder
    from enact_dist.link.client import CellClient

_open: set[Cell] = set()
"""Held strongly: handles made by a cell work on when nobody keeps the cell itself."""


@dataclass(frozen=True, slots=True)
class LockInfo:
    """One lock that is held or awaited at a shard; times in seconds.

    Attributes:
        number: What `Cell.break_lock` takes; unique within the shard's epoch.
        modes: "read", "write" or both.
        waits_for: Numbers of the locks in the way.
    """

    shard: str
    number: int
    lock_id: str
    actor: str
    host: str
    pid: int
    granted: bool
    modes: str
    age_s: float
    lease_left_s: float
    hold_left_s: float
    slots: tuple[str, ...]
    waits_for: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ShardInfo:
    """One shard of the cell; `reachable` False leaves everything else at zero.

    Attributes:
        open: False while a restarted shard waits for older leases to end.
        clock_ahead_s: Its wall clock less ours, half a round trip taken off.
        round_trip_s: Of the call that asked.
        carrier: How this process's calls to it travel: "socket", or "zenoh" and why.
        counters: Its statistics by name.
    """

    name: str
    endpoint: str
    reachable: bool
    epoch: int = 0
    open: bool = False
    uptime_s: float = 0.0
    slots: int = 0
    size_bytes: int = 0
    sessions: int = 0
    locks: int = 0
    clock_ahead_s: float = 0.0
    round_trip_s: float = 0.0
    carrier: str = ""
    counters: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ActorInfo:
    """One session of a named actor, as the shards see it.

    Attributes:
        report: The actor's own statistics; empty where it gives none.
    """

    actor: str
    host: str
    pid: int
    session: str
    shards: tuple[str, ...]
    lease_left_s: float
    locks: int
    report: dict[str, Any] = field(default_factory=dict)


class Cell:
    """A connection to a cell.  Use as a context manager, or `close` it.

    A cell left open does not hang the interpreter's exit.  After a fork the child must connect
    anew.
    """

    def __init__(self, name: str, client: CellClient, *, host: Any = None) -> None:
        self.name = name
        self._session = Session(client)
        self._client = client
        self._host = host
        _open.add(self)
        # What is registered last runs first: before the transport's own end, over which the
        # goodbyes have to go.
        atexit.unregister(_close_all)
        atexit.register(_close_all)

    # ---------------------------------------------------------------- world contexts

    def worlds(self) -> tuple[str, ...]:
        """Return the names of the world contexts.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self._client.greet()
        return self._client.worlds()

    def world(self, name: str) -> WorldContext:
        """Return the handle of a world context.

        Raises:
            UnknownWorldError: The cell has none of that name; the message lists those it has.
            ShardUnreachableError: A shard does not answer.
        """
        self._client.check_usable()
        if name not in self._client.worlds() and name not in self.worlds():
            known = self._client.worlds()
            raise UnknownWorldError(
                f"cell {self.name!r} has no world context {name!r}; it has"
                f" {', '.join(known) or 'none'}; make one with cell.create_world({name!r})",
                known=known,
            )
        return WorldContext(name, self._session)

    def create_world(self, name: str) -> WorldContext:
        """Make a world context, or return the one that exists.

        Raises:
            LockHeldError: This thread holds a lock.
            ValueError: The name is not allowed.
        """
        refuse_inside_lock("create_world")
        checked_name("world context", name, slashes=False)
        self._client.register(worlds=[name])
        return WorldContext(name, self._session)

    def wait(self, position: Position, *, timeout_s: float = 10.0) -> bool:
        """Wait until everything committed up to `position` is visible; say whether it is.

        Raises:
            LockHeldError: This thread holds a lock.
            ShardUnreachableError: The position's shard does not answer.
            MisuseError: `position` is none of this cell; a lock that wrote nothing has none.
        """
        refuse_inside_lock("wait")
        self._client.check_usable()
        if not isinstance(position, Position) or position.shard not in self._client.shards():
            raise MisuseError(
                f"{position!r} is no position of cell {self.name!r}; a lock has one after its block"
                " if it wrote something"
            )
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, deadline_s - time.monotonic())
            request = AwaitStamp(position.stamp_ns, int(min(left_s, 0.5) * 1e9))
            answer = self._client.call(position.shard, request, timeout_s=left_s + 1.0)
            if isinstance(answer, Reached) and answer.reached:
                return True
            if time.monotonic() >= deadline_s:
                return False

    # ---------------------------------------------------------------- people

    def locks(self) -> tuple[LockInfo, ...]:
        """Return all locks held or awaited, oldest first within each shard.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        shards = self._client.shards()
        answers = self._client.call_all([(shard, ListLocks()) for shard in shards])
        return tuple(
            lock_info(shard, holder)
            for shard, answer in zip(shards, answers, strict=True)
            if isinstance(answer, Locks)
            for holder in answer.holders
        )

    def break_lock(self, number: int, *, shard: str, reason: str = "") -> LockInfo | None:
        """Take a lock away from its holder, who is told why; audited by the shard.

        Returns:
            What the lock was, or None if no such lock is held or awaited.

        Raises:
            MisuseError: The cell has no such shard.
            ShardUnreachableError: The shard does not answer.
        """
        return self._ended_by_hand(shard, Break(number, reason))

    def force_abort(self, number: int, *, shard: str, reason: str) -> LockInfo | None:
        """Give up a lock in doubt whose deciding shard is lost for good; audited by the shard.

        If that shard had committed the lock after all, only a part of its writes stands then.

        Returns:
            What the lock was, or None if no such lock is in doubt.

        Raises:
            MisuseError: The cell has no such shard.
            ShardUnreachableError: The shard does not answer.
        """
        return self._ended_by_hand(shard, ForceAbort(number, reason))

    def _ended_by_hand(self, shard: str, request: Break | ForceAbort) -> LockInfo | None:
        if shard not in self._client.shards():
            raise MisuseError(
                f"cell {self.name!r} has no shard {shard!r}; it has"
                f" {', '.join(self._client.shards())}"
            )
        answer = self._client.call(shard, request)
        holder = answer.holder if isinstance(answer, Broken) else None
        return lock_info(shard, holder) if holder is not None else None

    def shards(self) -> tuple[ShardInfo, ...]:
        """Return every shard of the cell, unreachable ones too."""
        return tuple(self._shard_info(shard) for shard in self._client.shards())

    def _shard_info(self, shard: str) -> ShardInfo:
        endpoint = self._client.carrier.endpoint_of(shard)
        started_s = time.monotonic()
        answer = self._client.call_once([(shard, ListSessions())])[0]
        round_trip_s = time.monotonic() - started_s
        if not isinstance(answer, Sessions):
            return ShardInfo(shard, endpoint, reachable=False)
        ahead_ns = answer.wall_ns - time.time_ns() + round_trip_s * 1e9 / 2
        return ShardInfo(
            shard,
            endpoint,
            reachable=True,
            epoch=answer.epoch,
            open=answer.open,
            uptime_s=answer.uptime_ns / 1e9,
            slots=answer.slots,
            size_bytes=answer.bytes,
            sessions=len(answer.sessions),
            locks=sum(session.locks for session in answer.sessions),
            clock_ahead_s=ahead_ns / 1e9,
            round_trip_s=round_trip_s,
            carrier=self._client.carrier.way_to(shard),
            counters={counter.name: counter.value for counter in answer.counters},
        )

    def actors(self) -> tuple[ActorInfo, ...]:
        """Return the sessions of named actors over all shards.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        shards = self._client.shards()
        answers = self._client.call_all([(shard, ListSessions()) for shard in shards])
        found: dict[str, ActorInfo] = {}
        for shard, answer in zip(shards, answers, strict=True):
            for info in answer.sessions if isinstance(answer, Sessions) else ():
                if not info.actor:
                    continue
                before = found.get(info.session)
                report = _report(info.report)
                found[info.session] = ActorInfo(
                    info.actor,
                    info.host,
                    info.pid,
                    info.session,
                    (*(before.shards if before else ()), shard),
                    max(info.lease_left_ns / 1e9, before.lease_left_s if before else 0.0),
                    info.locks + (before.locks if before else 0),
                    report or (before.report if before else {}),
                )
        return tuple(sorted(found.values(), key=lambda info: (info.actor, info.session)))

    def set_report(self, report: bytes) -> None:
        """Let the keep-alives carry an actor's own statistics (msgpack of a map)."""
        self._client.set_report(report)

    def aspects(self) -> dict[str, tuple[str, str]]:
        """Return the registered aspects: name to (fingerprint of the type, durability)."""
        self._client.greet()
        entries = self._client.aspect_entries()
        return {name: (entry.fingerprint, entry.durability) for name, entry in entries.items()}

    def statistics(self) -> dict[str, int]:
        """Return this connection's own counters by name."""
        return dict(self._client.counters)

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """Give back everything and end the connection; twice is harmless."""
        _open.discard(self)
        try:
            self._client.close()
        finally:
            if self._host is not None and not self._client.forked:
                self._host.close()
                self._host = None

    def __enter__(self) -> Cell:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<cell {self.name!r}, {len(self._client.shards())} shards>"


def lock_info(shard: str, holder: Holder) -> LockInfo:
    """Return a shard's description of a lock in seconds."""
    return LockInfo(
        shard,
        holder.number,
        str(holder.lock),
        holder.actor,
        holder.host,
        holder.pid,
        holder.granted,
        holder.modes,
        holder.age_ns / 1e9,
        holder.lease_left_ns / 1e9,
        holder.hold_left_ns / 1e9,
        holder.slots,
        holder.waits_for,
    )


def _report(encoded: bytes) -> dict[str, Any]:
    """Return an actor's report; empty where it is none, as any client may send anything."""
    import msgpack

    try:
        report = msgpack.unpackb(encoded) if encoded else {}
    except (ValueError, msgpack.UnpackException):
        return {}
    return report if isinstance(report, dict) else {}


def _close_all() -> None:
    for cell in list(_open):
        with contextlib.suppress(EnactError):
            cell.close()
