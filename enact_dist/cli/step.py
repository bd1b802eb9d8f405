"""`enact replay --step`: the step of an actor that made a version, run again and compared."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING, Any

from enact_dist.cli.actor.run import actor_entry, cell_file
from enact_dist.cli.arguments import pairs, slot_version
from enact_dist.cli.target import cell_config, open_cell, see_modules
from enact_dist.cli.verbs import DIFFERENT, DONE, FAILED, Output
from enact_dist.cli.world.diff import print_diff
from enact_dist.errors import ConfigError, MisuseError
from enact_dist.terms import Aspect

if TYPE_CHECKING:
    from enact_dist.actor.actor import Actor
    from enact_dist.actor.running.step import StepResult


def run_step(options: argparse.Namespace) -> Output:
    """Run a step again; status 4 if it writes something else, 1 if it raises.

    Raises:
        ConfigError: No actor is named, or it cannot be made.
    """
    from enact_dist.actor.running.step import Step

    world, name = options.step
    try:
        entity, aspect, version = slot_version(name)
    except argparse.ArgumentTypeError as error:
        raise ConfigError(f"--step: {error}") from None
    actor, worlds = _actor(options)
    with open_cell(options, observer=False, actor="replay") as cell:
        step = Step(cell, world, entity, aspect, version)
        result = step.run(
            actor, worlds, keep_as=options.keep_as, tolerances=_tolerances(options, actor)
        )
        replaced = cell.invalidate(options.invalidate, step.made) if options.invalidate else ()
    invalidated = [{**one.slot._asdict(), "version": one.version} for one in replaced]

    def show() -> None:
        _print(result)
        for one in replaced:
            print(f"{one.slot} v{one.version} is null now")

    return Output(
        {**result.to_json(), "invalidated": invalidated},
        show,
        status=FAILED if result.error else DIFFERENT if result.differs else DONE,
    )


def _actor(options: argparse.Namespace) -> tuple[Actor, dict[str, str] | None]:
    """Return the actor that the command names, and what its roles are bound to."""
    from enact_dist.actor.running.load import load_actor
    from enact_dist.terms import Entity

    entry = actor_entry(cell_config(options), options.name) if options.name else None
    see_modules(cell_file(options))
    target = options.actor or (entry.class_path if entry is not None else "")
    if not target:
        raise ConfigError(
            "which actor is to run? --actor MODULE:CLASS, or --name NAME of cell.toml"
        )
    given: dict[str, object] = dict(pairs(options.option, "--option"))
    worlds = pairs(options.world, "--world")
    only = options.entity
    if entry is not None:
        os.environ.update(entry.env)
        given = {**entry.options, **given}
        worlds = {**entry.worlds, **worlds}
        only = only or (Entity(entry.entity) if entry.entity else None)
    actor = load_actor(target, given)
    if only is not None:
        actor.only_entity = only
    try:
        actor.declaration.check_entity(actor.only_entity)
    except MisuseError as error:
        raise ConfigError(str(error)) from None
    return actor, worlds or None


def _tolerances(options: argparse.Namespace, actor: Actor) -> dict[str, Aspect[Any]]:
    """Return the aspects that the options say how to compare."""
    names = {one.aspect.name for one in actor.declaration.requests.values()}
    allowed = dict(options.tolerance)
    if unknown := [name for name in allowed if name and name not in names]:
        raise ConfigError(
            f"--tolerance names the aspect {unknown[0]!r}; the actor has {', '.join(sorted(names))}"
        )
    chosen = {name: allowed.get(name, allowed.get("")) for name in names}
    return {
        name: Aspect(name, object, compare=one) for name, one in chosen.items() if one is not None
    }


def _print(result: StepResult) -> None:
    entity = f" for {result.entity}" if result.entity else ""
    print(
        f"{result.version}, made by {result.by}: {result.actor}.update once more{entity}, on"
        f" {result.inputs} data"
    )
    for remark in result.remarks:
        print(f"enact: {remark}", file=sys.stderr)
    if result.error:
        print(*result.traceback, sep="\n")
        print(f"update raised {result.error}")
    for diff in result.differences:
        print_diff(diff, every=True)
    if result.kept:
        for world, name in result.contexts.items():
            print(f"kept: {name}, the step in {world} (enact world drop {name})")
