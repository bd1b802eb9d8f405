"""A cell: the connection to its shards and the handles to its world contexts.

`connect` joins a running cell over the network; `local` runs one shard inside this process, with
the same core, the same locks and, given a folder, the same durability.
"""

from __future__ import annotations

import atexit
import contextlib
import time
import weakref
from typing import TYPE_CHECKING, Any, ClassVar

from enact_dist.access.arguments import check_reason
from enact_dist.access.asking import ask_all, await_stamp
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.access.session import Session
from enact_dist.access.watch import Closing, end_watches
from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import (
    Break,
    Broken,
    ForceAbort,
    ListLocks,
    ListSessions,
    Locks,
    Sessions,
)
from enact_dist.errors import EnactError, MisuseError
from enact_dist.link.client.dropped import when_dropped
from enact_dist.terms import Aspect, Entity, FormerNames, checked_name
from enact_dist.world.context import Version, WorldContext
from enact_dist.world.forks import drop_world
from enact_dist.world.invalidation import invalidate
from enact_dist.world.lineage import CauseTree, EffectTree, Made, tree_of
from enact_dist.world.listings import (
    ActorInfo,
    AspectInfo,
    AuditInfo,
    LockInfo,
    RefusalInfo,
    ShardInfo,
    actor_infos,
    aspect_infos,
    audit_infos,
    lock_info,
    lock_infos,
    refusal_infos,
    settle_alarms,
    shard_info,
)
from enact_dist.world.pins import pin_versions, pinned_versions, unpin_versions

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.link.client.locks import CellClient

_open: weakref.WeakKeyDictionary[CellClient, Any] = weakref.WeakKeyDictionary()
"""The sessions of cells that were not closed, with the shard inside this process, if it has one.

Handles of a cell keep working after the program has dropped its last reference to the cell.
"""


class Cell(FormerNames, Closing):
    """A connection to a cell.  Use as a context manager, or `close` it.

    A cell left open does not block the interpreter's exit.  Once neither a cell nor what it made is
    referenced any more, it is closed with a `ResourceWarning` that says where it was opened.

    A network connection does not survive a fork of the process: in the child the cell and every
    `connect` raise `MisuseError`, even if the parent had closed the cell before.
    Connect for the first time after the fork, or start the child with
    ``multiprocessing.get_context("spawn")``.  `local` works in both.
    """

    former: ClassVar[Mapping[str, str]] = {
        "keep": "pin",
        "kept": "pinned",
        "let_go": "unpin",
        "aspect_infos": "aspects",
        "settle_alarms": "acknowledge_alarms",
    }

    def __init__(self, name: str, client: CellClient, *, host: Any = None) -> None:
        self.name = name
        self._session = Session(client)
        self._client = client
        self._host = host
        self._dropped = when_dropped(client, name, host)
        _open[client] = host
        # What is registered last runs first: the transport, which carries the goodbyes, ends later.
        atexit.unregister(_close_all)
        atexit.register(_close_all)

    # ---------------------------------------------------------------- world contexts

    def worlds(self) -> tuple[str, ...]:
        """Return the names of the world contexts.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self._client.greet()
        return tuple(self._client.worlds())

    def world(self, name: str) -> WorldContext:
        """Return the handle of a world context.

        Raises:
            UnknownWorldError: The cell has none of that name; the message lists those it has.
            ShardUnreachableError: A shard does not answer.
        """
        self._client.check_usable()
        if name not in self._client.worlds():
            self._session.check_world(name)
        return WorldContext(name, self._session)

    def create_world(self, name: str) -> WorldContext:
        """Make a world context, or return the existing one.

        Raises:
            LockHeldError: This thread holds a lock.
            MisuseError: The connection only observes.
            UnknownWorldError: Some shards have it as an incomplete fork.
            ValueError: The name is not allowed.
        """
        refuse_inside_lock("create_world")
        checked_name("world context", name, slashes=False)
        if any(entry.source for entry in self._client.worlds_at(name).values()):
            self._session.check_world(name)
        self._client.register(worlds=[name])
        return WorldContext(name, self._session)

    def drop_world(self, name: str) -> int:
        """Delete a world context on every shard: its data, their history and its pinned versions.

        Its watchers get a change for each slot; its handles raise `UnknownWorldError`.  Forks of it
        stay as they are.  A new context may have the same name; version numbers never repeat.

        Returns:
            How many slots were deleted.

        Raises:
            UnknownWorldError: The cell has none of that name.
            MisuseError: A lock is held or awaited in it, or `cell.toml` names it.
            LockHeldError: This thread holds a lock.
            ShardUnreachableError: A shard does not answer; the message names the shards that have
                dropped it.
        """
        refuse_inside_lock("drop_world")
        self._client.check_usable()
        return drop_world(self._session, name)

    # ---------------------------------------------------------------- pinned versions

    def pin(self, label: str, versions: Iterable[Version[Any] | Made]) -> None:
        """Retain versions, whatever their aspect's retention, until `unpin`.

        They stay listed and readable (`Version.datum`), and count in the shard's room.  A second
        call with the same label adds versions.

        Args:
            label: Letters, digits, ``_ . -``, slashes between.
            versions: As `WorldContext.history` or `pinned` returns them, or those of a tree of
                `why` or `impact` (`tree.walk()`) that are `known`.

        Raises:
            ForgottenError: Some had left their retention before; the others are pinned.
            MisuseError: The label cannot be used, or something is no version.
            ShardUnreachableError: A shard does not answer; the call can be repeated safely.
        """
        self._client.check_usable()
        pin_versions(self._session, label, versions)

    def pinned(self) -> dict[str, tuple[Version[Any], ...]]:
        """Return the pinned versions by label; their aspects are of the type `object`.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self._client.check_usable()
        return pinned_versions(self._session)

    def unpin(self, label: str) -> None:
        """Release the versions of a label; those without another label follow their retention.

        A label without versions is no error.

        Raises:
            MisuseError: No version can have that label.
            ShardUnreachableError: A shard does not answer; the call can be repeated safely.
        """
        self._client.check_usable()
        unpin_versions(self._session, label)

    def wait(self, position: Position, *, timeout_s: float = 10.0) -> bool:
        """Wait until all commits up to `position` are visible; say whether they are.

        Raises:
            LockHeldError: This thread holds a lock.
            ShardUnreachableError: The position's shard does not answer.
            MisuseError: `position` is not of this cell; a lock that wrote nothing has none.
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
            if await_stamp(
                self._client,
                position.shard,
                position.stamp_ns,
                wait_s=min(left_s, 0.5),
                timeout_s=left_s + 1.0,
            ):
                return True
            if time.monotonic() >= deadline_s:
                return False

    def outcome(self, lock_id: str, *, timeout_s: float = 10.0) -> Position | None:
        """Ask what became of a commit that ended in `CommitUnknownError`.

        A commit that its shard has not received yet is ruled out by this call.

        Args:
            lock_id: As in the error; any process of the cell may ask.
            timeout_s: How long to wait for an answer of the shard.

        Returns:
            The position of the commit, or None if nothing was written.

        Raises:
            CommitUnknownError: The shard does not know: a restart took its record, 64 later commits
                of the process have ended in this error, too, or it has been gone for a day.
            PermissionDeniedError: The process that made the commit is alive; nothing is written
                yet, and only that process can rule out that it will be.
            ShardUnreachableError: The shard does not answer.
            LockHeldError: This thread holds a lock.
            MisuseError: `lock_id` is not of this cell.
        """
        refuse_inside_lock("outcome")
        return self._client.outcome(lock_id, timeout_s=timeout_s)

    # ---------------------------------------------------------------- lineage

    def why(
        self,
        world: WorldContext | str,
        entity: Entity | str,
        aspect: Aspect[Any] | str,
        version: int = 0,
        *,
        depth: int | None = None,
    ) -> CauseTree:
        """Return where a datum comes from: who committed it, what went in, and so on.

        Args:
            world: Its world context.
            entity: Its entity.
            aspect: Its aspect.
            version: Its version; 0 is the newest.
            depth: How many steps to go back; None: as far as known, at most
                `lineage.DEPTH_MAX`.

        Returns:
            A tree; versions beyond retention appear in it as "forgotten".

        Raises:
            NullDatumError: Nothing was ever set there.
            ForgottenError: The version itself is beyond retention.
            MisuseError: The version does not exist yet, or the entity or aspect is invalid.
            UnknownWorldError: The cell has no world context of that name.
            ShardUnreachableError: A shard does not answer.
        """
        return tree_of(CauseTree, self._session, (world, entity, aspect), version, depth)

    def impact(
        self,
        world: WorldContext | str,
        entity: Entity | str,
        aspect: Aspect[Any] | str,
        version: int = 0,
        *,
        depth: int | None = None,
    ) -> EffectTree:
        """Return what was made from a datum: the versions it went into, and those made from them.

        Arguments and errors are those of `why`.  Effects that have left their retention cannot be
        found any more.
        """
        return tree_of(EffectTree, self._session, (world, entity, aspect), version, depth)

    def invalidate(
        self, label: str, wrong: Version[Any] | Made, *, wait_s: float = 10.0
    ) -> tuple[EffectTree, ...]:
        """Make a wrong version null, and what was made of it; see `world.invalidation`.

        Returns:
            The versions that were shown until now, and are replaced by null.

        Raises:
            LockTimeoutError: Their slots stay locked for longer than `wait_s`.
            ShardUnreachableError: A shard does not answer; the call can be repeated safely.
        """
        refuse_inside_lock("invalidate")
        return invalidate(self._session, label, wrong, wait_s=wait_s)

    # ---------------------------------------------------------------- people

    def locks(self, shards: Iterable[str] | None = None) -> tuple[LockInfo, ...]:
        """Return all locks held or awaited, oldest first within each shard.

        Args:
            shards: The shards to ask; None means all.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return lock_infos(self._client, shards)

    def break_lock(self, number: int, *, shard: str, reason: str = "") -> LockInfo | None:
        """Take a lock away from its holder, who learns the reason; the shard audits the act.

        Returns:
            What the lock was, or None if no such lock is held or awaited.

        Raises:
            MisuseError: The cell has no such shard, or the reason is too long or no one line.
            ShardUnreachableError: The shard does not answer.
        """
        check_reason("reason", reason)
        return self._ended_by_hand(shard, Break(number, reason, self._epoch(shard)))

    def force_abort(self, number: int, *, shard: str, reason: str) -> LockInfo | None:
        """Abort a lock in doubt whose deciding shard is permanently lost; the shard audits it.

        If that shard had committed the lock after all, only a part of its writes takes effect.

        Returns:
            What the lock was, or None if no such lock is in doubt.

        Raises:
            MisuseError: The cell has no such shard, or the reason is too long or no one line.
            ShardUnreachableError: The shard does not answer.
        """
        check_reason("reason", reason)
        return self._ended_by_hand(shard, ForceAbort(number, reason, self._epoch(shard)))

    def audit(self, shards: Iterable[str] | None = None) -> tuple[AuditInfo, ...]:
        """Return acts of operators and their outcomes, oldest first; `shards` as in `locks`.

        An "alarm" is a lock that `force_abort` ended on one shard although another one had
        committed it: only a part of its writes took effect.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return audit_infos(self._client, shards)

    def refusals(self, shards: Iterable[str] | None = None) -> tuple[RefusalInfo, ...]:
        """Return the rights that clients lacked since each shard's start; `shards` as in `locks`.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return refusal_infos(self._client, shards)

    def acknowledge_alarms(self, *, shard: str, how: str) -> None:
        """Acknowledge all alarms of a shard so far; the shard audits the act.

        Raises:
            MisuseError: The cell has no such shard, or `how` is empty or too long.
            ShardUnreachableError: The shard does not answer.
        """
        if not how.strip():
            raise MisuseError("how= is empty: state how the alarms were settled")
        check_reason("how", how)
        self._check_shard(shard)
        settle_alarms(self._client, shard, how)

    def _check_shard(self, shard: str) -> None:
        if shard not in self._client.shards():
            raise MisuseError(
                f"cell {self.name!r} has no shard {shard!r}; it has"
                f" {', '.join(self._client.shards())}"
            )

    def _epoch(self, shard: str) -> int:
        """Return the epoch in which a shard counts its locks."""
        self._check_shard(shard)
        ((_, answer),) = ask_all(self._client, Locks, ListLocks(), (shard,))
        return answer.epoch

    def _ended_by_hand(self, shard: str, request: Break | ForceAbort) -> LockInfo | None:
        ((_, answer),) = ask_all(self._client, Broken, request, (shard,))
        return lock_info(shard, answer.holder) if answer.holder is not None else None

    def shards(self) -> tuple[ShardInfo, ...]:
        """Return every shard of the cell; of an unreachable one with the reason if it is known."""
        return tuple(shard_info(self._client, shard) for shard in self._client.shards())

    def actors(self) -> tuple[ActorInfo, ...]:
        """Return the sessions of named actors over all shards.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return actor_infos(ask_all(self._client, Sessions, ListSessions()))

    @property
    def session(self) -> str:
        """Identity of this process's session, as `ActorInfo.session` names it."""
        return self._client.core.session

    def aspects(self, world: str = "") -> tuple[AspectInfo, ...]:
        """Return the registered aspects, and how many data they have in one world context, or all.

        Where shards know an aspect differently, each way has its own entry.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return aspect_infos(self._session, world)

    def statistics(self) -> dict[str, int]:
        """Return this connection's own counters; `link.daemon.counters` explains each."""
        return dict(self._client.counters)

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """Release everything and end the connection; twice is harmless."""
        _open.pop(self._client, None)
        self._dropped.detach()
        try:
            self._client.close()
        finally:
            if self._host is not None and not self._client.forked:
                self._host.close()
                self._host = None

    def __repr__(self) -> str:
        return f"<cell {self.name!r}, {len(self._client.shards())} shards>"


def session_behind(cell: Cell) -> Session:
    """Return the session of a cell, for what only the framework asks of it."""
    return cell._session  # noqa: SLF001 - of this module


def _close_all() -> None:
    end_watches()
    for client, host in list(_open.items()):
        with contextlib.suppress(EnactError):
            client.close()
        if host is not None and not client.forked:
            host.close()
