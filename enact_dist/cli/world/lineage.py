"""`enact why`, `impact`, `invalidate`: where a datum comes from, what came of it, its end."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final

from enact_dist.cli.arguments import (
    READER,
    WORLD,
    counted,
    file_of,
    label,
    seconds_of,
    slot_version,
)
from enact_dist.cli.target import open_cell
from enact_dist.cli.verbs import NOUNS, Option, Output, Verb, flag, option
from enact_dist.errors import ConfigError
from enact_dist.terms import NAME_LENGTH_MAX
from enact_dist.world.trees import ALIKE_MIN, drawn, print_tree

if TYPE_CHECKING:
    import argparse

    from enact_dist.world.lineage import CauseTree, EffectTree

    Tree = CauseTree | EffectTree

DEPTH: Final = 3
"""Steps that are shown unless more are asked for: a screen or two."""


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


_RECORDING: Final = file_of(
    "--recording", "FILE.mcap", "ask a recording, and no cell; its end is what ages count to"
)
_PIN: Final = option(
    "--pin", "LABEL", "pin the versions of the tree until `enact world unpin`", type=label
)
VERBS: Final = (
    Verb(
        "why", NOUNS["why"].summary, "show_causes",
        "enact why online system/deviation\n"
        "enact why online system/deviation@12 --depth 5 --pin incident-7\n"
        "enact why online system/deviation@12 --recording run.mcap",
        _options("causes", _RECORDING, _PIN),
    ),
    Verb(
        "impact", NOUNS["impact"].summary, "show_effects",
        "enact impact training view/milk_carton/0/cloud\n"
        "enact impact online camera/1/image@7 --recording run.mcap",
        _options("effects", _RECORDING),
    ),
    Verb(
        "invalidate", NOUNS["invalidate"].summary, "invalidate_version",
        "enact invalidate online camera/3/calibration@12 --label bad-calibration --dry-run\n"
        "enact invalidate online camera/3/calibration@12 --label bad-calibration",
        (
            *_options("effects")[:2],
            option("--label", "LABEL", "pin all of it until `enact world unpin LABEL`",
                   type=label, required=True),
            flag("--dry-run", "show the tree of effects, and change nothing"),
            seconds_of("--wait", "how long to wait for the lock (default: 10)", 10.0),
            *READER,
        ),
    ),
)  # fmt: skip


def show_causes(options: argparse.Namespace) -> Output:
    """Draw the tree of causes of one version."""
    if options.recording:
        return _answer(_recorded(options), options)
    with open_cell(options, observer=not options.pin) as cell:
        tree = cell.why(options.world, *options.slot, depth=options.depth)
        if options.pin:
            cell.pin(options.pin, (one for one in tree.walk() if one.known))
    return _answer(tree, options)


def show_effects(options: argparse.Namespace) -> Output:
    """Draw the tree of effects of one version."""
    if options.recording:
        return _answer(_recorded(options), options)
    with open_cell(options) as cell:
        return _answer(cell.impact(options.world, *options.slot, depth=options.depth), options)


def invalidate_version(options: argparse.Namespace) -> Output:
    """Pin a version and what was made of it, and replace what is shown of it by null."""
    if options.dry_run:
        options.depth, options.all, options.recording = None, False, None
        return show_effects(options)
    actor = f"invalidate/{options.label}"[:NAME_LENGTH_MAX].rstrip("/")
    with open_cell(options, observer=False, actor=actor) as cell:
        entity, aspect, version = options.slot
        wrong = cell.why(options.world, entity, aspect, version, depth=0)
        replaced = cell.invalidate(options.label, wrong, wait_s=options.wait)
    lines = [f"{one.slot} v{one.version} is null now" for one in replaced]
    what = f"pinned under {options.label}: {wrong.slot} v{wrong.version} and what was made of it"
    return Output([facts_of(one) | {"children": []} for one in replaced], "\n".join([*lines, what]))


def _recorded(options: argparse.Namespace) -> Tree:
    """Return a tree of a recording; say on standard error what the file lacks.

    Raises:
        ConfigError: An option is one of a cell, or the file cannot be read or is no recording.
        MisuseError: The recording does not have this version, or names no causes.
    """
    if getattr(options, "pin", None):
        raise ConfigError(
            "--pin keeps versions in a cell beyond their retention; --recording asks a file, which"
            " forgets none"
        )
    if options.cell:
        raise ConfigError("--cell and --recording: name the one that is to be asked")
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.recording.causes import RecordedSearch
    from enact_dist.world.lineage import CauseTree, EffectTree, grown

    search = RecordedSearch(options.recording)
    entity, aspect, version = options.slot
    root = search.start(Slot(options.world, entity, aspect), version)
    for lacking in search.lacks():
        print(f"enact: {lacking}", file=sys.stderr)
    if options.noun == "why":
        return grown(CauseTree, search, root, options.depth)
    return grown(EffectTree, search, root, options.depth)


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
