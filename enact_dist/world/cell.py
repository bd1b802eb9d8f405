"""A cell: the connection to its shards and the handles to its world contexts.

`connect` joins a running cell over the network; `local` runs one shard inside this process, with
the same core, the same locks and, given a folder, the same durability.
"""

from __future__ import annotations

import atexit
import contextlib
import time
import weakref
from typing import TYPE_CHECKING, Any

from enact_dist.access.arguments import check_reason
from enact_dist.access.asking import await_stamp
from enact_dist.access.closing import Closing
from enact_dist.access.lock import refuse_inside_lock
from enact_dist.access.session import Session
from enact_dist.core.protocol.datum import Position
from enact_dist.core.protocol.messages import (
    Audited,
    Break,
    Broken,
    ForceAbort,
    ListAudit,
    ListLocks,
    ListSessions,
    Locks,
    Welcome,
)
from enact_dist.errors import EnactError, MisuseError
from enact_dist.link.client.dropped import when_dropped
from enact_dist.terms import checked_name
from enact_dist.world.context import WorldContext
from enact_dist.world.forks import drop_world
from enact_dist.world.history import keep_versions, kept_versions, let_go
from enact_dist.world.lineage import causes_of, effects_of
from enact_dist.world.listings import (
    ActorInfo,
    AspectInfo,
    AuditInfo,
    LockInfo,
    ShardInfo,
    actor_infos,
    aspect_infos,
    lock_info,
    shard_info,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.link.client.locks import CellClient
    from enact_dist.terms import Aspect, Entity
    from enact_dist.world.history import Version
    from enact_dist.world.lineage import CauseTree, EffectTree, Made

_open: weakref.WeakKeyDictionary[CellClient, Any] = weakref.WeakKeyDictionary()
"""The sessions of cells that were not closed, with the shard inside this process, if it has one.

Handles made by a cell go on working after the program has dropped its last reference to the cell.
"""


class Cell(Closing):
    """A connection to a cell.  Use as a context manager, or `close` it.

    A cell left open does not block the interpreter's exit.  Once neither a cell nor what it made is
    referenced any more, it is closed with a `ResourceWarning` that says where it was opened.

    A network connection does not survive a fork of the process: in the child the cell and every
    `connect` raise `MisuseError`, even if the parent had closed the cell before.
    Connect for the first time after the fork, or start the child with
    ``multiprocessing.get_context("spawn")``.  `local` works in both.
    """

    def __init__(self, name: str, client: CellClient, *, host: Any = None) -> None:
        self.name = name
        self._session = Session(client)
        self._client = client
        self._host = host
        self._dropped = when_dropped(client, name, host)
        _open[client] = host
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
        """Make a world context, or return the one that exists.

        Raises:
            LockHeldError: This thread holds a lock.
            MisuseError: The connection only observes.
            UnknownWorldError: Some shards have it as a fork that is not complete.
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
            How many slots went.

        Raises:
            UnknownWorldError: The cell has none of that name.
            MisuseError: A lock is held or awaited in it, or `cell.toml` names it.
            LockHeldError: This thread holds a lock.
            ShardUnreachableError: A shard does not answer; the message says where it is gone.
        """
        refuse_inside_lock("drop_world")
        self._client.check_usable()
        return drop_world(self._session, name)

    # ---------------------------------------------------------------- kept versions

    def keep(self, label: str, versions: Iterable[Version[Any] | Made]) -> None:
        """Keep versions from being forgotten, whatever their retention, until `let_go`.

        They stay listed and readable (`Version.datum`), and count in the shard's room.  Asked again
        with the same label, versions are added.

        Args:
            label: Letters, digits, ``_ . -``, slashes between.
            versions: As `WorldContext.history` or `kept` returns them, or those of a tree of
                `why` or `impact` (`tree.walk()`) that are `known`.

        Raises:
            ForgottenError: Some had gone before; the others are kept.
            MisuseError: The label cannot be used, or something is no version.
            ShardUnreachableError: A shard does not answer; asking again does no harm.
        """
        self._client.check_usable()
        keep_versions(self._session, label, versions)

    def kept(self) -> dict[str, tuple[Version[Any], ...]]:
        """Return the versions that are kept, by label; their aspects are of the type `object`.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self._client.check_usable()
        return kept_versions(self._session, lambda name: WorldContext(name, self._session))

    def let_go(self, label: str) -> None:
        """Release the versions of a label; what no other label and no retention keeps is removed.

        Nothing where the label keeps nothing.

        Raises:
            MisuseError: No version can have that label.
            ShardUnreachableError: A shard does not answer; asking again does no harm.
        """
        self._client.check_usable()
        let_go(self._session, label)

    def wait(self, position: Position, *, timeout_s: float = 10.0) -> bool:
        """Wait until everything committed up to `position` is visible; say whether it is.

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
            wait_s, stamp_ns, timeout_s = min(left_s, 0.5), position.stamp_ns, left_s + 1.0
            if await_stamp(
                self._client, position.shard, stamp_ns, wait_s=wait_s, timeout_s=timeout_s
            ):
                return True
            if time.monotonic() >= deadline_s:
                return False

    def outcome(self, lock_id: str, *, timeout_s: float = 10.0) -> Position | None:
        """Ask what became of a commit that ended in `CommitUnknownError`.

        A commit that its shard has not taken yet never comes true after this.

        Args:
            lock_id: As the error has it; any process of the cell may ask.
            timeout_s: How long the shard may stay without an answer.

        Returns:
            The position of the commit, or None if nothing was written.

        Raises:
            CommitUnknownError: The shard cannot tell (any more): 64 later commits of the process
                have ended in this error, too, or the process has been gone for a day.
            PermissionDeniedError: Another process made the commit and lives; nothing was written
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
        return causes_of(self._session, (world, entity, aspect), version, depth)

    def impact(
        self,
        world: WorldContext | str,
        entity: Entity | str,
        aspect: Aspect[Any] | str,
        version: int = 0,
        *,
        depth: int | None = None,
    ) -> EffectTree:
        """Return what came of a datum: which versions it went into, and these, and so on.

        Arguments and errors are those of `why`.  Effects that have left their retention cannot be
        found any more.
        """
        return effects_of(self._session, (world, entity, aspect), version, depth)

    # ---------------------------------------------------------------- people

    def locks(self, shards: Iterable[str] | None = None) -> tuple[LockInfo, ...]:
        """Return all locks held or awaited, oldest first within each shard.

        Args:
            shards: Where to look; everywhere unless given.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        shards = self._client.shards() if shards is None else tuple(shards)
        answers = self._client.call_all([(shard, ListLocks()) for shard in shards])
        return tuple(
            lock_info(shard, holder)
            for shard, answer in zip(shards, answers, strict=True)
            if isinstance(answer, Locks)
            for holder in answer.holders
        )

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

        If that shard had committed the lock after all, only a part of its writes stands then.

        Returns:
            What the lock was, or None if no such lock is in doubt.

        Raises:
            MisuseError: The cell has no such shard, or the reason is too long or no one line.
            ShardUnreachableError: The shard does not answer.
        """
        check_reason("reason", reason)
        return self._ended_by_hand(shard, ForceAbort(number, reason, self._epoch(shard)))

    def audit(self, shards: Iterable[str] | None = None) -> tuple[AuditInfo, ...]:
        """Return what operators did and what came of it, oldest first; `shards` as in `locks`.

        An "alarm" is a lock that `force_abort` has ended on one shard though another had committed
        it: only a part of its writes stands.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        shards = self._client.shards() if shards is None else tuple(shards)
        answers = self._client.call_all([(shard, ListAudit("")) for shard in shards])
        found = [
            AuditInfo(shard, entry.wall_ns / 1e9, entry.kind, entry.text, entry.identity)
            for shard, answer in zip(shards, answers, strict=True)
            if isinstance(answer, Audited)
            for entry in answer.entries
        ]
        return tuple(sorted(found, key=lambda entry: entry.stamp_s))

    def settle_alarms(self, *, shard: str, how: str) -> None:
        """Acknowledge all alarms of a shard so far; the shard audits the act.

        Raises:
            MisuseError: The cell has no such shard, or `how` is empty or too long.
            ShardUnreachableError: The shard does not answer.
        """
        if not how.strip():
            raise MisuseError("how= is empty: state how the alarms were settled")
        check_reason("how", how)
        self._check_shard(shard)
        seen = self._client.call(shard, ListAudit(""))
        stamps_ns = [e.wall_ns for e in seen.entries] if isinstance(seen, Audited) else []
        self._client.call(shard, ListAudit(how, max(stamps_ns, default=0)))

    def _check_shard(self, shard: str) -> None:
        if shard not in self._client.shards():
            raise MisuseError(
                f"cell {self.name!r} has no shard {shard!r}; it has"
                f" {', '.join(self._client.shards())}"
            )

    def _epoch(self, shard: str) -> int:
        """Return the epoch in which a shard gives its numbers."""
        self._check_shard(shard)
        answer = self._client.call(shard, ListLocks())
        return answer.epoch if isinstance(answer, Locks) else 0

    def _ended_by_hand(self, shard: str, request: Break | ForceAbort) -> LockInfo | None:
        answer = self._client.call(shard, request)
        holder = answer.holder if isinstance(answer, Broken) else None
        return lock_info(shard, holder) if holder is not None else None

    def shards(self) -> tuple[ShardInfo, ...]:
        """Return every shard of the cell, unreachable ones too, with why where that is known."""
        return tuple(shard_info(self._client, shard) for shard in self._client.shards())

    def welcomes(self) -> dict[str, Welcome]:
        """Return what each shard that answers at once says of the cell: its placement, contexts."""
        client = self._client
        names = client.shards()
        answers = client.call_once([(name, client.core.hello(name)) for name in names])
        said = zip(names, answers, strict=True)
        return {name: answer for name, answer in said if isinstance(answer, Welcome)}

    def actors(self) -> tuple[ActorInfo, ...]:
        """Return the sessions of named actors over all shards.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        shards = self._client.shards()
        answers = self._client.call_all([(shard, ListSessions()) for shard in shards])
        return actor_infos(zip(shards, answers, strict=True))

    @property
    def session(self) -> str:
        """Identity of this process's session, as `ActorInfo.session` names it."""
        return self._client.core.session

    def namesakes(self, name: str) -> tuple[ActorInfo, ...]:
        """Return the other sessions of actors of a name that are not silent.

        All shards are asked: the other may have spoken with one of them alone.  None is waited
        for longer than one call takes.
        """
        client = self._client
        shards = client.shards()
        answers = client.call_once([(shard, ListSessions()) for shard in shards])
        infos = actor_infos(zip(shards, answers, strict=True))
        return tuple(
            info
            for info in infos
            if name in (info.actor, *info.names())
            and not info.silent
            and info.session != client.core.session
        )

    def set_report(self, report: bytes) -> None:
        """Let keep-alives carry an actor's statistics: msgpack of a map, shown up to 4 KiB."""
        self._client.set_report(report)

    def aspects(self, *, enough: str = "") -> dict[str, tuple[str, str]]:
        """Return the registered aspects: name to (fingerprint of the type, durability).

        Args:
            enough: Once shards that answer know an aspect of this name, no other is waited for.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        self._session.greet(enough=enough)
        entries = self._client.aspect_entries()
        return {name: (entry.fingerprint, entry.durability) for name, entry in entries.items()}

    def aspect_infos(self, world: str = "") -> tuple[AspectInfo, ...]:
        """Return the registered aspects, and how much of them is in one world context, or all.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        return aspect_infos(self._session, world)

    def statistics(self) -> dict[str, int]:
        """Return this connection's own counters by name."""
        return dict(self._client.counters)

    # ---------------------------------------------------------------- end

    def close(self) -> None:
        """Give back everything and end the connection; twice is harmless."""
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


def _close_all() -> None:
    for client, host in list(_open.items()):
        with contextlib.suppress(EnactError):
            client.close()
        if host is not None and not client.forked:
            host.close()
