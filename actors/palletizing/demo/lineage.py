"""What a demonstration shows of lineage: where its last verdict comes from, what came of a view."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Final

from actors.palletizing.handling.expectation import last_forks
from actors.palletizing.vocabulary import (
    CANDIDATE,
    CLOUD,
    DEVIATIONS,
    NET,
    PLACES,
    REGION,
    REQUEST,
    RESULTS,
    STANDING,
    SYSTEM,
    view_entity,
)
from enact_dist import Entity, View
from enact_dist.world.trees import drawn, print_tree

if TYPE_CHECKING:
    from collections.abc import Collection

    from rich.console import Console

    from enact_dist import Cell
    from enact_dist.types import CauseTree, EffectTree

CAUSES_DEPTH: Final = 2
"""From the verdict over its depth frame and the model to the views."""
EFFECTS_DEPTH: Final = 3
"""From the cloud of a view over its surface and the model to the verdicts."""


def verdict_causes(cell: Cell) -> CauseTree:
    """Return where the newest verdict comes from, back to the depth frame and to the views."""
    return cell.why("online", SYSTEM, DEVIATIONS, depth=CAUSES_DEPTH)


def view_effects(cell: Cell, product: str) -> EffectTree:
    """Return what came of the first view of a product, on to the verdicts that rest on it."""
    return cell.impact("training", view_entity(product, 0), CLOUD, depth=EFFECTS_DEPTH)


def show_lineage(cell: Cell, product: str, console: Console) -> None:
    """Print both trees under the commands that print them."""
    verdict, view = f"{SYSTEM}/{DEVIATIONS}", f"{view_entity(product, 0)}/{CLOUD}"
    console.print(f"enact why online {verdict} --depth {CAUSES_DEPTH}", style="bold")
    print_tree(drawn(verdict_causes(cell)))
    console.print(f"\nenact impact training {view} --depth {EFFECTS_DEPTH}", style="bold")
    print_tree(drawn(view_effects(cell, product)))
    console.print()


WHY_DEPTH: Final = 6
"""From the region over the depth picture and the nets to the grasp."""
WAY: Final = ("observation", "net", "candidate", "request", "grasp", "plan")
"""What is shown of all these causes."""


def show_packing(cell: Cell, console: Console) -> None:
    """Print what was expected and did not come, and where one such verdict comes from."""
    online = cell.world("online")
    results, flags = View(online, SYSTEM, RESULTS), View(online, SYSTEM, DEVIATIONS)
    seen = online.view(results, flags)
    judged = {place: flag for place, flag in seen.get(flags, {}).items() if place in seen[results]}
    for name in last_forks(cell):
        for row in cell.world(name).diff(online, PLACES, STANDING):
            if row.left is not None and row.right is not None:
                console.print(f"{name} against online: {row.entity.name}: {row.difference}")
    bad = [place for place in judged if seen[results][place].result != "placed"]
    place = Entity((bad or list(judged))[-1]) if judged else None
    if place is None:
        return
    console.print(f"\nenact why online {place}/{REGION} --depth {WHY_DEPTH}", style="bold")
    console.print(f"of it, the way over {', '.join(WAY)}:")
    tree = cell.why(online, place, REGION, depth=WHY_DEPTH)
    entities = (place.name, f"product/{judged[place.name].product}", SYSTEM.name)
    print_tree(drawn(way_of(tree, entities, _of_other_places(cell, place.name))))
    console.print()


def _of_other_places(cell: Cell, place: str) -> set[tuple[str, int]]:
    """Return aspect and version of all requests, candidates and nets for other places."""
    online = cell.world("online")
    requests = {made.version: made.datum() for made in online.history(SYSTEM, REQUEST)}
    others = {each.number for each in requests.values() if each.place != place}
    candidates = online.history(SYSTEM, CANDIDATE)
    return {
        *((str(REQUEST), version) for version, each in requests.items() if each.place != place),
        *((str(CANDIDATE), made.version) for made in candidates if made.datum().request in others),
        *(
            (str(NET), made.version)
            for made in online.history(SYSTEM, NET)
            if made.datum().request in others
        ),
    }


def way_of(
    tree: CauseTree, entities: tuple[str, ...], left_out: Collection[tuple[str, int]]
) -> CauseTree:
    """Return a tree of causes without what is not on the way from picture over net to grasp.

    Args:
        tree: Of all causes.
        entities: Whose data are shown.
        left_out: Aspect and version of what is not shown.
    """
    whole = {_slot(cause): cause for cause in tree.walk()}
    shown: set[tuple[str, str, str, int]] = set()

    def part(cause: CauseTree) -> CauseTree:
        children = []
        for child in cause.children:
            on_it = child.aspect in WAY and child.entity.name in entities
            on_it = on_it and (child.aspect, child.version) not in left_out
            if on_it and child.aspect != cause.aspect and _slot(child) not in shown:
                shown.add(_slot(child))
                children.append(part(whole.get(_slot(child), child)))
        return dataclasses.replace(cause, children=tuple(children), elsewhere=False, unfollowed=0)

    return part(tree)


def _slot(cause: CauseTree) -> tuple[str, str, str, int]:
    return cause.world, cause.entity.name, cause.aspect, cause.version
