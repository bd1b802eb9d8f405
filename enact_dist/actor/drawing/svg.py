"""Draws what `actor.drawing.graph` has laid out as a self-contained SVG, without loaded fonts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import escape, quoteattr

from enact_dist.actor.drawing.graph import GAP, MARGIN, ROW, laid_out

if TYPE_CHECKING:
    from enact_dist.actor.drawing.graph import Box, Graph, Layout, Line

LEGEND_HEIGHT: Final = 48.0
LEGEND_WIDTH: Final = 700.0
_FILLS: Final = {
    "world": ("#e9e9ec", "#8a8a92"),
    "entity": ("#cfe8c9", "#4d8a43"),
    "aspect": ("#fbd9a8", "#c07f1f"),
    "actor": ("#c5dcf5", "#3469a5"),
}
_WRITES: Final = "#8c3b12"
_READS: Final = "#2d5d92"
_STYLE: Final = (
    "text{font:12px 'DejaVu Sans',Arial,sans-serif;fill:#1d1d22}"
    ".title{font-weight:bold}.note{fill:#55555f;font-size:11px}path{fill:none;stroke-width:1.3}"
)


def svg_of(graph: Graph, title: str) -> str:
    """Return the picture of a graph as the text of an SVG file."""
    layout = laid_out(graph)
    width = max(layout.width, LEGEND_WIDTH + 2.0 * MARGIN)
    height = layout.height + LEGEND_HEIGHT
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}"'
            f' viewBox="0 0 {width:.0f} {height:.0f}">'
        ),
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        "<defs>",
        *(_arrow(name, colour) for name, colour in (("writes", _WRITES), ("reads", _READS))),
        "</defs>",
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
    ]
    for world, box in layout.worlds.items():
        parts += [_rect("world", world, box), _text(world, box.x + GAP, box.y + 15.0, "title")]
    for (world, entity), box in layout.entities.items():
        parts += [_rect("entity", f"{world}:{entity}", box)]
        parts += [_text(entity, box.x + GAP, box.y + 15.0, "title")]
    for (world, entity, aspect), box in layout.aspects.items():
        parts += [_rect("aspect", f"{world}:{entity}/{aspect}", box)]
        parts += [_text(aspect, box.x + GAP, box.y + 15.0)]
    for group in graph.groups:
        box = layout.actors[group.key]
        parts += [_rect("actor", ", ".join(group.names), box)]
        top = box.middle_y - len(group.lines) * (ROW - 4.0) / 2.0
        for index, line in enumerate(group.lines):
            kind = "title" if not index else "note"
            parts += [_text(line, box.x + GAP, top + 13.0 + index * (ROW - 4.0), kind)]
    names = {group.key: ", ".join(group.names) for group in graph.groups}
    parts += [_path(line, names[line.group], layout, at) for at, line in enumerate(graph.lines)]
    return "\n".join([*parts, *_legend(layout.height), "</svg>", ""])


def _arrow(name: str, colour: str) -> str:
    return (
        f'<marker id="{name}" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="9" markerHeight="9"'
        ' markerUnits="userSpaceOnUse"'
        f' orient="auto-start-reverse"><path d="M0 0L8 4L0 8Z" style="fill:{colour}"/></marker>'
    )


def _rect(kind: str, name: str, box: Box) -> str:
    fill, stroke = _FILLS[kind]
    return (
        f'<rect class="{kind}" data-name={quoteattr(name)} x="{box.x:.1f}" y="{box.y:.1f}"'
        f' width="{box.width:.1f}" height="{box.height:.1f}" rx="4" fill="{fill}"'
        f' stroke="{stroke}"/>'
    )


def _text(text: str, x: float, y: float, kind: str = "") -> str:
    shown = f' class="{kind}"' if kind else ""
    return f'<text{shown} x="{x:.1f}" y="{y:.1f}">{escape(text)}</text>'


def _path(line: Line, actor: str, layout: Layout, at: int) -> str:
    begin, end = layout.ends[at]
    half = (end[0] - begin[0]) * 0.5
    curve = (begin, (begin[0] + half, begin[1]), (end[0] - half, end[1]), end)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in curve[1:])
    d = f"M{begin[0]:.1f},{begin[1]:.1f} C{points}"
    kind, colour = ("writes", _WRITES) if line.writes else ("reads", _READS)
    tip = f'marker-end="url(#{kind})"' if line.writes else f'marker-start="url(#{kind})"'
    dash = "" if line.locks else ' stroke-dasharray="5 3"'
    bold = ' style="stroke-width:2.4"' if line.triggers else ""
    world, entity, aspect = line.datum
    return (
        f"<path data-actor={quoteattr(actor)} data-request={quoteattr(line.name)}"
        f' data-datum={quoteattr(f"{world}:{entity}/{aspect}")} data-kind="{kind}"'
        f' d="{d}" stroke="{colour}"{dash}{bold} {tip}/>'
    )


def _legend(top: float) -> list[str]:
    """Return what the colours and lines mean."""
    y = top + 8.0
    parts, x = [], MARGIN
    for kind, text in (("world", "world context"), ("entity", "entity"), ("aspect", "aspect"),
                       ("actor", "actor")):  # fmt: skip
        fill, stroke = _FILLS[kind]
        parts += [
            (
                f'<rect x="{x:.1f}" y="{y:.1f}" width="14" height="14" rx="3" fill="{fill}"'
                f' stroke="{stroke}"/>'
            ),
            _text(text, x + 20.0, y + 11.0, "note"),
        ]
        x += 40.0 + 6.6 * len(text)
    for text, colour, more in (
        ("writes", _WRITES, ""),
        ("reads under a lock", _READS, ""),
        ("views", _READS, ' stroke-dasharray="5 3"'),
        ("triggers", _READS, ' stroke-dasharray="5 3" style="stroke-width:2.4"'),
    ):
        parts += [
            f'<path d="M{x:.1f},{y + 7:.1f} h26" stroke="{colour}"{more}/>',
            _text(text, x + 32.0, y + 11.0, "note"),
        ]
        x += 52.0 + 6.6 * len(text)
    return parts
