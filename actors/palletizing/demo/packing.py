"""`enact demo palletizing`: the cell with its robot as processes, watched from outside and scored.

Belt, robot, gripper, tray and sensors are one simulated process with physics (MuJoCo); two shards
and the actors are processes of their own.  This process only looks.  Files in `out`:

=======================  ===========================================================================
model_<product>.png      the trained surface, each planar patch in its colour
tray_<n>.png             each tray with the deviating regions in red
cell.png                 the cell in the middle of the run, drawn by MuJoCo;
                         deviation_<place>.png: when one was found
net_<stage>.svg          each net, with the trace of one run
actors.svg               who reads and writes what, drawn from the declarations
run.mcap                 the recording
report.json              the table
cell.toml, *.log         configuration and logs of the cell, if it ran here
=======================  ===========================================================================
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from actors.palletizing.control.controller import ControllerError
from actors.palletizing.demo.lineage import show_packing
from actors.palletizing.demo.packing_files import Seen, files_of
from actors.palletizing.demo.packing_report import (
    judged_by,
    report_bytes,
    row_of,
    score_of,
    table_of,
)
from actors.palletizing.demo.robot_cell import RunningRobotCell, watched_robot_cell
from actors.palletizing.demo.run import WATCHING, show_run, show_score, watch_demo, write_pictures
from actors.palletizing.operator import SCRIPT
from actors.palletizing.vocabulary import (
    CONTROL,
    DECISION,
    DEVIATIONS,
    NOTICES,
    PLACES,
    PLAN,
    PRODUCTS,
    REQUEST,
    RESULTS,
    ROBOT,
    SCAN,
    SYSTEM,
    USER,
    VIEWS,
)
from actors.running_cell import DemoError, recording
from enact_dist import View, ViewEach
from enact_dist.errors import ShardUnreachableError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    import numpy.typing as npt
    from rich.console import Console

    from actors.palletizing.demo.packing_report import Row
    from actors.palletizing.demo.robot_cell import RobotCell
    from actors.palletizing.vocabulary import Notice, Plan
    from actors.running_cell import DemoStore
    from enact_dist import Cell

    Picture = npt.NDArray[np.uint8]

LOOK_S: Final = 0.2
"""How often the demonstration looks at the cell."""
STALL_S: Final = 90.0
"""Without any progress for this long something is wrong."""
SEED: Final = 59
SPEED: Final = 1.25
"""Simulated seconds per second: what two cores can do beside all actors."""
PICTURE_PX: Final = (960, 720)


def run_packing(
    *,
    out: Path,
    packages: int = 12,
    seed: int = SEED,
    speed: float = SPEED,
    keep_running: bool = False,
    store: DemoStore | None = None,
) -> int:
    """Run the demonstration and report.

    Args:
        out: Folder for pictures and report; made if missing.
        packages: How many packages come, at least 1.
        seed: Seed of packages and sensors.
        speed: Simulated seconds per second; a slow machine does less.
        keep_running: Leave the cell up afterwards, until Ctrl-C.
        store: Where the cell's data are instead of a folder.

    Returns:
        Exit status: 0 done, 1 the cell failed; wrong verdicts are the score's matter.
    """
    if packages < 1:
        print(f"--packages is {packages}; at least one has to come", file=sys.stderr)
        return 1
    if not 0.1 <= speed <= 10.0:
        print(f"--speed is {speed:g}; it must be between 0.1 and 10", file=sys.stderr)
        return 1
    running = RunningRobotCell(out, packages=packages, seed=seed, speed=speed, store=store)
    up = f"cell up: 2 shards, 16 actors, and physics at {speed:g} times real time"
    return show_run(running, out, up, partial(_show, running, out), stays=keep_running)


def watch_packing(config: Path, *, out: Path) -> int:
    """Watch the demonstration in a cell that others run, with the robot or without, and report.

    Args:
        config: The `cell.toml` of that cell.
        out: Folder for pictures and report; made if missing.

    Returns:
        Exit status as of `run_packing`.

    Raises:
        ConfigError: The file cannot be used, or is not of a simulated palletizing cell.
    """
    running = watched_robot_cell(config)
    if running is None:
        return watch_demo(config, out=out)
    return show_run(running, out, WATCHING, partial(_show, running, out))


def _show(running: RobotCell | RunningRobotCell, out: Path, cell: Cell, console: Console) -> None:
    """Show a run and write its files."""
    with _recorded(cell, out, console):
        seen = follow(cell, running, console)
    rows = _rows(cell, running, seen)
    show_score(cell, table_of(rows), f"{score_of(rows)}\n{_told(seen)}", console)
    show_packing(cell, console)
    contents, left_out = files_of(cell, running.config, out, seen)
    contents[out / "report.json"] = report_bytes(rows, seen.figures)
    write_pictures(out, contents)
    for line in left_out:
        console.print(line)


def _recorded(cell: Cell, out: Path, console: Console) -> contextlib.AbstractContextManager[Any]:
    """Record the run, if what that takes is installed."""
    if importlib.util.find_spec("mcap") is None:
        console.print("no recording: install the record extra, pip install -e '.[record]'")
        return contextlib.nullcontext()
    return recording(cell, out / "run.mcap")


def follow(cell: Cell, running: RobotCell | RunningRobotCell, console: Console) -> Seen:
    """Show progress until every package is done with.

    Raises:
        DemoError: The processes ended, the operator's script has stopped the cell, or nothing
            moved for `STALL_S`.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    seen = Seen()
    told: dict[str, str] = {}
    trained: set[str] = set()
    moved_s, before = time.monotonic(), (0, 0, "")
    columns = TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        views_bar = progress.add_task("training: views", total=None)
        packages_bar = progress.add_task("online: packages", total=running.packages)
        while len(seen.results) < running.packages:
            running.check()
            if time.monotonic() - moved_s > STALL_S:
                raise DemoError(f"nothing moved for {STALL_S:.0f} s; see {running.log}")
            if why := _stopped(cell):
                raise DemoError(f"{why}; see {running.log}")
            with contextlib.suppress(ShardUnreachableError):  # the operator restarts it
                views, ordered, models = _training(cell)
                for product in sorted(models - trained):
                    console.print(f"{product} is trained")
                trained |= models
                progress.update(views_bar, completed=views, total=ordered or None)
                for place, text in _online(cell, running, seen).items():
                    if told.get(place) != text:
                        console.print(text)
                    told[place] = text
                progress.update(packages_bar, completed=len(seen.results))
                if line := running.progressed(len(seen.results)):
                    console.print(line)
                now = views, len(seen.results), "".join(told.values())
                moved_s, before = (moved_s, before) if now == before else (time.monotonic(), now)
            time.sleep(LOOK_S)
    seen.figures["seconds"] = round(time.monotonic() - (seen.started_s or moved_s), 1)
    return seen


def _stopped(cell: Cell) -> str:
    """Return why nothing moves any more: the operator is a script, and has stopped; "" if not."""
    online = cell.world("online")
    decision, request = View(online, SYSTEM, DECISION), View(online, SYSTEM, REQUEST)
    notices = View(online, USER, NOTICES)
    try:
        now = online.view(decision, request, notices)
    except ShardUnreachableError:  # the operator restarts it
        return ""
    decided, last = now.get(decision), now.get(request)
    if decided is None or last is None or last.kind != "stop" or decided.by != SCRIPT:
        return ""
    told: Mapping[str, Notice] = now.get(notices, {})
    why = told[last.place].text if last.place in told else last.place
    return f"the operator's script has stopped the cell: {why}"


def _training(cell: Cell) -> tuple[int, int, set[str]]:
    """Return how many views there are, how many are ordered, and which products are trained."""
    training = cell.world("training")
    scans = ViewEach(training, PRODUCTS, SCAN)
    models = {slot.entity.name for slot in training.list_slots(PRODUCTS, ("surface",))}
    views = len(training.list_slots(VIEWS, ("surface",)))
    return views, sum(training.view(scans)[scans].values()), models


def _online(cell: Cell, running: RobotCell | RunningRobotCell, seen: Seen) -> dict[str, str]:
    """Note verdicts with the truth of this moment, and results; return the notices by place."""
    online, training = cell.world("online"), cell.world("training")
    flags, results = View(online, SYSTEM, DEVIATIONS), View(online, SYSTEM, RESULTS)
    notices, plans = View(online, USER, NOTICES), ViewEach(training, PLACES, PLAN)
    now = online.view(flags, results, notices)
    if not seen.started_s and online.list_slots("package/*", ("sighting",)):
        seen.started_s = time.monotonic()
    found, planned = now.get(flags, {}), training.view(plans)[plans]
    new = [
        place
        for place, flag in found.items()
        if place not in seen.flags or seen.flags[place].captured_ns != flag.captured_ns
    ]
    if new:
        truths = running.hardware.truth().packages
        by_name = {place.name: plan for place, plan in planned.items()}
        for place in new:
            number = int(place.rpartition("/")[2])
            seen.judged[place] = judged_by(truths[number], by_name[place])
            if found[place].verdict != "ok":
                _draw(running, seen, f"deviation_{place.replace('/', '_')}.png")
    if seen.started_s and "cell.png" not in seen.pictures and 2 * len(found) >= running.packages:
        _draw(running, seen, "cell.png")
    seen.flags, seen.results = found, now.get(results, {})
    return {place: notice.text for place, notice in now.get(notices, {}).items()}


def _draw(running: RobotCell | RunningRobotCell, seen: Seen, name: str) -> None:
    """Have the cell drawn by MuJoCo, if it can be drawn here."""
    if seen.undrawn:
        return
    try:
        seen.pictures[name] = running.hardware.picture(*PICTURE_PX)
    except ControllerError as error:
        seen.undrawn = str(error)


def _rows(cell: Cell, running: RobotCell | RunningRobotCell, seen: Seen) -> list[Row]:
    """Set results and verdicts beside the truth."""
    training, online = cell.world("training"), cell.world("online")
    plans, control = ViewEach(training, PLACES, PLAN), View(online, ROBOT, CONTROL)
    planned: dict[str, Plan] = {
        place.name: plan for place, plan in training.view(plans)[plans].items()
    }
    truths = running.hardware.truth().packages
    if len(seen.results) and "cell.png" not in seen.pictures:
        _draw(running, seen, "cell.png")
    figures = online.view(control).get(control)
    if figures is not None:
        seen.figures |= {"period_p99_ms": figures.p99_ms, "period_median_ms": figures.median_ms}
    rows = []
    for place, result in seen.results.items():
        number = int(place.rpartition("/")[2])
        flag, judged = seen.flags.get(place), seen.judged.get(place)
        rows.append(row_of(place, planned[place], truths[number], flag, result, judged))
    return rows


def _told(seen: Seen) -> str:
    count, seconds = len(seen.results), float(str(seen.figures["seconds"]))
    period = seen.figures.get("period_p99_ms")
    control = "" if period is None else f"; control period p99 {period:.1f} ms"
    return f"{count} packages in {seconds:.0f} s, {seconds / max(count, 1):.1f} s each{control}"
