"""`enact verify --floods`."""

from __future__ import annotations

import argparse
import sys

from enact_dist.cli.text.output import print_json, print_table
from enact_dist.cli.verbs import DONE, FAILED, USAGE
from enact_dist.verify.floods.attacks import ATTACKS
from enact_dist.verify.floods.run import P99_MS_MAX, Figures, measure


def run(arguments: argparse.Namespace) -> int:
    """Run all floods, or those named; status 1 if one hurt the honest client."""
    wanted = [attack for attack in ATTACKS if not arguments.flood or attack.name in arguments.flood]
    unknown = set(arguments.flood or ()) - {attack.name for attack in ATTACKS}
    if unknown:
        names = ", ".join(repr(attack.name) for attack in ATTACKS)
        print(f"no flood {min(unknown)!r}; there are {names}", file=sys.stderr)
        return USAGE
    carriers = ("socket", "zenoh") if arguments.carrier is None else (arguments.carrier,)
    figures: list[Figures] = []
    for attack in wanted:
        for carrier in carriers:
            print(f"{attack.name}, updates over {carrier}", file=sys.stderr, flush=True)
            figures.append(measure(attack, carrier=carrier, updates=arguments.updates))
    if arguments.json:
        print_json([figure.as_json() for figure in figures])
    else:
        _print(figures)
    return DONE if all(figure.met for figure in figures) else FAILED


def _print(figures: list[Figures]) -> None:
    print_table(
        ("flood", "client", "updates", "p50", "p99", "joined in", "attacker", "restart", "stood"),
        [
            (
                figure.name,
                figure.carrier,
                figure.updates,
                f"{figure.p50_ms:.2f} ms",
                f"{figure.p99_ms:.2f} ms",
                f"{max(figure.newcomers_s, default=0.0):.2f} s",
                ", ".join(f"{n} {name}" for name, n in sorted(figure.tally.items())),
                f"{figure.restart_s:.2f} s" if figure.restart_s >= 0.0 else "no",
                "yes" if figure.met else "NO",
            )
            for figure in figures
        ],
        empty="nothing measured",
    )
    for figure in figures:
        for problem in figure.problems:
            print(f"{figure.name}, {figure.carrier}: {problem}")
        if figure.p99_ms > P99_MS_MAX:
            print(f"{figure.name}, {figure.carrier}: p99 above {P99_MS_MAX:g} ms")
