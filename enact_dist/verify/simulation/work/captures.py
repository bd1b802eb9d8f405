"""What the simulated threads do by capture stamp: data that belong together, found and viewed.

Data are stamped with the tick of true time in which they are made, a few late or not at all.  As
`enact_dist.access.together` does, a thread waits until its own commits are shown, asks which
versions are retained, and views the newest stamp that all its slots have.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.access.sets import Capture, newest_set_ns
from enact_dist.core.protocol.datum import Slot
from enact_dist.core.protocol.messages import AwaitStamp, Reached, Survey, Surveyed
from enact_dist.core.protocol.placement import shard_of
from enact_dist.terms import Access
from enact_dist.verify.simulation.hosts.client_host import ClientNode, ParallelCalls, Steps
from enact_dist.verify.simulation.hosts.world import MS

if TYPE_CHECKING:
    from collections.abc import Iterable
    from random import Random

    from enact_dist.core.protocol.messages import Item
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.model import Model

TICK_NS: Final = 1500 * MS
"""Data of one tick bear one stamp: about as long as a few slots take to be written once."""
SLICE_NS: Final = 200 * MS


def drawn_stamp_ns(luck: Random, now_ns: int) -> int:
    """Return a capture stamp: of this tick, in some cases of the last one, or none."""
    tick, kind = now_ns // TICK_NS, luck.random()
    if kind < 0.1:
        return 0
    return max(0, tick - (kind < 0.25)) * TICK_NS + 1


class Captures:
    """Finds the newest set of some slots."""

    def __init__(self, world: SimulatedWorld, model: Model) -> None:
        self._world, self._model = world, model

    def stamped(
        self, host: ClientNode, items: tuple[Item, ...], luck: Random
    ) -> Steps[tuple[Item, ...]]:
        """Return the items, the views among them with the stamp of their newest set.

        Without a set, they ask for a timestamp that only some slots, or none, have had.
        """
        slots = [Slot(*item[1:4]) for item in items if not Access(item.access).writes]
        versions = yield from self._versions(host, slots)
        captured_ns = newest_set_ns(list(versions.values()))
        self._world.tally["complete sets found"] += bool(captured_ns)
        if not captured_ns or luck.random() < 0.4:
            some = sorted({v.captured_ns for each in versions.values() for v in each} - {0})
            captured_ns = luck.choice([*some, *some, TICK_NS * 10**6])
        return tuple(
            item if Access(item.access).writes else item._replace(captured_ns=captured_ns)
            for item in items
        )

    def _versions(
        self, host: ClientNode, slots: Iterable[Slot]
    ) -> Steps[dict[Slot, list[Capture]]]:
        """Return the retained versions of each slot, as far as its shard tells them."""
        found: dict[Slot, list[Capture]] = {slot: [] for slot in slots}
        message = Survey(
            tuple(dict.fromkeys(slot.context for slot in found)),
            tuple(dict.fromkeys(slot.entity for slot in found)),
            tuple(dict.fromkeys(slot.aspect for slot in found)),
            retained=True,
        )
        for shard in sorted({shard_of(slot.entity, host.client.placement) for slot in found}):
            own = dict(host.own)
            if not (yield from self._settled(host, shard)):
                continue
            (answer,) = yield ParallelCalls([(shard, message)])
            if not isinstance(answer, Surveyed):
                continue
            self._model.of_clients.surveyed(host, own, shard, answer)
            for state in answer.states:
                if state.slot in found and state.version:
                    null = bool(state.null_reason)
                    version = Capture(state.version, state.stamp_ns, state.captured_ns, null)
                    found[state.slot].append(version)
        return found

    def _settled(self, host: ClientNode, shard: str) -> Steps[bool]:
        """Wait until a shard shows this process's own commits, for a while."""
        for _ in range(10):
            stamp_ns = host.client.unsettled_ns(shard)
            if not stamp_ns:
                return True
            self._world.tally["surveys that waited"] += 1
            session, epoch = host.client.session, host.client.epoch(shard)
            question = AwaitStamp(stamp_ns, SLICE_NS, session, epoch)
            (answer,) = yield ParallelCalls([(shard, question)])
            if isinstance(answer, Reached) and answer.reached:
                host.client.reached(shard, stamp_ns)
                return True
        return False
