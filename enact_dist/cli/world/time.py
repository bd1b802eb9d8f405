"""`enact world history|at|fork|drop|keep|kept|let-go`: world contexts in time."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from enact_dist.cli.text.missing import missing, named_if_missing
from enact_dist.cli.text.output import print_json, print_table, shown_bytes, shown_s
from enact_dist.cli.text.slots import print_datum, print_slots
from enact_dist.cli.text.times import MOMENT_HELP, moment, shown_position
from enact_dist.cli.verbs import (
    DONE,
    FAILED,
    add_reader,
    add_verb,
    add_world,
    entities,
    open_cell,
    slot_name,
    slot_version,
    whole,
)
from enact_dist.errors import ConfigError, ForgottenError
from enact_dist.link.refusals import moment_name
from enact_dist.terms import Aspect, Entity

if TYPE_CHECKING:
    from enact_dist.cli.verbs import Verb
    from enact_dist.world.context import Version, WorldContext


def add_verbs(verbs: argparse._SubParsersAction[Verb]) -> None:
    """Add the verbs about time to the noun `world`."""
    _add_history(verbs)
    _add_at(verbs)
    _add_fork_and_drop(verbs)
    _add_keeping(verbs)


def _add_history(verbs: argparse._SubParsersAction[Verb]) -> None:
    history = add_verb(
        verbs, "history", "list the versions of a datum that are still known", run=show_history,
        example="enact world history online system/deviation\n"
        "enact world history online system/deviation --since -5min --count 20",
    )  # fmt: skip
    add_world(history)
    history.add_argument("slot", metavar="ENTITY/ASPECT", type=slot_name, help="which datum")
    history.add_argument("--count", type=whole, metavar="N", help="only the newest N")
    history.add_argument(
        "--since", type=moment, metavar="TIME", help="only what was current after it"
    )
    add_reader(history)


def _add_at(verbs: argparse._SubParsersAction[Verb]) -> None:
    at = add_verb(
        verbs, "at", "show a world context as it was", run=show_past,
        example="enact world at online -30s\n"
        "enact world at online 2026-11-21T10:00:00 tree 'tray/**'\n"
        "enact world at online -30s get system/deviation --json",
    )  # fmt: skip
    add_world(at)
    at.add_argument("moment", metavar="TIME", type=moment, help=MOMENT_HELP)
    at.add_argument(
        "what", nargs="?", choices=("tree", "get"), default="tree", help="(default: tree)"
    )
    at.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        help="a pattern of entities (default: all), or ENTITY/ASPECT for get",
    )
    at.add_argument(
        "--out", metavar="FILE", help="save a datum: .npz (arrays), .npy (one array) or .json"
    )
    add_reader(at)


def _add_fork_and_drop(verbs: argparse._SubParsersAction[Verb]) -> None:
    fork = add_verb(
        verbs, "fork", "make another world context with the data of one", run=fork_world,
        example="enact world fork online what_if\n"
        "enact world fork online what_if --at -30s",
    )  # fmt: skip
    add_world(fork)
    fork.add_argument("name", metavar="NAME", help="of the new world context")
    fork.add_argument("--at", type=moment, metavar="TIME", help=f"as it was; {MOMENT_HELP}")
    add_reader(fork)
    drop = add_verb(
        verbs, "drop", "forget a world context with all its data and their history", run=drop_world,
        example="enact world drop what_if",
    )  # fmt: skip
    add_world(drop)
    add_reader(drop)


def _add_keeping(verbs: argparse._SubParsersAction[Verb]) -> None:
    keep = add_verb(
        verbs, "keep", "keep versions from being forgotten, under a label", run=keep_versions,
        example="enact world keep drop-17 online tray/package/3/surface@12 system/deviation",
    )  # fmt: skip
    keep.add_argument("label", metavar="LABEL", help="what let-go names")
    add_world(keep)
    keep.add_argument(
        "slots",
        metavar="ENTITY/ASPECT[@VERSION]",
        nargs="+",
        type=slot_version,
        help="which versions; of a slot the newest unless one is named",
    )
    add_reader(keep)
    kept = add_verb(
        verbs, "kept", "list the versions that labels keep", run=list_kept,
        example="enact world kept",
    )  # fmt: skip
    add_reader(kept)
    let_go = add_verb(
        verbs, "let-go", "release the versions that a label keeps", run=let_go_of,
        example="enact world let-go drop-17",
    )  # fmt: skip
    let_go.add_argument("label", metavar="LABEL", help="as `enact world kept` lists it")
    add_reader(let_go)


# ---------------------------------------------------------------- history


def show_history(arguments: argparse.Namespace) -> int:
    """Print the known versions of one datum, oldest first.

    Raises:
        NullDatumError: There are no versions: nothing was ever set there.
    """
    entity, aspect = arguments.slot
    with open_cell(arguments) as cell:
        world = cell.world(arguments.world)
        versions = world.history(
            Entity(entity), Aspect(aspect, object), since=arguments.since, count=arguments.count
        )
        if not versions:
            raise missing(world, arguments.slot)
    if arguments.json:
        print_json([_facts(version) for version in versions])
    else:
        print_table(
            ("version", "time", "age", "size", "actor", "position", ""),
            [_row(version) for version in versions],
            empty="",
        )
    return DONE


def _row(version: Version[Any]) -> tuple[str, ...]:
    stamp_ns = version.position.stamp_ns
    size = shown_bytes(version.size_bytes) if version.size_bytes else ""
    notes = [f"null: {version.null_reason}"] if version.null_reason else []
    notes += [f"kept as {', '.join(version.pinned)}"] if version.pinned else []
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


# ---------------------------------------------------------------- at


def show_past(arguments: argparse.Namespace) -> int:
    """Print a tree of a past world context, or one datum of it.

    Raises:
        ConfigError: No datum is named, the name is invalid, or a tree would be saved.
    """
    gets = arguments.what == "get"
    if arguments.out and not gets:
        raise ConfigError(
            "--out saves one datum: world at WORLD TIME get ENTITY/ASPECT --out FILE; world export"
            " --at TIME saves a whole context"
        )
    if gets and arguments.name is None:
        raise ConfigError("which datum? world at WORLD TIME get ENTITY/ASPECT")
    try:
        slot = slot_name(arguments.name) if gets else ("", "")
        pattern = "" if gets else entities(arguments.name or "**")
    except argparse.ArgumentTypeError as error:
        raise ConfigError(f"which {'datum' if gets else 'entities'}? {error}") from None
    with open_cell(arguments) as cell:
        past = cell.world(arguments.world).at(arguments.moment)
        if gets:
            with named_if_missing(past, slot):
                datum = past.get_untyped(Entity(slot[0]), slot[1])
            print_datum(datum, out=arguments.out, as_json=arguments.json)
            return DONE
        infos = past.list_slots(pattern)
    title = f"{past.name} at {moment_name(past.at_ns)}"
    print_slots(title, infos, as_json=arguments.json, at_ns=past.at_ns)
    return DONE


# ---------------------------------------------------------------- fork, drop


def fork_world(arguments: argparse.Namespace) -> int:
    """Fork a world context and say as of when."""
    with open_cell(arguments, observer=False) as cell:
        fork = cell.world(arguments.world).fork(arguments.name, at=arguments.at)
        facts = fork_facts(fork)
    if arguments.json:
        print_json({"world": fork.name, "forked_from": facts})
    elif facts is not None:
        print(f"{fork.name} is a fork of {arguments.world} as of {shown_origin(facts)}")
    return DONE


def fork_facts(world: WorldContext) -> dict[str, object] | None:
    """Return the source and the moment of a fork; None: it is no fork."""
    origin = world.forked_from
    return {"world": origin[0], "at_ns": origin[1]} if origin is not None else None


def shown_origin(facts: dict[str, object]) -> str:
    """Return as of when a fork was made, for people."""
    return moment_name(int(str(facts["at_ns"])))


def drop_world(arguments: argparse.Namespace) -> int:
    """Drop a world context."""
    with open_cell(arguments, observer=False) as cell:
        slots = cell.drop_world(arguments.world)
    if arguments.json:
        print_json({"world": arguments.world, "slots": slots})
    else:
        print(f"{arguments.world} is dropped, with {slots} slots")
    return DONE


# ---------------------------------------------------------------- keep, kept, let-go


def keep_versions(arguments: argparse.Namespace) -> int:
    """Keep versions of slots of one world context under a label.

    Raises:
        ForgottenError: A version is not known (any more).
    """
    with open_cell(arguments, observer=False) as cell:
        world = cell.world(arguments.world)
        versions = [_version(world, *named) for named in arguments.slots]
        cell.pin(arguments.label, versions)
    if arguments.json:
        print_json([_facts(version) for version in versions])
    else:
        for version in versions:
            print(f"{version.slot} v{version.version} is kept as {arguments.label}")
    return DONE


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


def list_kept(arguments: argparse.Namespace) -> int:
    """Print what labels keep."""
    with open_cell(arguments) as cell:
        kept = cell.pinned()
    if arguments.json:
        print_json({label: [_facts(each) for each in versions] for label, versions in kept.items()})
        return DONE
    print_table(
        ("label", "datum", "version", "time", "age", "size"),
        [
            (label, str(version.slot), *_row(version)[:4])
            for label, versions in kept.items()
            for version in versions
        ],
        empty="no version is kept under a label",
    )
    return DONE


def let_go_of(arguments: argparse.Namespace) -> int:
    """Release the versions of a label; status 1 if it keeps none."""
    with open_cell(arguments, observer=False) as cell:
        kept = cell.pinned()
        versions = kept.get(arguments.label, ())
        cell.unpin(arguments.label)
    if arguments.json:
        print_json({"label": arguments.label, "versions": len(versions)})
    elif versions:
        print(f"{arguments.label}: {len(versions)} versions released")
    else:
        print(f"nothing is kept as {arguments.label}; labels: {', '.join(kept) or 'none'}")
    return DONE if versions else FAILED
