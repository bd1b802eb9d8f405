"""A whole run from one seed: a cell, its faults, its work, its judgement.

::

    0 s ───────── faults ────────── heal ── work goes on ── wind down ── quiet? ── judge
"""

from __future__ import annotations

import traceback
from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING

from enact_dist.core.messages import Goodbye, PlacementMap, ShardEntry
from enact_dist.core.records import Drain, SessionDied, SessionSeen
from enact_dist.core.shard_state import ShardSettings
from enact_dist.verify.simulation import faults as fault_options
from enact_dist.verify.simulation.client_host import ClientHost
from enact_dist.verify.simulation.graph import Graph
from enact_dist.verify.simulation.history import History
from enact_dist.verify.simulation.model import Model
from enact_dist.verify.simulation.network import Network
from enact_dist.verify.simulation.shard_host import ShardHost
from enact_dist.verify.simulation.workload import ASPECTS, CONTEXTS, Workload
from enact_dist.verify.simulation.world import MS, Host, S, SimulationError, World

if TYPE_CHECKING:
    from collections import Counter

    from enact_dist.core.messages import Commit
    from enact_dist.verify.simulation.faults import Faults

FAULTS_NS = 20 * S
"""How long faults go on."""
WORK_NS = 25 * S
"""How long new locks are begun."""
QUIET_NS = 30 * S
"""How long after that everything must have come to rest."""
POLL_NS = 500 * MS


@dataclass(frozen=True, slots=True)
class Result:
    """What a run has shown.  `violation` is empty where every rule held."""

    seed: int
    violation: str
    tally: Counter[str]
    simulated_s: float
    trace: str = field(default="", repr=False)


class Scenario:
    """One cell and its run."""

    def __init__(
        self,
        seed: int,
        *,
        faults: Faults | None = None,
        through_wire: bool = True,
        asserts: bool = True,
    ) -> None:
        self.seed = seed
        random = Random(seed)
        self.world = world = World(random)
        count = random.choice((1, 2, 2, 3))
        self.faults = fault_options.drawn(random, shards=count) if faults is None else faults
        self.ttl_ns = random.choice((500 * MS, S, 2 * S))
        self.history = History()
        durabilities = {entry.name: entry.durability for entry in ASPECTS}
        self.model = Model(world, self.history, durabilities)
        self.network = Network(world, self.faults, through_wire=through_wire)
        self.network.set_off = self._set_off
        self.network.before_decision = self._before_decision
        self.shards = self._made_shards(count)
        for host in self.shards.values():
            host.asserts = asserts
        self.workload = Workload(
            world, self.history, self.model, entities=random.choice((1, 2, 3, 4))
        )
        self._lanes = random.choice((1, 2, 3))
        self._clients = random.choice((2, 3, 4))
        self._named = 0
        # Some runs end in the middle of the faults, so that nothing that comes later repairs them.
        self._work_ns = random.choice((WORK_NS, FAULTS_NS - S // 2))

    def _made_shards(self, count: int) -> dict[str, ShardHost]:
        names = [f"s{index}" for index in range(count)]
        placement = PlacementMap(1, tuple(ShardEntry(name, ()) for name in names), ())
        shards = {}
        for name in names:
            settings = ShardSettings(name, placement, worlds=CONTEXTS)
            host = shards[name] = ShardHost(
                self.world,
                settings,
                self.faults,
                wall_offset_ns=self.world.random.randrange(-200 * MS, 200 * MS),
            )
            host.model = self.model
            host.tokens = self._tokens_seen
            host.on_persist = self._on_persist
            host.on_decision = self._on_decision
            host.network, host.peers = self.network, shards
        return shards

    def _add_client(self) -> None:
        self._named += 1
        host = ClientHost(
            self.world,
            f"c{self._named}",
            network=self.network,
            shards=self.shards,
            model=self.model,
            faults=self.faults,
            ttl_ns=self.ttl_ns,
        )
        host.starves_until_ns = FAULTS_NS
        self.model.clients.append(host)
        self._show_token(host, present=True)

        def work() -> None:
            host.keep_alive()
            for lane in range(self._lanes):
                host.start(self.workload.thread(host, lane))

        host.start(host.open(ASPECTS, work))

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
        return Result(self.seed, violation, self.world.tally, self.world.now_ns / 1e9, trace)

    def _run(self) -> None:
        for host in self.shards.values():
            host.boot()
        for _ in range(self._clients):
            self._add_client()
        self._plan_faults()
        self.world.after(self._work_ns, self._wind_down)
        self.world.run_until(FAULTS_NS)
        self._heal()
        self.world.run_until(self._work_ns)
        while not self._quiet() and self.world.now_ns < WORK_NS + QUIET_NS:
            self.world.run_until(self.world.now_ns + POLL_NS)
        self._check_quiet()
        for host in self.shards.values():
            host.close()
        self.model.check_all_or_nothing()
        graph = Graph(self.history, self.model)
        graph.check_views()
        cycle = graph.cycle()
        if cycle is not None:
            self.world.violation("I6 strict serializability", *("\n  " + line for line in cycle))

    def _wind_down(self) -> None:
        self.world.winding_down = True

    def _quiet(self) -> bool:
        busy = any(host.threads_left for host in self.model.clients if host.up)
        locks = any(
            host.shard.state.tenures.by_lock
            or host.unanswered
            or host.shard.state.decisions.by_lock
            for host in self.shards.values()
        )
        return not busy and not locks

    def _check_quiet(self) -> None:
        """I12: when faults have ended, everything comes to rest."""
        for host in self.model.clients:
            if host.up and (host.threads_left or host.client.live_locks()):
                phases = [(str(lock.lock), lock.phase) for lock in host.client.live_locks()]
                self.world.violation("I12 all threads end", host.name, host.threads_left, phases)
        for host in self.shards.values():
            left = host.shard.state.tenures.by_lock
            untold = host.shard.state.decisions.by_lock
            if left or host.unanswered or untold:
                self.world.violation(
                    "I12 nothing is left", host.name, list(left.values()), host.unanswered, untold
                )

    # ---------------------------------------------------------------- faults in time

    def _plan_faults(self) -> None:
        faults, random = self.faults, self.world.random
        for rate, act in (
            (faults.crashes_per_s, self._crash_one),
            (faults.crashes_per_s / 4, self._drain_one),
            (faults.kills_per_s, self._kill_one),
            (faults.pauses_per_s, self._pause_one),
            (faults.partitions_per_s, self._partition),
            (faults.wall_jumps_per_s, self._jump),
        ):
            when_s = random.expovariate(rate) if rate else FAULTS_NS
            while when_s < FAULTS_NS / 1e9:
                self.world.after(int(when_s * 1e9), act)
                when_s += random.expovariate(rate)

    def _heal(self) -> None:
        self.network.heal(fault_options.NONE)
        for host in (*self.shards.values(), *self.model.clients):
            if host.paused:
                host.resume()
        for host in self.model.clients:
            self._show_token(host, present=host.up)

    def _up_clients(self) -> list[ClientHost]:
        return [host for host in self.model.clients if host.up]

    def _crash_one(self) -> None:
        self._crash(self.world.random.choice(list(self.shards.values())))

    def _crash(self, host: ShardHost) -> None:
        random = self.world.random
        if self.world.now_ns >= FAULTS_NS:
            return
        power_cut = random.random() < self.faults.power_cut
        down_ns = random.choice((20 * MS, 20 * MS, 300 * MS, 2 * S))
        host.crash(power_cut=power_cut, down_ns=down_ns)
        for client in self._up_clients():
            # A link that breaks is often noticed at once, and then nobody waits for an answer.
            if random.random() < 0.5:
                client.receive(lambda client=client: client.notices_end_of(host.name))

    def _drain_one(self) -> None:
        """Stop a shard as a signal does: it answers who is parked, grants no more, and ends."""
        host = self.world.random.choice(list(self.shards.values()))
        if host.up:
            self.world.tally["drains"] += 1
            host.receive(lambda: host.event(Drain()))
            life, delay_ns = host.life, self.world.random.randrange(S)
            self.world.after(delay_ns, lambda: self._end_drained(host, life))

    @staticmethod
    def _end_drained(host: ShardHost, life: int) -> None:
        if host.life == life:
            host.crash(power_cut=False, down_ns=300 * MS)

    def _kill_one(self) -> None:
        host = self.world.random.choice(self._up_clients())
        if self.world.random.random() < 0.3:
            self.world.tally["goodbyes"] += 1
            for shard in host.client.shards_in_use():
                host.call(shard, Goodbye(host.client.session), lambda _answer: None)
        else:
            self.world.tally["clients killed"] += 1
        host.dies()
        self._show_token(host, present=False)
        self._prove_death(host)
        self._add_client()

    def _prove_death(self, host: ClientHost) -> None:
        """Tell shards of the same host what the kernel knows; messages may still be under way."""
        chance = int(host.client.session, 16)  # drawn already: older seeds stay as they were
        for shard in self.shards.values():
            chance, proven = chance >> 8, chance & 1
            if proven:
                self.world.tally["deaths proven"] += 1
                died = SessionDied(host.client.session)
                self.world.after(
                    (chance & 31) * MS,
                    lambda shard=shard, died=died: shard.receive(lambda: shard.event(died)),
                )

    def _pause_one(self) -> None:
        self._pause(self.world.random.choice([*self.shards.values(), *self._up_clients()]))

    def _pause(self, host: Host) -> None:
        random, world = self.world.random, self.world
        ttl_ns = self.ttl_ns
        duration_ns = random.choice((ttl_ns // 4, ttl_ns, 3 * ttl_ns, 7 * ttl_ns))
        world.tally["pauses"] += 1
        host.pause(min(duration_ns, max(0, FAULTS_NS - world.now_ns)))
        if isinstance(host, ClientHost) and random.random() >= self.faults.busy:
            world.after(self.ttl_ns // 2, lambda: self._token_of(host))
            world.after(duration_ns + 10 * MS, lambda: self._token_of(host))
        elif isinstance(host, ClientHost):
            world.tally["pauses with token"] += 1

    def _partition(self) -> None:
        random, world = self.world.random, self.world
        if len(self.shards) > 1 and random.random() < 0.4:
            one, other = random.sample(list(self.shards.values()), 2)
            world.tally["partitions: shards"] += 1
            duration_ns = random.choice((500 * MS, 2 * S, 5 * S))
            self.network.cut(one, other, duration_ns=duration_ns)
            if random.random() < 0.5:
                self.network.cut(other, one, duration_ns=duration_ns)
            return
        client = random.choice(self._up_clients())
        shards = random.sample(list(self.shards.values()), random.randint(1, len(self.shards)))
        duration_ns = random.choice((500 * MS, 2 * S, 5 * S))
        ways = random.choice(("out", "in", "both"))
        world.tally[f"partitions: {ways}"] += 1
        for shard in shards:
            if ways != "in":
                self.network.cut(client, shard, duration_ns=duration_ns)
            if ways != "out":
                self.network.cut(shard, client, duration_ns=duration_ns)
        world.after(self.ttl_ns // 2, lambda: self._token_of(client))
        world.after(duration_ns + 10 * MS, lambda: self._token_of(client))

    def _jump(self) -> None:
        random = self.world.random
        host = random.choice(list(self.shards.values()))
        jump_ns = int(self.faults.wall_jump_s * 1e9)
        host.wall_offset_ns = random.randint(-jump_ns, jump_ns)
        self.model.clocks_were_set = True
        self.world.tally["wall clocks set"] += 1

    # ---------------------------------------------------------------- faults by state

    def _set_off(self, source: Host, target: Host) -> int | None:
        """Let something happen at a decisive message; return how late it is, None if lost."""
        random, world = self.world.random, self.world
        if world.now_ns >= FAULTS_NS:
            return 0
        world.tally["faults set off"] += 1
        kind = random.choice(("lose", "late", "pause", "crash", "late, crash", "partition"))
        host = random.choice((source, target))
        if kind == "lose":
            return None
        if kind == "pause":
            self._pause(host)
        elif kind == "partition":
            self.network.cut(target, source, duration_ns=random.choice((300 * MS, self.ttl_ns)))
        if "crash" in kind:
            shard = next(h for h in (source, target) if isinstance(h, ShardHost))
            world.after(random.choice((0, MS // 2, MS, 3 * MS)), lambda: self._crash(shard))
        late_ns = (50 * MS, self.ttl_ns // 2, self.ttl_ns * 3 // 4, self.ttl_ns)
        return random.choice(late_ns) if "late" in kind else 0

    def _on_persist(self, host: ShardHost) -> None:
        random = self.world.random
        if self.faults.triggered and random.random() < self.faults.triggered / 2:
            self.world.after(random.randrange(6 * MS), lambda: self._crash(host))

    def _before_decision(self, commit: Commit, primary: Host) -> None:
        """All are prepared, and the commit that decides is about to leave its client."""
        if self.world.random.random() < self.faults.at_decision:
            self.world.tally["crashes before a decision"] += 1
            self._crash_around([primary.name, *commit.participants])

    def _on_decision(self, primary: ShardHost, told: list[str]) -> None:
        """A decision is durable and its participants are about to hear of it."""
        if self.world.random.random() < self.faults.at_decision:
            self.world.tally["crashes after a decision"] += 1
            self._crash_around([primary.name, *told])

    def _crash_around(self, names: list[str]) -> None:
        random = self.world.random
        for name in random.sample(names, random.choice((1, 1, len(names)))):
            host = self.shards[name]
            delay_ns = random.choice((0, MS // 4, MS, 2 * MS))
            self.world.after(delay_ns, lambda host=host: self._crash(host))

    # ---------------------------------------------------------------- liveliness tokens

    def _visible(self, host: ClientHost, shard: ShardHost) -> bool:
        return (
            self.faults.tokens
            and host.up
            and not host.paused
            and not self.network.is_cut(host, shard)
        )

    def _tokens_seen(self, shard: ShardHost) -> list[str]:
        return [h.client.session for h in self.model.clients if self._visible(h, shard)]

    def _token_of(self, host: ClientHost) -> None:
        """Let every shard notice whether the client's liveliness token is there."""
        for shard in self.shards.values():
            seen = SessionSeen(host.client.session, self._visible(host, shard))
            shard.receive(lambda shard=shard, seen=seen: shard.event(seen))

    def _show_token(self, host: ClientHost, *, present: bool) -> None:
        seen = SessionSeen(host.client.session, present and self.faults.tokens)
        for shard in self.shards.values():
            self.world.after(10 * MS, lambda shard=shard: shard.receive(lambda: shard.event(seen)))
