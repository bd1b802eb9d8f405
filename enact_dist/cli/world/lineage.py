"""`enact why` and `enact impact`: where a datum comes from, and what came of it, as trees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import READER, WORLD, counted, slot_version
from enact_dist.cli.target import open_cell
from enact_dist.cli.text.output import Branch, print_tree, shown_s
from enact_dist.cli.verbs import NOUNS, Option, Output, Verb, flag, option
from enact_dist.world.lineage import FORGOTTEN, NULL, UNKNOWN

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence

    from enact_dist.world.lineage import CauseTree, EffectTree, Made

    Tree = CauseTree | EffectTree

DEPTH: Final = 3
"""Steps that are shown unless more are asked for: a screen or two."""
ALIKE_MIN: Final = 3
"""So many versions that differ in number or name alone share one line."""

_KIND: Final = {
    FORGOTTEN: "forgotten: it has left its retention",
    UNKNOWN: "its cause is not known",
    NULL: "null",
    "fork": "forked",
}


def _options(what: str, *more: Option) -> tuple[Option, ...]:
    return (
        WORLD,
        option("slot", "ENTITY/ASPECT[@VERSION]",
               "which datum; the newest version unless one is named", type=slot_version),
        counted("--depth", f"steps (default: {DEPTH})", DEPTH),
        flag("--all", f"show {what} that are alike one by one"),
        *READER,
        *more,
    )  # fmt: skip


_PIN: Final = option("--pin", "LABEL", "pin the versions of the tree until `enact world unpin`")
VERBS: Final = (
    Verb(
        "why", NOUNS["why"].summary, "show_causes",
        "enact why online system/deviation\n"
        "enact why online system/deviation@12 --depth 5 --pin incident-7",
        _options("causes", _PIN),
    ),
    Verb(
        "impact", NOUNS["impact"].summary, "show_effects",
        "enact impact training view/milk_carton/0/cloud",
        _options("effects"),
    ),
)  # fmt: skip


def show_causes(options: argparse.Namespace) -> Output:
    """Draw the tree of causes of one version."""
    with open_cell(options, observer=not options.pin) as cell:
        tree = cell.why(options.world, *options.slot, depth=options.depth)
        if options.pin:
            cell.pin(options.pin, (one for one in tree.walk() if one.known))
    return _answer(tree, options)


def show_effects(options: argparse.Namespace) -> Output:
    """Draw the tree of effects of one version."""
    with open_cell(options) as cell:
        return _answer(cell.impact(options.world, *options.slot, depth=options.depth), options)


def _answer(tree: Tree, options: argparse.Namespace) -> Output:
    alike_min = 0 if options.all else ALIKE_MIN
    return Output(lambda: facts_of(tree), lambda: print_tree(drawn(tree, alike_min=alike_min)))


def facts_of(one: Tree) -> dict[str, object]:
    """Return a tree as JSON can carry it."""
    return {
        "world": one.world,
        "entity": one.entity.name,
        "aspect": one.aspect,
        "version": one.version,
        "stamp_ns": one.position.stamp_ns,
        "shard": one.position.shard,
        "age_s": one.age_s,
        "kind": one.kind,
        "actor": one.actor,
        "host": one.host,
        "pid": one.pid,
        "captured_ns": one.stamp_ns,
        "held_s": one.held_s,
        "null_reason": one.null_reason,
        "left_out": one.left_out,
        "elsewhere": one.elsewhere,
        "unfollowed": one.unfollowed,
        "children": [facts_of(child) for child in one.children],
    }


# ---------------------------------------------------------------- lines for people


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
    parts.append(_made_by(one))
    if one.held_s:
        parts.append(f"held {shown_s(one.held_s)}")
    return "  ".join(parts)


def _label_of_many(alike: Sequence[Made]) -> str:
    parts = [_name_of_many(alike), f"{len(alike)} versions"]
    ages_s = [one.age_s for one in alike if one.position.stamp_ns]
    if ages_s:
        ages = dict.fromkeys((shown_s(min(ages_s)), shown_s(max(ages_s))))
        parts.append(f"{' to '.join(ages)} ago")
    return "  ".join([*parts, _made_by(alike[0])])


def _span(names: Iterable[str]) -> str:
    """Return the last segments of names as one: ``0…13`` where they count up, else ``*``."""
    segments = [name.rpartition("/")[2] for name in names]
    if not all(segment.isdigit() for segment in segments):
        return "*"
    numbers = sorted(map(int, segments))
    if numbers == list(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]}…{numbers[-1]}"
    return ",".join(map(str, numbers))


def _made_by(one: Made) -> str:
    said = _KIND.get(one.kind, "")
    by = f"{one.actor or '(unnamed)'}@{one.host}" if one.host else ""
    return f"{said}, {by}" if said and by else said or by
