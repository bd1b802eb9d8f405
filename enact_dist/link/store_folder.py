"""What a data folder says of itself before its rows are read, and how one is refused.

Refusing costs an operator minutes; serving from a damaged store costs trust in every datum.  So
each check ends in a `StoreError` that names the file and the way out.
"""

from __future__ import annotations

import json
import logging
import shutil
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

from enact_dist.core.moving import NAMED_MAX, strangers
from enact_dist.core.stamps import AHEAD_NS_MAX, STAMP_NS_MAX, newest_stamp
from enact_dist.errors import StoreError
from enact_dist.link.folder_lock import FORMAT_FILE
from enact_dist.link.store_mark import MARK_FILE, Mark, read_mark
from enact_dist.link.wal_check import check_wal

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from enact_dist.core.messages import PlacementMap
    from enact_dist.core.records import Recovered

DATABASE_FILE: Final = "store.db"
LOG_FILE: Final = "store.db-wal"
BLOB_FOLDER: Final = "blobs"
ACCEPT_LOSS_FILE: Final = "accept-loss"
"""Made by an operator, taken away by the start that it was made for."""
MOVING_FILE: Final = "moving"
REBALANCE: Final = "rebalance"
FORGET: Final = "forget"
_REFUSED_SUFFIX: Final = ".refused"

_RESTORE: Final = (
    "restore the whole folder from a backup, or give the shard an empty folder and start without"
    " its data"
)

_log = logging.getLogger("enact.store")


class Found(NamedTuple):
    """What a folder says of itself before its database is opened."""

    mark: Mark | None
    is_new: bool
    power_cut: bool
    """Whether the system has started anew since the store was last opened."""
    accepts_loss: bool = False
    """Whether an operator says that the shard is to start though commits may be missing."""

    @property
    def is_first(self) -> bool:
        """Whether no start before this one ever came to its end: nothing was acknowledged."""
        return self.mark.is_first if self.mark is not None else self.is_new


class MovingMark(NamedTuple):
    """That entities are being moved from or to a folder, or aspects forgotten.

    Attributes:
        number: Tells one run from another.
        shards: All shards whose folders take part.
        aspects: Those that are forgotten, and from which stamp on; none where entities move.
    """

    number: str
    shards: tuple[str, ...]
    aspects: Mapping[str, int] = MappingProxyType({})

    @property
    def what(self) -> str:
        """What was begun."""
        return f"forgetting {', '.join(self.aspects)}" if self.aspects else "a rebalance"


def way_out(mark: MovingMark) -> str:
    """Return what lets a run that was cut off come to its end."""
    command = "enact shard rebalance"
    if mark.aspects:
        only = " ".join(f"--shard {name}" for name in mark.shards)
        command = f"enact shard forget {' '.join(mark.aspects)} {only} --yes"
    return f"let `{command}` come to its end"


def moving_mark(folder: Path) -> MovingMark | None:
    """Return the mark of a run over several folders that was begun and has not come to its end.

    Raises:
        StoreError: There is one that cannot be read.
    """
    path = folder / MOVING_FILE
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        shards = tuple(map(str, found["shards"]))
        if FORGET in found:
            aspects = {str(name): int(at_ns) for name, at_ns in found["aspects"].items()}
            return MovingMark(str(found[FORGET]), shards, aspects)
        return MovingMark(str(found[REBALANCE]), shards)
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError):
        refuse(path, "is damaged")


def refuse_moving(folder: Path) -> None:
    """Refuse a folder of which some entities may be on their way, or an aspect half forgotten.

    Raises:
        StoreError: A rebalance was begun, or a forgetting, and has not come to its end.
    """
    mark = moving_mark(folder)
    if mark is not None:
        refuse(
            folder,
            f"is in the midst of {mark.what} with those of {', '.join(mark.shards)}",
            way_out(mark),
        )


def refuse_strangers(folder: Path, stored: Recovered, shard: str, placement: PlacementMap) -> None:
    """Refuse a folder with entities that nobody would look for there.

    Raises:
        StoreError: By the cell's placement some live on other shards.
    """
    found = strangers(stored, shard, placement)
    if found:
        named = ", ".join(f"{entity} (of {owner})" for entity, owner in found[:NAMED_MAX])
        more = f" and {len(found) - NAMED_MAX} more" if len(found) > NAMED_MAX else ""
        refuse(
            folder,
            f"holds entities that by the cell.toml do not live on {shard}: {named}{more}",
            "move them with `enact shard rebalance` while the cell is stopped, or let the cell have"
            " the shards and pins that it had",
        )


def refuse_far_stamps(folder: Path, stored: Recovered, *, wall_ns: int) -> None:
    """Refuse a folder whose clock could not go on, and warn of one that is ahead of its host.

    Raises:
        StoreError: A stamp lies beyond all that clocks give.
    """
    stamp_ns, holder = newest_stamp(stored)
    if stamp_ns > STAMP_NS_MAX:
        refuse(
            folder,
            f"holds {holder} with stamp {stamp_ns}, beyond the year 2116: no later commit could be"
            " stamped",
            "restore a backup from before that commit with `enact shard restore … --replace`, or"
            " give the shard an empty folder and start without its data",
        )
    if stamp_ns > wall_ns + AHEAD_NS_MAX:
        _log.warning(
            "%s holds %s with a stamp %.1f s ahead of the clock of this host: until its clock gets"
            " there, other shards refuse commits together with this one; set the clock, or restore"
            " a backup from before that commit",
            folder,
            holder,
            (stamp_ns - wall_ns) / 1e9,
        )


def refuse(path: Path, found: str, remedy: str = _RESTORE) -> NoReturn:
    """Raise the `StoreError` of a damaged file.

    Raises:
        StoreError: Always.
    """
    raise StoreError(f"{path} {found}; the shard does not start: {remedy}", path=str(path))


def look_at(folder: Path) -> Found:
    """Find out what kind of folder this is.

    Raises:
        StoreError: Data are there and their database is not.
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
        # A new folder has its mark before its database, so one was there.
        path = folder / MARK_FILE
        refuse(
            path,
            f"{'cannot be read' if path.exists() else 'is missing'}, and without it nothing tells"
            " whether commits that were acknowledged are missing at the end",
            _accept(folder, "with what can be read"),
        )
    return Found(mark, is_new, mark is not None and not mark.same_boot, accepted)


def _accept(folder: Path, what: str, first: str = "") -> str:
    """Return how to start a shard in spite of a loss."""
    return (
        f"restore the whole folder from a backup; or, to go on {what}, keep a copy of the folder,"
        f" {first}make an empty file '{folder / ACCEPT_LOSS_FILE}', and start the shard"
    )


def holds_store(folder: Path) -> bool:
    """Whether a shard has ever been started on a folder."""
    return (folder / FORMAT_FILE).is_file()


def has_blobs(folder: Path) -> bool:
    """Whether anything lies where large bodies do."""
    blobs = folder / BLOB_FOLDER
    return blobs.exists() and any(blobs.iterdir())


def check_log(folder: Path, *, power_cut: bool) -> None:
    """Refuse a log that is damaged in its middle.

    Raises:
        StoreError: It is damaged, and no power cut explains it.
        OSError: As the system reports it.
    """
    log = folder / LOG_FILE
    verdict = check_wal(log)
    if verdict.damaged_at is None:
        return
    if power_cut:
        _log.warning(
            "%s: what was written from byte %d on and not forced to the disk is gone after the"
            " system's restart",
            log,
            verdict.damaged_at,
        )
        return
    refuse(
        log,
        f"is damaged at byte {verdict.damaged_at}, and commits that were acknowledged follow",
        _accept(
            folder,
            "without what was written from there on",
            f"cut the log with 'truncate -s {verdict.damaged_at} {log}', ",
        ),
    )


def check_reach(folder: Path, found: Found, *, batch: int) -> None:
    """Refuse a database that does not reach as far as the mark says.

    Args:
        folder: The data folder.
        found: What it says of itself.
        batch: Number of the newest batch that was read.

    Raises:
        StoreError: Batches are missing that were acknowledged.
        OSError: As the system reports it.
    """
    needed = found.mark.needed() if found.mark is not None else None
    if found.is_new or (needed is not None and batch >= needed):
        return
    log = folder / LOG_FILE
    if found.accepts_loss:
        missing = "an unknown number of" if needed is None else needed - batch
        _log.critical(
            "%s says to start all the same: the last batch that can be read is %d, and %s batches"
            " of commits that were acknowledged may be lost",
            folder / ACCEPT_LOSS_FILE,
            batch,
            missing,
        )
        return
    readable = check_wal(log)
    if log.exists() and log.stat().st_size:
        # Closing the database cuts the log to what SQLite could read; the whole is evidence.
        shutil.copyfile(log, log.with_name(log.name + _REFUSED_SUFFIX))
    refuse(
        log,
        f"is cut or damaged from byte {readable.end} on: batch {needed} was"
        f" acknowledged, the last one that can be read is {batch}",
        _accept(folder, "without the missing commits"),
    )
