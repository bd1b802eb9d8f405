"""Which runs keep grants, which clients can, and what they lock again and again.

In two of three runs the threads of each client do a job several times in a row, now and then, with
short rests; the threads of one client choose among few sets of data, and so do other clients.
"""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.kept import Keeping
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    OUTCOME_UNSEEN,
    Item,
    Outcome,
    OutcomeIs,
    Release,
    Released,
)
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.hosts.client_host import ParallelCalls, Steps
from enact_dist.verify.simulation.hosts.keeping import Sight
from enact_dist.verify.simulation.hosts.world import MS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.verify.simulation.hosts.client_host import ClientNode
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import Entry
    from enact_dist.verify.simulation.judges.model import Model

SHARE: Final = 2 / 3
"""Share of the runs in which grants are kept."""
REPEATED: Final = 0.1
"""Share of the jobs in such a run that are done several times."""
TIMES: Final = (6, 8, 10, 14)
RESTS_NS: Final = tuple(ms * MS for ms in (0, 1, 5, 30, 150))
WORKS_NS: Final = tuple(ms * MS for ms in (0, 0, 0, 5, 20, 100))
SETS: Final = 3
"""Sets of data in a cell that are locked again and again."""
SIGHTS: Final = (*[Sight.HERE] * 6, *[Sight.FAR] * 4, Sight.BLIND, Sight.AWAY)
ASKED: Final = 0.7
"""Share of the commits without an answer of which a client asks later what became of them."""


class Keepers:
    """Draws who keeps what, and begins locks under kept grants."""

    def __init__(
        self,
        world: SimulatedWorld,
        model: Model,
        *,
        entities: Sequence[str],
        aspects: Sequence[str],
    ) -> None:
        self._world, self._model = world, model
        luck = world.schedule.stream("keeping")
        self.takes_place = luck.random() < SHARE
        self._sets = [self._set(luck, entities, aspects) for _ in range(SETS)]

    @staticmethod
    def _set(
        luck: Random, entities: Sequence[str], aspects: Sequence[str]
    ) -> tuple[tuple[str, str, str], ...]:
        """Draw one or two slots of one entity, so of one shard."""
        entity = luck.choice(entities)
        slots = {
            (luck.choice(CONTEXTS), entity, luck.choice(aspects)): None
            for _ in range(luck.choice((1, 1, 2)))
        }
        return tuple(slots)

    def sight(self, number: int) -> Sight:
        """Draw what a client sees of the pages of its shards."""
        if not self.takes_place:
            return Sight.AWAY
        return self._world.schedule.stream(f"sight of c{number}").choice(SIGHTS)

    def repeats(self, luck: Random) -> tuple[tuple[Item, ...], int]:
        """Draw what is locked several times in a row, and how often: mostly nothing."""
        if not self.takes_place or luck.random() >= REPEATED:
            return (), 1
        slots = luck.choice(self._sets)
        accesses = luck.choice(
            ((Access.WRITE,) * 2, (Access.WRITE, Access.READ), (Access.READ,) * 2)
        )
        items = tuple(Item(access, *slot) for access, slot in zip(accesses, slots, strict=False))
        return items, luck.choice(TIMES)

    # ---------------------------------------------------------------- locks

    def begin(
        self, host: ClientNode, lane: int, items: tuple[Item, ...], *, hold_ns: int
    ) -> Steps[MultiLock | None]:
        """Begin a lock under a kept grant; None if it has to be asked for."""
        if not self.takes_place or items not in host.client.kept.by_items:
            return None
        return (yield from host.kept.begin(lane, items, hold_ns=hold_ns))

    @staticmethod
    def may_keep(host: ClientNode, lock: MultiLock, items: tuple[Item, ...]) -> None:
        """Let a lock that is about to be asked for leave its grant with the session."""
        if lock.plan.keepable and host.kept.keeps(lock.plan.locks[0][0]):
            lock.keeping = Keeping(items)

    def asked_later(self, host: ClientNode, entry: Entry, luck: Random) -> Steps[None]:
        """Ask what became of a commit without an answer, as `link.client` does on demand."""
        lock = entry.lock
        if not self.takes_place or lock.phase is not Phase.UNKNOWN or luck.random() >= ASKED:
            return
        part = lock.parts[0]
        if len(lock.parts) > 1 or part.token is None:
            return
        (answer,) = yield ParallelCalls([(part.shard, Release(entry.id))])
        if not isinstance(answer, Released):
            return
        (answer,) = yield ParallelCalls([(part.shard, Outcome(entry.id))])
        if isinstance(answer, OutcomeIs) and answer.kind == OUTCOME_UNSEEN:
            assert lock.finishing is not None
            if lock.finishing.known_in not in (0, answer.epoch):
                self._world.tally["unknown commits that a restart took"] += 1
                return
            self._world.tally["unknown commits that never came"] += 1
            lock.phase = Phase.RELEASED
