"""What a run shows of its world contexts: why it stopped, what was then, what could have been."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.workcell import vocabulary as words
from actors.workcell.demo_conduct import DEPTH, WHAT_IF, WHAT_IF_S, masks_of
from actors.workcell.trace import ONLINE
from enact_dist import Aspect, View
from enact_dist.actor_process import ActorThread
from enact_dist.cli.lineage import drawn
from enact_dist.cli.output import print_tree
from enact_dist.errors import EnactError
from enact_dist.recording import Replay

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from actors.workcell.demo_conduct import Notes
    from enact_dist import Cell
    from enact_dist.lineage import CauseTree

REPLAYED = ("hull", "prediction", "track", "joints")
"""What the planner of a fork reads; all else is as it was when the fork was made."""


def show_lineage(tree: CauseTree, console: Console) -> None:
    """Print where the first stop came from: its hull, the masks of one stamp, their images.

    Args:
        tree: The causes of the speed that stopped the robot.
        console: Where progress and table are printed.
    """
    command = f"enact why online {words.ROBOT}/{words.SPEED}@{tree.version} --depth {DEPTH}"
    console.print(f"\nwhy the robot stopped: {command}; of it the hull", style="bold")
    for cause in tree.children:
        if str(cause.aspect) == words.HULL.name:
            print_tree(drawn(cause))
    console.print(f"{len(masks_of(tree))} masks; kept under the label first-stop")


def show_past(cell: Cell, notes: Notes, console: Console) -> None:
    """Print the world context as it was at the nearest approach, and the masks that were kept."""
    then = cell.world(ONLINE).at(stamp_ns=notes.nearest_ns)
    hull, speed = View(then, words.WORKSPACE, words.HULL), View(then, words.ROBOT, words.SPEED)
    second = (notes.nearest_ns - notes.start_ns) / 1e9
    console.print(f"\nonline at the nearest approach, second {second:.1f} (world.at)", style="bold")
    seen = then.view(hull, speed)
    found, command = seen.get(hull), seen.get(speed)
    if found is not None and command is not None:
        console.print(
            f"{len(found.voxels):,} voxels, the nearest {found.nearest_m:.2f} m from the arm;"
            f" speed {command.scale:.0%}: {command.reason}"
        )
    masks = [
        version
        for version in cell.kept().get("nearest", ())
        if version.aspect.name == words.SILHOUETTE.name and version.stamp_ns == notes.nearest_ns
    ]
    console.print(f"{len(masks)} masks of that stamp, kept under the label nearest")


def show_what_if(
    cell: Cell, recording: Path, notes: Notes, console: Console
) -> dict[str, object] | None:
    """Let another planner try ten recorded seconds in the fork, print the difference, drop it.

    Args:
        cell: The cell, with the fork that was made while the run went on.
        recording: What was recorded.
        notes: When the fork was made.
        console: Where progress and table are printed.

    Returns:
        What came of it, for the report; None where it could not be done.
    """
    from actors.workcell.planning import PathPlanning

    console.print(f"\nwhat if: a planner with no regard to predictions, in {WHAT_IF}", style="bold")
    path = Aspect(words.PATH.name, words.Path)
    try:
        fork = cell.world(WHAT_IF)
        first = fork.history(words.ROBOT, path, count=1)
        replay = Replay(
            cell,
            recording,
            worlds={ONLINE: WHAT_IF},
            only_worlds=(ONLINE,),
            aspects=REPLAYED,
            overwrite=True,
        )
        replay.between(notes.forked_ns, notes.forked_ns + round(WHAT_IF_S * 1e9))
        planner = PathPlanning()
        planner.predict = False
        with ActorThread(planner, cell, {"online": WHAT_IF}, name="what-if-planner"):
            summary = replay.run(warn=lambda _: None)
        begun = first[0].version if first else 0
        there = [version for version in fork.history(words.ROBOT, path) if version.version > begun]
        here = [
            version
            for version in cell.world(ONLINE).history(words.ROBOT, path)
            if 0 <= version.position.stamp_ns - notes.forked_ns <= WHAT_IF_S * 1e9
        ]
        diff = cell.world(ONLINE).diff(fork, words.ROBOT, [path])
        console.print(
            f"{summary.versions} versions of {WHAT_IF_S:g} s replayed: {len(there)} paths in the"
            f" fork, {len(here)} online; online never saw them"
        )
        differ = [str(row.difference or row.kind.value) for row in diff.rows]
        console.print("online against the fork: " + ("; ".join(differ) or "no difference"))
        return {"paths_fork": len(there), "paths_online": len(here), "differences": differ}
    except EnactError as error:
        console.print(f"not possible: {error}")
        return None
    finally:
        cell.drop_world(WHAT_IF)
