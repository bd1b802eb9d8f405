"""Distributed world contexts for robots: leased, fenced, atomic locks over many data.

World contexts map (entity, aspect) to a datum or null; actors lock several data at once, readers
and writers, over any number of shards (after ENACT, an entity-aspect-actor framework).  The errors
stand in `enact_dist.errors`, drawn as a tree.
"""

from enact_dist.actor import Actor
from enact_dist.actor_runner import run_actor
from enact_dist.cell import Cell
from enact_dist.connecting import connect, local
from enact_dist.core.datum import Position
from enact_dist.lock import Lock
from enact_dist.terms import (
    NULL,
    Aspect,
    Durability,
    Entities,
    Entity,
    NullReason,
    Read,
    ReadEach,
    View,
    ViewEach,
    World,
    Write,
    WriteEach,
)
from enact_dist.watch import Change, Watch
from enact_dist.wire.codecs import register_codec
from enact_dist.world import Snapshot, WorldContext

__all__ = [
    "NULL",
    "Actor",
    "Aspect",
    "Cell",
    "Change",
    "Durability",
    "Entities",
    "Entity",
    "Lock",
    "NullReason",
    "Position",
    "Read",
    "ReadEach",
    "Snapshot",
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
