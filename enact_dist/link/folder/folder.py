"""Checks of a data folder before its rows are read, and the errors that refuse one.

A refusal costs an operator minutes; serving from a damaged store costs trust in all data.  So each
failed check raises a `StoreError` that names the file and the remedy.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
from pathlib import Path
from typing import Final, NamedTuple, NoReturn

from enact_dist.core.offline.moving import NAMED_MAX, strangers
from enact_dist.core.protocol.messages import PlacementMap
from enact_dist.core.protocol.records import Recovered
from enact_dist.core.state.clock import AHEAD_NS_MAX, STAMP_NS_MAX, newest_stamp
from enact_dist.errors import StoreError
from enact_dist.link.folder.lock import FORMAT_FILE
from enact_dist.link.folder.mark import MARK_FILE, Mark, read_mark
from enact_dist.link.folder.wal_check import check_wal

DATABASE_FILE: Final = "store.db"
LOG_FILE: Final = "store.db-wal"
BLOB_FOLDER: Final = "blobs"
ACCEPT_LOSS_FILE: Final = "accept-loss"
"""An operator creates it; the one start that it is meant for deletes it."""
ASIDE: Final = ".replaced-"
"""Follows the name of a folder that was put aside; the second in which that happened follows."""
_REFUSED_SUFFIX: Final = ".refused"

_RESTORE: Final = (
    "restore the whole folder from a backup, or give the shard an empty folder and start without"
    " its data"
)
_RESTORE_TABLES: Final = (
    "restore the database from a backup (pg_restore), or give the cell another name and start"
    " without its data"
)

_log = logging.getLogger("enact.store")


class FolderFindings(NamedTuple):
    """The findings about a folder before its database is opened."""

    mark: Mark | None
    is_new: bool
    power_cut: bool
    """Whether the system has rebooted since the store was last opened."""
    accepts_loss: bool = False
    """Whether an operator wants the shard to start although commits may be missing."""

    @property
    def is_first(self) -> bool:
        """Whether no earlier start was ever completed: nothing was acknowledged."""
        return self.mark.is_first if self.mark is not None else self.is_new


def refuse_strangers(
    folder: Path | str, stored: Recovered, shard: str, placement: PlacementMap
) -> None:
    """Refuse a folder or database with entities that no client would look for there.

    Raises:
        StoreError: The cell's placement puts some entities on other shards.
    """
    found = strangers(stored, shard, placement)
    if found:
        named = ", ".join(f"{entity} (of {owner})" for entity, owner in found[:NAMED_MAX])
        more = f" and {len(found) - NAMED_MAX} more" if len(found) > NAMED_MAX else ""
        refuse(
            folder,
            f"holds entities that cell.toml places on other shards than {shard}: {named}{more}",
            "move them with `enact shard rebalance` while the cell is stopped, or restore the"
            " cell's previous shards and pins",
        )


def refuse_far_stamps(folder: Path | str, stored: Recovered, *, wall_ns: int) -> None:
    """Refuse a folder or database whose clock is exhausted; warn of one that is ahead of its host.

    Raises:
        StoreError: A timestamp exceeds the range of the clock.
    """
    stamp_ns, holder = newest_stamp(stored)
    if stamp_ns > STAMP_NS_MAX:
        refuse(
            folder,
            f"holds {holder} with timestamp {stamp_ns}, after the year 2116: no later commit could"
            " get a timestamp",
            "restore a backup from before that commit with `enact shard restore … --replace`, or"
            " give the shard an empty folder and start without its data",
        )
    if stamp_ns > wall_ns + AHEAD_NS_MAX:
        _log.warning(
            "%s holds %s with a timestamp %.1f s ahead of this host's clock: until that clock"
            " catches up, other shards refuse commits together with this one; set the clock, or"
            " restore a backup from before that commit",
            folder,
            holder,
            (stamp_ns - wall_ns) / 1e9,
        )


def warn_of_others(folder: Path, shard: str, placement: PlacementMap) -> None:
    """Warn of data beside a folder whose shard starts for the first time, as a renamed one does.

    They are those of shards that the cell does not have; nothing else would say that they are lost.
    """
    names = {folder.name, *(entry.name for entry in placement.shards)}
    with contextlib.suppress(OSError):
        for path in stores_in(folder.parent):
            if path.name not in names:
                _log.warning(
                    "shard %s starts without data, and %s has data of a shard that cell.toml does"
                    " not name: if that was renamed or has left the cell, stop the cell and move"
                    " its entities: enact shard rebalance --store %s=%s",
                    shard, path, path.name, path,
                )  # fmt: skip


def refuse(path: Path | str, found: str, remedy: str = "") -> NoReturn:
    """Raise the `StoreError` about a damaged file, or about a table, which `path` names as text.

    Raises:
        StoreError: Always.
    """
    remedy = remedy or (_RESTORE_TABLES if isinstance(path, str) else _RESTORE)
    raise StoreError(f"{path} {found}; the shard does not start: {remedy}", path=str(path))


def look_at(folder: Path) -> FolderFindings:
    """Inspect a folder without opening its database.

    Raises:
        StoreError: The folder has data but no database.
        OSError: As the system reports it.
    """
    mark = read_mark(folder)
    accepted = (folder / ACCEPT_LOSS_FILE).exists()
    database = folder / DATABASE_FILE
    is_new = not database.exists() or database.stat().st_size == 0
    if is_new:
        log = folder / LOG_FILE
        has_log = log.exists() and log.stat().st_size > 0
        has_mark = mark is not None and not mark.is_first
        if has_mark or has_log or has_blobs(folder):
            refuse(database, "is missing or empty, but the folder has been in use")
    elif mark is None and not accepted:
        # A new folder gets its mark before its database, so a mark has existed.
        path = folder / MARK_FILE
        refuse(
            path,
            f"{'cannot be read' if path.exists() else 'is missing'}, and without it nothing shows"
            " whether acknowledged commits are missing at the end",
            _accept(folder, "with what can be read"),
        )
    return FolderFindings(mark, is_new, mark is not None and not mark.same_boot, accepted)


def _accept(folder: Path, what: str, first: str = "") -> str:
    """Return how to start a shard despite a loss."""
    return (
        f"restore the whole folder from a backup; or, to go on {what}, keep a copy of the folder,"
        f" {first}make an empty file '{folder / ACCEPT_LOSS_FILE}', and start the shard"
    )


def stores_in(parent: Path) -> list[Path]:
    """Return the folders of shards in a folder, sorted, without those that were put aside.

    Raises:
        OSError: The folder cannot be read.
    """
    return [
        path for path in sorted(parent.iterdir()) if ASIDE not in path.name and holds_store(path)
    ]


def holds_store(folder: Path) -> bool:
    """Whether a shard has ever been started on a folder."""
    return (folder / FORMAT_FILE).is_file()


def has_blobs(folder: Path) -> bool:
    """Whether the folder has any files of large bodies."""
    blobs = folder / BLOB_FOLDER
    return blobs.exists() and any(blobs.iterdir())


def check_log(folder: Path, *, power_cut: bool) -> None:
    """Refuse a log that is damaged in the middle.

    Raises:
        StoreError: It is damaged, and a power cut does not explain it.
        OSError: As the system reports it.
    """
    log = folder / LOG_FILE
    verdict = check_wal(log)
    if verdict.damaged_at is None:
        return
    if power_cut:
        _log.warning(
            "%s: data from byte %d on, which had not been forced to the disk, are gone after the"
            " system's restart",
            log,
            verdict.damaged_at,
        )
        return
    refuse(
        log,
        f"is damaged at byte {verdict.damaged_at}, and acknowledged commits follow",
        _accept(
            folder,
            "without everything written from there on",
            f"cut the log with 'truncate -s {verdict.damaged_at} {log}', ",
        ),
    )


def check_reach(folder: Path, found: FolderFindings, *, batch: int) -> None:
    """Refuse a database whose newest batch comes before the one in the mark.

    Raises:
        StoreError: Acknowledged batches are missing.
        OSError: As the system reports it.
    """
    needed = found.mark.needed() if found.mark is not None else None
    if found.is_new or (needed is not None and batch >= needed):
        return
    log = folder / LOG_FILE
    if found.accepts_loss:
        missing = "an unknown number of" if needed is None else needed - batch
        _log.critical(
            "%s orders a start despite losses: the last readable batch is %d, and %s batches"
            " of acknowledged commits may be lost",
            folder / ACCEPT_LOSS_FILE,
            batch,
            missing,
        )
        return
    readable = check_wal(log)
    if log.exists() and log.stat().st_size:
        # Closing the database cuts the log to its readable part; the rest is evidence.
        shutil.copyfile(log, log.with_name(log.name + _REFUSED_SUFFIX))
    refuse(
        log,
        f"is cut or damaged from byte {readable.end} on: batch {needed} was"
        f" acknowledged, but the last readable one is {batch}",
        _accept(folder, "without the missing commits"),
    )
