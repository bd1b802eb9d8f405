"""What could have been: another planner tries ten recorded seconds in a fork of `online`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from actors.geometry.arms.joint_paths import JointPath, PathFollower, PathSpeeds
from actors.workcell import vocabulary as words
from actors.workcell.demo.conduct import WHAT_IF, WHAT_IF_S
from actors.workcell.motion import BRAKING_M_S2, CYCLE_S, NOMINAL_M_S
from actors.workcell.planning import PathPlanning
from actors.workcell.scores.trace import ONLINE
from enact_dist import ActorThread, View
from enact_dist.errors import EnactError
from enact_dist.recording import Replay

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console

    from actors.workcell.demo.conduct import Notes
    from enact_dist import Cell
    from enact_dist.types import Version

T = TypeVar("T")

REPLAYED: Final = ("hull", "prediction", "track", "joints")
"""What the planner of a fork reads; all else is as it was when the fork was made."""
LEG_S_MAX: Final = 60.0
"""No leg of the task takes longer at full speed."""


@dataclass(frozen=True, slots=True)
class WhatIf:
    """What came of the other planner.

    Attributes:
        paths_fork: How many paths it planned.
        paths_online: How many the planner of the cell planned in the same seconds.
        legs_fork_s: How long each leg of the task takes with its paths, see `legs_s`.
        legs_online_s: The same with the paths of the cell.
        strangers: Paths in `online` that the planner in the fork committed, which must not be.
    """

    paths_fork: int
    paths_online: int
    legs_fork_s: tuple[float, ...]
    legs_online_s: tuple[float, ...]
    strangers: int

    @property
    def saved_s(self) -> float:
        """How much less time the legs that both have planned take with the other planner."""
        pairs = zip(self.legs_online_s, self.legs_fork_s, strict=False)
        return sum(online_s - fork_s for online_s, fork_s in pairs)

    def checks(self) -> dict[str, bool]:
        """Return what must hold, in words, and whether it did."""
        return {
            "the planner in the fork planned": self.paths_fork > 0,
            "online never saw the fork": self.strangers == 0,
        }

    def facts(self) -> dict[str, object]:
        """Return it for the report."""
        return {
            "paths_fork": self.paths_fork,
            "paths_online": self.paths_online,
            "legs_fork_s": [round(one, 2) for one in self.legs_fork_s],
            "legs_online_s": [round(one, 2) for one in self.legs_online_s],
            "saved_s": round(self.saved_s, 2),
        }


def show_what_if(cell: Cell, recording: Path, notes: Notes, console: Console) -> WhatIf | None:
    """Let another planner try ten recorded seconds in the fork, print the difference, drop it.

    Args:
        cell: The cell, with the fork that was made while the run went on.
        recording: What was recorded.
        notes: When the fork was made.
        console: Where progress and table are printed.

    Returns:
        What came of it; None where it could not be done.
    """
    console.print(f"\nwhat if: a planner with no regard to predictions, in {WHAT_IF}", style="bold")
    try:
        found, versions = _tried(cell, recording, notes)
    except EnactError as error:
        console.print(f"not possible: {error}", soft_wrap=True)
        return None
    finally:
        cell.drop_world(WHAT_IF)
    console.print(
        f"{versions} versions of {WHAT_IF_S:g} s replayed: {found.paths_fork} paths in the fork,"
        f" {found.paths_online} online; online has {found.strangers or 'none'} of the fork's paths",
        soft_wrap=True,
    )
    both = min(len(found.legs_fork_s), len(found.legs_online_s))
    if both:
        console.print(
            f"{both} legs at full speed: online {sum(found.legs_online_s[:both]):.1f} s,"
            f" the fork {sum(found.legs_fork_s[:both]):.1f} s: {found.saved_s:.1f} s saved",
            soft_wrap=True,
        )
    return found


def _tried(cell: Cell, recording: Path, notes: Notes) -> tuple[WhatIf, int]:
    """Replay into the fork while another planner plans there; return also how much was replayed."""
    fork, online = cell.world(WHAT_IF), cell.world(ONLINE)
    first = fork.history(words.ROBOT, words.PATH, count=1)
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
    there = [one for one in fork.history(words.ROBOT, words.PATH) if one.version > begun]
    all_online = online.history(words.ROBOT, words.PATH)
    here = [
        one for one in all_online if 0 <= one.position.stamp_ns - notes.forked_ns <= WHAT_IF_S * 1e9
    ]
    model = View(online, words.ROBOT, words.MODEL)
    arm = online.view(model)[model]
    legs_fork_s, legs_online_s = (
        legs_s(arm, [(one.stamp_ns, one.datum()) for one in versions]) for versions in (there, here)
    )
    found = WhatIf(len(there), len(here), legs_fork_s, legs_online_s, in_both(there, all_online))
    return found, summary.versions


def in_both(fork: Sequence[Version[T]], online: Sequence[Version[T]]) -> int:
    """Return how many versions that were committed in a fork are in `online`, too.

    Who wrote them would not tell: in one process both planners have one session.
    """
    return len({one.position for one in fork} & {one.position for one in online})


def legs_s(arm: words.ArmModel, paths: Sequence[tuple[int, words.Path]]) -> tuple[float, ...]:
    """Return how long each leg of a task takes, seconds.

    A leg begins with its first path and ends when its last path has been followed at full speed.

    Args:
        arm: The arm.
        paths: Stamp and path, in the order of planning; those without points only wait.
    """
    legs: list[tuple[int, int, float]] = []
    for stamp_ns, path in paths:
        if not len(path.waypoints):
            continue
        same = bool(legs) and legs[-1][0] == path.to_goal
        begin_ns = legs.pop()[1] if same else stamp_ns
        legs.append((path.to_goal, begin_ns, (stamp_ns - begin_ns) / 1e9 + along_s(arm, path)))
    return tuple(seconds for _, _, seconds in legs)


def along_s(arm: words.ArmModel, path: words.Path) -> float:
    """Return how long the arm takes along a path at full speed, from rest to rest, seconds."""
    speeds = PathSpeeds(arm, JointPath(path.waypoints), nominal_m_s=NOMINAL_M_S)
    follower = PathFollower(speeds, cycle_s=CYCLE_S, braking_m_s2=BRAKING_M_S2)
    cycles = 0
    while not follower.arrived and cycles * CYCLE_S < LEG_S_MAX:
        follower.step(NOMINAL_M_S)
        cycles += 1
    return cycles * CYCLE_S
