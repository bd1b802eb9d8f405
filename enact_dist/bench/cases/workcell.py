"""Bench `workcell`: the application of ENACT 4.1 as processes, scored on its simulated truth.

A run of `enact demo workcell` whose pictures are thrown away: every score with its goal, and the
processor time of its processes.  Scenario `visit`, seed 1, views played, arm drawn.  Afterwards the
same updates run without sharing, in one thread of this process; what the processes take beyond that
is the framework's own share: shard, sessions, copies, and being processes.

With `--embedded` its quality alone: S1 to S12 in simulated time, one after another in two
processes.  Nothing of it depends on the machine but how long planning takes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.bench.rows import value_row
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.bench.run import Run

NAME: Final = "workcell"
SHARE_CORES: Final = 0.3
"""What the framework may take of the processors."""
TIMES: Final = 20
"""The cell runs this many times as long as a line of another bench: 60 s by default."""
EMBEDDED_TIMES: Final = 4
"""The same of each scenario with `--embedded`: 12 s."""


def run_workcell(run: Run) -> None:
    """Measure one run of the cell.

    Raises:
        MisuseError: The extras of the workcell are not installed, or the cell failed.
    """
    try:
        from rich.console import Console

        from actors.running_cell import DemoError
        from actors.workcell.demo.options import Options
        from actors.workcell.demo.run import run_quietly, with_recording
        from actors.workcell.demo.unshared import UnsharedCell
    except ImportError as error:
        raise MisuseError(
            f"bench workcell needs {error.name}, which is not installed; install its extras:"
            " pip install -e '.[workcell,record]' in the clone of enact-dist"
        ) from error
    if run.place.embedded:
        _run_embedded(run)
        return
    seconds = TIMES * run.seconds_s
    run.told(f"workcell: {seconds:g} s, after about a minute of preparation")
    with tempfile.TemporaryDirectory(prefix="enact-bench-workcell-") as folder:
        options = Options(Path(folder), seconds=seconds, quiet=True)
        try:
            report = run_quietly(options)
            run.told(f"workcell: the same work without sharing, {seconds:g} s")
            alone = UnsharedCell(with_recording(options, Console(quiet=True))).run()
        except (DemoError, TimeoutError) as error:
            raise MisuseError(str(error)) from error
    _add_scores(run, report.scores)
    sets = round(report.scores.get("sets", 0.0))
    cores = report.cores
    run.add_row(value_row(NAME, "processors, all processes", sum(cores.values()), "cores", sets))
    run.add_row(value_row(NAME, "the same work in one process, not shared", alone, "cores", sets))
    share, goal_text = sum(cores.values()) - alone, f"≤ {SHARE_CORES:g}"
    met = share <= SHARE_CORES
    title = "the framework's own share"
    run.add_row(value_row(NAME, title, share, "cores", sets, goal_text, met=met))
    for name in ("cell", "reconstruction", "camera-0"):
        if name in cores:
            title = "the shard" if name == "cell" else name
            run.add_row(value_row(NAME, f"of it: {title}", cores[name], "cores", sets))


def _run_embedded(run: Run) -> None:
    """Play the scenarios in simulated time."""
    from actors.workcell.scenarios import SCENARIOS
    from actors.workcell.scores.quality import quality

    seeds = range(1, run.seeds + 1)
    found = quality(SCENARIOS[1:], seeds, seconds=EMBEDDED_TIMES * run.seconds_s, told=run.told)
    _add_scores(run, found["all"])


def _add_scores(run: Run, scores: Mapping[str, float]) -> None:
    """Add a row per score."""
    from actors.workcell.demo.report import value_text
    from actors.workcell.scores.evaluation import GOALS, missed

    failed = set(missed(scores))
    sets = round(scores.get("sets", scores.get("moments", 0.0) / 10.0))
    for name, value in scores.items():
        goal = GOALS[name]
        met = name not in failed if str(goal) else None
        note = value_text(name, value)
        run.add_row(value_row(NAME, goal.what, value, "", sets, str(goal), met=met, note=note))
