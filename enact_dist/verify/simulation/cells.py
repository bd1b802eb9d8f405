"""The cell of a run: how many shards and clients there are and what may go wrong in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from enact_dist.verify.simulation import faults as fault_options
from enact_dist.verify.simulation.hosts.world import MS, S

if TYPE_CHECKING:
    from random import Random

    from enact_dist.verify.simulation.faults import Faults

CONTEXTS = ("training", "online")
"""The world contexts that every shard is configured with."""
FAULTS_NS = 20 * S
"""How long faults go on."""
WORK_NS = 25 * S
"""How long new locks are begun."""


@dataclass(frozen=True, slots=True)
class CellPlan:
    """What a seed draws first.

    Attributes:
        lanes: Threads of each client.
        entities: How many entities most locks choose from; with one nearly all of them collide.
        work_ns: How long new locks are begun.  Some runs end in the middle of the faults, so that
            nothing that comes later repairs them.
    """

    shards: int
    clients: int
    lanes: int
    entities: int
    ttl_ns: int
    work_ns: int
    faults: Faults


def drawn(random: Random, *, faults: Faults | None = None) -> CellPlan:
    """Draw a cell; with `faults`, those instead of drawn ones."""
    shards = random.choice((1, 2, 2, 3))
    some = fault_options.drawn(random, shards=shards)
    return CellPlan(
        shards=shards,
        clients=random.choice((2, 3, 4, 5)),
        lanes=random.choice((1, 2, 2, 3)),
        entities=random.choice((1, 2, 3, 4)),
        ttl_ns=random.choice((500 * MS, S, 2 * S)),
        work_ns=random.choice((WORK_NS, FAULTS_NS - S // 2)),
        faults=some if faults is None else faults,
    )
