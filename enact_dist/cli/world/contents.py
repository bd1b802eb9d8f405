"""`enact world ls|aspects|tree|get|put|create`: what the cell holds now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.text.slots import datum_output, named_if_missing, slots_output
from enact_dist.cli.verbs import Output
from enact_dist.cli.world.time import fork_facts, shown_origin
from enact_dist.config.table import suggestion
from enact_dist.terms import Entities, Entity
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    import argparse
    from collections.abc import Collection

    from enact_dist.world.cell import Cell
    from enact_dist.world.listings import AspectInfo


def list_worlds(cell: Cell, _options: argparse.Namespace) -> Output:
    """List the world contexts with what they hold."""
    facts: list[dict[str, object]] = []
    rows = []
    for name in cell.worlds():
        world = cell.world(name)
        known = [info for info in world.list_slots() if not info.null_reason]
        entities, size = len({info.entity for info in known}), sum(one.size_bytes for one in known)
        fork = fork_facts(world)
        origin = f"{fork['world']} as of {shown_origin(fork)}" if fork is not None else ""
        rows.append((name, entities, len(known), shown_bytes(size), origin))
        counts = {"entities": entities, "data": len(known), "size_bytes": size}
        facts.append({"world": name, **counts, "forked_from": fork})
    return Output(facts, rows=rows)


def list_aspects(cell: Cell, options: argparse.Namespace) -> Output:
    """List the aspects; where shards differ about one, a line for each way they know it."""
    if options.world:
        cell.world(options.world)
    infos = cell.aspects(options.world)
    return Output(infos, rows=[_aspect_row(info) for info in infos])


def _aspect_row(info: AspectInfo) -> tuple[object, ...]:
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


def show_tree(cell: Cell, options: argparse.Namespace) -> Output:
    """Show the entities of one world context as a tree, aspects as its leaves."""
    world = cell.world(options.world)
    found = world.list_slots(Entities(options.pattern))
    infos = [info for info in found if options.null or not info.null_reason]
    title = options.world
    if not found:
        known = {info.entity.name for info in world.list_slots()}
        title += _near(options.pattern, known) if known else ""
    return slots_output(title, infos)


def _near(pattern: str, known: Collection[str]) -> str:
    """Return that a pattern matches nothing, and what does or has a similar name."""
    below = sum(name.startswith(f"{pattern}/") for name in known)
    more = f"; {pattern}/** matches {below}" if below else suggestion(pattern, known)
    return f": none of its {len(known)} entities matches {pattern!r}{more}"


def get_datum(cell: Cell, options: argparse.Namespace) -> Output:
    """Print or save one datum."""
    entity, aspect = options.slot
    world = cell.world(options.world)
    with named_if_missing(world, options.slot):
        datum = world.get_untyped(Entity(entity), aspect)
    return datum_output(datum, out=options.out)


def put_datum(cell: Cell, options: argparse.Namespace) -> Output:
    """Set one datum under a write lock."""
    from enact_dist.access.lock import Lock
    from enact_dist.cli.text import literals
    from enact_dist.terms import Aspect, Write
    from enact_dist.world.cell import session_behind

    entity, name = options.slot
    world = cell.world(options.world)
    known = session_behind(cell).registered(enough=name)
    datum_type = literals.type_to_put(name, known, options.value, new=options.new)
    value = literals.read(options.value, datum_type)
    request = Write(world, Entity(entity), Aspect(name, datum_type))
    with Lock(request, wait_s=options.wait) as lock:
        version = lock.version(request) + 1
        if value is literals.NOTHING:
            del lock[request]
        else:
            lock[request] = value
    if version == 1:  # not where a context was dropped, or an aspect purged, before
        made = world.history(Entity(entity), request.aspect, count=1)
        version = max((v.version for v in made if v.position == lock.position), default=1)
    done = "is null" if value is literals.NOTHING else "set"
    return Output(
        {"world": world.name, "entity": entity, "aspect": name, "version": version},
        f"{world.name}:{entity}/{name} {done}, v{version}",
    )


def create_world(cell: Cell, options: argparse.Namespace) -> Output:
    """Make a world context; one that is there stays as it is."""
    is_new = options.world not in cell.worlds()
    cell.create_world(options.world)
    done = "is made" if is_new else "was there"
    return Output({"world": options.world, "new": is_new}, f"{options.world} {done}")
