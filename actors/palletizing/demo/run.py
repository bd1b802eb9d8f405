"""The list-driven cell as processes, watched from outside and scored: a test of perception.

What stands on the tray, and what is wrong with it, comes from a seeded list, without a robot; the
containers run this cell (`enact demo palletizing --cell`), and `demo.packing` the one with a robot.

Two shard daemons and eight actors run as processes of their own, under `enact up` or in containers;
this process only looks: it shows progress, and at the end sets the verdicts beside the truth.
Files in `out`:

===================  =========================================================
model_<product>.png  the trained surface, each planar patch in its colour
tray_<n>.png         each tray with the deviating regions in red
report.json          the table
===================  =========================================================
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from actors.geometry.files import write_whole
from actors.geometry.pictures.picture import png_bytes
from actors.palletizing.control.controller import ControllerError
from actors.palletizing.demo.cell import watched_cell
from actors.palletizing.demo.lineage import show_lineage
from actors.palletizing.demo.pictures import model_picture, tray_picture
from actors.palletizing.demo.report import difference_of, report_bytes, rows_of, score_of, table_of
from actors.palletizing.simulation.packages import package_sequence
from actors.palletizing.vocabulary import (
    DEVIATIONS,
    EMPTY,
    NOTICES,
    OBSERVATION,
    PLACES,
    PLAN,
    PRODUCTS,
    REGION,
    SCAN,
    STANDING,
    SURFACE,
    SYSTEM,
    TRAY,
    USER,
    VIEWS,
)
from actors.running_cell import DemoError, until_interrupted
from enact_dist import View, ViewEach
from enact_dist.errors import ShardUnreachableError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from actors.palletizing.simulation.packages import Package
    from actors.palletizing.vocabulary import Deviation, Notice
    from actors.running_cell import DemoCell
    from enact_dist import Cell

LOOK_S: Final = 0.2
"""How often the demonstration looks at the cell."""
STALL_S: Final = 120.0
"""Without any progress for this long something is wrong; a view takes less than a second."""
WATCHING: Final = "watching a cell that runs already"


def watch_demo(config: Path, *, out: Path) -> int:
    """Watch the demonstration in a cell that others run, and report.

    Args:
        config: The `cell.toml` of that cell.
        out: Folder for pictures and report; made if missing.

    Returns:
        Exit status: 0 done, 1 the cell failed; wrong verdicts are the score's matter.

    Raises:
        ConfigError: The file cannot be used, or is not of a simulated palletizing cell.
    """
    demo = watched_cell(config)
    truths = package_sequence(demo.packages, seed=demo.seed)

    def show(cell: Cell, console: Console) -> None:
        _follow(cell, demo, truths, console)
        flags, notices = _outcome(cell)
        rows = rows_of(truths, flags, notices)
        show_score(cell, table_of(rows), score_of(rows), console)
        show_lineage(cell, rows[-1].product, console)
        contents = {out / "report.json": report_bytes(rows, seed=demo.seed)}
        write_pictures(out, contents | pictures_of(cell, out, flags))

    return show_run(demo, out, WATCHING, show)


def show_run(
    demo: DemoCell,
    out: Path,
    up: str,
    show: Callable[[Cell, Console], None],
    *,
    stays: bool = False,
) -> int:
    """Enter a cell, let a run be shown, and return the exit status.

    Args:
        demo: The cell.
        out: Folder for the files; made if missing.
        up: What is said when the cell is up.
        show: Follows the run to its end, and writes the files.
        stays: Leave the cell up afterwards, until Ctrl-C.
    """
    from rich.console import Console

    out.mkdir(parents=True, exist_ok=True)
    console = Console(highlight=False)
    started_s = time.monotonic()
    try:
        with demo as running, running.joined() as cell:
            console.print(f"{up}; log in {running.log}")
            show(cell, console)
            console.print(f"pictures in {out}; {time.monotonic() - started_s:.0f} s in all")
            if stays:
                console.print(f"the cell stays up: enact world tree --cell {running.config}")
                until_interrupted(running)
    except (DemoError, ControllerError) as error:
        print(f"enact demo: {error}", file=sys.stderr)
        return 1
    return 0


def show_score(cell: Cell, table: Table, score: str, console: Console) -> None:
    """Print table and score, and what is not as planned."""
    console.print("\n", table, f"\n{score}", sep="")
    planned = cell.world("training").diff(cell.world("online"), PLACES, STANDING)
    console.print("", difference_of(planned), "", sep="\n")


def pictures_of(cell: Cell, out: Path, flags: Mapping[str, Deviation]) -> dict[Path, bytes]:
    """Return the pictures of the trained surfaces, and of the newest look at each tray, by file.

    Args:
        cell: The cell.
        out: Folder of the files.
        flags: Verdicts by name of the place; what deviates is marked on its tray.
    """
    training, online = cell.world("training"), cell.world("online")
    surfaces, plans = ViewEach(training, PRODUCTS, SURFACE), ViewEach(training, PLACES, PLAN)
    empty = View(training, TRAY, EMPTY)
    looks, regions = ViewEach(online, PLACES, OBSERVATION), ViewEach(online, PLACES, REGION)
    reference, seen = training.view(surfaces, plans, empty), online.view(looks, regions)
    pictures = {}
    for product, surface in reference[surfaces].items():
        name = product.name.removeprefix("product/")
        pictures[out / f"model_{name}.png"] = model_picture(name, surface)
    trays = {place: plan.tray for place, plan in reference[plans].items()}
    by_time = sorted(seen[looks].items(), key=lambda look: look[1].captured_ns)
    for tray, frame in {trays[place]: look.frame for place, look in by_time}.items():
        deviating = [
            (place.name, flags[place.name], region)
            for place, region in seen[regions].items()
            if trays[place] == tray and place.name in flags and flags[place.name].verdict != "ok"
        ]
        picture = tray_picture(frame, reference[empty].depth_mm, deviating)
        pictures[out / f"tray_{tray + 1}.png"] = picture
    return {file: png_bytes(picture) for file, picture in pictures.items()}


def _follow(cell: Cell, running: DemoCell, truths: Sequence[Package], console: Console) -> None:
    """Show progress until the user was notified of every package.

    Raises:
        DemoError: The processes ended, or nothing moved for `STALL_S`.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    told: set[str] = set()
    trained: set[str] = set()
    moved_s, before, away = time.monotonic(), (0, 0, 0), False
    columns = TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        views_bar = progress.add_task("training: views", total=None)
        models_bar = progress.add_task("training: products", total=None)
        packages_bar = progress.add_task("online: packages", total=len(truths))
        while len(told) < len(truths):
            running.check()
            if time.monotonic() - moved_s > STALL_S:
                raise DemoError(f"nothing moved for {STALL_S:.0f} s; see {running.log}")
            try:
                seen = _look(cell)
            except ShardUnreachableError as error:  # the operator restarts it
                if not away:
                    console.print(f"waiting: {error}")
                away = True
                continue
            away = False
            for place, notice in seen.notices.items():
                if place not in told:
                    console.print(notice.text)
            told |= seen.notices.keys()
            for product in sorted(seen.models - trained):
                console.print(f"{product} is trained")
            trained |= seen.models
            progress.update(views_bar, completed=seen.views, total=seen.views_ordered or None)
            progress.update(models_bar, completed=len(trained), total=seen.models_ordered or None)
            progress.update(packages_bar, completed=len(told))
            now = seen.views, len(trained), len(told)
            moved_s, before = (moved_s, before) if now == before else (time.monotonic(), now)
            time.sleep(LOOK_S)


@dataclass(frozen=True, slots=True)
class _Seen:
    """How far a run is."""

    notices: Mapping[str, Notice]
    models: set[str]
    models_ordered: int
    views: int
    views_ordered: int


def _look(cell: Cell) -> _Seen:
    training, online = cell.world("training"), cell.world("online")
    notices, scans = View(online, USER, NOTICES), ViewEach(training, PRODUCTS, SCAN)
    orders = training.view(scans)[scans]
    return _Seen(
        notices=online.view(notices).get(notices, {}),
        models={slot.entity.name for slot in training.list_slots(PRODUCTS, ("surface",))},
        models_ordered=len(orders),
        views=len(training.list_slots(VIEWS, ("surface",))),
        views_ordered=sum(orders.values()),
    )


def _outcome(cell: Cell) -> tuple[Mapping[str, Deviation], Mapping[str, Notice]]:
    """Return flags and notices, by place."""
    online = cell.world("online")
    flags, notices = View(online, SYSTEM, DEVIATIONS), View(online, USER, NOTICES)
    told = online.view(flags, notices)
    return told[flags], told[notices]


def write_pictures(out: Path, contents: dict[Path, bytes]) -> None:
    """Write all files, none half, and remove the pictures of an earlier run."""
    old = ("tray_[0-9]*.png", "model_*.png", "deviation_*.png", "net_*.svg", "cell.png")
    for stale in {path for pattern in old for path in out.glob(pattern)} - contents.keys():
        stale.unlink()
    write_whole(contents)
