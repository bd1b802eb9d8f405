"""`enact bench`: what it costs here, beside raw floors of the same run; see `enact_dist.bench`."""

from __future__ import annotations

import argparse
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.cli.text.benches import BENCHES
from enact_dist.cli.verbs import NOUNS, add_verb, seconds, whole
from enact_dist.config.types import CARRIERS

if TYPE_CHECKING:
    from enact_dist.cli.verbs import Verb


PROVOKED: Final = ("moved", "tipped", "deformed", "missing")
"""Errors of packing that can be provoked; as `KNOCKS` of the simulation, which is an extra."""
_HEADING: Final = (
    "\n\nbenches (less than a minute each with --seconds 3; [minutes]: one to three):\n"
)


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    bench = add_verb(
        nouns,
        "bench",
        NOUNS["bench"].summary,
        run=run_bench,
        example="enact bench\n"
        "enact bench floor update --json\n"
        "enact bench update --embedded\n"
        "enact bench multi --shards 3\n"
        "enact bench fetch --connect tcp/tray-pc:7447\n"
        "enact bench palletizing --packages 1000 --provoke all --out scores\n"
        "enact bench --table run1.json run2.json run3.json",
    )
    assert bench.description is not None
    bench.description += _HEADING + "\n".join(map(_line, BENCHES))
    bench.add_argument(
        "names",
        nargs="*",
        type=bench_name,
        metavar="NAME",
        help="which of those above (default: all but those `only by name`); a row without a goal is"
        " one for which the design sets none, as all of `waiters` and most of `multi`, `durable`",
    )
    where = bench.add_mutually_exclusive_group()
    where.add_argument("--embedded", action="store_true", help="in this process only, no daemon")
    where.add_argument(
        "--shards", type=whole, metavar="N", help="daemons of the throw-away cell (default: 1)"
    )
    where.add_argument(
        "--connect",
        metavar="ENDPOINT_OR_FILE",
        help="a cell that runs; its world context `bench` (and some that begin so) is made, written"
        " to, and dropped at the end, unless it was there before; benches for whose data there is"
        " no room under shared_bytes_max are refused, those not named left out",
    )
    bench.add_argument(
        "--carrier",
        choices=CARRIERS,
        default="auto",
        help="how calls travel (default: auto; `update` and `multi` then compare all)",
    )
    bench.add_argument(
        "--seconds",
        dest="seconds_s",
        type=seconds,
        metavar="S",
        help="measuring time of each line, all rounds together (default: 3, with which all benches"
        " take about 10 minutes on a quiet machine); a pipeline runs 20 times as long",
    )
    bench.add_argument(
        "--seeds",
        type=whole,
        default=1,
        metavar="N",
        help="`workcell --embedded` plays each scenario with seeds 1 to N (default: 1; one takes"
        " about 3 minutes of two processors)",
    )
    _add_packing(bench)
    bench.add_argument("--json", action="store_true", help="print one JSON object")
    bench.add_argument(
        "--table",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="measure nothing; print what earlier runs wrote with --json, as one Markdown table",
    )


def _add_packing(bench: Verb) -> None:
    """Add what the bench `palletizing` alone asks for."""
    packing = bench.add_argument_group("palletizing")
    packing.add_argument(
        "--packages", type=whole, default=36, metavar="N", help="how many (default: 36, 12 a tray)"
    )
    packing.add_argument(
        "--seed", type=whole, default=1, metavar="N", help="of all that is random (default: 1)"
    )
    packing.add_argument(
        "--processes", type=whole, default=2, metavar="N", help="trays side by side (default: 2)"
    )
    packing.add_argument(
        "--spread",
        type=_spread,
        metavar="SIGMA_MM,FRICTION",
        help="how far the belt's sensor is off, and friction (default: 2, 6 and 12 mm with 0.2, 0.4"
        " and 0.6, in turn)",
    )
    packing.add_argument(
        "--provoke",
        type=_kinds,
        default=(),
        metavar="KIND,…",
        help="provoke errors by physics on every fourth tray: moved, tipped, deformed, missing, or"
        " all; how well the robot packs is then scored on the other trays",
    )
    packing.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="add what becomes of each tray to DIR/trays.jsonl as it comes, from which an"
        " interrupted run goes on; and draw one error of each kind that is provoked: before, with"
        " the error, after the reaction",
    )
    packing.add_argument(
        "--perception",
        action="store_true",
        help="score perception alone, on drawn packages: verdicts, pose, dents, noise and light",
    )


def _line(name: str) -> str:
    """Return what is said of a bench, indented as the help of arguments is."""
    told = BENCHES[name]
    but = {
        "not --embedded": not told.alone,
        "not --connect": not told.guest,
        "minutes": told.minutes,
        "only by name": told.named,
    }
    marks = ", ".join(mark for mark, holds in but.items() if holds)
    text = f"{told.what} [{marks}]" if marks else told.what
    return textwrap.fill(text, 98, initial_indent=f"  {name:12}", subsequent_indent=" " * 14)


def _spread(text: str) -> tuple[float, float]:
    """Read "SIGMA_MM,FRICTION"; an `argparse` type."""
    try:
        sigma_mm, friction = (float(part) for part in text.split(","))
    except ValueError:
        sigma_mm = friction = math.nan
    if not (0.0 <= sigma_mm < math.inf and 0.0 < friction < math.inf):
        raise argparse.ArgumentTypeError(
            f"asked for {text!r}; it is SIGMA_MM,FRICTION, such as 2,0.4: 0 or more, more than 0"
        )
    return sigma_mm, friction


def _kinds(text: str) -> tuple[str, ...]:
    """Read errors to provoke, or "all"; an `argparse` type."""
    kinds = PROVOKED if text == "all" else tuple(text.split(","))
    for kind in kinds:
        if kind not in PROVOKED:
            raise argparse.ArgumentTypeError(
                f"asked for {kind!r}; errors that can be provoked: {', '.join(PROVOKED)}, or all"
            )
    return kinds


def bench_name(text: str) -> str:
    """Read the name of a bench; an `argparse` type."""
    if text not in BENCHES:
        raise argparse.ArgumentTypeError(f"there is no bench {text!r}; known: {', '.join(BENCHES)}")
    return text


def run_bench(arguments: argparse.Namespace) -> int:
    """Run what the options ask for."""
    from enact_dist.bench import command

    return command.run(arguments)
