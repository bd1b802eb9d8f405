"""`enact world export`: one world context as of one moment, as a recording or as a folder of files.

A folder holds for each datum `ENTITY/ASPECT.npy` (an array), `.json` (plain data) or `.npz` with a
`.json` beside it (arrays with plain data around them), and `index.json`, which names all of them.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from enact_dist.cli.record import shows_of
from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.verbs import Output
from enact_dist.config.table import path_of
from enact_dist.errors import ConfigError, ProtocolError
from enact_dist.terms import checked_name

if TYPE_CHECKING:
    import argparse

    from enact_dist.recording.exact import Recorded
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import WorldContext


def export_world(cell: Cell, options: argparse.Namespace) -> Output:
    """Write the context and say how much it was."""
    from enact_dist import recording
    from enact_dist.access.arguments import stamp_of

    world = cell.world(options.world)
    at_ns = stamp_of(options.at) if options.at is not None else 0
    if Path(options.out).suffix == ".mcap":
        done = recording.export_world(
            world,
            options.out,
            at_ns=at_ns,
            shows=shows_of(options),
            compression=options.compress,
        )
        facts = {"path": done.path, "data": done.versions, "size_bytes": done.size_bytes}
    else:
        facts = _into_folder(world, path_of(options.out), at_ns)
    size = shown_bytes(int(str(facts["size_bytes"])))
    return Output(facts, f"{options.world}: {facts['data']} data, {size} in {facts['path']}")


def _into_folder(world: WorldContext, folder: Path, at_ns: int) -> dict[str, object]:
    """Write each datum as files of common formats; nothing is written over."""
    from enact_dist.recording.exporting import world_as_of

    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ConfigError(
            f"{folder} exists; an export makes a new folder, or a file that ends in .mcap"
        ) from None
    try:
        index = [_save(version, folder) for version in world_as_of(world, at_ns)]
        (folder / "index.json").write_text(json.dumps(index, indent=2), encoding="utf-8")
    except BaseException:  # a part of an export is none, and would be in the way of the next one
        shutil.rmtree(folder, ignore_errors=True)
        raise
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {"path": str(folder), "data": len(index), "size_bytes": size}


def _checked_names(version: Recorded) -> tuple[str, str]:
    """Return the names of an entity and an aspect that may become those of files.

    Raises:
        ProtocolError: A shard has told a name that no client can have made.
    """
    _, entity, aspect = version.slot
    try:
        checked_name("entity", entity, slashes=True)
        checked_name("aspect", aspect, slashes=False)
    except ValueError as error:
        raise ProtocolError(
            f"shard {version.shard!r} sent a name that leads out of the folder or is not a valid"
            f" file name: {error}; nothing was written for it"
        ) from None
    return entity, aspect


def _save(version: Recorded, folder: Path) -> dict[str, object]:
    """Write one datum; return its line of the index."""
    import numpy as np

    from enact_dist.cli.text import showing
    from enact_dist.wire.payload import decode_untyped

    assert version.datum is not None, "an export has no null"
    value: Any = decode_untyped(version.datum)
    entity, aspect = _checked_names(version)
    place = folder / entity
    place.mkdir(parents=True, exist_ok=True)
    if isinstance(value, np.ndarray):
        suffixes = [".npy"]
    else:
        suffixes = [".npz", ".json"] if showing.has_arrays(value) else [".json"]
    for suffix in suffixes:
        whole = suffix != ".json" or suffixes == [".json"]
        showing.save(value if whole else showing.plain(value), str(place / f"{aspect}{suffix}"))
    return {
        "entity": entity,
        "aspect": aspect,
        "version": version.version,
        "stamp_ns": version.stamp_ns,
        "captured_ns": version.captured_ns,
        "shard": version.shard,
        "actor": version.actor,
        "files": [f"{entity}/{aspect}{suffix}" for suffix in suffixes],
    }
