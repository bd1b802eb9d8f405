"""Tables, values and small plots as HTML; every text of the cell is escaped."""

from __future__ import annotations

import time
from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np

from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.text.showing import lines, one_line, visible
from enact_dist.world.trees import drawn, shown_s

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.compare.diff import Diff
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.world.lineage import CauseTree, EffectTree
    from enact_dist.world.trees import Branch

VALUE_SHOWN_MAX: Final = 90
LINES_SHOWN_MAX: Final = 40
ROWS_SHOWN_MAX: Final = 60
SAMPLES_MAX: Final = 120
"""Points of a small plot."""
SERIES_MAX: Final = 8
"""Numbers of one datum that are plotted."""
CHANGED: Final = (255, 150, 0)
ONLY_LEFT: Final = (220, 40, 40)
ONLY_RIGHT: Final = (40, 170, 60)
OTHER: Final = (90, 120, 255)
"""Colours of a difference: what changed, what one side has alone, the right side of a change."""
_PLOT_COLOURS: Final = (
    "#d62728", "#2ca02c", "#1f77b4", "#ff7f0e", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f",
)  # fmt: skip


class Markup(str):
    """Markup that was made here, which a table takes as it is."""

    __slots__ = ()


def text(value: object) -> str:
    """Return a text that no name or datum can turn into markup."""
    return escape(visible(str(value)))


def small(content: str) -> str:
    """Wrap markup in small type."""
    style = "font-size:0.75em;line-height:1.35;overflow-x:auto;padding:0 0.8em"
    return f'<div style="{style}">{content}</div>'


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], *, empty: str, count: int = 0
) -> str:
    """Return a table, or the sentence `empty` without any row; `count`: of all rows, if more."""

    def column(cell: object) -> str:
        content = cell if isinstance(cell, Markup) else text(cell)
        return f'<td style="padding:1px 6px;white-space:nowrap">{content}</td>'

    lines_ = ["<tr>" + "".join(map(column, row)) + "</tr>" for row in rows]
    if not lines_:
        return small(f"<i>{text(empty)}</i>")
    head = "".join(
        f'<th style="padding:1px 6px;white-space:nowrap;text-align:left">{text(one)}</th>'
        for one in columns
    )
    more = max(count, len(lines_)) - ROWS_SHOWN_MAX
    left = f"<div>… and {more} more</div>" if more > 0 else ""
    body = "".join(lines_[:ROWS_SHOWN_MAX])
    return small(f'<table style="border-collapse:collapse"><tr>{head}</tr>{body}</table>{left}')


def clock(stamp_ns: int) -> str:
    """Return a moment as the time of the day: ``12:03:04.250``."""
    seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
    return f"{time.strftime('%H:%M:%S', time.localtime(seconds))}.{rest_ns // 1_000_000:03d}"


def age(now_ns: int, stamp_ns: int) -> str:
    """Return how long ago a moment was."""
    return f"{shown_s(max(0, now_ns - stamp_ns) / 1e9)} ago" if stamp_ns else "never"


def size(size_bytes: int) -> str:
    """Return a size in words; of data without a body, that they are small."""
    return shown_bytes(size_bytes) if size_bytes else "small"


def short_value(value: object) -> str:
    """Return a datum in one short line, as plain text."""
    found = " ".join(one_line(value).split())
    more = len(found) - VALUE_SHOWN_MAX
    return found if more <= 0 else f"{found[:VALUE_SHOWN_MAX]}…"


def whole_value(value: object) -> str:
    """Return a datum as lines of markup; arrays are summarised."""
    found = [each for line in lines(value) for each in line.splitlines()]
    cut = found[:LINES_SHOWN_MAX]
    more = [f"… {len(found) - len(cut)} more lines"] if len(found) > len(cut) else []
    return f'<pre style="margin:0">{text(chr(10).join([*cut, *more]))}</pre>'


# ---------------------------------------------------------------- numbers over time


def numbers_in(value: object, name: str = "") -> dict[str, float]:
    """Return the numbers that a small datum consists of, by their place in it."""
    found: dict[str, float] = {}
    if isinstance(value, bool | int | float):
        found[name] = float(value)
    elif isinstance(value, dict):
        for key, each in value.items():
            found |= numbers_in(each, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value[:SERIES_MAX]):
            found |= numbers_in(each, f"{name}[{index}]")
    elif isinstance(value, np.longdouble):  # `tolist` leaves it as it is
        found[name] = float(value)
    elif isinstance(value, np.ndarray) and value.ndim <= 1 and value.size <= SERIES_MAX:
        found |= numbers_in(value.tolist(), name)
    return dict(list(found.items())[:SERIES_MAX])


def plot(
    samples: Sequence[tuple[int, dict[str, float]]], *, wide_px: int = 90, high_px: int = 16
) -> str:
    """Return numbers over time as a small picture; "" of fewer than two moments.

    Args:
        samples: Timestamp and the numbers of that moment, ascending.
        wide_px: Width.
        high_px: Height.
    """
    if len(samples) < 2:
        return ""
    begin_ns, end_ns = samples[0][0], samples[-1][0]
    names = list(samples[-1][1])
    finite = [v for _, each in samples for v in each.values() if abs(v) < float("inf")]
    if end_ns <= begin_ns or not finite:
        return ""
    low, high = min(finite), max(finite)
    span = high - low or 1.0
    lines_ = []
    for colour, name in zip(_PLOT_COLOURS, names, strict=False):
        points = " ".join(
            f"{(at - begin_ns) / (end_ns - begin_ns) * wide_px:.1f},"
            f"{high_px - 1 - (each[name] - low) / span * (high_px - 2):.1f}"
            for at, each in samples
            if abs(each.get(name, float("inf"))) < float("inf")
        )
        lines_.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
    style = "background:#f4f4f6;vertical-align:middle"
    head = f'<svg width="{wide_px}" height="{high_px}" style="{style}">'
    return f"{head}{''.join(lines_)}</svg>"


def big_plot(samples: Sequence[tuple[int, dict[str, float]]]) -> str:
    """Return a plot with its range, span of time and names; "" of fewer than two moments."""
    picture = plot(samples, wide_px=330, high_px=90)
    if not picture:
        return ""
    finite = [v for _, each in samples for v in each.values() if abs(v) < float("inf")]
    names = " ".join(
        f'<span style="color:{colour}">{text(name or "value")}</span>'
        for colour, name in zip(_PLOT_COLOURS, samples[-1][1], strict=False)
    )
    over = shown_s((samples[-1][0] - samples[0][0]) / 1e9)
    return small(f"{picture}<div>{min(finite):.6g} to {max(finite):.6g} over {over}: {names}</div>")


# ---------------------------------------------------------------- trees, differences


def tree_lines(tree: CauseTree | EffectTree) -> str:
    """Return causes or effects as `enact why` draws them."""
    found: list[str] = []

    def add(branch: Branch, depth: int) -> None:
        found.append("  " * depth + branch.label)
        for child in branch.children.values():
            add(child, depth + 1)

    add(drawn(tree), 0)
    return small(f'<pre style="margin:0">{text(chr(10).join(found))}</pre>')


def colour_of_difference(kind: str) -> tuple[int, int, int]:
    """Return the colour of a slot by how its two sides compare."""
    return {"only left": ONLY_LEFT, "only right": ONLY_RIGHT}.get(kind, CHANGED)


def difference_table(diff: Diff) -> str:
    """Return the rows of a difference, each in its colour."""
    rows = []
    for row in diff.rows[:ROWS_SHOWN_MAX]:
        red, green, blue = colour_of_difference(row.kind.value)
        mark = f'<span style="color:rgb({red},{green},{blue})">■</span>'
        what = text(row.difference or "")
        rows.append(
            f"<div>{mark} {text(row.entity)}/{text(row.aspect)} {row.kind.value} {what}</div>"
        )
    more = len(diff.rows) - len(rows)
    rows += [f"<div>… and {more} more</div>"] if more > 0 else []
    head = f"{len(diff.rows)} differ, {diff.within} within their tolerance, {diff.equal} equal"
    return small(f"<b>{text(head)}</b>{''.join(rows)}")


def slot_name(slot: Slot) -> str:
    """Return ``entity/aspect``."""
    return f"{slot.entity}/{slot.aspect}"
