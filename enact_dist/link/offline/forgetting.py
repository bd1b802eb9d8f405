"""Purges aspects from the folders of a stopped cell: their types and all their data.

::

    all folders opened and marked ─> shard by shard: one batch ─> marks removed

See `link.offline.cell`.  If the run is cut off while marks are being set or removed, some shards
start: with all of their data, or with none of the aspect's.  Each shard's data of an aspect go in
one batch, so a shard never has a part of them.  Old leases need no waiting: a commit under a lock
from before the stop is refused, and a shard that starts first waits until such leases have ended.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from enact_dist.config.table import suggestion
from enact_dist.core.offline.forgetting import planned, unused_aspects, unused_worlds, world_drops
from enact_dist.errors import MisuseError
from enact_dist.link.folder.moving_marks import mark, under_way, unmark
from enact_dist.link.offline.cell import SILENT, opened, refuse_obstacles, write

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping
    from pathlib import Path

    from enact_dist.core.offline.forgetting import Going, PurgePlan
    from enact_dist.core.protocol.records import Recovered


class PurgeProgress(Protocol):
    """Reports what is purged, and the progress."""

    def found(self, found: Purged) -> None:
        """Take what will be purged; nothing has changed yet, and an exception keeps it so."""

    def act(self, name: str) -> None:
        """Take the next step; it is durable before the one after."""


class Purged(NamedTuple):
    """What was purged, or would be.

    Attributes:
        aspects: The aspects, including those of an interrupted earlier run.
        known: All aspects that these shards have or had.
        going: Each shard's data of each aspect.
        resumed: Whether an earlier run was interrupted.  A shard that had already purged an aspect
            no longer has it; any data there are newer.
        done: The aspects of the earlier run that every shard had already purged.
        worlds: The world contexts without data that were dropped, or would be.
    """

    aspects: tuple[str, ...]
    known: frozenset[str]
    going: list[Going]
    resumed: bool
    done: tuple[str, ...] = ()
    worlds: tuple[str, ...] = ()


def look(
    folders: Mapping[str, Path],
    aspects: Iterable[str],
    *,
    unused: Collection[str] | None = None,
    progress: PurgeProgress | None = None,
) -> Purged:
    """Return what `forget` would purge; change nothing.

    Raises:
        StoreError: As `forget`.
        MisuseError: As `forget`.
    """
    with opened(folders) as (_, stored):
        found, _ = planned_purge(_begun(folders), stored, aspects, now_ns=0, unused=unused)
    (progress or SILENT).found(found)
    return found


def forget(
    folders: Mapping[str, Path],
    aspects: Iterable[str],
    *,
    now_ns: int,
    unused: Collection[str] | None = None,
    progress: PurgeProgress | None = None,
) -> Purged:
    """Purge aspects, with all data that these shards have of them.

    Args:
        folders: The folder of each shard.
        aspects: Names of the aspects.
        now_ns: The wall clock, nanoseconds since 1970.
        unused: If given, also purge all aspects and world contexts without data, except these
            contexts and forks.
        progress: Receives what is purged, and each step.

    Raises:
        StoreError: A folder is in use, damaged or not writable, folders of an earlier run are
            missing, or a commit that names an aspect is undecided; the message says what to do.
        MisuseError: None of these shards ever knew one of the aspects.
    """
    progress = progress or SILENT
    with opened(folders, progress.act, unix_s=now_ns // 1_000_000_000) as (stores, stored):
        found, plan = planned_purge(_begun(folders), stored, aspects, now_ns=now_ns, unused=unused)
        progress.found(found)
        if plan.records:
            begun = _begun(folders)
            at_ns = {name: begun.get(name, at_ns) for name, at_ns in plan.at_ns.items()}
            mark(folders, progress.act, at_ns)
        for name, records in plan.records.items():
            progress.act(f"forget on {name}")
            write(stores[name], records)
            progress.act(f"unlink on {name}")
            stores[name].rest()
        unmark(folders, progress.act)
        for name, dropped in world_drops(stored, found.worlds).items():
            progress.act(f"drop on {name}")
            write(stores[name], dropped)
    return found


def planned_purge(
    begun: Mapping[str, int],
    stored: Mapping[str, Recovered],
    aspects: Iterable[str],
    *,
    now_ns: int,
    unused: Collection[str] | None,
) -> tuple[Purged, PurgePlan]:
    """Return the plan; aspects of an interrupted run are purged as well.

    Args:
        begun: These, each with the timestamp from which on to purge.
        stored: What each shard has stored.
        aspects: Names of the aspects.
        now_ns: The wall clock, nanoseconds since 1970.
        unused: As for `forget`.

    Raises:
        StoreError: There is an obstacle.
        MisuseError: No shard ever knew one of the aspects.
    """
    worlds: tuple[str, ...] = ()
    if unused is not None:
        aspects = dict.fromkeys((*aspects, *unused_aspects(stored)))
        worlds = unused_worlds(stored, unused)
    plan = planned(stored, aspects, now_ns=now_ns, begun=begun)
    refuse_obstacles("nothing was forgotten", plan.obstacles)
    known = plan.known | begun.keys()  # a restore may have removed all traces of the run
    if unknown := [name for name in plan.names if name not in known]:
        raise MisuseError(
            f"no shard here has an aspect {', '.join(unknown)}{suggestion(unknown[0], known)}"
            f" (known: {', '.join(sorted(known)) or 'none'}); nothing was forgotten"
        )
    return Purged(plan.names, known, plan.going, bool(begun), plan.done, worlds), plan


def _begun(folders: Mapping[str, Path]) -> dict[str, int]:
    """Return the aspects of an interrupted run, each with the timestamp from which on to purge.

    Raises:
        StoreError: As `under_way`.
    """
    marks = under_way(folders, forgets=True)
    return {name: at_ns for each in marks.values() for name, at_ns in each.aspects.items()}
