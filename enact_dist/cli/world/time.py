"""`enact world history|at|fork|drop|pin|pinned|unpin`: world contexts in time."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from enact_dist.cli.arguments import entities, slot_name
from enact_dist.cli.target import open_cell
from enact_dist.cli.text.output import shown_bytes
from enact_dist.cli.text.slots import datum_output, missing, named_if_missing, slots_output
from enact_dist.cli.text.times import shown_position
from enact_dist.cli.verbs import DONE, FAILED, Output
from enact_dist.errors import ConfigError, ForgottenError
from enact_dist.link.refusals import moment_name
from enact_dist.terms import Aspect, Entity
from enact_dist.world.trees import shown_s

if TYPE_CHECKING:
    from enact_dist.world.cell import Cell
    from enact_dist.world.context import Version, WorldContext


def show_history(cell: Cell, options: argparse.Namespace) -> Output:
    """List the known versions of one datum, oldest first.

    Raises:
        NullDatumError: There are no versions: nothing was ever set there.
    """
    entity, aspect = options.slot
    world = cell.world(options.world)
    versions = world.history(
        Entity(entity), Aspect(aspect, object), since=options.since, count=options.count
    )
    if not versions:
        raise missing(world, options.slot)
    return Output([_facts(version) for version in versions], rows=[*map(_row, versions)])


def _row(version: Version[Any]) -> tuple[str, ...]:
    stamp_ns = version.position.stamp_ns
    size = shown_bytes(version.size_bytes) if version.size_bytes else ""
    notes = [f"null: {version.null_reason}"] if version.null_reason else []
    notes += [f"pinned as {', '.join(version.pinned)}"] if version.pinned else []
    return (
        f"v{version.version}",
        moment_name(stamp_ns),
        shown_s(max(0.0, time.time() - stamp_ns / 1e9)),
        size,
        _actor(version),
        shown_position(version.position),
        "; ".join(notes),
    )


def _actor(version: Version[Any]) -> str:
    cause = version.cause
    if cause is None:
        return "?"
    return f"{cause.actor or 'client'}@{cause.host}" + (" (fork)" if cause.kind == "fork" else "")


def _facts(version: Version[Any]) -> dict[str, object]:
    cause = version.cause
    return {
        "world": version.world.name,
        "entity": version.entity.name,
        "aspect": version.aspect.name,
        "version": version.version,
        "stamp_ns": version.position.stamp_ns,
        "shard": version.position.shard,
        "until_ns": version.until_ns,
        "captured_ns": version.stamp_ns,
        "size_bytes": version.size_bytes,
        "null_reason": version.null_reason,
        "kept": list(version.pinned),
        "cause": None
        if cause is None
        else {"kind": cause.kind, "actor": cause.actor, "host": cause.host, "pid": cause.pid},
    }


def show_past(options: argparse.Namespace) -> Output:
    """Show a tree of a past world context, or one datum of it.

    Raises:
        ConfigError: No datum is named, the name is invalid, or a tree would be saved.
    """
    gets = options.what == "get"
    if options.out and not gets:
        raise ConfigError(
            "--out saves one datum: world at WORLD TIME get ENTITY/ASPECT --out FILE; world export"
            " --at TIME saves a whole context"
        )
    if gets and options.name is None:
        raise ConfigError("which datum? world at WORLD TIME get ENTITY/ASPECT")
    try:
        slot = slot_name(options.name) if gets else ("", "")
        pattern = "" if gets else entities(options.name or "**")
    except argparse.ArgumentTypeError as error:
        raise ConfigError(f"which {'datum' if gets else 'entities'}? {error}") from None
    with open_cell(options) as cell:
        past = cell.world(options.world).at(options.moment)
        if not gets:
            title = f"{past.name} at {moment_name(past.at_ns)}"
            return slots_output(title, past.list_slots(pattern), at_ns=past.at_ns)
        with named_if_missing(past, slot):
            datum = past.get_untyped(Entity(slot[0]), slot[1])
    return datum_output(datum, out=options.out)


# ---------------------------------------------------------------- fork, drop


def fork_world(cell: Cell, options: argparse.Namespace) -> Output:
    """Fork a world context and say as of when."""
    fork = cell.world(options.world).fork(options.name, at=options.at)
    facts = fork_facts(fork)
    text = ""
    if facts is not None:
        text = f"{fork.name} is a fork of {options.world} as of {shown_origin(facts)}"
    return Output({"world": fork.name, "forked_from": facts}, text)


def fork_facts(world: WorldContext) -> dict[str, object] | None:
    """Return the source and the moment of a fork; None: it is no fork."""
    origin = world.forked_from
    return {"world": origin[0], "at_ns": origin[1]} if origin is not None else None


def shown_origin(facts: dict[str, object]) -> str:
    """Return as of when a fork was made, for people."""
    return moment_name(int(str(facts["at_ns"])))


def drop_world(cell: Cell, options: argparse.Namespace) -> Output:
    """Drop a world context."""
    slots = cell.drop_world(options.world)
    facts = {"world": options.world, "slots": slots}
    return Output(facts, f"{options.world} is dropped, with {slots} slots")


# ---------------------------------------------------------------- pin, pinned, unpin


def pin_versions(cell: Cell, options: argparse.Namespace) -> Output:
    """Pin versions of slots of one world context under a label.

    Raises:
        ForgottenError: A version is not known (any more).
    """
    world = cell.world(options.world)
    versions = [_version(world, *named) for named in options.slots]
    cell.pin(options.label, versions)
    lines = (f"{one.slot} v{one.version} is pinned as {options.label}" for one in versions)
    return Output([_facts(version) for version in versions], "\n".join(lines))


def _version(world: WorldContext, entity: str, aspect: str, number: int) -> Version[Any]:
    found = world.history(Entity(entity), Aspect(aspect, object))
    for version in reversed(found):
        if version.version == number or not number:
            return version
    known = ", ".join(f"v{version.version}" for version in found) or "none"
    asked = f"version {number}" if number else "version"
    raise ForgottenError(
        f"{world.name}:{entity}/{aspect} has no {asked} that is known; known: {known}",
        oldest_ns=found[0].position.stamp_ns if found else 0,
    )


def list_pinned(cell: Cell, _options: argparse.Namespace) -> Output:
    """List the pinned versions by label."""
    pinned = cell.pinned()
    rows = [(label, str(one.slot), *_row(one)[:4]) for label in pinned for one in pinned[label]]
    return Output({label: [*map(_facts, pinned[label])] for label in pinned}, rows=rows)


def unpin_label(cell: Cell, options: argparse.Namespace) -> Output:
    """Release the versions of a label; status 1 if it has none."""
    label, pinned = options.label, cell.pinned()
    count = len(pinned.get(label, ()))
    cell.unpin(label)
    text = f"{label}: {count} versions released"
    if not count:
        text = f"nothing is pinned as {label}; labels: {', '.join(pinned) or 'none'}"
    return Output({"label": label, "versions": count}, text, status=DONE if count else FAILED)
