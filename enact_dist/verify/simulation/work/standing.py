"""What the simulated actors do whose locks wait for news at their shard.

One of them looks at a slot and writes another one of the same shard, as an actor with a trigger
does.  It asks for its next lock at once, after what its last update that was committed has seen.
When the run winds down, it goes on until it has seen the newest datum: news that were lost keep the
run from coming to rest.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import DatumRead, Item
from enact_dist.core.protocol.placement import shard_of
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.hosts.client_host import ClientNode, Sleep, Thread
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.work.workload import ENTITIES, PLAIN, Job, Workload

if TYPE_CHECKING:
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import Entry, Observations

SHARE: Final = 0.25
"""Share of the runs in which the first client has such an actor."""
SEEN_NOTHING: Final = (0, 0)


class StandingActors:
    """Waits for news of a slot, again and again."""

    def __init__(self, world: SimulatedWorld, observed: Observations, workload: Workload) -> None:
        self._world, self._observed, self._workload = world, observed, workload
        draw = world.schedule.stream("asks in advance for news, or not").random()
        self.takes_place = draw < SHARE

    def thread(self, host: ClientNode, lane: int) -> Thread:
        """Make something of each news until the run winds down and nothing new is left."""
        luck = self._world.schedule.stream(f"standing of {host.name}")
        context, entity = luck.choice(CONTEXTS), luck.choice(ENTITIES)
        # What is made of one aspect is of a later one: no actor is the cause of its own news.
        trigger, made = sorted(luck.sample(PLAIN, 2), key=PLAIN.index)
        slot = Slot(context, entity, trigger)
        items = Item(Access.VIEW, *slot), Item(Access.WRITE, context, entity, made)
        seen = done = SEEN_NOTHING
        number = 0
        while not self._is_over(host, slot, done):
            number += 1
            job = Job(
                f"{host.name}/{lane}.{number}", "increment", items, luck,
                wait_ns=luck.choice((200 * MS, 2 * S)), hold_ns=60 * S,
                work_ns=luck.choice((0, 2 * MS, 100 * MS, S)),
                abandons=False, expects=False,
                after=(DatumRead(slot, *seen),), gives_up=partial(self._is_over, host, slot, done),
            )  # fmt: skip
            if self._world.schedule.begins(job.name):
                entry = yield from self._workload.do(host, lane, job)
                seen, done = self._shown(entry, slot, seen), self._done(entry, slot, done)
                if self._world.winding_down and (entry is None or entry.told is Phase.REFUSED):
                    return  # for good: of a wall clock, or of a type
            yield Sleep(luck.choice((MS, 30 * MS, 150 * MS)))

    @staticmethod
    def _shown(entry: Entry | None, slot: Slot, seen: tuple[int, int]) -> tuple[int, int]:
        """Return what the actor has seen: what an update without a commit saw is still to do."""
        return StandingActors._done(entry, slot, seen)

    @staticmethod
    def _done(entry: Entry | None, slot: Slot, done: tuple[int, int]) -> tuple[int, int]:
        """Return the newest state of which something was made."""
        if entry is None or entry.told is not Phase.COMMITTED:
            return done
        return next(
            (one.state.version, one.state.stamp_ns)
            for one in entry.lock.states
            if one.state.slot == slot
        )

    def _is_over(self, host: ClientNode, slot: Slot, done: tuple[int, int]) -> bool:
        """Whether the run winds down, and something was made of the newest datum."""
        if not self._world.winding_down:
            return False
        picture = self._observed.pictures[shard_of(slot.entity, host.client.placement)]
        chain = picture.chains.get(slot)
        return not chain or chain[-1].datum is None or chain[-1].name == done
