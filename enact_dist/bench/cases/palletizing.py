"""Bench `palletizing`: the robot of ENACT 4.2 packs trays, scored on what physics did.

Arm, gripper, belt, tray and depth sensors are simulated, in simulated time; what decides is what
the actors of `enact demo palletizing` decide with.  Nothing of it depends on the machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.bench.rows import value_row
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from enact_dist.bench.run import PackingOptions, Run

NAME: Final = "palletizing"


def run_palletizing(run: Run) -> None:
    """Pack trays.

    Raises:
        MisuseError: The extras of the cell are not installed, or options do not fit together.
    """
    try:
        import mujoco  # noqa: F401

        from actors.palletizing.trials import packing_scores as packing
    except ImportError as error:
        raise MisuseError(
            f"bench {NAME} needs {error.name}, which is not installed; install its extras:"
            " pip install -e '.[actors]' in the clone of enact-dist"
        ) from error
    asked = run.packing
    if asked.perception:
        if asked.provoke or asked.out:
            raise MisuseError("--provoke and --out are about packing; leave them with --perception")
        _score_perception(run, asked)
        return
    settings = [asked.spread] if asked.spread else packing.SETTINGS
    trays = packing.trays_of(
        asked.packages, seed=asked.seed, settings=settings, provoke=asked.provoke
    )
    if asked.provoke and not any(tray.provoked for tray in trays):
        least = packing.TRAY * (packing.EVERY - 1) + 1
        raise MisuseError(
            f"asked to provoke errors with {asked.packages} packages; every {packing.EVERY}th tray"
            f" of {packing.TRAY} is provoked, so that needs {least} packages or more"
        )
    if asked.out:
        asked.out.mkdir(parents=True, exist_ok=True)
    found = packing.played(trays, processes=asked.processes, told=run.told, out=asked.out)
    scores = packing.scores_of(found)
    failed = set(packing.missed(scores))
    first, last = trays[0].seed, trays[-1].seed
    run.add_row(
        value_row(NAME, f"held-out seeds {first} to {last}", len(trays), "trays", len(trays))
    )
    for name, value in scores.items():
        goal = packing.GOALS[name]
        met = name not in failed if str(goal) and value is not None else None
        note = "" if value is not None else "no case"
        row = value_row(
            NAME, goal.what, value, "", asked.packages, str(goal) or None, met=met, note=note
        )
        run.add_row(row)
    for (truth, verdict), count in sorted(packing.confusion(found).items()):
        title = f"truth {truth}, judged {verdict}"
        run.add_row(value_row(NAME, title, count, "places", asked.packages))


def _score_perception(run: Run, asked: PackingOptions) -> None:
    """Judge drawn packages, over noise and light of the sensor; no robot, no physics."""
    from actors.palletizing.trials import perception_scores as scores

    seed = scores.HELD_OUT + asked.seed
    for series, scored in scores.played(asked.packages, seed=seed, processes=asked.processes):
        for what, value, unit, goal in scores.figures(series, scored):
            least = goal.startswith(">=")
            limit = float(goal.split()[-1]) if goal else 0.0
            met = (value >= limit if least else value <= limit) if goal else None
            run.add_row(value_row(NAME, what, value, unit, len(scored), goal or None, met=met))
        for (kind, verdict), count in sorted(scores.confusion(scored).items()):
            title = f"{series.name}: truth {kind}, judged {verdict}"
            run.add_row(value_row(NAME, title, count, "packages", len(scored)))
