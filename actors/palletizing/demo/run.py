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
cell.toml, cell.log  configuration and log of the cell, if it ran here
===================  =========================================================
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from actors.geometry.files import write_whole
from actors.geometry.pictures.picture import png_bytes
from actors.palletizing.demo.cell import PalletizingCell, RunningCell, watched_cell
from actors.palletizing.demo.lineage import show_lineage
from actors.palletizing.demo.pictures import latest, model_picture, tray_picture
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
    place_entity,
)
from actors.running_cell import DemoError, until_interrupted
from enact_dist import View, ViewEach
from enact_dist.errors import ShardUnreachableError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rich.console import Console

    from actors.palletizing.demo.pictures import Picture
    from actors.palletizing.demo.report import Row
    from actors.palletizing.simulation.packages import Package
    from actors.palletizing.vocabulary import Notice
    from actors.running_cell import DemoStore
    from enact_dist import Cell

LOOK_S: Final = 0.2
"""How often the demonstration looks at the cell."""
STALL_S: Final = 120.0
"""Without any progress for this long something is wrong; a view takes less than a second."""
SEED: Final = 59
"""A seed whose first twelve packages show every kind of deviation."""


def run_demo(
    *,
    out: Path,
    packages: int = 12,
    seed: int = SEED,
    keep_running: bool = False,
    store: DemoStore | None = None,
) -> int:
    """Run the demonstration and report.

    Args:
        out: Folder for pictures and report; made if missing.
        packages: How many packages come, at least 1.
        seed: Seed of packages and sensors.
        keep_running: Leave the cell up afterwards, until Ctrl-C.
        store: Where the cell's data are instead of a folder.

    Returns:
        Exit status: 0 done, 1 the cell failed; wrong verdicts are the score's matter.
    """
    if packages < 1:
        print(f"--packages is {packages}; at least one has to come", file=sys.stderr)
        return 1
    out.mkdir(parents=True, exist_ok=True)
    return _shown(
        RunningCell(out, packages=packages, seed=seed, store=store),
        out,
        up="cell up: 2 shards, 8 actors, each a process",
        keep_running=keep_running,
    )


def watch_demo(config: Path, *, out: Path) -> int:
    """Watch the demonstration in a cell that others run, and report.

    Args:
        config: The `cell.toml` of that cell.
        out: Folder for pictures and report; made if missing.

    Returns:
        Exit status as of `run_demo`.

    Raises:
        ConfigError: The file cannot be used, or is not of a simulated palletizing cell.
    """
    running = watched_cell(config)
    out.mkdir(parents=True, exist_ok=True)
    return _shown(running, out, up="watching a cell that runs already", keep_running=False)


def _shown(demo: PalletizingCell | RunningCell, out: Path, *, up: str, keep_running: bool) -> int:
    """Show a run and write its files; return the exit status."""
    from rich.console import Console

    console = Console(highlight=False)
    started_s = time.monotonic()
    truths = package_sequence(demo.packages, seed=demo.seed)
    try:
        with demo as running, running.joined() as cell:
            console.print(f"{up}; log in {running.log}")
            _follow(cell, running, truths, console)
            rows = _outcome(cell, truths)
            console.print("\n", table_of(rows), f"\n{score_of(rows)}", sep="")
            planned = cell.world("training").diff(cell.world("online"), PLACES, [STANDING])
            console.print("", difference_of(planned), "", sep="\n")
            show_lineage(cell, rows[-1].product, console)
            _write_files(cell, out, report_bytes(rows, seed=running.seed))
            console.print(f"pictures in {out}; {time.monotonic() - started_s:.0f} s in all")
            if keep_running:
                console.print(f"the cell stays up: enact world tree --cell {running.config}")
                until_interrupted(running)
    except DemoError as error:
        print(f"enact demo: {error}", file=sys.stderr)
        return 1
    return 0


def _follow(
    cell: Cell, running: PalletizingCell | RunningCell, truths: Sequence[Package], console: Console
) -> None:
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
            if line := running.progressed(len(told)):
                console.print(line)
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
    """How far a run is.

    Attributes:
        notices: Notices to the user, by place.
        models: Number of trained products.
        models_ordered: Number of products to train.
        views: Number of reconstructed views.
        views_ordered: Number of views to reconstruct.
    """

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


def _outcome(cell: Cell, truths: Sequence[Package]) -> list[Row]:
    """Read flags and notices, and set them beside the truth."""
    online = cell.world("online")
    flags, notices = View(online, SYSTEM, DEVIATIONS), View(online, USER, NOTICES)
    told = online.view(flags, notices)
    return rows_of(truths, told[flags], told[notices])


def _write_files(cell: Cell, out: Path, report: bytes) -> None:
    """Draw the pictures; write all files, none half, and remove those of an earlier run."""
    training = cell.world("training")
    contents = {out / "report.json": report}
    surfaces = ViewEach(training, PRODUCTS, SURFACE)
    for product, surface in training.view(surfaces)[surfaces].items():
        name = product.name.removeprefix("product/")
        contents[out / f"model_{name}.png"] = png_bytes(model_picture(name, surface))
    for tray, picture in _tray_pictures(cell).items():
        contents[out / f"tray_{tray + 1}.png"] = png_bytes(picture)
    for stale in {*out.glob("tray_[0-9]*.png"), *out.glob("model_*.png")} - contents.keys():
        stale.unlink()
    write_whole(contents)


def _tray_pictures(cell: Cell) -> dict[int, Picture]:
    """Return the picture of each tray, by its number."""
    training, online = cell.world("training"), cell.world("online")
    plans, empty = ViewEach(training, PLACES, PLAN), View(training, TRAY, EMPTY)
    seen, regions = ViewEach(online, PLACES, OBSERVATION), ViewEach(online, PLACES, REGION)
    judged = View(online, SYSTEM, DEVIATIONS)
    reference, observed = training.view(plans, empty), online.view(seen, regions, judged)
    flags = observed[judged]
    stops = {stop: place_entity(stop) for stop in range(len(flags))}
    trays = {stop: reference[plans][place].tray for stop, place in stops.items()}
    frames = {stop: observed[seen][place].frame for stop, place in stops.items()}
    pictures = {}
    for tray, frame in latest(frames, trays).items():
        deviating = [
            (place.name, flags[place.name], observed[regions][place])
            for stop, place in stops.items()
            if trays[stop] == tray and flags[place.name].verdict != "ok"
        ]
        pictures[tray] = tray_picture(frame, reference[empty].depth_mm, deviating)
    return pictures
