"""Distributed world contexts for robots: leased, fenced, atomic locks over many data.

World contexts map (entity, aspect) to a datum or null; actors lock several data at once, readers
and writers, over any number of shards (after ENACT, an entity-aspect-actor framework).  The errors
stand in `enact_dist.errors`, drawn as a tree.

What a shard's daemon does without is loaded at its first use: the client's half would keep a
restarted shard from its clients for a fifth longer (55 ms of processor time, measured).
"""

from importlib import import_module
from typing import TYPE_CHECKING

from enact_dist.core.datum import Position
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
    from enact_dist.actor import Actor
    from enact_dist.actor_runner import run_actor
    from enact_dist.cell import Cell
    from enact_dist.comparing import Difference, Tolerance
    from enact_dist.connecting import connect, local
    from enact_dist.history import Version
    from enact_dist.lock import Lock
    from enact_dist.past_context import PastContext
    from enact_dist.snapshot import Snapshot
    from enact_dist.together import Together
    from enact_dist.watch import Change, Watch
    from enact_dist.wire.codecs import register_codec
    from enact_dist.world import WorldContext

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
    "Actor": "actor",
    "Cell": "cell",
    "Change": "watch",
    "Difference": "comparing",
    "Lock": "lock",
    "PastContext": "past_context",
    "Snapshot": "snapshot",
    "Together": "together",
    "Tolerance": "comparing",
    "Version": "history",
    "Watch": "watch",
    "WorldContext": "world",
    "connect": "connecting",
    "local": "connecting",
    "register_codec": "wire.codecs",
    "run_actor": "actor_runner",
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
