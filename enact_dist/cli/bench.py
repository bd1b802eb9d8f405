"""`enact bench`: what it costs here, beside raw floors of the same run; see `enact_dist.bench`."""

from __future__ import annotations

import argparse
import math
import textwrap
from pathlib import Path
from typing import Final

from enact_dist.cli.arguments import counted, file_of, seconds_of
from enact_dist.cli.text.benches import BENCHES
from enact_dist.cli.verbs import NOUNS, OneOf, OptionGroup, Verb, flag, option
from enact_dist.config.types import CARRIERS

PROVOKED: Final = ("moved", "tipped", "deformed", "missing")
"""Errors of packing that can be provoked; as `KNOCKS` of the simulation, which is an extra."""
_HEADING: Final = (
    "\n\nbenches (less than a minute each with --seconds 3; [minutes]: one to three):\n"
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


_PACKING: Final = OptionGroup("palletizing", (
    counted("--packages", "number of packages (default: 36, 12 a tray)", 36),
    counted("--seed", "seed of all random values (default: 1)", 1),
    counted("--processes", "trays side by side (default: 2)", 2),
    option("--spread", "SIGMA_MM,FRICTION",
           "how far the belt's sensor is off, and friction (default: 2, 6 and 12 mm with 0.2, 0.4"
           " and 0.6, in turn)", type=_spread),
    option("--provoke", "KIND,…",
           "provoke errors by physics on every fourth tray: moved, tipped, deformed, missing, or"
           " all; how well the robot packs is then scored on the other trays",
           type=_kinds, default=()),
    file_of("--out", "DIR",
            "add the result of each tray to DIR/trays.jsonl as it comes, from which an interrupted"
            " run continues; and draw one error of each provoked kind: before, with the error,"
            " after the reaction"),
    flag("--perception",
         "score perception alone, on drawn packages: verdicts, pose, dents, noise and light"),
))  # fmt: skip

VERBS: Final = (
    Verb(
        "bench", NOUNS["bench"].summary, "run_bench",
        "enact bench\n"
        "enact bench floor update --json\n"
        "enact bench update --embedded\n"
        "enact bench multi --shards 3\n"
        "enact bench fetch --connect tcp/tray-pc:7447\n"
        "enact bench palletizing --packages 1000 --provoke all --out scores\n"
        "enact bench --table run1.json run2.json run3.json",
        (
            option("names", "NAME",
                   "which of those above (default: all but those `only by name`); a row without a"
                   " goal is one for which the design sets none, as all of `waiters` and most of"
                   " `multi`, `durable`", nargs="*", type=bench_name),
            OneOf((
                flag("--embedded", "in this process only, no daemon"),
                counted("--shards", "daemons of the throw-away cell (default: 1)"),
                option("--connect", "ENDPOINT_OR_FILE",
                       "a running cell; its world context `bench` (and some that begin so) is made,"
                       " written to, and dropped at the end, unless it was there before; benches"
                       " whose data do not fit under shared_bytes_max are refused, those not named"
                       " left out"),
            )),
            option("--carrier", None,
                   "how calls travel (default: auto; `update` and `multi` then compare all)",
                   choices=CARRIERS, default="auto"),
            seconds_of("--seconds",
                       "measuring time of each line, all rounds together (default: 3, with which"
                       " all benches take about 10 minutes on a quiet machine); a pipeline and"
                       " a view run 20 times as long", dest="seconds_s"),
            counted("--seeds",
                    "`workcell --embedded` plays each scenario with seeds 1 to N (default: 1; one"
                    " takes about 3 minutes of two processors)", 1),
            _PACKING,
            flag("--json", "print one JSON object"),
            option("--table", "FILE",
                   "measure nothing; print what earlier runs wrote with --json, as one Markdown"
                   " table", nargs="+", type=Path),
        ),
        details=_HEADING + "\n".join(map(_line, BENCHES)),
    ),
)  # fmt: skip


def run_bench(options: argparse.Namespace) -> int:
    """Run what the options ask for."""
    from enact_dist.bench import command

    return command.run(options)
