"""An aspect whose type gains a field while the cell runs, in some of the runs.

Some process registers the newer type at some moment, at the shards where it writes.  From then on
these shards refuse a process with the older program as a writer.  It goes on reading, and after
some refusals it runs the newer program too.

The core decides which types go together and who may write.  Outside it, the client compares types
before it asks for a lock, after a refusal, and after a grant if a catalogue changed meanwhile:
here as in `enact_dist.access.session` and `enact_dist.link.client.locks`, with the real
`KnownCatalogue`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import NEWER_TYPE, AspectEntry, Refused, Register, Request
from enact_dist.core.protocol.placement import shard_of
from enact_dist.terms import Access
from enact_dist.verify.simulation.hosts.client_host import ClientNode, ParallelCalls, Sleep, Steps
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.judges.growth import NEWER, NEWER_ENCODING, OLDER

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from random import Random

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.core.protocol.messages import Item
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.model import Model

SHARE: Final = 0.4
"""Share of the runs in which a type grows."""
UPDATED: Final = 0.03
"""Share of its refusals after which a process runs the newer program."""
CALLS_MAX: Final = 8
"""How often a shard is asked before a process gives a job up."""
ATTEMPTS_MAX: Final = 4
"""How often a job asks for its lock while shards refuse it until its client has looked."""
REFUSED_NS: Final = 100 * MS
"""How long a thread rests after a refusal."""


class Growth:
    """Which process has which program, and what its client compares."""

    def __init__(self, world: SimulatedWorld, model: Model, aspects: Iterable[AspectEntry]) -> None:
        self._world, self._judge = world, model.growth
        luck = world.schedule.stream("growth")
        self.takes_place = luck.random() < SHARE
        older = luck.choice([entry for entry in aspects if entry.fingerprint == OLDER])
        self._older, self._newer = older, older._replace(fingerprint=NEWER)
        self._begins_ns = luck.randrange(S, 12 * S)
        self._first = luck.choice((1, 2))
        self._updated: set[str] = set()

    def registered(self, aspects: Sequence[AspectEntry]) -> tuple[AspectEntry, ...]:
        """Return what a process registers at its start: what grows, as one that reads it."""
        return tuple(
            entry._replace(reads=self.takes_place and entry.name == self._older.name)
            for entry in aspects
        )

    def written_newer(self, host: ClientNode, items: Iterable[Item]) -> str:
        """Return the aspect that a job writes with the newer type ("": none)."""
        if not self.takes_place or not self._writes(items):
            return ""
        first = host.name == f"c{self._first}" and self._world.now_ns >= self._begins_ns
        return self._older.name if first or host.name in self._updated else ""

    def encoding(self, newer: str, slot: Slot) -> bytes:
        """Return how a datum is encoded that a job of this type writes."""
        return NEWER_ENCODING if newer and slot.aspect == newer else b"text"

    def shown(self, newer: str, data: Iterable[Datum | None]) -> None:
        """Count the data with the newer type that a job of the older program has read."""
        if self.takes_place and not newer:
            of_newer = sum(d is not None and d.encoding == NEWER_ENCODING for d in data)
            self._world.tally["newer data read by older programs"] += of_newer

    def compared(
        self, host: ClientNode, items: Iterable[Item], newer: str, luck: Random
    ) -> Steps[bool]:
        """Let a client compare the type that it would write, as `Session.prepare` does.

        Returns:
            Whether it may write it at every shard that it needs.
        """
        items = tuple(items)
        if not self.takes_place or not self._writes(items):
            return True
        entry = self._newer if newer else self._older
        for shard in self._shards(host, items):
            for _ in range(CALLS_MAX):
                if not host.catalogue.lacks(shard, (), (entry,)):
                    break
                refused = yield from self._asked(host, shard, entry)
                if refused:
                    if luck.random() < UPDATED:
                        self._updated.add(host.name)
                    yield Sleep(REFUSED_NS)
                    return False
            else:
                return False
        return True

    def _asked(self, host: ClientNode, shard: str, entry: AspectEntry) -> Steps[bool]:
        client, epoch = host.client, host.client.epoch(shard)
        request: Request = client.hello(shard)
        if not client.needs_hello(shard):
            request = Register(client.session, (), (entry,))
        (answer,) = yield ParallelCalls([(shard, request)])
        if answer is None:
            yield Sleep(50 * MS)
        elif isinstance(answer, Refused):
            self._judge.client_refused(host, entry, answer)
            return True
        else:
            host.learn(shard, answer, sent_in=epoch)
            client.answered(shard, request, answer, host.local_ns)
        return False

    def looks_again(self, host: ClientNode, lock: MultiLock) -> Steps[bool]:
        """Greet the shards of a lock that was refused for a newer type; whether it was."""
        if getattr(lock.refusal, "code", "") != NEWER_TYPE:
            return False
        self._world.tally["locks refused for a newer type"] += 1
        for shard in dict.fromkeys(shard for shard, _ in (*lock.plan.locks, *lock.plan.views)):
            hello = host.client.hello(shard)
            (answer,) = yield ParallelCalls([(shard, hello)])
            if answer is not None:
                host.learn(shard, answer)
                host.client.answered(shard, hello, answer, host.local_ns)
        return True

    def _writes(self, items: Iterable[Item]) -> bool:
        name = self._older.name
        return any(item.aspect == name and Access(item.access).writes for item in items)

    def _shards(self, host: ClientNode, items: Iterable[Item]) -> list[str]:
        placement = host.client.placement
        written = [
            item for item in items if item.aspect == self._older.name and Access(item.access).writes
        ]
        if any(Access(item.access).each for item in written):
            return [shard.name for shard in placement.shards]
        return sorted({shard_of(item.entity, placement) for item in written})
