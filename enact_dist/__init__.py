"""Distributed world contexts for robots: leased, fenced, atomic locks over many data.

World contexts map (entity, aspect) to a datum or null; actors lock several data at once, readers
and writers, over any number of shards (after ENACT, an entity-aspect-actor framework).  The errors
stand in `enact_dist.errors`, drawn as a tree.

What a shard's daemon does without is loaded at its first use: the client's half would keep a
restarted shard from its clients for a fifth longer (55 ms of processor time, measured).
"""

from importlib import import_module
from typing import TYPE_CHECKING

from enact_dist.core.protocol.datum import Position
from enact_dist.terms import (
    NULL,
    Aspect,
    Durability,
    Entities,
    Entity,
    NullReason,
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
    from enact_dist.access.snapshot import Snapshot
    from enact_dist.access.together import Together
    from enact_dist.access.watch import Change, Watch
    from enact_dist.actor.actor import Actor
    from enact_dist.actor.running.runner import run_actor
    from enact_dist.comparing import Difference, Tolerance
    from enact_dist.wire.codecs import register_codec
    from enact_dist.world.cell import Cell
    from enact_dist.world.connecting import connect, local
    from enact_dist.world.context import Version, WorldContext
    from enact_dist.world.past import PastContext

__all__ = [
    "NULL",
    "Actor",
    "Aspect",
    "Cell",
    "Change",
    "Difference",
    "Durability",
    "Entities",
    "Entity",
    "Lock",
    "NullReason",
    "PastContext",
    "Position",
    "Read",
    "ReadEach",
    "Retention",
    "Snapshot",
    "Together",
    "Tolerance",
    "Version",
    "View",
    "ViewEach",
    "Watch",
    "World",
    "WorldContext",
    "Write",
    "WriteEach",
    "connect",
    "local",
    "register_codec",
    "run_actor",
]

_HOME_OF = {
    "Actor": "actor.actor",
    "Cell": "world.cell",
    "Change": "access.watch",
    "Difference": "comparing",
    "Lock": "access.lock",
    "PastContext": "world.past",
    "Snapshot": "access.snapshot",
    "Together": "access.together",
    "Tolerance": "comparing",
    "Version": "world.context",
    "Watch": "access.watch",
    "WorldContext": "world.context",
    "connect": "world.connecting",
    "local": "world.connecting",
    "register_codec": "wire.codecs",
    "run_actor": "actor.running.runner",
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
