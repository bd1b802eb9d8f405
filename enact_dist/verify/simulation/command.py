"""What `enact verify` does: runs seeds, tells what happened, makes a failure small."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from enact_dist.cli.text.output import print_json
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.errors import ConfigError
from enact_dist.verify.simulation.scenario import Scenario
from enact_dist.verify.simulation.schedule import WHOLE, PartOfRun, names_in
from enact_dist.verify.simulation.series import Totals, fresh_seed, run_series
from enact_dist.verify.simulation.shrink import Shrunk, command, shrink
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

    from enact_dist.verify.simulation.scenario import Result

SEEDS: Final = 200
"""Default number of seeds."""
INTERRUPTED: Final = 130

_SHOWN: Final = (
    ("shard: fenced", "fenced commits"),
    ("epoch changes", "epoch changes"),
    ("decisions", "commits over shards"),
    ("shard: resolves_asked", "resolves"),
    ("shard: orphans_freed", "orphans freed"),
    ("torn logs", "torn logs"),
    ("pauses", "pauses"),
    ("lost", "messages lost"),
)


def run(arguments: argparse.Namespace) -> int:
    """Run the seeds that the options ask for.

    Returns:
        0 if no rule was broken, 1 if one was, 130 if Ctrl-C ended it before that.

    Raises:
        ConfigError: The options do not go together.
    """
    part = part_of(arguments)
    if arguments.seed is not None:
        return _run_one(arguments, part)
    if part != WHOLE:
        raise ConfigError("--only, --locks, --clients and --until repeat one run: name its --seed")
    first = fresh_seed() if arguments.first is None else arguments.first
    seconds = arguments.seconds
    count = arguments.seeds
    if count is None and seconds is None:
        count = SEEDS
    with told_progress(arguments, count, seconds) as on_progress:
        totals = run_series(
            first,
            count=count,
            seconds=seconds,
            jobs=arguments.jobs or os.cpu_count() or 1,
            keep_going=arguments.keep_going,
            on_progress=on_progress,
        )
    found = [_made_small(arguments, result) for result in totals.failures]
    if arguments.json:
        print_json(as_json(totals, found))
    else:
        _tell(totals, found)
    if found:
        return FAILED
    return INTERRUPTED if totals.interrupted else DONE


def part_of(arguments: argparse.Namespace) -> PartOfRun:
    """Return what of a run the options ask for.

    Raises:
        ConfigError: A client is not named by its number.
    """
    clients: frozenset[int] | None = None
    if arguments.clients is not None:
        try:
            clients = frozenset(int(number) for number in names_in(arguments.clients))
        except ValueError:
            raise ConfigError(
                f"--clients {arguments.clients}: clients are named by number, as in --clients 1,3"
            ) from None
    return PartOfRun(
        only=None if arguments.only is None else names_in(arguments.only),
        locks=None if arguments.locks is None else names_in(arguments.locks),
        clients=clients,
        until_s=arguments.until_s,
    )


def _made_small(arguments: argparse.Namespace, result: Result, part: PartOfRun = WHOLE) -> Shrunk:
    seconds = arguments.shrink_s if part == WHOLE else 0.0
    if seconds and not arguments.json:
        print(f"seed {result.seed} breaks a rule; shrinking it", file=sys.stderr, flush=True)
    return shrink(result, seconds=seconds)


# ---------------------------------------------------------------- one run


def _run_one(arguments: argparse.Namespace, part: PartOfRun) -> int:
    scenario = Scenario(arguments.seed, part=part, story=not arguments.json)
    result = scenario.run()
    totals = Totals(arguments.seed)
    totals.add(result, 0.0)
    if not arguments.json:
        for at_ns, line in scenario.world.story or ():
            print(f"{at_ns / 1e9:10.6f} s  {line}")
        print()
    found = []
    if result.violation:
        small = _made_small(arguments, result, part)
        found = [small if part == WHOLE else Shrunk(part, result, result, 1)]
    if arguments.json:
        print_json(as_json(totals, found))
        return FAILED if found else DONE
    for name, number in sorted(totals.tally.items()):
        print(f"{number:>10,}  {name}")
    _tell(totals, found)
    return FAILED if found else DONE


# ---------------------------------------------------------------- telling


def _tell(totals: Totals, found: list[Shrunk]) -> None:
    for small in found:
        print("\n".join(told(small)))
        print()
    tally = totals.tally
    end = " (interrupted)" if totals.interrupted else ""
    print(
        f"{totals.seeds:,} seeds from {totals.first} on, {shown_s(totals.simulated_s)} simulated"
        + (f" in {shown_s(totals.wall_s)}" if totals.wall_s else "")
        + end
    )
    print(
        f"{tally['commits']:,} commits checked, {totals.crashes:,} crashes,"
        f" {totals.partitions:,} partitions, {len(totals.failures)} violations"
    )
    print(", ".join(f"{tally[name]:,} {text}" for name, text in _SHOWN))
    if totals.cpu_s:
        print(
            f"{tally['commits'] / totals.cpu_s:.0f} checked commits and"
            f" {totals.seeds / totals.cpu_s:.1f} seeds per second of one core"
        )


def told(small: Shrunk) -> list[str]:
    """Return the lines that tell of a failure: rule, schedule, commands."""
    whole = small.whole
    lines = [f"seed {whole.seed}: {whole.violation}"]
    if whole.trace:
        lines.append(whole.trace.rstrip())
    if small.runs > 1:
        lines += small.lines()
        lines.append(f"again: {small.command}")
        lines.append(f"all of it: {command(whole.seed)}")
    else:
        lines.append(f"again: {small.command}")
    return lines


def as_json(totals: Totals, found: list[Shrunk]) -> dict[str, object]:
    """Return what `--json` prints."""
    return {
        "seeds": totals.seeds,
        "first": totals.first,
        "simulated_s": round(totals.simulated_s, 3),
        "wall_s": round(totals.wall_s, 3),
        "cpu_s": round(totals.cpu_s, 3),
        "interrupted": totals.interrupted,
        "commits": totals.tally["commits"],
        "crashes": totals.crashes,
        "partitions": totals.partitions,
        "violations": [
            {
                "seed": small.whole.seed,
                "rule": small.whole.rule,
                "message": small.whole.violation,
                "command": small.command,
                "schedule": [fault._asdict() for fault in small.result.faults],
                "locks": list(small.result.locks),
            }
            for small in found
        ],
        "tally": dict(sorted(totals.tally.items())),
    }


@contextmanager
def told_progress(
    arguments: argparse.Namespace, count: int | None, seconds: float | None
) -> Iterator[Callable[[Totals], None]]:
    """Show a bar on a terminal; nothing in a pipe, and nothing beside JSON."""
    if arguments.json or not sys.stderr.isatty():
        yield lambda _totals: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=count if count is not None else seconds)

        def show(totals: Totals) -> None:
            done = totals.seeds if count is not None else bar.tasks[task].elapsed or 0.0
            text = f"{totals.seeds:,} seeds, {totals.tally['commits']:,} commits"
            bar.update(task, completed=done, description=text)

        yield show
