"""The outcome of a demonstration with the robot: rows, table, score, lines.

The score is the one place where verdicts meet the truth of physics.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from actors.palletizing.trials.truth import DENTED, in_words, seen_as

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

    from actors.palletizing.simulation.cell.truth import PackageTruth
    from actors.palletizing.vocabulary import Deviation, Plan, Result

RIGHT: Final = {DENTED: ("ok", "deformed")}
"""What may be found where the truth is between two verdicts."""


@dataclass(frozen=True, slots=True)
class Row:
    """One package.

    Attributes:
        place: Name of its place.
        product: What it is.
        planned: Where it was to stand, mm, tray frame.
        truth: What physics made of it, in the words of the verdicts, or `DENTED`.
        physical: The same in numbers.
        verdict: What was found.
        correct: Whether that is right, see `RIGHT`.
        reactions: Kinds of the requests that followed the first one.
        result: What became of it.
        reason: Why.
    """

    place: str
    product: str
    planned: str
    truth: str
    physical: str
    verdict: str
    correct: bool
    reactions: tuple[str, ...]
    result: str
    reason: str


def judged_by(package: PackageTruth, plan: Plan) -> tuple[str, str]:
    """Return what became of a package in the words of the verdicts, and in numbers."""
    planned = plan.tray_from_product
    return seen_as(package, planned), in_words(package, planned)


def row_of(
    place: str,
    plan: Plan,
    package: PackageTruth,
    flag: Deviation | None,
    result: Result,
    judged: tuple[str, str] | None,
) -> Row:
    """Return the row of one package.

    Args:
        place: Name of its place.
        plan: Where it was to stand.
        package: The truth in the end.
        flag: The last verdict about its place; None: there was none.
        result: What became of it.
        judged: The truth when that verdict was given, as `judged_by` returns it; None: unknown.
    """
    truth, physical = judged_by(package, plan)
    then = judged or (truth, physical)
    x, y = 1e3 * plan.tray_from_product[:2, 3]
    return Row(
        place=place,
        product=plan.product,
        planned=f"{x:.0f}, {y:.0f}",
        truth=then[0] if flag is not None else truth,
        physical=then[1] if flag is not None else physical,
        verdict="-" if flag is None else flag.verdict,
        correct=flag is None or flag.verdict in RIGHT.get(then[0], (then[0],)),
        reactions=result.reactions,
        result=result.result,
        reason=result.reason,
    )


def table_of(rows: Sequence[Row]) -> Table:
    """Return the rows as a table for the terminal."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("package", "planned (mm)", "physics", "verdict", "reactions", "result"):
        table.add_column(name, no_wrap=name in {"package", "planned (mm)", "result"})
    for row in rows:
        colour = "red" if not row.correct else "green" if row.verdict == "ok" else "yellow"
        table.add_row(
            f"{row.place} {row.product}",
            row.planned,
            f"{row.truth}: {row.physical}",
            f"[{colour}]{row.verdict}[/]" + ("" if row.correct else " (wrong)"),
            ", ".join(row.reactions) or "-",
            row.result,
        )
    return table


def score_of(rows: Sequence[Row]) -> str:
    """Return the score as one line."""
    judged = [row for row in rows if row.verdict != "-"]
    right = sum(row.correct for row in judged)
    by_robot = sum(row.result == "placed" for row in rows)
    at_once = sum(row.result == "placed" and not row.reactions for row in rows)
    return (
        f"{right} of {len(judged)} verdicts right; {by_robot} of {len(rows)} packages placed as"
        f" planned, {at_once} of them at the first try"
    )


def report_bytes(rows: Sequence[Row], figures: Mapping[str, object]) -> bytes:
    """Return rows and figures as JSON, for `report.json`."""
    content = {
        **figures,
        "right": sum(row.correct for row in rows if row.verdict != "-"),
        "packages": [dataclasses.asdict(row) for row in rows],
    }
    return (json.dumps(content, indent=2) + "\n").encode()
