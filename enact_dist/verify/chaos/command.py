"""`enact verify --chaos` and `enact verify --history FOLDER`."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from enact_dist.cli.text.output import print_json, print_table
from enact_dist.cli.verbs import DONE, FAILED
from enact_dist.verify.chaos import runner
from enact_dist.verify.chaos.evidence import load
from enact_dist.verify.chaos.figures import FACTS_MAX, Verdict, judge

SECONDS: Final = 60.0
"""Default duration of a run."""
PROGRESS_S: Final = 5.0


def run(arguments: argparse.Namespace) -> int:
    """Do what `--chaos` or `--history` asks for; return the exit status."""
    return check_again(arguments) if arguments.history is not None else run_chaos(arguments)


def run_chaos(arguments: argparse.Namespace) -> int:
    """Run a cell of real processes under faults; return the exit status."""
    seed = arguments.seed if arguments.seed is not None else runner.seed_of_now()
    settings = runner.ChaosSettings(
        arguments.seconds or SECONDS,
        seed,
        arguments.shards,
        arguments.actors,
        namespaces_required=arguments.require_namespaces,
        store=arguments.store,
    )
    kept = arguments.keep
    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
    folder = kept if kept is not None else Path(tempfile.mkdtemp(prefix="enact-chaos-"))
    keep = kept is not None
    try:
        runner.run(settings, folder.resolve(), progress=_Progress(settings.seconds))
        verdict = judge(load(folder))
        keep = keep or bool(verdict.anomalies)
    finally:
        if not keep:
            shutil.rmtree(folder, ignore_errors=True)
    return _tell(verdict, folder if keep else None, as_json=arguments.json)


def check_again(arguments: argparse.Namespace) -> int:
    """Check the journals of an earlier run; return the exit status."""
    return _tell(judge(load(arguments.history)), arguments.history, as_json=arguments.json)


class _Progress:
    """Says on standard error what is being done, now and then."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._said, self._due_s = "", 0.0

    def __call__(self, what: str, left_s: float) -> None:
        now_s = time.monotonic()
        if what == self._said and now_s < self._due_s:
            return
        self._said, self._due_s = what, now_s + PROGRESS_S
        left = f", {left_s:.0f} of {self._seconds:.0f} s left" if what == "faults" else ""
        print(f"chaos: {what}{left}", file=sys.stderr, flush=True)


def _tell(verdict: Verdict, folder: Path | None, *, as_json: bool) -> int:
    """Print what a run showed; return the exit status."""
    if as_json:
        print_json(verdict)
    else:
        _print(verdict)
    if not verdict.anomalies:
        return DONE
    print(
        f"{len(verdict.anomalies)} anomalies; seed {verdict.settings['seed']};"
        f" check again: enact verify --history {folder}",
        file=sys.stderr,
    )
    return FAILED


def _print(verdict: Verdict) -> None:
    settings = verdict.settings
    print(
        f"{settings['seconds']:.0f} s, seed {settings['seed']}, {settings['shards']} shards,"
        f" {settings['actors']} actors, TTL {settings['ttl_s']:g} s"
        + (f", store {settings['store']}" if settings.get("store") else "")
    )
    for name in verdict.missing:
        print(f"left out: {name}")
    rows: list[tuple[str, object]] = [(f"fault: {k}", n) for k, n in verdict.faults.items()]
    rows += [
        ("locks asked for", verdict.locks),
        ("commits", verdict.commits),
        ("of them over shards", verdict.over_shards),
        ("locks that only looked", verdict.reads),
        ("views over several slots checked", verdict.views_checked),
        ("fenced zombies", verdict.fenced),
        ("epoch changes", verdict.epoch_changes),
    ]
    if settings.get("store"):
        rows += [
            ("takeovers", verdict.takeovers),
            ("answers of daemons", verdict.answers),
            ("of them after the end of a lease", verdict.late_answers),
        ]
        rows += [(f"daemons that ended: {name}", n) for name, n in verdict.ended.items()]
    rows += [(f"writes: {name}", n) for name, n in verdict.writes.items()]
    rows += [(f"outcome: {name}", n) for name, n in verdict.outcomes.items()]
    rows += [(f"shards: {name}", n) for name, n in verdict.counters.items()]
    rows += [("unseen versions, of several possible writers", verdict.guessed)]
    rows += [("anomalies", len(verdict.anomalies))]
    print_table(("what", "count"), rows, empty="nothing happened")
    print()
    print_table(
        ("recovery", "n", "p50 s", "p99 s", "max s"),
        [
            (name, s.n, f"{s.p50_s:.3f}", f"{s.p99_s:.3f}", f"{s.max_s:.3f}")
            for name, s in verdict.recovery.items()
            if s.n
        ],
        empty="no recovery could be measured",
    )
    for anomaly in verdict.anomalies[:FACTS_MAX]:
        print(f"\nANOMALY {anomaly}")
