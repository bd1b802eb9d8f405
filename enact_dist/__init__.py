"""Distributed world contexts for robots: leased, fenced, atomic locks over many data.

World contexts map (entity, aspect) to a datum or null; actors lock several data at once, readers
and writers, over any number of shards (after ENACT, an entity-aspect-actor framework).

::

    enact_dist              what a program or an actor is made of
    enact_dist.errors       the errors, drawn as a tree
    enact_dist.types        the types of what calls return, for annotations
    enact_dist.testing      actors in this process, on a manual clock
    enact_dist.recording    recordings and their replay

Everything else is internal, but for what pages of `docs/` name.

What a shard's daemon does without is loaded at its first use: the client's half would keep a
restarted shard from its clients for a fifth longer (55 ms of processor time, measured).
"""

from importlib import import_module
from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import Position
from enact_dist.terms import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Read,
    ReadEach,
    Retention,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)

if TYPE_CHECKING:
    from enact_dist.access.lock import Lock
    from enact_dist.access.together import Together
    from enact_dist.actor.actor import Actor
    from enact_dist.actor.running.process import ActorThread
    from enact_dist.comparing import Difference, Tolerance
    from enact_dist.outcome import Outcome
    from enact_dist.wire.codecs import register_codec
    from enact_dist.world.cell import Cell
    from enact_dist.world.connecting import connect, local
    from enact_dist.world.context import WorldContext

__all__ = [
    "Actor",
    "ActorThread",
    "Aspect",
    "Cell",
    "Difference",
    "Durability",
    "Entities",
    "Entity",
    "Lock",
    "Outcome",
    "Position",
    "Read",
    "ReadEach",
    "Retention",
    "Together",
    "Tolerance",
    "View",
    "ViewEach",
    "World",
    "WorldContext",
    "Write",
    "WriteEach",
    "connect",
    "local",
    "register_codec",
]

_HOME_OF = {
    "Actor": "actor.actor",
    "ActorThread": "actor.running.process",
    "Cell": "world.cell",
    "Difference": "comparing",
    "Lock": "access.lock",
    "Outcome": "outcome",
    "Together": "access.together",
    "Tolerance": "comparing",
    "WorldContext": "world.context",
    "connect": "world.connecting",
    "local": "world.connecting",
    "register_codec": "wire.codecs",
}


def __getattr__(name: str) -> object:
    """Load one of the names above at its first use."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
