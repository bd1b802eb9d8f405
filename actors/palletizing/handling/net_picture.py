"""A net as a picture: an SVG with its states coloured by outcome, and one run drawn into it.

Primitives that can still succeed stand in the left column, from the start down to the successes;
beside them those that only a failure can follow, and the failures.  Each line carries the
conditions of its exit.  A run is the thick line: how long each primitive took, and how it ended.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import escape, quoteattr

from actors.palletizing.handling.nets import AXES, TOOLS, unit_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from actors.palletizing.handling.nets import Execution, Net

WIDTH: Final = 270.0
HEIGHT: Final = 54.0
ROW: Final = 112.0
"""From one row to the next, pixels; lines carry two rows of text between them."""
COLUMNS: Final = (200.0, 760.0, 1290.0)
"""Left edges of the columns: what can succeed, what only fails, the failures."""
TOP: Final = 64.0
LINE: Final = 13.0
"""From one line of text to the next, pixels."""
LEGEND: Final = 40.0
_FILLS: Final = {
    "goes on": ("#c5dcf5", "#3469a5"),
    "can only fail": ("#f8e6d3", "#b06a2c"),
    "success": ("#cfe8c9", "#4d8a43"),
    "failure": ("#f6cfcb", "#b0413a"),
}
_RUN: Final = "#1d1d22"
_ENDED: Final = "#ffb347"
_STYLE: Final = (
    "text{font:12px 'DejaVu Sans',Arial,sans-serif;fill:#1d1d22}.title{font-weight:bold}"
    ".note,.exit{fill:#55555f;font-size:10px}path{fill:none}"
    ".exit{paint-order:stroke;stroke:#ffffff;stroke-width:3px}"
)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a state stands.

    Attributes:
        column: See `COLUMNS`.
        row: From the top.
        kind: A key of `_FILLS`.
    """

    column: int
    row: int
    kind: str

    @property
    def x(self) -> float:
        return COLUMNS[self.column]

    @property
    def y(self) -> float:
        return TOP + self.row * ROW


def svg_of_net(net: Net, run: Execution | None = None) -> str:
    """Return the picture of a net as the text of an SVG file.

    Args:
        net: What to draw.
        run: An execution of it, drawn into it; None for the net alone.
    """
    places = _places(net)
    width = COLUMNS[2] + WIDTH + 40.0
    height = TOP + (max(place.row for place in places.values()) + 1) * ROW + LEGEND
    took: dict[str, float] = {}
    taken: set[tuple[str, str]] = set()
    for step in () if run is None else run.trace:
        took[step.primitive] = took.get(step.primitive, 0.0) + step.elapsed_s
        taken.add((step.primitive, step.to))
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
            f' viewBox="0 0 {width:.0f} {height:.0f}">'
        ),
        f"<title>{escape(net.name)}</title>",
        f"<style>{_STYLE}</style>",
        "<defs>",
        *(_arrow(kind, colour) for kind, (_, colour) in _FILLS.items()),
        _arrow("run", _RUN),
        "</defs>",
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        _text(_heading(net, run), 24.0, 30.0, "title"),
        *_lines(net, places, taken),
    ]
    for name, place in places.items():
        parts += _state(net, name, place, took, run)
    return "\n".join([*parts, *_legend(height - LEGEND, run), "</svg>", ""])


def _places(net: Net) -> dict[str, _Place]:
    """Return where each state stands."""
    found = net.reachable(net.start)
    good = [name for name in found if any(net.outcome(end) for end in net.reachable(name))]
    main = [name for name in _in_order(net, good) if name in net.primitives]
    main += [name for name in good if name in net.ends]
    places = {
        name: _Place(0, row, "success" if name in net.ends else "goes on")
        for row, name in enumerate(main)
    }
    used: tuple[set[int], set[int]] = (set(), set())
    for name in [name for name in found if name not in good]:
        before = [places[other].row for other in places if name in _ways(net, other)]
        column, row = 2 if name in net.ends else 1, max(before, default=0)
        while row in used[column - 1]:
            row += 1
        used[column - 1].add(row)
        places[name] = _Place(column, row, "failure" if column == 2 else "can only fail")
    return places


def _in_order(net: Net, names: list[str]) -> list[str]:
    """Return primitives by the longest way from the start to them, ways back left out."""
    depth: dict[str, int] = {}

    def visit(name: str, passed: tuple[str, ...]) -> None:
        if name in names and name not in passed and depth.get(name, -1) < len(passed):
            depth[name] = len(passed)
            for to in _ways(net, name):
                visit(to, (*passed, name))

    visit(net.start, ())
    return sorted(depth, key=depth.__getitem__)


def _ways(net: Net, name: str) -> dict[str, list[str]]:
    """Return the conditions of all exits of a state by where they lead."""
    ways: dict[str, list[str]] = {}
    for way in net.primitives[name].exits if name in net.primitives else ():
        ways.setdefault(way.to, []).append(str(way))
    return ways


def _lines(net: Net, places: dict[str, _Place], taken: set[tuple[str, str]]) -> Iterator[str]:
    """Draw the exits, those of the run last, and what they wait for above all of them."""
    conditions: list[str] = []
    lines = [(name, to, texts) for name in places for to, texts in _ways(net, name).items()]
    for name, to, texts in sorted(lines, key=lambda line: line[:2] in taken):
        begin, end = places[name], places[to]
        run = (name, to) in taken
        kind = "run" if run else end.kind
        colour = _RUN if run else _FILLS[end.kind][1]
        d, x, y, anchor = _way(begin, end, _rows_until(net, places, name, to))
        yield (
            f"<path class={quoteattr(kind)} data-from={quoteattr(name)} data-to={quoteattr(to)}"
            f" d={quoteattr(d)}"
            f' stroke="{colour}" stroke-width="{3.0 if run else 1.3}"'
            f' marker-end="url(#{kind.replace(" ", "-")})"/>'
        )
        above = 0.0 if begin.column == end.column else LINE * (len(texts) - 1)
        for row, text in enumerate(texts):
            conditions.append(_text(text, x, y + LINE * row - above, "exit", anchor))
    yield from conditions


def _rows_until(net: Net, places: dict[str, _Place], name: str, to: str) -> int:
    """Return how many lines of text the exits to other columns have, up to the one to a state."""
    rows = 0
    for other, texts in _ways(net, name).items():
        if places[other].column != places[name].column:
            rows += len(texts)
        if other == to:
            break
    return rows


def _way(begin: _Place, end: _Place, rows: int) -> tuple[str, float, float, str]:
    """Return the curve of an exit, and where its text stands.

    Args:
        begin: The state that it leaves.
        end: The state that it leads to.
        rows: Lines of text down to its own, beside the state that it leaves.
    """
    if begin.column == end.column:
        if end.row == begin.row + 1:
            x, y = begin.x + WIDTH / 2.0, begin.y + HEIGHT
            return f"M{x:.1f},{y:.1f} V{end.y:.1f}", x + 8.0, y + 34.0, "start"
        top, bottom = begin.y + HEIGHT * 0.7, end.y + HEIGHT * 0.3
        out = begin.x - 40.0 - 12.0 * abs(end.row - begin.row)
        text_y = top + (16.0 if end.row > begin.row else -6.0)
        return _curve(begin.x, top, out, end.x, bottom), begin.x - 10.0, text_y, "end"
    x, y = begin.x + WIDTH, begin.y + LINE * rows + 2.0
    end_y = end.y + HEIGHT / 2.0
    if end.column - begin.column == 1:
        return _curve(x, y, (x + end.x) / 2.0 + 60.0, end.x, end_y), x + 10.0, y - 4.0, "start"
    below, past_x = begin.y + HEIGHT + 12.0, COLUMNS[1] + WIDTH + 20.0
    down = _curve(x + 150.0, y, x + 190.0, x + 230.0, below)
    on = _curve(past_x, below, (past_x + end.x) / 2.0, end.x, end_y)
    return f"M{x:.1f},{y:.1f} L{down[1:]} L{on[1:]}", x + 10.0, y - 4.0, "start"


def _curve(x: float, y: float, middle: float, to_x: float, to_y: float) -> str:
    return f"M{x:.1f},{y:.1f} C{middle:.1f},{y:.1f} {middle:.1f},{to_y:.1f} {to_x:.1f},{to_y:.1f}"


def _state(
    net: Net, name: str, place: _Place, took: dict[str, float], run: Execution | None
) -> Iterator[str]:
    """Draw a primitive or an end."""
    fill, stroke = _FILLS[place.kind]
    result = "" if run is None else run.result
    stopped = run is not None and name == run.primitive and result not in net.ends
    visited = name in took or name == result or stopped
    round_px = 4 if name in net.primitives else 26
    yield (
        f'<rect class={quoteattr(place.kind)} data-name={quoteattr(name)} x="{place.x:.1f}"'
        f' y="{place.y:.1f}" width="{WIDTH:.0f}" height="{HEIGHT:.0f}" rx="{round_px}"'
        f' fill="{_ENDED if stopped else fill}" stroke="{_RUN if visited else stroke}"'
        f' stroke-width="{3.0 if visited else 1.2}"/>'
    )
    if name in net.ends:
        yield _text(name, place.x + WIDTH / 2.0, place.y + 31.0, "title", "middle")
        return
    seconds = f"  {took[name]:.2f} s" if name in took else ""
    ended = f"  {result or 'runs'}" if stopped else ""
    yield _text(f"{name}{seconds}{ended}", place.x + 10.0, place.y + 17.0, "title")
    for row, text in enumerate(_notes(net, name)):
        yield _text(text, place.x + 10.0, place.y + 32.0 + 13.0 * row, "note")


def _notes(net: Net, name: str) -> Iterator[str]:
    """Return what a primitive does, in two lines; which entity it is about, by its parameter."""
    primitive, entity = net.primitives[name], net.primitives[name].frame.entity
    parameters = {bound: parameter for parameter, bound in net.grounded.items()}
    held = {
        n: axis for n, axis in zip(AXES, primitive.axes, strict=True) if axis.mode == "position"
    }
    points = [f"{name} {axis.value:.3g}" for name, axis in held.items() if name[0] != "r"]
    moves = [
        f"{name} {axis.value:.4g} {unit_of(name, axis.mode)}"
        for name, axis in zip(AXES, primitive.axes, strict=True)
        if axis.mode == "force" or (axis.mode == "velocity" and axis.value)
    ]
    to = [f"to {' '.join(points)} m"] if points else []
    to += ["turn"] if len(held) > len(points) else []
    yield ", ".join([*to, *moves]) or "holds"
    tool = ""
    if primitive.tool != "keep":
        tool = f", {primitive.tool} {primitive.tool_value:.4g} {TOOLS[primitive.tool]}"
    tare = ", tare" if primitive.tare else ""
    yield f"{parameters.get(entity, entity)}, {primitive.limit_s:g} s at most{tool}{tare}"


def _heading(net: Net, run: Execution | None) -> str:
    bound = ", ".join(
        entity if entity.partition("/")[0] == name else f"{name} {entity}"
        for name, entity in net.grounded.items()
    )
    result = "" if run is None else f": {run.result or 'it runs'}"
    return f"{net.name}{f' ({bound})' if bound else ''}{result}"


def _arrow(kind: str, colour: str) -> str:
    return (
        f'<marker id="{kind.replace(" ", "-")}" viewBox="0 0 8 8" refX="8" refY="4"'
        ' markerWidth="10" markerHeight="10" markerUnits="userSpaceOnUse" orient="auto">'
        f'<path d="M0 0L8 4L0 8Z" style="fill:{colour}"/></marker>'
    )


def _text(text: str, x: float, y: float, kind: str, anchor: str = "start") -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {place}>{escape(text)}</text>'


def _legend(top: float, run: Execution | None) -> Iterator[str]:
    """Return what the colours mean."""
    kinds = dict(_FILLS)
    if run is not None:
        kinds |= {"ended by time, brakes or a fault": (_ENDED, _RUN), "the run": ("#ffffff", _RUN)}
    x = 24.0
    for kind, (fill, stroke) in kinds.items():
        yield (
            f'<rect x="{x:.1f}" y="{top:.1f}" width="14" height="14" rx="3" fill="{fill}"'
            f' stroke="{stroke}" stroke-width="{3.0 if kind == "the run" else 1.2}"/>'
        )
        yield _text(kind, x + 20.0, top + 11.0, "note")
        x += 44.0 + 6.4 * len(kind)
