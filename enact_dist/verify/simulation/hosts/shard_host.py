"""The process around one real `Shard`: carries out its effects, ticks it, dies and comes back."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Protocol, cast

from enact_dist.core.protocol.messages import FAR, Answer, Finish, Refused, Request, Stage
from enact_dist.core.protocol.records import (
    Call,
    Called,
    Persist,
    Persisted,
    Reply,
    SessionSeen,
    Tick,
)
from enact_dist.core.shard.shard import Shard
from enact_dist.verify.simulation.hosts.disk import Disk
from enact_dist.verify.simulation.hosts.folders import NO_NONCE, Folders
from enact_dist.verify.simulation.hosts.keeping import SimulatedMarks, SimulatedPage
from enact_dist.verify.simulation.hosts.payloads import ShardPayloads, as_kept
from enact_dist.verify.simulation.hosts.world import MS, Host, S

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from random import Random

    from enact_dist.core.protocol.records import Effect, Event, Recovered
    from enact_dist.core.shard.state import ShardSettings
    from enact_dist.core.state.tenure import Tenure
    from enact_dist.verify.simulation.faults import Faults
    from enact_dist.verify.simulation.hosts.network import Network
    from enact_dist.verify.simulation.hosts.world import SimulatedWorld


ASSERT_EVERY = 4
"""Steps between two looks at the shard's own assertions; the judge looks at each step."""
AHEAD_NS = (0, 0, MS // 10, MS, 40 * MS)
"""How long after an answer a shard makes files ahead."""


class ShardJudge(Protocol):
    """Looks at each step of a shard, and at its crashes and starts."""

    def booted(self, host: ShardNode, recovered: Recovered, *, crashed_at_ns: int) -> None:
        """A shard has started with what its disk kept."""

    def judge_prefixes(self, host: ShardNode, *, power_cut: bool) -> None:
        """A shard is about to lose what a crash may take."""

    def crashed(self, host: ShardNode, lost: list[Persist], *, power_cut: bool) -> None:
        """A shard has died, and its disk has lost these records."""

    def handled(self, host: ShardNode, message: object, effects: Sequence[Effect]) -> None:
        """A shard has taken a message and decided."""


class ShardPlace(Host):
    """Where requests to a shard go."""

    marks: SimulatedMarks | None = None

    def request(self, message: Request, reply: Callable[[Answer], None]) -> None:
        """Hand a request to the shard."""
        raise NotImplementedError


class ShardNode(ShardPlace):
    """A shard daemon.  `asked` are the requests that it has not answered yet, by their handles."""

    def __init__(
        self, world: SimulatedWorld, settings: ShardSettings, faults: Faults, *, wall_offset_ns: int
    ) -> None:
        super().__init__(
            world, settings.name, drift_ppm=faults.drift_ppm, wall_offset_ns=wall_offset_ns
        )
        self.settings = settings
        self.faults = faults
        self.disk = Disk(world, faults, settings.name)
        self.asserts = True
        self.judge: ShardJudge
        self.shard: Shard
        self.payloads: ShardPayloads
        self.folders = Folders(world)
        self.keeps = False
        self.between: Callable[[str], None] = lambda _session: None
        self.tokens: Callable[[ShardNode], list[str]] = lambda _host: []
        self.on_persist: Callable[[ShardNode], None] = lambda _host: None
        self.on_decision: Callable[[ShardNode, list[str]], None] = lambda _host, _told: None
        self.network: Network
        self.peers: Mapping[str, ShardPlace] = {}
        self.asked: dict[int, Request] = {}
        self._replies: dict[int, Callable[[Answer], None]] = {}
        self._ahead = world.schedule.stream(f"{settings.name} makes ahead")
        self._handle = self._steps = 0
        self._stalled = self._deciding = False
        self._inbox: list[tuple[Request | Event, int]] = []
        self._tick_due_ns = 0
        self._crashed_at_ns = 0

    # ---------------------------------------------------------------- life

    def boot(self) -> None:
        """Start with what the disk has kept."""
        self.up = True
        self.clock = self.new_clock()
        self.serve(self.disk.recovered(unix_s=self.wall_ns // S))

    def serve(self, recovered: Recovered) -> None:
        """Serve what a store held when it was opened."""
        self._replies.clear()
        self.asked.clear()
        settings, folder = self.settings, None
        if self.folders.takes_place:
            folder = self.folders.made_for(self.name, self.between)
            settings = replace(settings, shared=folder.name, shared_nonce=NO_NONCE)
        self.shard = Shard(settings, recovered, now_ns=self.local_ns, wall_ns=self.wall_ns)
        self.payloads = ShardPayloads(self, self.shard, self.is_unused, self.folders, folder)
        if self.keeps:
            if self.marks is not None:
                self.marks.sweep()
            self.marks = SimulatedMarks(self.shard.epoch, self.between, lambda: self.world.now_ns)
            self.shard.state.tenures.kept.marks = self.marks
        self.judge.booted(self, recovered, crashed_at_ns=self._crashed_at_ns)
        self._tick_due_ns = 0
        self._plan_tick()
        for session in self.tokens(self):
            self.later(10 * MS, partial(self.event, SessionSeen(session, True)))
        if self.shard.epoch != 1:
            self.world.tally["epoch changes"] += 1
        self.world.tell(f"{self.name} starts with epoch {self.shard.epoch}")

    def crash(self, *, power_cut: bool, down_ns: int, luck: Random) -> None:
        """Die now and come back after a while."""
        if not self.up:
            return
        self.world.tally["power cuts" if power_cut else "crashes"] += 1
        self.end_life()
        self._stalled = False
        self.payloads.end()
        if power_cut:
            self.folders.remove(self.name)
            if self.marks is not None:
                self.marks.sweep()
        self._inbox.clear()
        self._crashed_at_ns = self.world.now_ns
        self._tally_counters()
        self.judge.judge_prefixes(self, power_cut=power_cut)
        lost = self.disk.crash(power_cut=power_cut, luck=luck)
        self.judge.crashed(self, lost, power_cut=power_cut)
        self.world.after(down_ns, self.boot)

    def _tally_counters(self) -> None:
        for name, count in self.shard.counters.items():
            self.world.tally[f"shard: {name}"] += count

    def stall(self, true_ns: int) -> bool:
        """Let the dispatcher stand still for a while, and nothing else of this host.

        The disk goes on, and what it reports waits with the requests.  False if it stalls already.
        """
        if self._stalled or self.paused or not self.up:
            return False
        self._stalled = True
        life = self.life
        self.world.after(true_ns, lambda: self._do(life, self.go_on))
        return True

    def go_on(self) -> None:
        """End a stall: what has come in is handled first, then the time is looked at."""
        self._stalled = False
        inbox, self._inbox = self._inbox, []
        for message, handle in inbox:
            if not isinstance(message, Tick):
                self._give(message, handle)
        if self.up and inbox:
            self._give(Tick(), 0)

    def is_living(self, tenure: Tenure) -> bool:
        """Whether a grant is kept: it is far, its cell says so, or a block uses it to its end."""
        if tenure.kept == FAR:
            return not tenure.bound
        page, number = self._page_of(tenure)
        return page is not None and (number in page.numbers() or tenure.recalled)

    def is_unused(self, tenure: Tenure) -> bool:
        """Whether a grant is kept, and no block uses it: who wants it can have it at once."""
        page, number = self._page_of(tenure)
        return page is not None and number in page.numbers() and number not in page.marks

    def _page_of(self, tenure: Tenure) -> tuple[SimulatedPage | None, int]:
        if self.marks is None or tenure.token is None or tenure.bound or not tenure.kept:
            return None, 0
        return self.marks.made.get(tenure.lock.session), tenure.token.number

    def close(self) -> None:
        """Add this shard's own statistics to those of the run."""
        self._tally_counters()
        self.payloads.tally_counters()

    # ---------------------------------------------------------------- messages in, effects out

    def request(self, message: Request, reply: Callable[[Answer], None]) -> None:
        """Hand a request to the shard; exactly one answer must come, now or later."""
        if isinstance(message, Stage):
            reply(self.payloads.stage(message))
            self._make_ahead()
            return
        self._handle += 1
        self._replies[self._handle], self.asked[self._handle] = reply, message
        self._give(self.payloads.with_bodies(message), self._handle)
        self._make_ahead()

    def _make_ahead(self) -> None:
        """Make the files that are wanted ahead, in a moment: clients meet none, some or all."""
        if self.payloads.handler.wants_ahead:
            self.later(self._ahead.choice(AHEAD_NS), self.payloads.make_ahead)

    def event(self, event: Event) -> None:
        """Hand an event of this host to the shard."""
        self._give(event, 0)

    def _give(self, message: Request | Event, handle: int) -> None:
        if self._stalled:
            self._inbox.append((message, handle))
            return
        if self._deciding:  # a client has gone on meanwhile, and something came of it at once
            self.later(0, lambda: self._give(message, handle))
            return
        now_ns, wall_ns = self.local_ns, self.wall_ns
        if isinstance(message, Tick):
            self.payloads.look()
        self._deciding = True
        decided = self.shard.handle(message, reply_to=handle, now_ns=now_ns, wall_ns=wall_ns)
        self._deciding = False
        effects = [as_kept(effect) for effect in decided]
        self._steps += 1
        if self.asserts and self._steps % ASSERT_EVERY == 0:
            self.shard.assert_invariants()
        self.judge.handled(self, message, effects)
        self.carry_out(effects)
        told = [e.shard for e in effects if isinstance(e, Call) and isinstance(e.request, Finish)]
        if told:
            self.on_decision(self, told)
        self._plan_tick()

    def carry_out(self, effects: Sequence[Effect]) -> None:
        """Answer, write and ask, in this order of the core's."""
        for effect in effects:
            if isinstance(effect, Reply):
                reply = self._replies.pop(effect.reply_to, None)
                self.asked.pop(effect.reply_to, None)
                if reply is None:
                    self.world.violation("one answer per request", self.name, effect.answer)
                    return
                if isinstance(effect.answer, Refused):
                    self.world.tally[f"refused: {effect.answer.code}"] += 1
                reply(cast("Answer", effect.answer))
            elif isinstance(effect, Persist):
                self.persist(effect)
            elif isinstance(effect, Call):
                self._call(effect)

    def persist(self, persist: Persist) -> None:
        """Write, and let the shard know once it survives what it must."""
        self.disk.submit(self, persist, lambda ticket: self.event(Persisted(ticket)))
        self.on_persist(self)

    def _call(self, call: Call) -> None:
        """Ask another shard over the same bad network; no answer needs no report."""
        peer, network = self.peers[call.shard], self.network

        def answered(answer: Answer) -> None:
            if self.up:
                self.event(Called(call.shard, call.request, answer))

        def reply(answer: Answer) -> None:
            network.send(peer, self, answer, answered)

        request = cast("Request", call.request)
        network.send(self, peer, request, lambda came: peer.request(came, reply))

    def _plan_tick(self) -> None:
        now_ns = self.local_ns
        due_ns = max(self.shard.next_deadline_ns(), now_ns + MS)
        if self._tick_due_ns > now_ns and self._tick_due_ns <= due_ns:
            return
        self._tick_due_ns = due_ns
        self.later(due_ns - now_ns, lambda: self._tick(due_ns))

    def _tick(self, due_ns: int) -> None:
        if due_ns == self._tick_due_ns:
            self._tick_due_ns = 0
            self.event(Tick())

    @property
    def unanswered(self) -> int:
        """How many requests have had no answer yet."""
        return len(self._replies)
