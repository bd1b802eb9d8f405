"""The outcome of a run as a table for the terminal, as JSON, and as rows for the documents."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Final

from actors.workcell.evaluation import GOALS, missed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

TRUTHLESS: Final = frozenset({"sets", "true_voxels", "moments", "paths"})
"""Scores that are counts of what was looked at."""


def value_text(name: str, value: float) -> str:
    """Return a score as shown in a table."""
    if not math.isfinite(value):
        return "none"
    if name in TRUTHLESS or float(value).is_integer():
        return f"{value:,.0f}"
    if name.endswith("_share"):
        return f"{value:.4%}"
    return f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.3f}"


def rows_of(scores: Mapping[str, float]) -> list[tuple[str, str, str, str]]:
    """Return what, value, goal and whether it is met, for each score."""
    failed = set(missed(scores))
    rows = []
    for name, value in scores.items():
        goal = str(GOALS[name])
        met = "" if not goal else "no" if name in failed else "yes"
        rows.append((GOALS[name].what, value_text(name, value), goal, met))
    return rows


def table_of(scores: Mapping[str, float]) -> Table:
    """Return the scores as a table for the terminal."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("what")
    for head in ("measured", "goal", "met"):
        table.add_column(head, justify="right")
    for what, value, goal, met in rows_of(scores):
        colour = {"yes": "green", "no": "red"}.get(met)
        table.add_row(what, value, goal, f"[{colour}]{met}[/]" if colour else "")
    return table


def markdown_of(runs: Sequence[Mapping[str, float]], heads: Sequence[str]) -> str:
    """Return a table for a document: a row per score, a column per run.

    Args:
        runs: The scores of each run.
        heads: What each run is called.
    """
    lines = [f"| what | goal | {' | '.join(heads)} |", "|---" * (len(runs) + 2) + "|"]
    for name, goal in GOALS.items():
        if any(name in run for run in runs):
            cells = [value_text(name, run[name]) if name in run else "" for run in runs]
            lines.append(f"| {goal.what} | {goal} | {' | '.join(cells)} |")
    return "\n".join(lines)


def report_of(
    scores: Mapping[str, float], facts: Mapping[str, object], checks: Mapping[str, bool]
) -> dict[str, object]:
    """Return the report as plain data.

    Args:
        scores: By name.
        facts: What ran: scenario, seed, seconds, how.
        checks: What the scenario must hold, in words, and whether it did.
    """
    finite = {name: value if math.isfinite(value) else None for name, value in scores.items()}
    return {**facts, "scores": finite, "missed": missed(scores), "checks": dict(checks)}


def report_bytes(report: Mapping[str, object]) -> bytes:
    """Return the report as JSON, for `report.json`."""
    return (json.dumps(report, indent=2) + "\n").encode()
