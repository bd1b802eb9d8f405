"""The outcome of a run: its scores as a table and as JSON, why it stopped, and what was then."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Final, TypeVar

from actors.workcell import vocabulary as words
from actors.workcell.demo.conduct import DEPTH, masks_of
from actors.workcell.scores.evaluation import GOALS, missed
from actors.workcell.scores.trace import ONLINE
from enact_dist import View
from enact_dist.world.trees import drawn, print_tree

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console
    from rich.table import Table

    from actors.workcell.demo.conduct import Notes
    from enact_dist import Aspect, Cell, Entity
    from enact_dist.types import CauseTree

T = TypeVar("T")

COUNTS: Final = frozenset({"sets", "true_voxels", "moments", "paths"})
"""Scores that are counts of what was looked at."""


def value_text(name: str, value: float) -> str:
    """Return a score as shown in a table."""
    if not math.isfinite(value):
        return "none"
    if name in COUNTS or float(value).is_integer():
        return f"{value:,.0f}"
    if name.endswith("_share"):
        return f"{value:.4%}"
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3f}"


def table_of(scores: Mapping[str, float]) -> Table:
    """Return the scores as a table for the terminal."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("what")
    for head in ("measured", "goal", "met"):
        table.add_column(head, justify="right")
    failed = set(missed(scores))
    for name, value in scores.items():
        goal, met = GOALS[name], "[red]no[/]" if name in failed else "[green]yes[/]"
        table.add_row(goal.what, value_text(name, value), str(goal), met if str(goal) else "")
    return table


def report_of(
    scores: Mapping[str, float], facts: Mapping[str, object], checks: Mapping[str, bool]
) -> dict[str, object]:
    """Return the report as plain data.

    Args:
        scores: By name.
        facts: What ran: scenario, seed, seconds, how.
        checks: What the scenario must hold, in words, and whether it did.
    """
    finite = {name: value if math.isfinite(value) else None for name, value in scores.items()}
    return {**facts, "scores": finite, "missed": missed(scores), "checks": dict(checks)}


def report_bytes(report: Mapping[str, object]) -> bytes:
    """Return the report as JSON, for `report.json`."""
    return (json.dumps(report, indent=2) + "\n").encode()


def show_lineage(tree: CauseTree, images: int, console: Console) -> None:
    """Print where the first stop came from: its hull, the masks of one stamp, their images.

    Args:
        tree: The causes of the speed that stopped the robot.
        images: How many images were committed in one step with the masks.
        console: Where progress and table are printed.
    """
    if console.quiet:
        return  # the tree is not printed by the console itself
    command = f"enact why online {words.ROBOT}/{words.SPEED}@{tree.version} --depth {DEPTH}"
    console.print(f"\nwhy the robot stopped: {command}; of it the hull", style="bold")
    for cause in tree.children:
        if str(cause.aspect) == words.HULL.name:
            print_tree(drawn(cause), console.file)
    beside = f", {images} of them in one commit with their image" if images else ""
    console.print(f"{len(masks_of(tree))} masks{beside}; kept under the label first-stop")


def show_past(cell: Cell, notes: Notes, console: Console) -> None:
    """Print the world context as it was at the nearest approach, and the masks that were kept."""
    then = cell.world(ONLINE).at(stamp_ns=notes.nearest_ns)
    hull, speed = View(then, words.WORKSPACE, words.HULL), View(then, words.ROBOT, words.SPEED)
    second = (notes.nearest_ns - notes.start_ns) / 1e9
    console.print(f"\nonline at the nearest approach, second {second:.1f} (world.at)", style="bold")
    seen = then.view(hull, speed)
    found, command = seen.get(hull), seen.get(speed)
    if found is None or command is None:  # what is not kept has left its retention since
        found, command = (
            _kept(cell, words.WORKSPACE, words.HULL, notes.nearest_ns),
            _kept(cell, words.ROBOT, words.SPEED, notes.nearest_ns),
        )
    if found is not None and command is not None:
        console.print(
            f"{len(found.voxels):,} voxels, the nearest {found.nearest_m:.2f} m from the arm;"
            f" speed {command.scale:.0%}: {command.reason}"
        )
    masks = [
        version
        for version in cell.pinned().get("nearest", ())
        if version.aspect.name == words.SILHOUETTE.name and version.stamp_ns == notes.nearest_ns
    ]
    console.print(f"{len(masks)} masks of that stamp, kept under the label nearest")


def _kept(cell: Cell, entity: Entity, aspect: Aspect[T], stamp_ns: int) -> T | None:
    """Return the datum of a stamp among what is kept; None if it is gone."""
    history = cell.world(ONLINE).history(entity, aspect)
    return next((one.datum() for one in history if one.stamp_ns == stamp_ns), None)


def stop_checks(notes: Notes) -> dict[str, bool]:
    """Return whether the tree of the first stop ends at all masks of one stamp."""
    tree = notes.stop
    masks = masks_of(tree) if tree is not None else []
    stamps = {mask.stamp_ns for mask in masks}
    whole = len(masks) == notes.cameras and len(stamps) == 1
    images = {
        cause.entity
        for cause in (tree.walk() if tree is not None else ())
        if str(cause.aspect) == words.IMAGE.name and cause.stamp_ns in stamps
    }
    images |= {image.entity for image in notes.images if image.stamp_ns in stamps}
    return {
        f"the first stop leads to {notes.cameras} masks of one stamp": whole,
        "and to their images": whole and images == {mask.entity for mask in masks},
    }
