"""Trees for people: drawn on a terminal, plain text into a pipe; above all causes and effects."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.wire.texts import shown

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from typing import IO

    from enact_dist.world.lineage import CauseTree, EffectTree, Made

    Tree = CauseTree | EffectTree

ALIKE_MIN: Final = 3
"""So many versions that differ in number or name alone share one line."""
INDENT: Final = 4
"""Columns of a terminal by which a branch is set off."""


def on_terminal(out: IO[str] | None = None) -> bool:
    """Say whether a stream (None: standard output) is a terminal that shows colours."""
    out = out if out is not None else sys.stdout
    return out.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb"


def shown_s(value_s: float) -> str:
    """Return a duration as people read it: ``12 ms``, ``3.4 s``, ``2 h 5 min``."""
    if value_s < 1.0:
        return f"{value_s * 1e3:.0f} ms" if value_s >= 0.01 else f"{value_s * 1e3:.1f} ms"
    if value_s < 60.0:
        return f"{value_s:.1f} s"
    minutes, rest_s = divmod(round(value_s), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days} d {hours} h"
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest_s} s"


@dataclass(slots=True)
class Branch:
    """A part of a tree: its own line, and the parts below it by name."""

    label: str
    children: dict[str, Branch] = field(default_factory=dict)

    def at(self, segments: list[str]) -> Branch:
        """Return the branch at a path below this one, growing it where needed."""
        branch = self
        for segment in segments:
            branch = branch.children.setdefault(segment, Branch(f"{segment}/"))
        return branch

    def add(self, branch: Branch) -> None:
        """Put a branch below this one, after the others."""
        self.children[str(len(self.children))] = branch


def print_tree(root: Branch, out: IO[str] | None = None) -> None:
    """Print a tree with its root as the first line.

    Args:
        root: Of the tree.
        out: Where to; None: standard output.
    """
    out = out if out is not None else sys.stdout
    if on_terminal(out):
        _rich_tree(root, out)
    else:
        _plain_tree(root, 0, out)


def _plain_tree(branch: Branch, depth: int, out: IO[str]) -> None:
    print(f"{'  ' * depth}{shown(branch.label)}", file=out)
    for child in branch.children.values():
        _plain_tree(child, depth + 1, out)


def _rich_tree(root: Branch, out: IO[str]) -> None:
    from rich.console import Console
    from rich.text import Text
    from rich.tree import Tree

    needed = 0

    def grow(tree: Tree, branch: Branch, indent: int) -> None:
        nonlocal needed
        for child in branch.children.values():
            label = shown(child.label)
            needed = max(needed, indent + max(map(len, label.split()), default=0))
            grow(tree.add(Text(label)), child, indent + INDENT)

    tree = Tree(Text(shown(root.label), style="bold"))
    grow(tree, root, INDENT)
    console = Console(file=out)
    # Where a word does not fit, the terminal breaks the line: rich would break, or drop, the word.
    Console(file=out, width=max(console.width, needed)).print(tree)


# ---------------------------------------------------------------- causes and effects


def drawn(tree: Tree, *, alike_min: int = ALIKE_MIN) -> Branch:
    """Return the lines of a tree.

    Args:
        tree: Of causes or effects.
        alike_min: How many versions that differ in number or name alone share a line; what
            follows them shares lines, too.  0: none do.
    """
    return _line_of([tree], alike_min)


def _line_of(alike: Sequence[Tree], alike_min: int) -> Branch:
    line = Branch(_label_of_one(alike[0]) if len(alike) == 1 else _label_of_many(alike))
    groups: dict[tuple[object, ...], list[Tree]] = {}
    for child in _once(child for one in alike for child in one.children):
        groups.setdefault(_likeness(child), []).append(child)
    repeated = groups.pop(_REPEATED, [])
    for group in groups.values():
        if alike_min and len(group) >= alike_min:
            line.add(_line_of(group, alike_min))
        else:
            for one in group:
                line.add(_line_of([one], alike_min))
    if repeated:
        line.add(Branch(f"and, shown elsewhere: {', '.join(_names_of(repeated, alike_min))}"))
    left_out = sum(one.left_out for one in alike)
    if left_out:
        line.add(Branch(f"… and {left_out} further data, more than are named"))
    unfollowed = sum(one.unfollowed for one in alike)
    if unfollowed:
        line.add(Branch(f"… {unfollowed} more steps, with a larger --depth"))
    return line


def _names_of(repeated: Sequence[Made], alike_min: int) -> Iterable[str]:
    """Return the names of versions, those that are alike as one."""
    groups: dict[tuple[object, ...], list[Made]] = {}
    for one in repeated:
        groups.setdefault(_place(one), []).append(one)
    for group in groups.values():
        if alike_min and len(group) >= alike_min:
            yield _name_of_many(group)
        else:
            yield from map(_name, group)


def _once(many: Iterable[Tree]) -> Iterable[Tree]:
    """Leave out those that are shown in full among the others."""
    found: dict[tuple[object, ...], Tree] = {}
    for one in many:
        key = one.slot, one.position
        if key not in found or found[key].elsewhere:
            found[key] = one
    return found.values()


_REPEATED: Final = ("elsewhere",)


def _likeness(one: Made) -> tuple[object, ...]:
    """Return what the versions that share a line have in common."""
    if one.elsewhere:
        return _REPEATED
    return *_place(one), one.kind, one.actor, one.host, one.null_reason


def _place(one: Made) -> tuple[object, ...]:
    place, slash, name = one.entity.name.rpartition("/")
    return one.world, place if slash else name, slash, one.aspect


def _name(one: Made) -> str:
    return f"{one.world}:{one.entity}/{one.aspect} v{one.version}"


def _name_of_many(alike: Sequence[Made]) -> str:
    first, names = alike[0], {one.entity.name for one in alike}
    numbers = sorted(one.version for one in alike)
    versions = f"v{numbers[0]}" if numbers[0] == numbers[-1] else f"v{numbers[0]}…{numbers[-1]}"
    place = first.entity.name.rpartition("/")[0]
    entity = first.entity.name if len(names) == 1 else f"{place}/{_span(names)}"
    return f"{first.world}:{entity}/{first.aspect} {versions}"


def _label_of_one(one: Made) -> str:
    parts = [_name(one)]
    if one.null_reason:
        parts.append(f"NULL ({one.null_reason})")
    if one.position.stamp_ns:
        parts.append(f"{shown_s(one.age_s)} ago")
    if one.stamp_ns:
        old_s = one.age_s + (one.position.stamp_ns - one.stamp_ns) / 1e9
        parts.append(f"captured {shown_s(old_s)} ago")
    parts.append(one.made_by)
    if one.held_s:
        parts.append(f"held {shown_s(one.held_s)}")
    return "  ".join(parts)


def _label_of_many(alike: Sequence[Made]) -> str:
    parts = [_name_of_many(alike), f"{len(alike)} versions"]
    ages_s = [one.age_s for one in alike if one.position.stamp_ns]
    if ages_s:
        ages = dict.fromkeys((shown_s(min(ages_s)), shown_s(max(ages_s))))
        parts.append(f"{' to '.join(ages)} ago")
    return "  ".join([*parts, alike[0].made_by])


def _span(names: Iterable[str]) -> str:
    """Return the last segments of names as one: ``0…13`` where they count up, else ``*``."""
    segments = [name.rpartition("/")[2] for name in names]
    if not all(segment.isdigit() for segment in segments):
        return "*"
    numbers = sorted(map(int, segments))
    if numbers == list(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]}…{numbers[-1]}"
    return ",".join(map(str, numbers))
