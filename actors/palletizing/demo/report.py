"""The outcome of a demonstration: rows, table, score, files.

The score is the one place where verdicts meet the truth, after the last verdict was given.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING

from actors.palletizing.simulation.packages import VERDICT_OF_KIND
from actors.palletizing.vocabulary import place_entity
from enact_dist.types import DiffKind

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.table import Table

    from actors.palletizing.simulation.packages import Package
    from actors.palletizing.vocabulary import Deviation, Notice
    from enact_dist.types import Diff


@dataclass(frozen=True, slots=True)
class Row:
    """One package.

    Attributes:
        place: Name of its place.
        product: What it is.
        truth: What really is the matter with it.
        verdict: What was found.
        correct: Whether that is right.
        deviation_mm: By how much it deviates, as found.
        frame_to_feedback_ms: From the capture of the image to the user's line.
    """

    place: str
    product: str
    truth: str
    verdict: str
    correct: bool
    deviation_mm: float
    frame_to_feedback_ms: float


def rows_of(
    packages: Sequence[Package], flags: Mapping[str, Deviation], notices: Mapping[str, Notice]
) -> list[Row]:
    """Set verdicts beside the truth."""
    rows = []
    for stop, package in enumerate(packages):
        place = place_entity(stop).name
        flag = flags[place]
        rows.append(
            Row(
                place=place,
                product=flag.product,
                truth=str(package.truth),
                verdict=flag.verdict,
                correct=flag.verdict == VERDICT_OF_KIND[package.truth.kind],
                deviation_mm=round(flag.deviation_mm, 1),  # as the user's line says it
                frame_to_feedback_ms=round(notices[place].latency_ms, 1),
            )
        )
    return rows


def table_of(rows: Sequence[Row]) -> Table:
    """Return the rows as a table for the terminal."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("package")
    table.add_column("truth")
    table.add_column("verdict")
    table.add_column("deviation", justify="right")
    table.add_column("frame to feedback", justify="right")
    for row in rows:
        colour = "red" if not row.correct else "green" if row.verdict == "ok" else "yellow"
        table.add_row(
            f"{row.place} {row.product}",
            row.truth,
            f"[{colour}]{row.verdict}[/]" + ("" if row.correct else " (wrong)"),
            f"{row.deviation_mm:.1f} mm" if row.verdict != "ok" else "-",
            f"{row.frame_to_feedback_ms:.0f} ms",
        )
    return table


def score_of(rows: Sequence[Row]) -> str:
    """Return the score as one line."""
    right = sum(row.correct for row in rows)
    sound = [row for row in rows if row.truth == "ok"]
    alarms = sum(not row.correct for row in sound)
    times = [row.frame_to_feedback_ms for row in rows]
    return (
        f"{right} of {len(rows)} verdicts right, {alarms} false alarms on {len(sound)} sound"
        f" packages; frame to feedback median {median(times):.0f} ms, longest {max(times):.0f} ms"
    )


def difference_of(diff: Diff) -> str:
    """Return what is not as planned, a line for each place.

    Args:
        diff: Of training and online, of the aspect `STANDING`.
    """
    judged = diff.equal + diff.within + len(diff.of(DiffKind.CHANGED))
    lines = [f"  {row.entity.name}: {row.difference}" for row in diff.of(DiffKind.CHANGED)]
    return "\n".join([f"training against online: {len(lines)} of {judged} places differ", *lines])


def report_bytes(rows: Sequence[Row], *, seed: int) -> bytes:
    """Return the rows as JSON, for `report.json`."""
    content = {
        "seed": seed,
        "right": sum(row.correct for row in rows),
        "packages": [dataclasses.asdict(row) for row in rows],
    }
    return (json.dumps(content, indent=2) + "\n").encode()
