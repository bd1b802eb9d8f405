"""`enact demo workcell`: the whole cell as processes, conducted, recorded, scored on its truth.

A shard and one process per camera and actor run under `enact up`; this process confirms the empty
cell, starts the scenario, breaks what the scenario breaks, and records.  Afterwards it scores the
recording and draws.  Files in `out`:

==================  ==========================================================================
run.mcap            everything but the images, for `enact replay`, Foxglove and the evaluation
report.json         the table
figure1.png         limbs, voxels, models and properties of the nearest approach
figure4.svg         all actors, and what they read and write, drawn from their declarations
figure3_top.png     its eight masks, changed pixels in colour
figure3_bottom.png  its hull before and after the refinement
plan.png            the cell from above: tracks, prediction, path, truth
timeline.png        distance, allowed and actual speed
cell.toml cell.log  configuration and log of the cell
==================  ==========================================================================
"""

from __future__ import annotations

import dataclasses
import math
import signal
import sys
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from actors.geometry.files import write_whole
from actors.running_cell import DemoCell, DemoError, until_interrupted
from actors.workcell.cameras.sources import CameraError
from actors.workcell.demo.cell import EmbeddedCell, RunningCell
from actors.workcell.demo.conduct import Conductor, recording
from actors.workcell.demo.options import PLAYED
from actors.workcell.demo.report import (
    report_bytes,
    report_of,
    show_lineage,
    show_past,
    stop_checks,
    table_of,
)
from actors.workcell.demo.what_if import show_what_if
from actors.workcell.scenarios import scenario_of
from actors.workcell.scores.evaluation import score
from actors.workcell.scores.figures import figure4, pictures_of
from actors.workcell.scores.scenario_checks import checks_of
from actors.workcell.scores.trace import trace_of
from actors.workcell.simulation.recording import cache_folder, kept_recording, record

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from actors.workcell.demo.conduct import Notes
    from actors.workcell.demo.options import Options
    from actors.workcell.demo.what_if import WhatIf
    from enact_dist import Cell

HULLS_SCORED = 120
"""About so many hulls of a run are compared voxel by voxel."""


def run_demo(options: Options) -> int:
    """Run a scenario and report.

    Returns:
        Exit status: 0 done, 1 the cell failed; what the scores say is the report's matter.
    """
    from rich.console import Console

    console = Console(highlight=False, stderr=options.quiet)
    begun_s = time.monotonic()
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        outcome = _run(options, console)
    except (DemoError, CameraError) as error:
        print(f"enact demo: {error}", file=sys.stderr)
        return 1
    finally:
        signal.signal(signal.SIGTERM, before)
    if options.quiet:
        sys.stdout.write(report_bytes(outcome.report).decode())
    console.print(f"pictures in {options.out}; {time.monotonic() - begun_s:.0f} s in all")
    return 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run."""

    scores: dict[str, float]
    cores: dict[str, float]
    report: dict[str, object]


def run_quietly(options: Options) -> Outcome:
    """Run a scenario and return what came of it; nothing is printed.

    Raises:
        DemoError: The cell failed, or its views cannot be drawn.
    """
    from rich.console import Console

    try:
        return _run(options, Console(quiet=True))
    except CameraError as error:
        raise DemoError(str(error)) from error


def _run(options: Options, console: Console) -> Outcome:
    options = with_recording(options, console)
    running = _cell_of(options)
    with running, running.joined() as cell:
        how = "in this process" if options.embedded else "a shard and processes are up"
        console.print(f"{how}; log in {running.log}")
        notes = _conducted(cell, running, options, console)
        what_if = _shown(cell, options, notes, console)
        if options.keep_running:
            outcome = _reported(running.config, options, notes, what_if, console)
            console.print(f"the cell stays up: enact world tree online --cell {running.config}")
            until_interrupted(running)
            return outcome
    return _reported(running.config, options, notes, what_if, console)


def _cell_of(options: Options) -> DemoCell:
    if options.cell is not None:
        return DemoCell(options.cell, log="the logs of its processes")
    return EmbeddedCell(options) if options.embedded else RunningCell(options)


def with_recording(options: Options, console: Console) -> Options:
    """Return the options with the folder of the images that are played, made if they are not there.

    Raises:
        CameraError: The images cannot be drawn.
    """
    if options.source not in PLAYED:
        return options
    scenario = scenario_of(options.scenario, options.seed, options.seconds)
    with console.status("drawing the views of the scenario"):
        folder = kept_recording(cache_folder(), scenario)
    return dataclasses.replace(options, source=f"{options.source}:{folder}")


def record_views(options: Options, folder: Path, renderer: str) -> int:
    """Draw the views of a scenario into a folder, for `--play`; return the exit status.

    Args:
        options: Which scenario.
        folder: A new one, or that of a recording, which is replaced.
        renderer: "composite" or "mujoco".
    """
    from rich.progress import Progress

    scenario = scenario_of(options.scenario, options.seed, options.seconds)
    try:
        with Progress() as progress:
            bar = progress.add_task(f"views of {scenario.name}", total=None)
            record(
                folder,
                scenario,
                renderer=renderer,
                progress=lambda done, total: progress.update(bar, completed=done, total=total),
            )
    except CameraError as error:
        print(f"enact demo: {error}", file=sys.stderr)
        return 1
    chosen = f"--scenario {scenario.name} --seed {scenario.seed} --seconds {scenario.seconds:g}"
    print(f"recorded in {folder}; play it with --play {folder} {chosen}")
    return 0


def _conducted(cell: Cell, running: DemoCell, options: Options, console: Console) -> Notes:
    """Conduct and record the run; return what was noted."""
    conductor = Conductor(cell, running, options, partial(console.print, soft_wrap=True))
    conductor.prepare()
    with recording(cell, options.out / "run.mcap"):
        before, begun_s = running.processor_s(), time.monotonic()
        conductor.follow()
        took_s = time.monotonic() - begun_s
    conductor.notes.cores = {
        name: round((used_s - before[name]) / took_s, 3)
        for name, used_s in running.processor_s().items()
        if used_s >= before.get(name, math.inf)
    }
    return conductor.notes


def _shown(cell: Cell, options: Options, notes: Notes, console: Console) -> WhatIf | None:
    """Show what only a running cell can tell: its past, why it stopped, another planner."""
    if notes.nearest_ns:
        show_past(cell, notes, console)
    if notes.stop is not None:
        show_lineage(notes.stop, len(notes.images), console)
    if not notes.forked_ns:
        return None
    return show_what_if(cell, options.out / "run.mcap", notes, console)


def _reported(
    config: Path, options: Options, notes: Notes, what_if: WhatIf | None, console: Console
) -> Outcome:
    """Score, print and draw a run that is over; return what came of it."""
    with console.status("reading the recording") as status:
        trace = trace_of(options.out / "run.mcap")
        every = max(1, math.ceil(options.seconds * 10.0 / HULLS_SCORED))
        scores = score(trace, every=every, tell=status.update)
        status.update("drawing the pictures")
        contents = {
            options.out / name: png for name, png in pictures_of(trace, notes.nearest_ns).items()
        }
    checks = checks_of(trace, scores)
    if options.scenario == "S9":
        checks |= {"the fork was tried": what_if is not None}
    checks |= what_if.checks() if what_if is not None else {}
    if options.scenario == "S12":
        checks |= stop_checks(notes)
    console.print("", table_of(scores), "", sep="\n")
    for text, held in checks.items():
        console.print(f"[{'green' if held else 'red'}]{'holds' if held else 'fails'}[/]  {text}")
    if notes.cores:
        most = sorted(notes.cores.items(), key=lambda item: -item[1])
        told = ", ".join(f"{name} {cores:.2f}" for name, cores in most)
        console.print(f"processors: {sum(notes.cores.values()):.2f} cores: {told}", soft_wrap=True)
    facts = {
        "scenario": options.scenario,
        "seed": options.seed,
        "seconds": options.seconds,
        "source": options.source,
        "embedded": options.embedded,
        "separate": options.separate,
        "events": notes.lines,
        "what_if": what_if.facts() if what_if is not None else None,
        "recording_missing": trace.missing,
        "cores": notes.cores,
    }
    report = report_of(scores, facts, checks)
    contents[options.out / "report.json"] = report_bytes(report)
    contents[options.out / "figure4.svg"] = figure4(config)
    write_whole(contents)
    return Outcome(scores, notes.cores, report)
