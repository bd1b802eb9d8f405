"""The actors of a cell and their data as a picture: what Figures 4 and 7 of the ENACT paper show.

World contexts (grey) stand in the middle, each with its entities (green) and their aspects
(orange).  Actors (blue) stand on both sides, those that the data reach first on the left.  Each
declared read and write is one line.  Lines run between the columns only, so none crosses a box.

`graph_of` collects, `laid_out` places, `svg_of` draws a self-contained SVG (PURE, all three).
Actors of one class and one binding that differ in their `entity` only, such as eight cameras, are
one box.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Final
from xml.sax.saxutils import escape, quoteattr

from enact_dist.actor.uses import ActorDeclaration, Use, uses_of

CHARACTER: Final = 8.2
"""Mean width of a character in the widest of the usual bold fonts, pixels."""
ROW: Final = 22.0
"""Height of an aspect, or of a line of text, pixels."""
GAP: Final = 10.0
GUTTER: Final = 190.0
"""Between the columns, for the lines."""
MARGIN: Final = 24.0
NAMES_MAX: Final = 3
"""Names of a group that are written out."""

Datum = tuple[str, str, str]
"""World context, entity or pattern, aspect."""


@dataclass(frozen=True, slots=True)
class Group:
    """Actors that are drawn as one box.

    Attributes:
        key: What distinguishes it from others.
        title: Its class.
        note: When they run, and how often they do if that is known.
        layer: Number of groups that data pass before they reach this one.
    """

    key: str
    title: str
    names: tuple[str, ...]
    note: str = ""
    layer: int = 0

    @property
    def lines(self) -> tuple[str, ...]:
        """What is written into its box."""
        many = f" ({len(self.names)})" if len(self.names) > 1 else ""
        names = ", ".join(self.names[:NAMES_MAX]) + ", …" * (len(self.names) > NAMES_MAX)
        plain = names.replace("-", "").replace("_", "").lower() == self.title.lower()
        return tuple(
            line for line in (self.title + many, "" if plain else names, self.note) if line
        )


@dataclass(frozen=True, slots=True)
class RequestLine:
    """One declared request of a group.

    Attributes:
        group: Key of the group.
        datum: What it names.
        locks: Whether it holds a lock, which a view does not.
    """

    group: str
    name: str
    datum: Datum
    writes: bool
    locks: bool
    triggers: bool


@dataclass(frozen=True, slots=True)
class ActorGraph:
    """All groups and lines, in the order of the actors."""

    groups: tuple[Group, ...]
    lines: tuple[RequestLine, ...]

    @property
    def data(self) -> tuple[Datum, ...]:
        """Every datum that a line leads to, those of one entity behind each other."""
        order: dict[str, dict[str, dict[str, None]]] = {}
        for world, entity, aspect in (line.datum for line in self.lines):
            order.setdefault(world, {}).setdefault(entity, {})[aspect] = None
        return tuple(
            (world, entity, aspect)
            for world, entities in order.items()
            for entity, aspects in entities.items()
            for aspect in aspects
        )


def graph_of(
    actors: Sequence[ActorDeclaration], *, rates_hz: Mapping[str, float] | None = None
) -> ActorGraph:
    """Return the graph of a cell's actors, with the updates per second of those that run."""
    members: dict[str, list[ActorDeclaration]] = {}
    for actor in actors:
        members.setdefault(_key(actor), []).append(actor)
    uses = [use for those in members.values() for use in uses_of(those[:1])]
    layers = _layers(uses)
    groups = [
        Group(
            key,
            those[0].actor_class.__name__,
            tuple(one.name for one in those),
            _note(those, rates_hz or {}),
            layers.get(those[0].name, 0),
        )
        for key, those in members.items()
    ]
    single = {key for key, those in members.items() if len(those) == 1}
    lines = [
        RequestLine(
            key,
            use.name,
            (use.world, *_place(use, named=key in single)),
            use.request.access.writes,
            use.request.access.locks,
            use.request in use.actor.actor_class.declaration.triggers,
        )
        for use in uses
        for key in (_key(use.actor),)
    ]
    return ActorGraph(tuple(groups), tuple(lines))


def _key(actor: ActorDeclaration) -> str:
    if actor.entity is None:
        return actor.name
    kind = f"{actor.actor_class.__module__}:{actor.actor_class.__qualname__}"
    return f"{kind} {sorted((actor.worlds or {}).items())}"


def _place(use: Use, *, named: bool) -> tuple[str, str]:
    request = use.named if named else use.request
    return str(request.entity), request.aspect.name


def _note(actors: Sequence[ActorDeclaration], rates_hz: Mapping[str, float]) -> str:
    found = [rates_hz[actor.name] for actor in actors if actor.name in rates_hz]
    if found:
        low, high = min(found), max(found)
        return f"{low:.1f}/s" if f"{low:.1f}" == f"{high:.1f}" else f"{low:.1f} to {high:.1f}/s"
    period_s = actors[0].period_s
    if period_s is not None:
        return f"every {period_s:g} s"
    return "" if actors[0].actor_class.declaration.triggers else "once"


def _layers(uses: Sequence[Use]) -> dict[str, int]:
    """Return how many actors data pass before each; what comes back in a circle is left out."""
    comes_from: dict[str, set[str]] = {use.actor.name: set() for use in uses}
    for reader in uses:
        if reader.request.access.writes:
            continue
        for writer in uses:
            if writer.request.access.writes and writer.meets(reader):
                comes_from[reader.actor.name].add(writer.actor.name)
    found: dict[str, int] = {}

    def layer(name: str, passed: frozenset[str]) -> int:
        if name not in found:
            before = [layer(one, passed | {name}) for one in comes_from[name] - passed - {name}]
            depth = 1 + max(before, default=-1)
            if passed:
                return depth
            found[name] = depth
        return found[name]

    for name in comes_from:
        layer(name, frozenset())
    return found


# ---------------------------------------------------------------- where everything stands


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle, pixels: left, top, width, height."""

    x: float
    y: float
    width: float
    height: float

    @property
    def right(self) -> float:
        """Right edge."""
        return self.x + self.width

    @property
    def bottom(self) -> float:
        """Lower edge."""
        return self.y + self.height

    @property
    def middle_y(self) -> float:
        """Height of the middle."""
        return self.y + self.height / 2.0


@dataclass(slots=True)
class Layout:
    """Where everything stands, pixels.

    Attributes:
        worlds: Box of each world context.
        entities: Box of each (world context, entity).
        aspects: Box of each datum.
        actors: Box of each group, by its key.
        ends: Both ends of each line, (x, y) at the actor and (x, y) at the aspect.
    """

    worlds: dict[str, Box] = field(default_factory=dict)
    entities: dict[tuple[str, str], Box] = field(default_factory=dict)
    aspects: dict[Datum, Box] = field(default_factory=dict)
    actors: dict[str, Box] = field(default_factory=dict)
    ends: list[tuple[tuple[float, float], tuple[float, float]]] = field(default_factory=list)
    width: float = 0.0
    height: float = 0.0


def laid_out(graph: ActorGraph) -> Layout:
    """Return where everything stands: actors, data, actors, from left to right."""
    layout = Layout()
    left, right = _sides(graph)
    widths = [
        max((_width(line) for group in side for line in group.lines), default=0.0)
        for side in (left, right)
    ]
    data_x = MARGIN + widths[0] + GUTTER * bool(left)
    _place_data(graph, layout, data_x)
    data_right = max((box.right for box in layout.worlds.values()), default=data_x)
    right_x = data_right + GUTTER
    for side, x, width in ((left, MARGIN, widths[0]), (right, right_x, widths[1])):
        _place_actors(graph, layout, side, x, width)
    boxes = [*layout.worlds.values(), *layout.actors.values()]
    layout.width = max((box.right for box in boxes), default=0.0) + MARGIN
    layout.height = max((box.bottom for box in boxes), default=0.0) + MARGIN
    _place_lines(graph, layout, {group.key for group in left})
    return layout


def _width(text: str) -> float:
    return len(text) * CHARACTER + 2.0 * GAP


def _sides(graph: ActorGraph) -> tuple[list[Group], list[Group]]:
    """Return the groups that stand on the left and on the right: half of the lines on each."""
    order = sorted(graph.groups, key=lambda group: group.layer)
    count = {group.key: 1.0 for group in order}
    for line in graph.lines:
        count[line.group] += 1.0
    half, sofar = sum(count.values()) / 2.0, 0.0
    left: list[Group] = []
    for group in order:
        if left and sofar + count[group.key] / 2.0 > half:
            break
        sofar += count[group.key]
        left.append(group)
    return left, order[len(left) :]


def _place_data(graph: ActorGraph, layout: Layout, x: float) -> None:
    data = graph.data
    texts = [text for datum in data for text in datum]
    width = max((_width(text) for text in texts), default=0.0) + 2.0 * GAP
    y = MARGIN
    for world in dict.fromkeys(datum[0] for datum in data):
        top = y
        y += ROW + GAP
        for entity in dict.fromkeys(one[1] for one in data if one[0] == world):
            entity_top = y
            y += ROW
            for datum in (one for one in data if one[:2] == (world, entity)):
                layout.aspects[datum] = Box(x + 2.0 * GAP, y, width, ROW)
                y += ROW + GAP / 2.0
            y += GAP / 2.0
            box = Box(x + GAP, entity_top, width + 2.0 * GAP, y - entity_top)
            layout.entities[world, entity] = box
            y += GAP
        layout.worlds[world] = Box(x, top, width + 4.0 * GAP, y - top)
        y += 2.0 * GAP


def _place_actors(
    graph: ActorGraph, layout: Layout, side: Sequence[Group], x: float, width: float
) -> None:
    """Stack the actors of one side, each as near to the middle of its data as there is room."""

    def at(group: Group) -> float:
        lines = [line for line in graph.lines if line.group == group.key]
        return fmean([layout.aspects[line.datum].middle_y for line in lines] or [0.0])

    heights = {
        group.key: max(
            len(group.lines) * (ROW - 4.0) + GAP,
            sum(line.group == group.key for line in graph.lines) * GAP,
        )
        for group in side
    }
    order = sorted(side, key=at)
    tops: list[float] = []
    floor = MARGIN
    for group in order:
        tops.append(max(floor, at(group) - heights[group.key] / 2.0))
        floor = tops[-1] + heights[group.key] + 2.0 * GAP
    ceiling = max((box.bottom for box in layout.worlds.values()), default=0.0)
    for index in range(len(order) - 1, -1, -1):  # back up, where the last ones hang over
        height = heights[order[index].key]
        above = sum(heights[group.key] + 2.0 * GAP for group in order[:index])
        lowest = max(ceiling - height, MARGIN + above)
        tops[index] = min(tops[index], lowest)
        ceiling = tops[index] - 2.0 * GAP
    for group, top in zip(order, tops, strict=True):
        layout.actors[group.key] = Box(x, top, width, heights[group.key])


def _place_lines(graph: ActorGraph, layout: Layout, left: set[str]) -> None:
    """Give each line a place of its own at both of its ends, in the order of the other ends."""
    at_actor: dict[int, float] = {}
    for key, box in layout.actors.items():
        mine = [index for index, line in enumerate(graph.lines) if line.group == key]
        mine.sort(key=lambda index: layout.aspects[graph.lines[index].datum].y)
        for place, index in enumerate(mine):
            at_actor[index] = box.y + box.height * (place + 1) / (len(mine) + 1)
    at_datum: dict[int, float] = {}
    for datum, box in layout.aspects.items():
        for on_left in (True, False):
            here = [
                index
                for index, line in enumerate(graph.lines)
                if line.datum == datum and (line.group in left) == on_left
            ]
            here.sort(key=at_actor.__getitem__)
            for place, index in enumerate(here):
                at_datum[index] = box.y + box.height * (place + 1) / (len(here) + 1)
    for index, line in enumerate(graph.lines):
        actor, aspect = layout.actors[line.group], layout.aspects[line.datum]
        xs = (actor.right, aspect.x) if line.group in left else (actor.x, aspect.right)
        layout.ends.append(((xs[0], at_actor[index]), (xs[1], at_datum[index])))


# ---------------------------------------------------------------- the picture

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


def svg_of(graph: ActorGraph, title: str) -> str:
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


def _path(line: RequestLine, actor: str, layout: Layout, at: int) -> str:
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
