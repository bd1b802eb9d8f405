"""What some of the simulated processes do besides: look back, and keep what they have found.

A thread lists the versions of a few slots, asks for many slots as of a stamp at, before or after
one of them, and puts versions under labels and removes the labels again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import Item, KeepVersions, ListHistory, SlotVersion, Versions
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.hosts.client_host import ParallelCalls, Sleep
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.judges.history import Entry
from enact_dist.verify.simulation.work.workload import ENTITIES, PLAIN

if TYPE_CHECKING:
    from random import Random

    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.verify.simulation.hosts.client_host import ClientNode, Steps, Thread
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.history import RunHistory
    from enact_dist.verify.simulation.judges.model import Model
    from enact_dist.verify.simulation.work.workload import Workload

SHARE: Final = 0.5
"""Share of the runs in which a client views the past."""
LABELS: Final = 2
"""Labels of one process."""


class Historian:
    """Views the past, and adds and removes labels."""

    def __init__(
        self, world: SimulatedWorld, history: RunHistory, model: Model, workload: Workload
    ) -> None:
        self._world, self._history = world, history
        self._model, self._workload = model, workload
        self.takes_place = world.schedule.stream("history").random() < SHARE

    def thread(self, host: ClientNode, lane: int) -> Thread:
        """Look back until the run winds down."""
        luck = self._world.schedule.stream(f"history of {host.name}")
        number = 0
        while not self._world.winding_down:
            yield Sleep(luck.choice((20, 100, 400)) * MS)
            shard = luck.choice(host.client.placement.shards).name
            entries = yield from self._listed(host, shard, luck)
            kind = luck.random()
            if entries and kind < 0.25:
                yield from self._keeps(host, shard, entries, luck)
            elif entries:
                number += 1
                name = f"{host.name}/{lane}.{number}"
                if self._world.schedule.begins(name):
                    yield from self._looks(host, lane, name, entries, luck)

    def _listed(self, host: ClientNode, shard: str, luck: Random) -> Steps[list[VersionEntry]]:
        message = ListHistory((luck.choice(CONTEXTS),), (), (luck.choice(PLAIN),))
        (answer,) = yield ParallelCalls([(shard, message)])
        found = answer.entries if isinstance(answer, Versions) else ()
        return [entry for entry in found if entry.state.version]

    # ---------------------------------------------------------------- views

    def _looks(
        self, host: ClientNode, lane: int, name: str, entries: list[VersionEntry], luck: Random
    ) -> Thread:
        """View some slots of all shards as of one stamp."""
        stamp_ns = luck.choice(entries).state.stamp_ns
        at_ns = stamp_ns + luck.choice((-2 * S, -1, 0, 0, 0, 1, 50 * MS, S))
        items = self._items(entries, luck)
        client = host.client
        plan = client.plan(items, past_ns=min(at_ns, max(client.seen_stamp_ns, stamp_ns)))
        lock = client.begin(lane, plan, now_ns=host.local_ns, wait_ns=4 * S, hold_ns=60 * S)
        entry = Entry(lock, items, "look back", self._world.now_ns)
        self._history.begin(entry)
        self._world.tell(name, "looks back to", plan.past_ns)
        yield from host.drive(lock)
        if lock.phase is Phase.HELD:
            self._model.of_clients.holds(host, entry)
            yield from self._workload.data(host, lock)
            lock.release()
            yield from host.drive(lock)
        self._history.end(entry, now_ns=self._world.now_ns)
        self._model.of_clients.told(host, entry)

    @staticmethod
    def _items(entries: list[VersionEntry], luck: Random) -> tuple[Item, ...]:
        slot = luck.choice(entries).state.slot
        if luck.random() < 0.3:
            return (Item(Access.VIEW_EACH, slot.context, "**", slot.aspect),)
        if luck.random() < 0.3:
            return (Item(Access.VIEW, *slot),)
        return tuple(
            Item(Access.VIEW, context, entity, slot.aspect)
            for context in CONTEXTS
            for entity in ENTITIES
        )

    # ---------------------------------------------------------------- labels

    def _keeps(
        self, host: ClientNode, shard: str, entries: list[VersionEntry], luck: Random
    ) -> Thread:
        """Keep one or two versions under a label, or remove the label."""
        client, label = host.client, f"{host.name}/{luck.randrange(LABELS)}"
        chosen = [luck.choice(entries).state for _ in range(luck.choice((0, 0, 1, 2)))]
        versions = tuple(SlotVersion(state.slot, state.version) for state in chosen)
        count = client.sendings.next(host.local_ns)
        message = KeepVersions(client.session, label, versions, client.epoch(shard), count)
        for _ in range(luck.choice((1, 1, 2))):
            yield ParallelCalls([(shard, message)])
