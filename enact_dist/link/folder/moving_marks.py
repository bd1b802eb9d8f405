"""Marks on folders of a stopped cell that are changed together; no shard starts meanwhile.

The marks are set before the first folder changes and removed after the last one, so the next run
completes an interrupted one.  They are set and removed in the order of the shards' names.  They do
not record progress: a folder restored meanwhile has no mark.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

from enact_dist.errors import StoreError
from enact_dist.link.folder.folder import refuse
from enact_dist.link.folder.lock import replace_file, sync_folder

MOVING_FILE: Final = "moving"
REBALANCE: Final = "rebalance"
FORGET: Final = "forget"


class MovingMark(NamedTuple):
    """A mark: entities are being moved from or to a folder, or aspects purged.

    Attributes:
        number: Identifies the run.
        shards: All shards whose folders take part.
        aspects: The purged aspects, each with the timestamp from which on; empty for a rebalance.
    """

    number: str
    shards: tuple[str, ...]
    aspects: Mapping[str, int] = MappingProxyType({})

    @property
    def what(self) -> str:
        """The operation in progress, for messages."""
        return f"forgetting {', '.join(self.aspects)}" if self.aspects else "a rebalance"


def way_out(mark: MovingMark) -> str:
    """Return the command that completes an interrupted run."""
    command = "enact shard rebalance"
    if mark.aspects:
        only = " ".join(f"--shard {name}" for name in mark.shards)
        command = f"enact shard forget {' '.join(mark.aspects)} {only} --yes"
    return f"let `{command}` finish"


def moving_mark(folder: Path) -> MovingMark | None:
    """Return the mark of an unfinished run over several folders.

    Raises:
        StoreError: The mark cannot be read.
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
    """Refuse a folder in an unfinished rebalance or purge.

    Raises:
        StoreError: A rebalance or a purge is unfinished.
    """
    mark = moving_mark(folder)
    if mark is not None:
        refuse(
            folder,
            f"is in the middle of {mark.what} with those of {', '.join(mark.shards)}",
            way_out(mark),
        )


def mark(
    folders: Mapping[str, Path],
    act: Callable[[str], None],
    aspects: Mapping[str, int] | None = None,
) -> None:
    """Mark all folders for one change, new or resumed.

    Args:
        folders: The folder of each shard.
        act: Called before each mark is set.
        aspects: Aspects being purged, each with the timestamp from which on; empty for a rebalance.
    """
    found = [mark for folder in folders.values() if (mark := moving_mark(folder)) is not None]
    number = found[0].number if found else uuid.uuid4().hex
    content: dict[str, object] = {FORGET if aspects else REBALANCE: number}
    content["shards"] = sorted(folders)
    if aspects:
        content["aspects"] = dict(sorted(aspects.items()))
    for name, folder in sorted(folders.items()):
        act(f"mark {name}")
        replace_file(folder / MOVING_FILE, json.dumps(content).encode())


def unmark(folders: Mapping[str, Path], act: Callable[[str], None]) -> None:
    """Remove all marks: everything is done, durably."""
    for name, folder in sorted(folders.items()):
        act(f"unmark {name}")
        (folder / MOVING_FILE).unlink(missing_ok=True)
        sync_folder(folder)


def under_way(folders: Mapping[str, Path], *, forgets: bool = False) -> dict[str, MovingMark]:
    """Return the marks of an interrupted run; all of its folders must be present.

    Args:
        folders: The folder of each shard.
        forgets: Whether the present run purges aspects; otherwise it moves entities.

    Raises:
        StoreError: Folders are missing, or the marks belong to several runs or to the other
            command.
    """
    marks = {name: mark for name, folder in folders.items() if (mark := moving_mark(folder))}
    for name, mark in marks.items():
        if bool(mark.aspects) != forgets:
            raise StoreError(f"shard {name} is in the middle of {mark.what}; {way_out(mark)} first")
    if len({mark.number for mark in marks.values()}) > 1:
        which = "times that aspects were forgotten" if forgets else "rebalances"
        raise StoreError(
            f"the folders of {', '.join(sorted(marks))} are in the middle of different {which};"
            " use the folders that belong to one run"
        )
    for name, mark in marks.items():
        lacking = [shard for shard in mark.shards if shard not in folders]
        if lacking:
            others = ", ".join(lacking)
            if forgets:
                raise StoreError(
                    f"the interrupted run on {name} also forgets aspects of {others}; leave"
                    f" --shard out, or {way_out(mark)}, with --store NAME=PATH for a folder that"
                    " is not where cell.toml says"
                )
            raise StoreError(
                f"the interrupted run on {name} also moves entities of {others}; name their"
                " folders too, with --store NAME=PATH"
            )
        if forgets and folders.keys() - set(mark.shards):  # these keep their data
            raise StoreError(
                f"the interrupted run on {name} covers only {', '.join(mark.shards)};"
                f" {way_out(mark)} first"
            )
    return marks
