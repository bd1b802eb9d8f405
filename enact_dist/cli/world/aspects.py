"""`enact world aspects`: which aspects the cell knows, and how much there is of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.cli.text.output import print_json, print_table, shown_bytes, shown_s
from enact_dist.cli.verbs import DONE, add_reader, add_verb, open_cell

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb
    from enact_dist.world.listings import AspectInfo


def add_aspects(verbs: argparse._SubParsersAction[Verb]) -> None:
    """Add the verb to the noun `world`."""
    aspects = add_verb(
        verbs,
        "aspects",
        "list the registered aspects: types, durability, what is retained of each slot, how many"
        " slots there are",
        run=list_aspects,
        example="enact world aspects\nenact world aspects online --json",
    )
    aspects.add_argument(
        "world",
        metavar="WORLD",
        nargs="?",
        default="",
        help="count slots of this world context only (default: of all)",
    )
    add_reader(aspects)


def list_aspects(arguments: argparse.Namespace) -> int:
    """Print the aspects; where shards differ about one, a line for each way they know it."""
    with open_cell(arguments) as cell:
        if arguments.world:
            cell.world(arguments.world)
        infos = cell.aspect_infos(arguments.world)
    if arguments.json:
        print_json(infos)
    else:
        print_table(
            ("aspect", "slots", "data", "size", "durability", "retained", "shards", "type"),
            [_row(info) for info in infos],
            empty="the cell knows no aspect",
        )
    return DONE


def _row(info: AspectInfo) -> tuple[object, ...]:
    return (
        info.aspect,
        info.slots,
        info.data,
        shown_bytes(info.size_bytes),
        info.durability or "-",
        _retained(info) if info.type else "-",
        ", ".join(info.shards),
        (info.type or "-") + (f" (older: {len(info.older_types)})" if info.older_types else ""),
    )


def _retained(info: AspectInfo) -> str:
    limits = (
        f"{info.versions} versions" if info.versions is not None else "",
        shown_s(info.age_s) if info.age_s is not None else "",
        shown_bytes(info.history_bytes) if info.history_bytes is not None else "",
    )
    return ", ".join(filter(None, limits)) or "all"
