"""`enact bench`: what it costs here, beside raw floors of the same run; see `enact_dist.bench`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.cli.verbs import add_verb, seconds, whole
from enact_dist.config_values import CARRIERS

if TYPE_CHECKING:
    from enact_dist.cli.verbs import Verb

NAMES: Final = (
    "floor",
    "core",
    "update",
    "layers",
    "multi",
    "durable",
    "waiters",
    "fetch",
    "publish",
    "wakeup",
    "history",
    "pipeline",
    "stopped",
    "memory",
    "recovery",
)
"""The benches, in the order in which they run and stand in the table."""


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb, which has no noun."""
    bench = add_verb(
        nouns,
        "bench",
        "measure locks, commits and data on this machine, beside the raw floor of the same run",
        run=run_bench,
        example="enact bench\n"
        "enact bench floor update --json\n"
        "enact bench update --embedded\n"
        "enact bench multi --shards 3\n"
        "enact bench fetch --connect tcp/tray-pc:7447\n"
        "enact bench --table run1.json run2.json run3.json",
    )
    bench.add_argument(
        "names",
        nargs="*",
        type=bench_name,
        metavar="NAME",
        help=f"which: {', '.join(NAMES)} (default: all); a row without a goal is one for which"
        " the design sets none, as all of `waiters` and most of `multi` and `durable`",
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
    bench.add_argument("--json", action="store_true", help="print one JSON object")
    bench.add_argument(
        "--table",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="measure nothing; print what earlier runs wrote with --json, as one Markdown table",
    )


def bench_name(text: str) -> str:
    """Read the name of a bench; an `argparse` type."""
    if text not in NAMES:
        raise argparse.ArgumentTypeError(f"there is no bench {text!r}; known: {', '.join(NAMES)}")
    return text


def run_bench(arguments: argparse.Namespace) -> int:
    """Run what the options ask for."""
    from enact_dist.bench import command

    return command.run(arguments)
