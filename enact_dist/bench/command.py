"""Runs the benches that `enact bench` was asked for, and prints what they found."""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from enact_dist.bench.cases.decisions import core_cases
from enact_dist.bench.cases.faults import run_recovery, run_stopped
from enact_dist.bench.cases.history import run_history
from enact_dist.bench.cases.layers import run_layers
from enact_dist.bench.cases.memory import run_memory
from enact_dist.bench.cases.palletizing import run_palletizing
from enact_dist.bench.cases.payloads import run_fetch, run_publish, run_wakeup
from enact_dist.bench.cases.pipeline import run_pipeline
from enact_dist.bench.cases.security import run_security
from enact_dist.bench.cases.updates import run_durable, run_multi, run_update, run_waiters
from enact_dist.bench.cases.workcell import run_workcell
from enact_dist.bench.floors import Floors
from enact_dist.bench.place import EMBEDDED, Place, folders
from enact_dist.bench.rows import Row, shown_spread, shown_us
from enact_dist.bench.run import Answer, PackingOptions, Run
from enact_dist.bench.tables import table
from enact_dist.bench.view.case import run_view
from enact_dist.bench.visit import PEAK_BYTES, without_room
from enact_dist.cli.text.benches import BENCHES as TOLD
from enact_dist.cli.text.output import print_json, print_table
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.errors import EnactError, MisuseError

SECONDS_S: Final = 3.0
"""Measuring time of each line unless given."""
COLUMNS: Final = (
    "bench", "variant", "median", "rounds", "p99", "n", "x floor", "goal", "met", "note",
)  # fmt: skip
FIRST: Final = ("first of all", "here", "rounds", "raw floor of the same run", "", "x floor")


def run_floor(run: Run) -> None:
    """What the machine and the bare transports do."""
    run.measure([run.floors.case(variant) for _, variant in Floors.every()])


def run_core(run: Run) -> None:
    """The shard's decisions alone."""
    run.measure(core_cases())


BENCHES: Final[dict[str, Callable[[Run], None]]] = {
    "floor": run_floor,
    "core": run_core,
    "update": run_update,
    "layers": run_layers,
    "multi": run_multi,
    "durable": run_durable,
    "waiters": run_waiters,
    "fetch": run_fetch,
    "publish": run_publish,
    "wakeup": run_wakeup,
    "history": run_history,
    "pipeline": run_pipeline,
    "stopped": run_stopped,
    "memory": run_memory,
    "recovery": run_recovery,
    "security": run_security,
    "view": run_view,
    "workcell": run_workcell,
    "palletizing": run_palletizing,
}
BETWEEN_PROCESSES: Final = frozenset(name for name, told in TOLD.items() if not told.alone)
"""Benches that mean nothing within one process."""
OWN_DAEMONS: Final = frozenset(name for name, told in TOLD.items() if not told.guest)
"""Benches that look into daemons or kill them."""


def carriers_of(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return what the benches that compare carriers go over."""
    if arguments.embedded:
        return (EMBEDDED,)
    if arguments.carrier != "auto":
        return (arguments.carrier,)
    if arguments.connect is not None:
        return ("auto",)
    return (EMBEDDED, "zenoh", "socket")


def names_of(arguments: argparse.Namespace) -> list[str]:
    """Return the benches to run, in the order of the table.

    Raises:
        MisuseError: One is named that needs several processes, and there is to be one; or daemons
            of its own, and there are others; or a carrier where there is nothing to carry.
    """
    if arguments.embedded and arguments.carrier != "auto":
        raise MisuseError(
            f"--embedded with --carrier {arguments.carrier}: within one process calls travel over"
            " none; leave out one of both"
        )
    asked = set(arguments.names or (name for name in BENCHES if not TOLD[name].named))
    for option, given, cannot, why in (
        ("--embedded", arguments.embedded, BETWEEN_PROCESSES, "needs several processes"),
        ("--connect", arguments.connect, OWN_DAEMONS, "needs daemons of its own"),
    ):
        lost = sorted(asked & cannot) if given and arguments.names else []
        if lost:
            raise MisuseError(
                f"{', '.join(lost)} with {option}: {why}; leave out {option} or {lost[0]}"
            )
        if given:
            asked -= cannot
    return [name for name in BENCHES if name in asked]


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, and return the exit status: a goal that is missed is no failure.

    A bench that cannot run is one, after the others have run.
    """
    if arguments.table:
        print(table(arguments.table), end="")
        return DONE
    names = names_of(arguments)
    found = machine()  # its load is that of others, before this adds its own
    with _ends_in_order(), contextlib.ExitStack() as stack:
        folder, memory = stack.enter_context(folders())
        place = stack.enter_context(
            Place(
                folder,
                target=arguments.connect,
                shards=arguments.shards or 1,
                carriers=carriers_of(arguments),
                shared=memory / "shared",
                said=_say,
            )
        )
        if arguments.connect is not None:
            names = with_room(place, names, named=bool(arguments.names))
        floors = stack.enter_context(Floors(folder, memory))
        told = stack.enter_context(_progress())
        seconds_s = arguments.seconds_s or SECONDS_S
        packing = PackingOptions(
            arguments.packages,
            arguments.seed,
            arguments.processes,
            arguments.spread,
            arguments.perception,
            arguments.provoke,
            arguments.out,
        )
        measured = Run(
            place, floors, seconds_s=seconds_s, told=told, seeds=arguments.seeds, packing=packing
        )
        failed = [name for name in names if not _ran(name, measured)]
        rows, first = measured.rows(), measured.answer()
    if arguments.json:
        answer = [one.as_json() for one in first]
        print_json({"machine": found, "answer": answer, "rows": [row.as_json() for row in rows]})
    else:
        _print(found, first, rows)
    return FAILED if failed else DONE


def with_room(place: Place, names: list[str], *, named: bool) -> list[str]:
    """Return the benches for whose data a cell that runs has room, and say which are left out.

    Raises:
        MisuseError: There is none for one that was asked for by name.
    """
    if not PEAK_BYTES.keys() & names:
        return names
    refused = without_room(place.cell(place.carrier).shards(), names)
    if named and refused:
        raise MisuseError("; ".join(refused.values()))
    for why in refused.values():
        _say(f"left out: {why}")
    return [name for name in names if name not in refused]


def _say(text: str) -> None:
    print(f"enact: {text}", file=sys.stderr)


@contextlib.contextmanager
def _ends_in_order() -> Iterator[None]:
    """Let SIGTERM and Ctrl-C end the processes and remove the files, of which some lie in memory.

    After the first Ctrl-C the process is about to end; a further one would only break that off.
    """

    def leave(*_: object) -> None:
        raise SystemExit(FAILED)

    def interrupt(*_: object) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        error = KeyboardInterrupt()
        error.add_note("the bench was interrupted; no figures are printed")
        raise error

    acts = {signal.SIGTERM: leave, signal.SIGINT: interrupt}
    before = {number: signal.signal(number, act) for number, act in acts.items()}
    try:
        yield
    finally:
        for number, act in acts.items():
            if signal.getsignal(number) is act:
                signal.signal(number, before[number])


def _ran(name: str, measured: Run) -> bool:
    """Run one bench; one that fails costs its own rows and not those of the others."""
    try:
        BENCHES[name](measured)
    except EnactError as error:
        if not measured.place.own:
            raise
        _say(f"bench {name}: {error}")
        measured.add_row(
            Row(name, "failed", None, None, 0, goal="runs", met=False, note=str(error))
        )
        return False
    return True


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Give a function that shows what is being measured, if anybody watches."""
    if not sys.stderr.isatty():
        yield lambda _text: None
        return
    from rich.console import Console

    with Console(stderr=True).status("starting") as status:
        yield status.update


def machine() -> dict[str, object]:
    """Return what the figures were measured on."""
    from importlib.metadata import PackageNotFoundError, version

    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    try:
        zenoh = version("eclipse-zenoh")
    except PackageNotFoundError:
        zenoh = "unknown"
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "zenoh": zenoh,
        "load": round(os.getloadavg()[0], 2),
        "date": time.strftime("%Y-%m-%d"),
    }


# ---------------------------------------------------------------- the table


def _cells(row: Row) -> tuple[str, ...]:
    if row.value is not None:
        median, p99 = f"{row.value:g} {row.unit or ''}".strip(), ""
    else:
        median = shown_us(row.median_us) if row.median_us is not None else ""
        p99 = shown_us(row.p99_us) if row.p99_us is not None else ""
    met = "" if row.goal is None else {True: "yes", False: "NO", None: "?"}[row.met]
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    speed = "" if row.mb_s is None else f"{row.mb_s:,.0f} MB/s"
    note = "; ".join(filter(None, (speed, row.beside, row.note)))
    rounds = "" if row.spread_us is None else shown_spread(row.spread_us)
    goal, count = row.goal or "", f"{row.n:,}"
    return row.name, row.variant, median, rounds, p99, count, ratio, goal, met, note


def _first(one: Answer) -> tuple[str, ...]:
    """Return the line of a figure that comes first: its name, its cells, its floor."""
    _, _, median, rounds, _, _, ratio, *_ = _cells(one.row)
    floor = "" if one.floor_us is None else shown_us(one.floor_us)
    return one.what, median, rounds, one.floor, floor, ratio


def _print(found: Mapping[str, object], first: Sequence[Answer], rows: Sequence[Row]) -> None:
    print(
        f"{found['processor']}, {found['cores']} cores, Python {found['python']}, load before"
        f" {found['load']}"
    )
    if first:
        print_table(FIRST, [_first(one) for one in first], empty="")
        print()
    print_table(COLUMNS, [_cells(row) for row in rows], empty="nothing was measured")
    judged = [row for row in rows if row.goal is not None]
    missed = [row for row in judged if row.met is False]
    print(
        f"{len(judged)} goals, {len(missed)} not met; the design's budgets name none for the rest"
    )
