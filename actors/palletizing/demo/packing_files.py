"""The pictures of a demonstration with the robot: models, trays, the cell, nets, actors."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from actors.geometry.pictures.picture import png_bytes
from actors.palletizing.demo.run import pictures_of
from actors.palletizing.handling.net_picture import svg_of_net
from actors.palletizing.handling.stages import STANDS
from actors.palletizing.vocabulary import (
    EXECUTION,
    NET,
    ROBOT,
    SYSTEM,
)
from enact_dist.actor.check import declarations_of
from enact_dist.actor.graph import graph_of, svg_of
from enact_dist.config.read import load_config

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt

    from actors.palletizing.vocabulary import Deviation, Result
    from enact_dist import Cell

    Picture = npt.NDArray[np.uint8]

_NO_NAME: Final = re.compile(r"[^A-Za-z0-9_-]")


@dataclass(slots=True)
class Seen:
    """What was seen while a run went on.

    Attributes:
        results: What became of each package, by place.
        flags: The last verdicts, by place.
        judged: The truth when each of them was given.
        pictures: The cell, drawn by MuJoCo, by name of the file.
        undrawn: Why it could not be drawn.
        started_s: When the first package had come; 0: it has not.
        figures: What was measured.
    """

    results: Mapping[str, Result] = field(default_factory=dict)
    flags: Mapping[str, Deviation] = field(default_factory=dict)
    judged: dict[str, tuple[str, str]] = field(default_factory=dict)
    pictures: dict[str, Picture] = field(default_factory=dict)
    undrawn: str = ""
    started_s: float = 0.0
    figures: dict[str, object] = field(default_factory=dict)


def files_of(
    cell: Cell, config: Path, out: Path, seen: Seen
) -> tuple[dict[Path, bytes], list[str]]:
    """Return the contents of all pictures by file, and a line for each that cannot be drawn."""
    standing = {place for place, result in seen.results.items() if result.result in STANDS}
    flags = {place: flag for place, flag in seen.flags.items() if place in standing}
    contents = pictures_of(cell, out, flags)
    for name, picture in seen.pictures.items():
        contents[out / name] = png_bytes(picture)
    for stage, text in _nets(cell).items():
        contents[out / f"net_{stage}.svg"] = text.encode()
    actors, _ = declarations_of(load_config(config))
    contents[out / "actors.svg"] = svg_of(graph_of(actors), f"cell {cell.name}").encode()
    left_out = [f"no picture of the cell: {seen.undrawn}"] if seen.undrawn else []
    return contents, left_out


def _nets(cell: Cell) -> dict[str, str]:
    """Return the net of each stage with the trace of one run, a failed one where there is one."""
    online = cell.world("online")
    executions = (version.datum() for version in online.history(ROBOT, EXECUTION))
    runs = {execution.net_version: execution for execution in executions if execution.result}
    chosen: dict[str, str] = {}
    failed: set[str] = set()
    for version in online.history(SYSTEM, NET):
        attached = version.datum()
        run = runs.get(attached.number)
        stage = _NO_NAME.sub("_", attached.stage)
        if run is None or stage in failed:
            continue
        chosen[stage] = svg_of_net(attached.net, run)
        if not attached.net.outcome(run.result):
            failed.add(stage)
    return chosen
