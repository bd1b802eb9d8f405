"""A run from one seed: shards with two daemons each, a database that fails, clients, a judgement.

Clients add one to what they find, under locks over one or two shards.  At the end the database's
log says what was written, by whom and in which order; `verify.checker` judges it together with what
each client learned: nothing that was acknowledged is lost, doubled or invented, nothing stale was
shown under a lock, and there is an order for all of it.
"""

from __future__ import annotations

import traceback
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import AspectEntry, Item, PlacementMap, ShardEntry, WriteItem
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import SlotRecord
from enact_dist.core.shard.state import ShardSettings
from enact_dist.terms import Access
from enact_dist.verify.checker import ChainState, Checker, LockOutcome, LockStory, StateRead
from enact_dist.verify.simulation.data import datum_of, value_of, writer_of
from enact_dist.verify.simulation.faults import Faults
from enact_dist.verify.simulation.hosts.client_host import ClientNode, Sleep
from enact_dist.verify.simulation.hosts.network import Network
from enact_dist.verify.simulation.hosts.shard_host import ShardPlace
from enact_dist.verify.simulation.hosts.world import MS, S, SimulatedWorld, SimulationError
from enact_dist.verify.simulation.judges.history import TOLD_NOT
from enact_dist.verify.simulation.scenario import Result
from enact_dist.verify.simulation.schedule import Schedule
from enact_dist.verify.takeover.daemon import SimulatedDaemon
from enact_dist.verify.takeover.database import SimulatedDatabase

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from random import Random

    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.core.protocol.records import Persist, Recovered
    from enact_dist.verify.simulation.hosts.client_host import Thread
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode

WORLD: Final = "online"
ASPECTS: Final = (AspectEntry("count", "int", "durable"), AspectEntry("note", "int", "os"))
ENTITIES: Final = ("piece", "bench", "tray/4")
WORK_NS: Final = 60 * S
FAULTS_NS: Final = 50 * S
QUIET_NS: Final = 60 * S
LEASE_NS: Final = 2 * S
TTL_NS: Final = 2 * S
_KINDS: Final = ("increment",) * 5 + ("both",) * 2 + ("read", "view")


class _Pair(ShardPlace):
    """A shard as its clients reach it: every daemon that serves it gets their requests."""

    def __init__(self, world: SimulatedWorld, name: str) -> None:
        super().__init__(world, name, drift_ppm=0, wall_offset_ns=0)
        self.daemons: list[SimulatedDaemon] = []

    def request(self, message: Request, reply: Callable[[Answer], None]) -> None:
        """Bring a request to each daemon that serves."""
        for daemon in self.daemons:
            daemon.receive(partial(daemon.request, message, reply))


class _NoJudge:
    """The database's log is judged at the end."""

    def booted(self, host: ShardNode, recovered: Recovered, *, crashed_at_ns: int) -> None:
        """Judge nothing."""

    def judge_prefixes(self, host: ShardNode, *, power_cut: bool) -> None:
        """Judge nothing."""

    def crashed(self, host: ShardNode, lost: list[Persist], *, power_cut: bool) -> None:
        """Judge nothing."""

    def handled(self, host: ShardNode, message: object, effects: Sequence[object]) -> None:
        """Judge nothing."""


def run_takeover(seed: int) -> Result:
    """Run one seed."""
    return TakeoverRun(seed).run()


class TakeoverRun:
    """One cell whose shards are in a database.

    Args:
        seed: It decides everything.
        story: Whether to tell what happened.
    """

    def __init__(self, seed: int, *, story: bool = False) -> None:
        self.seed = seed
        self.world = SimulatedWorld(Schedule(seed), story=[] if story else None)
        luck = self.world.schedule.stream("cell")
        self.faults = Faults(
            loss=luck.choice((0.0, 0.02)),
            duplication=luck.choice((0.0, 0.02)),
            delay=luck.choice((0.0, 0.02)),
            late_answers=0.5,
            tokens=False,
            drift_ppm=9_900,
        )
        self._faults_per_s = luck.choice((0.3, 0.6, 1.2))
        self.network = Network(self.world, self.faults, through_wire=False)
        self.databases: dict[str, SimulatedDatabase] = {}
        self.pairs = self._made(luck.choice((1, 2)))
        self.stories: list[tuple[LockStory, MultiLock]] = []
        self.clients = [self._client(number) for number in range(1, luck.choice((2, 3, 4)) + 1)]

    def _made(self, count: int) -> dict[str, _Pair]:
        names = [f"s{index}" for index in range(count)]
        placement = PlacementMap(1, tuple(ShardEntry(name, ()) for name in names), ())
        pairs = {name: _Pair(self.world, name) for name in names}
        for name, pair in pairs.items():
            self.databases[name] = SimulatedDatabase(self.world, name)
            for place in "ab":
                offset = self.world.schedule.stream(f"wall of {name}{place}")
                daemon = SimulatedDaemon(
                    self.world,
                    ShardSettings(name, placement, worlds=(WORLD,)),
                    self.faults,
                    name=f"{name}{place}",
                    database=self.databases[name],
                    lease_ns=LEASE_NS,
                    wall_offset_ns=offset.randrange(-200 * MS, 200 * MS),
                )
                daemon.judge, daemon.network, daemon.peers = _NoJudge(), self.network, dict(pairs)
                pair.daemons.append(daemon)
        return pairs

    def _client(self, number: int) -> ClientNode:
        return ClientNode(
            self.world,
            f"c{number}",
            network=self.network,
            shards=dict(self.pairs),
            check_beliefs=lambda _client: None,
            faults=self.faults,
            ttl_ns=TTL_NS,
        )

    # ---------------------------------------------------------------- the run

    def run(self) -> Result:
        """Run to the end and judge."""
        violation = trace = ""
        try:
            self._run()
        except SimulationError as broken:
            violation = str(broken)
        except Exception as failure:  # noqa: BLE001 - whatever the core raises is a finding too
            violation = f"{type(failure).__name__} at {self.world.now_ns / 1e9:.6f} s: {failure}"
            trace = traceback.format_exc()
        world = self.world
        happened = tuple(world.schedule.happened.values())
        simulated_s = world.now_ns / 1e9
        return Result(self.seed, violation, world.tally, simulated_s, happened, trace=trace)

    def _run(self) -> None:
        for pair in self.pairs.values():
            for daemon in pair.daemons:
                daemon.boot()
        for client in self.clients:

            def work(client: ClientNode = client) -> None:
                client.keep_alive()
                for lane in range(2):
                    client.start(self._thread(client, lane))

            client.start(client.open(ASPECTS, work))
        self._plan_faults()
        self.world.after(WORK_NS, self._wind_down)
        self.world.run_until(WORK_NS)
        self.network.heal(Faults())
        end_ns = WORK_NS + QUIET_NS
        while self.world.now_ns < end_ns and any(client.threads_left for client in self.clients):
            self.world.run_until(self.world.now_ns + S)
        for client in self.clients:
            if client.threads_left:
                phases = [(str(lock.lock), lock.phase) for lock in client.client.live_locks()]
                self.world.violation("all threads end", client.name, phases)
        self.world.run_until(self.world.now_ns + 10 * S)
        self._judge()

    def _wind_down(self) -> None:
        self.world.winding_down = True

    # ---------------------------------------------------------------- faults

    def _plan_faults(self) -> None:
        times = self.world.schedule.stream("times of faults")
        place = self.world.schedule.place("fault")
        acts = (
            self._kill, self._kill, self._freeze, self._freeze, self._cut, self._cut,
            self._stall, self._cancel, self._lose_standby, self._fail_over, self._fail_over,
            self._part, self._deafen, self._deafen, self._unsure, self._unsure,
        )  # fmt: skip
        when_s = 3.0 + times.expovariate(self._faults_per_s)
        while when_s * 1e9 < FAULTS_NS:
            place.next()
            fire = partial(self._fire, place.fault, times.choice(acts))
            if self.world.schedule.allows(place.fault):
                self.world.after(int(when_s * 1e9), fire)
            when_s += times.expovariate(self._faults_per_s)

    def _fire(self, fault: str, act: Callable[[Random, str], str]) -> None:
        luck = self.world.schedule.stream(fault)
        text = act(luck, luck.choice(list(self.pairs)))
        if text:
            self.world.befell(fault, text)

    def _server(self, luck: Random, shard: str) -> SimulatedDaemon:
        """Return mostly the one that serves."""
        daemons = self.pairs[shard].daemons
        serving = [daemon for daemon in daemons if daemon.serving]
        return luck.choice(serving if serving and luck.random() < 0.8 else daemons)

    def _kill(self, luck: Random, shard: str) -> str:
        daemon = self._server(luck, shard)
        down_ns = luck.choice((100 * MS, S, 5 * S))
        self.world.tally["daemons killed"] += daemon.up
        return f"{daemon.name} is killed" if daemon.dies(down_ns) else ""

    def _freeze(self, luck: Random, shard: str) -> str:
        daemon = self._server(luck, shard)
        duration_ns = luck.choice((500 * MS, 1_900 * MS, 2_100 * MS, 4 * S))
        if daemon.paused or not daemon.up:
            return ""
        self.world.tally["daemons frozen"] += 1
        daemon.pause(duration_ns)
        return f"{daemon.name} stands still for {duration_ns // MS} ms"

    def _cut(self, luck: Random, shard: str) -> str:
        daemon = self._server(luck, shard)
        return f"{daemon.name} loses its connections" if self.databases[shard].cut(daemon) else ""

    def _part(self, luck: Random, shard: str) -> str:
        """Keep one daemon from the database, not from its clients."""
        daemon, until_ns = self._server(luck, shard), self.world.now_ns + luck.choice((S, 5 * S))
        self.databases[shard].bar(daemon, until_ns)
        return f"{daemon.name} is cut off from the database"

    def _deafen(self, luck: Random, shard: str) -> str:
        daemon, duration_ns = self._server(luck, shard), luck.choice((S, 2_200 * MS, 3 * S))
        self.databases[shard].deafen(daemon, self.world.now_ns + duration_ns)
        return f"{daemon.name} has no answer of the database for {duration_ns // MS} ms"

    def _unsure(self, luck: Random, shard: str) -> str:
        """Let the primary go while it has what its standby has not, and after a look at it."""
        database, daemon = self.databases[shard], self._server(luck, shard)
        database.stall(6 * S)
        strike = luck.choice((database.cut, database.cut, lambda one: one.dies(100 * MS)))
        self.world.after(30 * MS, lambda: strike(daemon))
        after_ns = luck.randrange(1_100 * MS, 5 * S)
        self.world.after(after_ns, lambda: self._fail_over(luck, shard))
        return f"{daemon.name} loses a database whose standby stalls, and that fails over"

    def _stall(self, luck: Random, shard: str) -> str:
        duration_ns = luck.choice((100 * MS, S, 3 * S, 6 * S))
        self.databases[shard].stall(duration_ns)
        return f"the standby of the database of {shard} stalls for {duration_ns // MS} ms"

    def _cancel(self, luck: Random, shard: str) -> str:
        database = self.databases[shard]
        database.stall(luck.choice((50 * MS, S)))
        self.world.after(20 * MS, database.cancel)
        if luck.random() < 0.5:
            after_ns = luck.randrange(25 * MS, S)
            self.world.after(after_ns, lambda: self._fail_over(luck, shard))
        return f"a wait for the standby of {shard} is cancelled"

    def _lose_standby(self, luck: Random, shard: str) -> str:
        noticed_ns, back_ns = luck.choice((S, 4 * S)), luck.choice((S, 5 * S))
        lost = self.databases[shard].lose_standby(noticed_ns=noticed_ns, back_ns=back_ns)
        return f"the database of {shard} loses its standby" if lost else ""

    def _fail_over(self, luck: Random, shard: str) -> str:
        still = [daemon for daemon in self.pairs[shard].daemons if luck.random() < 0.5]
        done = self.databases[shard].fail_over(
            away_ns=luck.choice((200 * MS, 2 * S, 6 * S)), back_ns=2 * S, still=still
        )
        names = ", ".join(daemon.name for daemon in still)
        return f"the database of {shard} fails over; still at the old one: {names}" if done else ""

    # ---------------------------------------------------------------- clients

    def _thread(self, host: ClientNode, lane: int) -> Thread:
        luck = self.world.schedule.stream(f"work of {host.name}/{lane}")
        while not self.world.winding_down:
            yield from self._lock(host, lane, luck)
            yield Sleep(luck.choice((MS, 20 * MS, 200 * MS)))

    def _lock(self, host: ClientNode, lane: int, luck: Random) -> Thread:
        kind = luck.choice(_KINDS)
        access = {"read": Access.READ, "view": Access.VIEW}.get(kind, Access.WRITE)
        entities = luck.sample(ENTITIES, 1 if kind == "increment" else 2)
        aspect = luck.choice(ASPECTS).name
        items = tuple(Item(access, WORLD, entity, aspect) for entity in entities)
        begun_ns, plan = self.world.now_ns, host.client.plan(items)
        lock = host.client.begin(lane, plan, now_ns=host.local_ns, wait_ns=8 * S, hold_ns=60 * S)
        story = LockStory(str(lock.lock), begun_ns, None, LockOutcome.UNKNOWN)
        self.stories.append((story, lock))
        yield from host.drive(lock)
        if lock.phase is Phase.HELD:
            yield Sleep(luck.choice((0, 0, MS, 50 * MS, S)))
            if lock.phase is Phase.HELD:
                self._finish(host, lock, story, luck, writes=access is Access.WRITE)
            yield from host.drive(lock)
        self._ended(lock, story, view=access is Access.VIEW)

    @staticmethod
    def _finish(
        host: ClientNode, lock: MultiLock, story: LockStory, luck: Random, *, writes: bool
    ) -> None:
        items: dict[str, list[WriteItem]] = {}
        for reading in lock.states if writes else ():
            slot, old = reading.state.slot, reading.state.datum
            datum = datum_of(f"{lock.lock}|{1 if old is None else value_of(old) + 1}")
            shard = shard_of(slot.entity, host.client.placement)
            items.setdefault(shard, []).append(WriteItem(slot, datum))
        story.writes = [write.slot for some in items.values() for write in some]
        lock.finish(items, give_up_ns=host.local_ns + luck.choice((3, 30)) * S)

    def _ended(self, lock: MultiLock, story: LockStory, *, view: bool) -> None:
        story.ended_ns = self.world.now_ns
        if lock.phase is Phase.COMMITTED:
            story.told = LockOutcome.COMMITTED
        elif lock.phase in TOLD_NOT:
            story.told = LockOutcome.NOT
        self.world.tally[f"locks {lock.phase.value}"] += 1
        reads = [
            StateRead(state.slot, (state.version, state.stamp_ns) if state.version else None)
            for _, _, state in lock.states
        ]
        if view:
            story.views = reads
        else:
            story.reads = reads

    # ---------------------------------------------------------------- judgement

    def _judge(self) -> None:
        chains: dict[Slot, list[ChainState]] = {}
        for database in self.databases.values():
            persists = database.persists()
            if len(set(map(id, persists))) < len(persists):
                self.world.violation("no batch is written twice", database.name)
            for record in (record for persist in persists for record in persist.records):
                if isinstance(record, SlotRecord) and record.datum is not None:
                    chain = chains.setdefault(record.slot, [])
                    name = record.version, record.stamp_ns
                    if not chain or chain[-1].name != name:
                        chain.append(ChainState(name, writer_of(record.datum), record.version))
        anomalies = Checker((story for story, _ in self.stories), chains).anomalies()
        if anomalies:
            self.world.violation(anomalies[0].rule, *anomalies[0].facts)
        self.world.tally["writes judged"] += sum(map(len, chains.values()))
