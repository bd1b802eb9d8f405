"""Carries out faults: what comes with time, and what a message, write or decision sets off.

Faults that only come with time miss the moments in which the protocol changes hands.
"""

from __future__ import annotations

from functools import partial
from random import Random
from typing import TYPE_CHECKING

from enact_dist.core.protocol.messages import Goodbye
from enact_dist.core.protocol.records import Drain, SessionDied
from enact_dist.verify.simulation.hosts.client_host import ClientNode
from enact_dist.verify.simulation.hosts.shard_host import ShardNode
from enact_dist.verify.simulation.hosts.world import MS, Host, S

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.core.protocol.messages import Commit
    from enact_dist.verify.simulation.cells import CellPlan
    from enact_dist.verify.simulation.hosts.network import Network
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld
    from enact_dist.verify.simulation.schedule import FaultPlace

    Act = Callable[[Random], str]

SET_OFF = ("lose", "late", "pause", "crash", "late, crash", "cut", "stall", "kill")
"""What a decisive message may set off."""


class Injector:
    """Faults of one cell.  Each act returns what it did, or "" if there was nothing to do."""

    def __init__(
        self,
        world: SimulatedWorld,
        cell: CellPlan,
        network: Network,
        shards: dict[str, ShardNode],
        *,
        until_ns: int,
    ) -> None:
        self._world, self._cell, self._network, self._shards = world, cell, network, shards
        self._faults = cell.faults
        self._until_ns = until_ns
        self.clients: dict[int, ClientNode] = {}
        """The process that is up for each client, by the client's number."""
        self.token_of: Callable[[ClientNode], None] = lambda _client: None
        self.replace: Callable[[int], None] = lambda _number: None
        self.clock_set: Callable[[], None] = lambda: None
        self._decisions = world.schedule.place("decision")
        self._told = world.schedule.place("told")
        self._steps = world.schedule.place("step")
        network.set_off = self.set_off
        network.before_decision = self.before_decision
        for host in shards.values():
            host.on_persist = partial(self.on_persist, world.schedule.place(f"{host.name}-write"))
            host.on_decision = self.on_decision

    @property
    def _over(self) -> bool:
        return self._world.now_ns >= self._until_ns

    # ---------------------------------------------------------------- in time

    def plan(self) -> None:
        """Plan what comes with time, until faults end."""
        faults = self._faults
        kinds: tuple[tuple[str, float, Act], ...] = (
            ("crash", faults.crashes_per_s, self._crash_one),
            ("drain", faults.crashes_per_s / 4, self._drain_one),
            ("kill", faults.kills_per_s, self._kill_one),
            ("pause", faults.pauses_per_s, self._pause_one),
            ("stall", faults.stalls_per_s, self._stall_one),
            ("starve", faults.starves_per_s, self._starve_one),
            ("cut", faults.partitions_per_s, self._cut_some),
            ("clock", faults.wall_jumps_per_s, self._set_clock),
        )
        for name, rate, act in kinds:
            times = self._world.schedule.stream(f"times of {name}")
            place = self._world.schedule.place(name)
            when_s = times.expovariate(rate) if rate else float("inf")
            while when_s * 1e9 < self._until_ns:
                luck = Random(place.next())
                if self._world.schedule.allows(place.fault):
                    fire = partial(self._fire, place.fault, act, luck)
                    self._world.after(int(when_s * 1e9), fire)
                when_s += times.expovariate(rate)

    def _fire(self, fault: str, act: Act, luck: Random) -> None:
        text = "" if self._over else act(luck)
        if text:
            self._world.befell(fault, text)

    def _shard(self, luck: Random) -> ShardNode:
        return luck.choice(list(self._shards.values()))

    def _client(self, luck: Random) -> ClientNode | None:
        """Return who is up for a client; None if that client has no part in this run."""
        found = self.clients.get(luck.randint(1, self._cell.clients))
        return found if found is not None and found.up else None

    def _crash_one(self, luck: Random) -> str:
        return self._crash(self._shard(luck), luck)

    def _crash(self, host: ShardNode, luck: Random) -> str:
        power_cut = luck.random() < self._faults.power_cut
        down_ns = luck.choice((20 * MS, 20 * MS, 300 * MS, 2 * S))
        # A link that breaks is often noticed at once, and then no client waits for an answer.
        notices = luck.getrandbits(self._cell.clients + 1)
        if self._over or not host.up:
            return ""
        host.crash(power_cut=power_cut, down_ns=down_ns, luck=luck)
        for number, client in self.clients.items():
            if notices >> number & 1:
                client.receive(partial(client.notices_end_of, host.name))
        how = "loses power" if power_cut else "is killed"
        return f"{host.name} {how}, back after {down_ns // MS} ms"

    def _crash_later(self, fault: str, host: ShardNode, luck: Random, delay_ns: int) -> None:
        """Crash a shard in a moment, as a part of a fault that has happened already."""
        self._world.after(delay_ns, lambda: self._fire(fault, partial(self._crash, host), luck))

    def _drain_one(self, luck: Random) -> str:
        """Stop a shard as a signal does: it answers parked requests, grants no more, and ends."""
        host, delay_ns = self._shard(luck), luck.randrange(S)
        if not host.up:
            return ""
        self._world.tally["drains"] += 1
        host.receive(partial(host.event, Drain()))
        self._world.after(delay_ns, partial(self._end_drained, host, host.life, luck))
        return f"{host.name} gets SIGTERM, ends after {delay_ns // MS} ms, back 300 ms later"

    @staticmethod
    def _end_drained(host: ShardNode, life: int, luck: Random) -> None:
        if host.life == life:
            host.crash(power_cut=False, down_ns=300 * MS, luck=luck)

    def _kill_one(self, luck: Random) -> str:
        client = self._client(luck)
        return "" if client is None else self._kill(client, luck)

    def _kill(self, client: ClientNode, luck: Random) -> str:
        if not client.up:
            return ""
        leaves = luck.random() < 0.3
        if leaves:
            self._world.tally["goodbyes"] += 1
            for shard in client.client.shards_in_use():
                client.call(shard, Goodbye(client.client.session), lambda _answer: None)
        else:
            self._world.tally["clients killed"] += 1
        client.dies()
        number = next(number for number, host in self.clients.items() if host is client)
        self.token_of(client)
        self.replace(number)
        for host in self._shards.values():
            if luck.random() < 0.4:
                self._prove_death(client, host, delay_ns=luck.randrange(20 * MS))
        return f"{client.name} {'says goodbye and ends' if leaves else 'is killed'}"

    def _prove_death(self, client: ClientNode, shard: ShardNode, *, delay_ns: int) -> None:
        """Tell a shard what the kernel of its host knows; messages may still be under way."""
        self._world.tally["deaths proven"] += 1
        died = SessionDied(client.client.session)
        self._world.after(delay_ns, lambda: shard.receive(lambda: shard.event(died)))

    def _pause_one(self, luck: Random) -> str:
        # One among all hosts; a client that is left out of a run is not paused.
        index = luck.randrange(len(self._shards) + self._cell.clients)
        host: Host | None = self.clients.get(index - len(self._shards) + 1)
        if index < len(self._shards):
            host = list(self._shards.values())[index]
        return "" if host is None else self._pause(host, luck)

    def _pause(self, host: Host, luck: Random) -> str:
        world, ttl_ns = self._world, self._cell.ttl_ns
        duration_ns = luck.choice((ttl_ns // 4, ttl_ns, 3 * ttl_ns, 7 * ttl_ns))
        busy, suspended = luck.random() < self._faults.busy, luck.random() < self._faults.suspended
        if host.paused or not host.up:
            return ""
        world.tally["pauses"] += 1
        world.tally["pauses longer than the TTL"] += duration_ns > ttl_ns
        pause_ns = min(duration_ns, max(0, self._until_ns - world.now_ns))
        if isinstance(host, ClientNode):
            host.pause(pause_ns)
            if busy:
                world.tally["pauses with token"] += 1
                return f"{host.name} stands still for {duration_ns // MS} ms, its token stays"
            self._token_goes(host, duration_ns)
            return f"{host.name} stands still for {duration_ns // MS} ms"
        host.pause(pause_ns, suspended=suspended)
        world.tally["suspends"] += suspended
        clock = ", and so does its clock" if suspended else ""
        return f"{host.name} stands still for {duration_ns // MS} ms{clock}"

    def _token_goes(self, client: ClientNode, duration_ns: int) -> None:
        """Let a client's liveliness token vanish, a while after its link went silent."""
        self._world.after(self._cell.ttl_ns // 2, partial(self.token_of, client))
        self._world.after(duration_ns + 10 * MS, partial(self.token_of, client))

    def _stall_one(self, luck: Random) -> str:
        return self._stall(self._shard(luck), luck)

    def _stall(self, host: ShardNode, luck: Random) -> str:
        ttl_ns = self._cell.ttl_ns
        duration_ns = luck.choice((ttl_ns // 8, ttl_ns // 2, ttl_ns, 3 * ttl_ns))
        if not host.stall(min(duration_ns, max(0, self._until_ns - self._world.now_ns))):
            return ""
        self._world.tally["dispatchers stalled"] += 1
        return f"the dispatcher of {host.name} is stuck for {duration_ns // MS} ms"

    def _starve_one(self, luck: Random) -> str:
        client, duration_ns = self._client(luck), luck.choice((S, 3 * S, 10 * S))
        if client is None:
            return ""
        until_ns = min(self._until_ns, self._world.now_ns + duration_ns)
        client.starves_until_ns = max(client.starves_until_ns, until_ns)
        return f"{client.name} sends no keep-alive for {duration_ns // MS} ms"

    def _cut_some(self, luck: Random) -> str:
        world, network = self._world, self._network
        among_shards = len(self._shards) > 1 and luck.random() < 0.4
        duration_ns = luck.choice((100 * MS, 500 * MS, 2 * S, 5 * S))
        names = luck.sample(list(self._shards), luck.randint(1, len(self._shards)))
        if among_shards:
            one, other = luck.sample(list(self._shards.values()), 2)
            both = luck.random() < 0.5
            world.tally[f"partitions: shards, {'both ways' if both else 'one way'}"] += 1
            network.cut(one, other, duration_ns=duration_ns)
            if both:
                network.cut(other, one, duration_ns=duration_ns)
            way = "and back " if both else ""
            return f"nothing from {one.name} to {other.name} {way}for {duration_ns // MS} ms"
        client, ways = self._client(luck), luck.choice(("out", "in", "both"))
        if client is None:
            return ""
        world.tally[f"partitions: {ways}"] += 1
        for shard in (self._shards[name] for name in names):
            if ways != "in":
                network.cut(client, shard, duration_ns=duration_ns)
            if ways != "out":
                network.cut(shard, client, duration_ns=duration_ns)
        self._token_goes(client, duration_ns)
        way = {"out": "to", "in": "from", "both": "between it and"}[ways]
        return f"{client.name}: nothing {way} {', '.join(names)} for {duration_ns // MS} ms"

    def _set_clock(self, luck: Random) -> str:
        host, jump_ns = self._shard(luck), int(self._faults.wall_jump_s * 1e9)
        host.wall_offset_ns = luck.randint(-jump_ns, jump_ns)
        self.clock_set()
        self._world.tally["wall clocks set"] += 1
        return f"the wall clock of {host.name} is set to {host.wall_offset_ns / 1e9:+.3f} s"

    # ---------------------------------------------------------------- by state

    def set_off(self, fault: str, luck: Random, source: Host, target: Host) -> int | None:
        """Let something happen at a decisive message; return how late it is, None if lost."""
        if self._over:
            return 0
        world, ttl_ns = self._world, self._cell.ttl_ns
        world.tally["faults set off"] += 1
        kind, host = luck.choice(SET_OFF), luck.choice((source, target))
        late_ns = luck.choice((50 * MS, ttl_ns // 2, ttl_ns * 3 // 4, ttl_ns))
        shard = next(h for h in (source, target) if isinstance(h, ShardNode))
        told = [f"a message from {source.name} to {target.name}"]
        if kind == "lose":
            told.append("is lost")
        elif kind == "pause":
            told.append(self._pause(host, luck))
        elif kind == "stall":
            told.append(self._stall(shard, luck))
        elif kind == "kill" and isinstance(host, ClientNode):
            told.append(self._kill(host, luck))
        elif kind == "cut":
            duration_ns = luck.choice((300 * MS, ttl_ns))
            self._network.cut(target, source, duration_ns=duration_ns)
            told.append(f"nothing comes back for {duration_ns // MS} ms")
        if "late" in kind:
            told.append(f"is {late_ns // MS} ms late")
        world.befell(fault, ", ".join(part for part in told if part))
        if "crash" in kind:
            delay_ns = luck.choice((0, MS // 2, MS, 3 * MS))
            self._crash_later(fault, shard, luck, delay_ns)
        return None if kind == "lose" else late_ns * ("late" in kind)

    def on_persist(self, place: FaultPlace, host: ShardNode) -> None:
        """Let a shard die while it writes."""
        bits = place.next()
        if (bits & 0xFFFF) < self._faults.triggered * 0x8000:
            self._crash_around(place.fault, Random(bits), [host], within_ns=6 * MS)

    def at_step(self, client: ClientNode, shard: str) -> None:
        """Let a client that is between two steps with a kept grant, or its shard, be struck."""
        bits = self._steps.next()
        fault = self._steps.fault
        if (bits & 0xFFFF) >= self._faults.triggered * 0x8000 or self._over:
            return
        if not self._world.schedule.allows(fault):
            return
        luck, host = Random(bits), self._shards[shard]
        kind, text = luck.choice(("pause", "kill", "crash", "stall", "starve")), ""
        if kind == "pause":
            text = self._pause(client, luck)
        elif kind == "kill":
            text = self._kill(client, luck)
        elif kind == "stall":
            text = self._stall(host, luck)
        elif kind == "starve":
            client.starves_until_ns = max(client.starves_until_ns, self._world.now_ns + 3 * S)
            text = f"{client.name} sends no keep-alive for 3000 ms"
        else:
            self._crash_later(fault, host, luck, luck.choice((0, MS, 5 * MS)))
        if text:
            self._world.befell(fault, text)

    def before_decision(self, commit: Commit, primary: Host) -> None:
        """All are prepared, and the commit that decides is about to leave its client."""
        self._at_decision(self._decisions, [primary.name, *commit.participants], "before")

    def on_decision(self, primary: ShardNode, told: Sequence[str]) -> None:
        """A decision is durable and its participants are about to be notified."""
        self._at_decision(self._told, [primary.name, *told], "after")

    def _at_decision(self, place: FaultPlace, names: list[str], when: str) -> None:
        bits = place.next()
        if (bits & 0xFFFF) < self._faults.at_decision * 0x10000 and not self._over:
            hosts = [self._shards[name] for name in names]
            if self._crash_around(place.fault, Random(bits), hosts, within_ns=2 * MS):
                self._world.tally[f"crashes {when} a decision"] += 1

    def _crash_around(
        self, fault: str, luck: Random, hosts: list[ShardNode], *, within_ns: int
    ) -> bool:
        """Let one of these shards die in a moment, or all of them."""
        if not self._world.schedule.allows(fault):
            return False
        for host in luck.sample(hosts, luck.choice((1, 1, len(hosts)))):
            delay_ns = luck.choice((0, luck.randrange(within_ns)))
            self._crash_later(fault, host, Random(luck.getrandbits(64)), delay_ns)
        return True
