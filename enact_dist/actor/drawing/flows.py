"""What flows from actor to actor, by their declarations: capture stamps, and streams.

A source stamps its data with its tick.  Actors that it triggers write with the same stamp, and so
do the actors that these trigger.  A declaration does not show how often a triggered actor writes.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Final

from enact_dist.actor.drawing.uses import Finding

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from enact_dist.actor.drawing.uses import ActorDeclaration, Use

STREAM_S: Final = 0.1
"""Data that are written this often, or more often, are a stream."""


def unstamped_sets(uses: Sequence[Use]) -> Iterator[Finding]:
    """Find data of a `Together` whose writers are known and set no capture stamp."""
    stamping = _stamping(uses)
    for use in uses:
        together = use.actor.actor_class.declaration.together
        if together is None or use.request not in together.requests:
            continue
        writers = _writers(use, uses)
        if not writers or any(writer.actor.name in stamping for writer in writers):
            continue
        writer = writers[0]
        why = (
            "runs once" if not writer.actor.actor_class.declaration.triggers
            else "is triggered by data without one"
        )  # fmt: skip
        yield Finding(
            "warning",
            "set without stamps",
            (use.actor.name, writer.actor.name),
            f"{use} waits for data with equal capture stamps, but {writer} writes them without one:"
            f" {writer.actor.name} {why}, and its module never uses stamp_ns; call"
            " lock.put(…, stamp_ns=…), or let a source or stamped data trigger it",
        )


def streams(uses: Sequence[Use], said: Collection[str]) -> Iterator[Finding]:
    """Find aspects that actors write often and that are durable only by default.

    Args:
        uses: All requests of the cell.
        said: Names of the aspects whose durability `cell.toml` sets.
    """
    told = {use.request.aspect.name for use in uses if use.request.aspect.durability} | set(said)
    for use in uses:
        period_s, aspect = use.actor.period_s, use.request.aspect.name
        if period_s is None or period_s > STREAM_S:
            continue
        if not use.request.access.writes or aspect in told:
            continue
        told.add(aspect)
        yield Finding(
            "advice",
            "durable stream",
            (use.actor.name,),
            f"{use} may be written {1 / period_s:.3g} times a second, and each write is forced to"
            " the disk, because no durability is set; if each datum replaces the one before, write"
            f' [aspects.{aspect}] durability = "volatile" in cell.toml (or in Aspect(…)), else'
            ' "os" or "durable" to confirm that this is intended',
        )


def _stamping(uses: Sequence[Use]) -> set[str]:
    """Return the names of the actors whose data bear a capture stamp, or may."""
    found = {
        use.actor.name for use in uses if use.actor.period_s is not None or _says_stamps(use.actor)
    }
    while True:
        more = {
            use.actor.name
            for use in uses
            if _triggers(use) and use.actor.name not in found and _is_stamped(use, uses, found)
        }
        if not more:
            return found
        found |= more


def _is_stamped(use: Use, uses: Sequence[Use], stamping: Collection[str]) -> bool:
    """Whether what triggers through a request has a stamp; of outside writers it may."""
    writers = _writers(use, uses)
    return not writers or any(writer.actor.name in stamping for writer in writers)


def _says_stamps(actor: ActorDeclaration) -> bool:
    module = inspect.getmodule(actor.actor_class)
    try:
        return "stamp_ns" in inspect.getsource(module or actor.actor_class)
    except (OSError, TypeError):
        return True  # its source is not here: assume that it does


def _triggers(use: Use) -> bool:
    return use.request in use.actor.actor_class.declaration.triggers


def _writers(use: Use, uses: Sequence[Use]) -> list[Use]:
    return [one for one in uses if one.request.access.writes and one.meets(use)]
