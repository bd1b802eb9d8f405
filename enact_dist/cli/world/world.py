"""`enact world ls|tree|get|put|create`; about watching, time, comparing and exports see beside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.cli.text.missing import named_if_missing
from enact_dist.cli.text.output import print_json, print_table, shown_bytes
from enact_dist.cli.text.slots import print_datum, print_slots
from enact_dist.cli.verbs import (
    DONE,
    add_noun,
    add_reader,
    add_verb,
    add_world,
    entities,
    open_cell,
    seconds,
    slot_name,
    verbs_of,
    world_name,
)
from enact_dist.cli.world import aspects as world_aspects
from enact_dist.cli.world import diff as world_diff
from enact_dist.cli.world import export as world_export
from enact_dist.cli.world import time as world_time
from enact_dist.cli.world import watch as world_watch
from enact_dist.terms import Entities, Entity

if TYPE_CHECKING:
    import argparse

    from enact_dist.cli.verbs import Verb


def add_to(nouns: argparse._SubParsersAction[Verb]) -> None:
    """Add the noun and its verbs."""
    verbs = verbs_of(add_noun(nouns, "world"))
    ls = add_verb(
        verbs, "ls", "list the world contexts of the cell", run=list_worlds,
        example="enact world ls",
    )  # fmt: skip
    add_reader(ls)
    world_aspects.add_aspects(verbs)
    _add_tree(verbs)
    _add_get(verbs)
    _add_put(verbs)
    _add_create(verbs)
    world_watch.add_watch(verbs)
    world_time.add_verbs(verbs)
    world_diff.add_diff(verbs)
    world_export.add_export(verbs)


def _add_tree(verbs: argparse._SubParsersAction[Verb]) -> None:
    tree = add_verb(
        verbs, "tree", "show the entities of a world context with their aspects", run=show_tree,
        example="enact world tree online 'tray/**'",
    )  # fmt: skip
    add_world(tree)
    _add_pattern(tree)
    tree.add_argument("--null", action="store_true", help="show slots without a datum, too")
    add_reader(tree)


def _add_pattern(verb: Verb) -> None:
    verb.add_argument(
        "pattern",
        metavar="PATTERN",
        type=entities,
        nargs="?",
        default="**",
        help="of entities (default: all)",
    )


def _add_get(verbs: argparse._SubParsersAction[Verb]) -> None:
    get = add_verb(
        verbs, "get", "print or save one datum, as last committed", run=get_datum,
        example="enact world get online system/deviation\n"
        "enact world get training product/surface --out surface.npz",
    )  # fmt: skip
    add_world(get)
    get.add_argument("slot", metavar="ENTITY/ASPECT", type=slot_name, help="which datum")
    get.add_argument(
        "--out", metavar="FILE", help="save it: .npz (arrays), .npy (one array) or .json (the rest)"
    )
    add_reader(get)


def _add_put(verbs: argparse._SubParsersAction[Verb]) -> None:
    put = add_verb(
        verbs, "put", "set one datum under a lock, checked by its aspect's type", run=put_datum,
        example="enact world put online work_bench/contact_count 3\n"
        "enact world put online camera/intrinsics @intrinsics.npy",
    )  # fmt: skip
    add_world(put)
    put.add_argument("slot", metavar="ENTITY/ASPECT", type=slot_name, help="which datum")
    put.add_argument(
        "value",
        metavar="VALUE",
        help="JSON literal (null deletes), or @FILE: .npy, .json or raw",
    )
    put.add_argument(
        "--new", action="store_true", help="register the aspect, if unknown, by the value's type"
    )
    put.add_argument(
        "--wait", type=seconds, default=10.0, metavar="S", help="for the lock (default: 10)"
    )
    add_reader(put)


def _add_create(verbs: argparse._SubParsersAction[Verb]) -> None:
    create = add_verb(
        verbs, "create", "make a world context, unless the cell has it", run=create_world,
        example="enact world create planning",
    )  # fmt: skip
    create.add_argument("world", metavar="NAME", type=world_name, help="of the world context")
    add_reader(create)


# ---------------------------------------------------------------- ls, tree


def list_worlds(arguments: argparse.Namespace) -> int:
    """Print the world contexts with what they hold."""
    with open_cell(arguments) as cell:
        rows: list[dict[str, Any]] = []
        for name in cell.worlds():
            world = cell.world(name)
            known = [info for info in world.list_slots() if not info.null_reason]
            rows.append(
                {
                    "world": name,
                    "entities": len({info.entity for info in known}),
                    "data": len(known),
                    "size_bytes": sum(info.size_bytes for info in known),
                    "forked_from": world_time.fork_facts(world),
                }
            )
    if arguments.json:
        print_json(rows)
    else:
        print_table(
            ("world", "entities", "data", "size", "fork of"),
            [_world_row(**row) for row in rows],
            empty="the cell has no world context",
        )
    return DONE


def _world_row(
    *,
    world: str,
    entities: int,
    data: int,
    size_bytes: int,
    forked_from: dict[str, object] | None,
) -> tuple[object, ...]:
    origin = ""
    if forked_from is not None:
        origin = f"{forked_from['world']} as of {world_time.shown_origin(forked_from)}"
    return world, entities, data, shown_bytes(size_bytes), origin


def show_tree(arguments: argparse.Namespace) -> int:
    """Print the entities of one world context as a tree, aspects as its leaves."""
    with open_cell(arguments) as cell:
        infos = [
            info
            for info in cell.world(arguments.world).list_slots(Entities(arguments.pattern))
            if arguments.null or not info.null_reason
        ]
    print_slots(arguments.world, infos, as_json=arguments.json)
    return DONE


# ---------------------------------------------------------------- get, put


def get_datum(arguments: argparse.Namespace) -> int:
    """Print or save one datum."""
    entity, aspect = arguments.slot
    with open_cell(arguments) as cell:
        world = cell.world(arguments.world)
        with named_if_missing(world, arguments.slot):
            datum = world.get_untyped(Entity(entity), aspect)
    print_datum(datum, out=arguments.out, as_json=arguments.json)
    return DONE


def put_datum(arguments: argparse.Namespace) -> int:
    """Set one datum under a write lock."""
    from enact_dist.access.lock import Lock
    from enact_dist.cli.text import literals
    from enact_dist.terms import Aspect, Write

    entity, name = arguments.slot
    with open_cell(arguments, observer=False) as cell:
        world = cell.world(arguments.world)
        datum_type = literals.type_to_put(
            name, cell.aspects(enough=name), arguments.value, new=arguments.new
        )
        value = literals.read(arguments.value, datum_type)
        request = Write(world, Entity(entity), Aspect(name, datum_type))
        with Lock(request, wait_s=arguments.wait) as lock:
            version = lock.version(request) + 1
            if value is literals.NOTHING:
                del lock[request]
            else:
                lock[request] = value
        if version == 1:  # not where a context was dropped, or an aspect forgotten, before
            made = world.history(Entity(entity), request.aspect, count=1)
            version = max((v.version for v in made if v.position == lock.position), default=1)
    if arguments.json:
        print_json({"world": world.name, "entity": entity, "aspect": name, "version": version})
    else:
        done = "is null" if value is literals.NOTHING else "set"
        print(f"{world.name}:{entity}/{name} {done}, v{version}")
    return DONE


def create_world(arguments: argparse.Namespace) -> int:
    """Make a world context; one that is there stays as it is."""
    with open_cell(arguments, observer=False) as cell:
        is_new = arguments.world not in cell.worlds()
        cell.create_world(arguments.world)
    if arguments.json:
        print_json({"world": arguments.world, "new": is_new})
    else:
        print(f"{arguments.world} {'is made' if is_new else 'was there'}")
    return DONE
