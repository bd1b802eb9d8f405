"""What some of the simulated processes do besides: fork a world context, work in it, drop it.

Each forks under names of its own, which it uses again and again, so that what was dropped must not
come back: neither a copy of an earlier request that comes late, nor a version.
"""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import (
    CLOCK_SKEW,
    HELD,
    OVERLOAD,
    AwaitStamp,
    Dropped,
    DropWorld,
    EpochChanged,
    Forgotten,
    Fork,
    Forked,
    Item,
    Reached,
    Refused,
)
from enact_dist.terms import Access
from enact_dist.verify.simulation.cells import CONTEXTS
from enact_dist.verify.simulation.hosts.client_host import ParallelCalls, Sleep, Steps
from enact_dist.verify.simulation.hosts.world import MS, S
from enact_dist.verify.simulation.work.workload import ENTITIES, PLAIN, Job

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.verify.simulation.hosts.client_host import ClientNode, Thread
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.judges.model import Model
    from enact_dist.verify.simulation.work.workload import Workload

    _Make = Callable[[int, int], Fork | DropWorld]
    _Answered = Steps[Answer | None]

SHARE: Final = 0.3
"""Share of the runs in which there are forks."""
NAMES: Final = 2
"""Names that one process forks under."""
TRIES: Final = 60
"""How often a shard is asked for one thing: longer than any partition lasts."""
IN_USE: Final = 0.3
"""Share of the contexts that a client tries to drop under a lock."""
LATE: Final = 0.3
"""How often a copy of an earlier request comes in between."""
_AGO_NS: Final = (0, 0, 0, 0, 50 * MS, 500 * MS)


class Forker:
    """Forks and drops world contexts, and lets the workload loose in them."""

    def __init__(self, world: SimulatedWorld, model: Model, workload: Workload) -> None:
        self._world, self._model, self._workload = world, model, workload
        self._unclear: dict[str, None] = {}
        self._sent: dict[str, list[tuple[str, Request]]] = {}
        self._newest_ns = 0
        self.takes_place = world.schedule.stream("forks").random() < SHARE

    def thread(self, host: ClientNode, lane: int) -> Thread:
        """Fork, work and drop until the run winds down."""
        luck = self._world.schedule.stream(f"forks of {host.name}")
        sources: list[str] = [*CONTEXTS]
        number = 0
        while not self._world.winding_down:
            yield Sleep(luck.choice((50, 200, 600)) * MS)
            name = f"trial-{host.name}-{luck.randrange(NAMES)}"
            if name in sources:
                sources.remove(name)
                number += 1
                yield from self._drop_in_use(host, lane, name, f"{host.name}/{lane}.{number}", luck)
                yield from self._drop(host, name, luck)
                yield from self._late_copy(host, luck)
            source = luck.choice(sources)
            if name not in self._unclear and (yield from self._fork(host, name, source, luck)):
                sources.append(name)
                yield from self._late_copy(host, luck)
                for _ in range(luck.choice((0, 1, 2, 4))):
                    number += 1
                    job = self._job(f"{host.name}/{lane}.{number}", name, luck)
                    yield from self._workload.do(host, lane, job)

    # ---------------------------------------------------------------- one context

    def _fork(self, host: ClientNode, name: str, source: str, luck: Random) -> Steps[bool]:
        """Fork on every shard; a fork that some cannot make is dropped again."""
        shards = [shard.name for shard in host.client.placement.shards]
        self._check_gone(name)
        present = yield ParallelCalls([(shard, AwaitStamp(0, 0)) for shard in shards])
        stamps = [answer.stamp_ns for answer in present if isinstance(answer, Reached)]
        at_ns = max((host.client.seen_stamp_ns, *stamps)) - luck.choice(_AGO_NS)
        at_ns = self._newest_ns = max(at_ns, self._newest_ns + 1)
        session = host.client.session

        def fork(epoch: int, count: int) -> Fork:
            return Fork(session, name, source, at_ns, epoch, count)

        self._world.tell(host.name, "forks", name, "from", source, "as of", at_ns)
        self._unclear[name] = None
        made = []
        for shard in shards:
            answer = yield from self._asked(host, shard, fork, luck)
            made.append(isinstance(answer, Forked))
            if isinstance(answer, Forgotten):
                self._world.tally["forks of what is forgotten"] += 1
            elif isinstance(answer, Refused) and not (
                answer.code == CLOCK_SKEW and self._model.clocks_were_set
            ):
                self._world.violation("no fork is refused", answer)
        if all(made):
            del self._unclear[name]
            return True
        yield from self._drop(host, name, luck)
        return False

    def _drop(self, host: ClientNode, name: str, luck: Random) -> Steps[None]:
        session = host.client.session

        def drop(epoch: int, count: int) -> DropWorld:
            return DropWorld(session, name, epoch, count)

        self._unclear[name] = None
        gone = []
        for shard in host.client.placement.shards:
            answer = yield from self._asked(host, shard.name, drop, luck)
            gone.append(isinstance(answer, Dropped))
        if all(gone):
            del self._unclear[name]

    def _drop_in_use(
        self, host: ClientNode, lane: int, name: str, job: str, luck: Random
    ) -> Thread:
        """Ask for the end of a context, in some cases, while a lock is held in it."""
        if luck.random() >= IN_USE:
            return
        client = host.client

        def drops() -> Thread:
            for shard in client.placement.shards:
                count = client.sendings.next(host.local_ns)
                request = DropWorld(client.session, name, client.epoch(shard.name), count)
                (answer,) = yield ParallelCalls([(shard.name, request)])
                held = isinstance(answer, Refused) and answer.code == HELD
                self._world.tally["drops refused for a lock"] += held

        item = Item(Access.READ, name, luck.choice(ENTITIES), "count")
        reads = Job(job, "read", (item,), luck, 2 * S, 60 * S, 0, False, False, meanwhile=drops)
        yield from self._workload.do(host, lane, reads)

    def _late_copy(self, host: ClientNode, luck: Random) -> Thread:
        """Let a copy of an earlier request come late, sometimes; no thread awaits its answer."""
        sent = self._sent.get(host.name, [])
        if sent and luck.random() < LATE:
            self._world.tally["copies of forks and drops that came late"] += 1
            yield ParallelCalls([luck.choice(sent)])

    def _check_gone(self, name: str) -> None:
        """What was dropped on every shard has not come back by itself."""
        for shard, picture in self._model.pictures.items():
            if name in picture.worlds:
                self._world.violation("late copies make no context", shard, name)

    def _asked(self, host: ClientNode, shard: str, make: _Make, luck: Random) -> _Answered:
        """Ask a shard until it has done it, or says for good why not; None: it never answered."""
        client = host.client
        for _ in range(TRIES):
            if client.needs_hello(shard):
                hello = client.hello(shard)
                (answer,) = yield ParallelCalls([(shard, hello)])
                if answer is not None:
                    client.answered(shard, hello, answer, host.local_ns)
                continue
            request = make(client.epoch(shard), client.sendings.next(host.local_ns))
            self._sent.setdefault(host.name, []).append((shard, request))
            answer = None
            for _ in range(luck.choice((1, 2, 3))):
                (answer,) = yield ParallelCalls([(shard, request)])
                if answer is not None:
                    break
            if isinstance(answer, EpochChanged):
                client.answered(shard, request, answer, host.local_ns)
            elif isinstance(answer, Refused) and answer.code in (OVERLOAD, HELD):
                yield Sleep(100 * MS)
            elif answer is not None:
                return answer
        return None

    def _job(self, name: str, context: str, luck: Random) -> Job:
        """Draw something to do in a fork, with a look at a context that is no fork."""
        random = Random(luck.getrandbits(64))
        job = self._workload.job(name, random)
        while job.kind not in ("increment", "derive", "view", "read"):
            job = self._workload.job(name, random)

        def moved(item: Item) -> Item:
            return item._replace(context=context)

        items = dict.fromkeys(moved(item) for item in job.items if item.aspect in PLAIN)
        distinct = {item[1:4]: item for item in items}
        return Job(
            name,
            job.kind,
            tuple(distinct.values()),
            random,
            wait_ns=2 * S,
            hold_ns=job.hold_ns,
            work_ns=min(job.work_ns, 100 * MS),
            abandons=job.abandons,
            expects=job.expects,
        )
