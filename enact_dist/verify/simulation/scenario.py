"""A whole run from one seed: a cell, its faults, its work, its judgement.

::

    0 s ───────── faults ────────── heal ── work goes on ── wind down ── quiet? ── judge
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
from enact_dist.core.protocol.records import Drain, SessionSeen
from enact_dist.core.shard.state import ShardSettings
from enact_dist.verify.simulation import cells
from enact_dist.verify.simulation import faults as fault_options
from enact_dist.verify.simulation.cells import CONTEXTS, WORK_NS
from enact_dist.verify.simulation.hosts.client_host import ClientNode
from enact_dist.verify.simulation.hosts.folders import SHARE, Folders
from enact_dist.verify.simulation.hosts.network import Network
from enact_dist.verify.simulation.hosts.payloads import DRAFT_NS
from enact_dist.verify.simulation.hosts.shard_host import ShardNode
from enact_dist.verify.simulation.hosts.world import MS, S, SimulatedWorld, SimulationError
from enact_dist.verify.simulation.injector import Injector
from enact_dist.verify.simulation.judges.graph import DependencyGraph
from enact_dist.verify.simulation.judges.history import RunHistory
from enact_dist.verify.simulation.judges.model import Model
from enact_dist.verify.simulation.schedule import WHOLE, Happening, PartOfRun, Schedule
from enact_dist.verify.simulation.work.forks import Forker
from enact_dist.verify.simulation.work.historian import Historian
from enact_dist.verify.simulation.work.standing import StandingActors
from enact_dist.verify.simulation.work.workload import ASPECTS, Workload

if TYPE_CHECKING:
    from collections import Counter

    from enact_dist.core.state.tenure import Tenure
    from enact_dist.verify.simulation.faults import Faults

QUIET_NS = 30 * S
"""How long after that everything must have come to rest."""
POLL_NS = 500 * MS
LINGERING = 0.1
"""Share of the runs that go on for twice as long as a draft may be without a slice."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a run has shown.

    Attributes:
        violation: Which rule broke, when and how; empty where every rule held.
        faults: What went wrong outside the core, in the order in which it began.
        locks: Names of the locks that were asked for.
        trace: Where an exception came from.
    """

    seed: int
    violation: str
    tally: Counter[str]
    simulated_s: float
    faults: tuple[Happening, ...] = ()
    locks: tuple[str, ...] = ()
    trace: str = field(default="", repr=False)

    @property
    def rule(self) -> str:
        """The rule that broke, without moment and facts."""
        return self.violation.partition(" broken at ")[0].partition(" at ")[0]


class Scenario:
    """One cell and its run."""

    def __init__(
        self,
        seed: int,
        *,
        part: PartOfRun = WHOLE,
        faults: Faults | None = None,
        through_wire: bool = True,
        asserts: bool = True,
        story: bool = False,
    ) -> None:
        self.seed = seed
        self.schedule = Schedule(seed, part)
        self.world = world = SimulatedWorld(self.schedule, story=[] if story else None)
        self.cell = cell = cells.drawn(self.schedule.stream("cell"), faults=faults)
        until_ns = WORK_NS if part.until_s is None else int(part.until_s * 1e9)
        self._faults_end_ns = min(cells.FAULTS_NS, until_ns + S // 2)
        self._work_ns = min(cell.work_ns, until_ns)
        self.history = RunHistory()
        self.model = Model(world, self.history, ASPECTS)
        self.network = Network(world, cell.faults, through_wire=through_wire)
        self.shards = self._made_shards(cell.shards)
        self.folders = Folders(world, share=SHARE)
        self.workload = Workload(
            world,
            self.history,
            self.model,
            entities=cell.entities,
            folders=self.folders.takes_place,
        )
        for host in self.shards.values():
            host.asserts, host.folders = asserts, self.folders
            host.keeps, host.between = self.workload.keepers.takes_place, self._between
        self._steps = self.schedule.place("steps")
        self.forker = Forker(world, self.model, self.workload)
        self.historian = Historian(world, self.history, self.model, self.workload)
        self.standing = StandingActors(world, self.model, self.workload)
        self.injector = Injector(
            world, cell, self.network, self.shards, until_ns=self._faults_end_ns
        )
        self.injector.token_of = self._token_of
        self.injector.replace = self._add_client
        self.injector.clock_set = self.model.clock_was_set

    def _made_shards(self, count: int) -> dict[str, ShardNode]:
        names = [f"s{index}" for index in range(count)]
        placement = PlacementMap(1, tuple(ShardEntry(name, ()) for name in names), ())
        shards: dict[str, ShardNode] = {}
        for name in names:
            settings = ShardSettings(name, placement, worlds=CONTEXTS)
            offset_ns = self.schedule.stream(f"wall of {name}").randrange(-200 * MS, 200 * MS)
            host = shards[name] = ShardNode(
                self.world, settings, self.cell.faults, wall_offset_ns=offset_ns
            )
            host.judge = self.model
            host.tokens = self._tokens_seen
            host.network, host.peers = self.network, shards
        return shards

    def _add_client(self, number: int) -> None:
        """Start a process for a client, in the place of the one that was killed."""
        before = self.injector.clients.get(number)
        name = f"c{number}" if before is None else f"c{number}_{before.generation + 1}"
        host = ClientNode(
            self.world,
            name,
            network=self.network,
            shards=self.shards,
            check_beliefs=self.model.of_clients.check_beliefs,
            faults=self.cell.faults,
            ttl_ns=self.cell.ttl_ns,
            sight=self.workload.keepers.sight(number),
            folders=self.folders,
        )
        host.kept.looked = self.model.keeping.looked
        host.kept.stands = partial(self.injector.at_step, host)
        host.generation = 0 if before is None else before.generation + 1
        self.injector.clients[number] = host
        self.model.of_clients.clients.append(host)
        self._show_token(host, present=True)

        def work() -> None:
            host.keep_alive()
            for lane in range(self.cell.lanes):
                host.start(self.workload.thread(host, lane))
            if self.forker.takes_place:
                host.start(self.forker.thread(host, self.cell.lanes))
            if self.historian.takes_place:
                host.start(self.historian.thread(host, self.cell.lanes + 1))
            if self.standing.takes_place and number == 1:
                host.start(self.standing.thread(host, self.cell.lanes + 2))

        host.start(host.open(self.workload.growth.registered(ASPECTS), work))

    def _between(self, session: str) -> None:
        """Let the threads of a client that stand between two steps go on, or some of them."""
        for host in self.injector.clients.values():
            if host.client.session == session:
                while self._steps.next() & 3 and host.acts():
                    pass

    # ---------------------------------------------------------------- the run

    def run(self) -> Result:
        """Run to the end and judge."""
        try:
            self._run()
            violation, trace = "", ""
        except SimulationError as broken:
            violation, trace = str(broken), ""
        except Exception as failure:  # noqa: BLE001 - whatever the core raises is a finding too
            violation = f"{type(failure).__name__} at {self.world.now_ns / 1e9:.6f} s: {failure}"
            trace = traceback.format_exc()
        return Result(
            self.seed,
            violation,
            self.world.tally,
            self.world.now_ns / 1e9,
            tuple(self.schedule.happened.values()),
            tuple(self.schedule.locks),
            trace,
        )

    def _run(self) -> None:
        for host in self.shards.values():
            host.boot()
        wanted = self.schedule.part.clients
        for number in range(1, self.cell.clients + 1):
            if wanted is None or number in wanted:
                self._add_client(number)
        self.injector.plan()
        self.world.after(self._work_ns, self._wind_down)
        self.world.run_until(self._faults_end_ns)
        self._heal()
        self.world.run_until(self._work_ns)
        end_ns = max(self._work_ns, self._faults_end_ns) + QUIET_NS
        while not self._quiet() and self.world.now_ns < end_ns:
            self.world.run_until(self.world.now_ns + POLL_NS)
        self._check_quiet()
        self._linger()
        self._check_given_up()
        for host in self.shards.values():
            host.payloads.check_released()
            host.close()
        self.model.check_all_or_nothing()
        graph = DependencyGraph(self.history, self.model)
        graph.check_views()
        cycle = graph.cycle()
        if cycle is not None:
            self.world.violation("I6 strict serializability", *("\n  " + line for line in cycle))

    def _linger(self) -> None:
        """Let a client that is left work very slowly, in some runs, and drafts grow old."""
        hosts = [host for host in self.model.of_clients.clients if host.up]
        if not hosts or self.schedule.stream("lingering").random() >= LINGERING:
            return
        for thread in self.workload.lingering(hosts[0]):
            hosts[0].start(thread)
        self.world.run_until(self.world.now_ns + 2 * DRAFT_NS)
        self._check_quiet()
        for shard in self.shards.values():
            for file in shard.payloads.handler.drafts():
                self.world.violation("I12 nothing is left", shard.name, file)

    def _wind_down(self) -> None:
        self.world.winding_down = True

    def _quiet(self) -> bool:
        busy = any(host.threads_left for host in self.model.of_clients.clients if host.up)
        locks = any(
            _locks_left(host) or host.unanswered or host.shard.state.decisions.by_lock
            for host in self.shards.values()
        )
        return not busy and not locks

    def _check_quiet(self) -> None:
        """I12: when faults have ended, everything comes to rest."""
        for client in self.model.of_clients.clients:
            if client.up and (client.threads_left or client.client.live_locks()):
                phases = [(str(lock.lock), lock.phase) for lock in client.client.live_locks()]
                facts = (client.name, client.threads_left, phases)
                self.world.violation("I12 all threads end", *facts)
        for host in self.shards.values():
            left = _locks_left(host)
            untold = host.shard.state.decisions.by_lock
            if left or host.unanswered or untold:
                self.world.violation(
                    "I12 nothing is left", host.name, left, host.unanswered, untold
                )

    def _check_given_up(self) -> None:
        """I12: a shard that has to stop takes all unused grants back at once."""
        for host in self.shards.values():
            host.event(Drain())
            if host.shard.state.tenures.by_lock or not host.shard.idle:
                left = list(host.shard.state.tenures.by_lock.values())
                self.world.violation("I12 no kept grant keeps a shard", host.name, left)

    def _heal(self) -> None:
        self.world.tell("faults end")
        self.network.heal(fault_options.NONE)
        for host in (*self.shards.values(), *self.model.of_clients.clients):
            if host.paused:
                host.resume()
        for host in self.model.of_clients.clients:
            self._show_token(host, present=host.up)

    # ---------------------------------------------------------------- liveliness tokens

    def _visible(self, host: ClientNode, shard: ShardNode) -> bool:
        return (
            self.cell.faults.tokens
            and host.up
            and not host.paused
            and not self.network.is_cut(host, shard)
        )

    def _tokens_seen(self, shard: ShardNode) -> list[str]:
        return [h.client.session for h in self.model.of_clients.clients if self._visible(h, shard)]

    def _token_of(self, host: ClientNode) -> None:
        """Let every shard notice whether the client's liveliness token is there."""
        if not host.up:
            self._show_token(host, present=False)
            return
        for shard in self.shards.values():
            seen = SessionSeen(host.client.session, self._visible(host, shard))
            shard.receive(partial(shard.event, seen))

    def _show_token(self, host: ClientNode, *, present: bool) -> None:
        seen = SessionSeen(host.client.session, present and self.cell.faults.tokens)
        for shard in self.shards.values():
            self.world.after(10 * MS, partial(shard.receive, partial(shard.event, seen)))


def _locks_left(host: ShardNode) -> list[Tenure]:
    """Return the locks of a shard without the kept grants that no block uses."""
    return [t for t in host.shard.state.tenures.by_lock.values() if not host.is_unused(t)]
