"""Time and processes: one queue of events in true time, and hosts with clocks of their own.

True time is what no host in the simulation can read.  Each host has a clock that runs up to 1 %
fast or slow, and a wall clock that may be set.  A host that is paused keeps what arrives and
handles it when it goes on; a host that was restarted has a new life, and whatever an older life
had scheduled is void.
"""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.verify.simulation.schedule import Schedule

MS = 1_000_000
S = 1_000 * MS
EPOCH_OF_WALL_NS = 1_800_000_000 * S


class SimulationError(Exception):
    """The checked system broke a rule.  The message says which."""


@dataclass(slots=True)
class DriftingClock:
    """A clock that counts ns since some start, at a rate off by `ppm` millionths."""

    offset_ns: int
    ppm: int

    def at(self, true_ns: int) -> int:
        """Return what the clock shows at a moment of true time."""
        return self.offset_ns + true_ns + true_ns * self.ppm // 1_000_000

    def true_duration(self, local_ns: int) -> int:
        """Return how long a duration of this clock takes in true time, rounded up."""
        return local_ns * 1_000_000 // (1_000_000 + self.ppm) + 1


@dataclass(slots=True)
class SimulatedWorld:
    """The queue of events, the schedule of faults and the tallies of one run.

    Attributes:
        story: What happened, line by line with its true time in ns; None if not wanted.
    """

    schedule: Schedule
    now_ns: int = 0
    story: list[tuple[int, str]] | None = None
    tally: Counter[str] = field(default_factory=Counter)
    winding_down: bool = False
    _events: list[tuple[int, int, Callable[[], object]]] = field(default_factory=list)
    _number: int = 0

    def after(self, delay_ns: int, action: Callable[[], object]) -> None:
        """Let `action` happen `delay_ns` of true time from now."""
        self._number += 1
        heapq.heappush(self._events, (self.now_ns + max(0, delay_ns), self._number, action))

    def run_until(self, end_ns: int) -> None:
        """Let everything happen that is due until `end_ns`."""
        events = self._events
        while events and events[0][0] <= end_ns:
            self.now_ns, _, action = heapq.heappop(events)
            self.tally["events"] += 1
            action()
        self.now_ns = max(self.now_ns, end_ns)

    def tell(self, *parts: object) -> None:
        """Add a line to the story of the run, if wanted."""
        if self.story is not None:
            self.story.append((self.now_ns, " ".join(str(part) for part in parts)))

    def befell(self, fault: str, text: str) -> None:
        """Note that a fault took place."""
        self.schedule.note(fault, self.now_ns, text)
        self.tell(f"[{fault}]", text)

    def violation(self, rule: str, *facts: object) -> None:
        """Stop the run: a rule is broken."""
        told = " ".join(str(fact) for fact in facts)
        raise SimulationError(f"{rule} broken at {self.now_ns / 1e9:.6f} s: {told}")


class Host:
    """A process: its clocks, whether it is up, and what waits while it stands still."""

    def __init__(
        self, world: SimulatedWorld, name: str, *, drift_ppm: int, wall_offset_ns: int
    ) -> None:
        self.world, self.name = world, name
        self._drift_ppm = drift_ppm
        self.life = 0
        self.clock = self.new_clock()
        self.wall_offset_ns = wall_offset_ns
        self.up = True
        self._paused_until_ns = 0
        self._stood_at_ns = 0
        self._backlog: list[tuple[int, Callable[[], None]]] = []

    def new_clock(self) -> DriftingClock:
        """Return a clock with a start and a rate of its own."""
        random = self.world.schedule.stream(f"clock of {self.name} in life {self.life}")
        ppm = random.randint(-self._drift_ppm, self._drift_ppm)
        # It showed `offset` at this moment, wherever true time stands.
        now_ns = self.world.now_ns
        return DriftingClock(random.randrange(10**15) - now_ns * ppm // 1_000_000, ppm)

    @property
    def local_ns(self) -> int:
        """What the host's steady clock shows now."""
        return self.clock.at(self.world.now_ns)

    @property
    def wall_ns(self) -> int:
        """What the host's wall clock shows now."""
        return EPOCH_OF_WALL_NS + self.world.now_ns + self.wall_offset_ns

    @property
    def paused(self) -> bool:
        """Whether the host stands still."""
        return self.world.now_ns < self._paused_until_ns

    def later(self, local_ns: int, action: Callable[[], None]) -> None:
        """Let this life of the host do something after a duration of its own clock."""
        life = self.life
        self.world.after(self.clock.true_duration(local_ns), lambda: self._do(life, action))

    def receive(self, action: Callable[[], None]) -> None:
        """Let the host handle something that has arrived; a host that is down loses it."""
        self._do(self.life, action)

    def _do(self, life: int, action: Callable[[], None]) -> None:
        if not self.up or life != self.life:
            return
        if self.paused:
            self._backlog.append((life, action))
        else:
            action()

    def pause(self, true_ns: int, *, suspended: bool = False) -> None:
        """Stand still for a while; what arrives is handled afterwards, in order.

        A host that is suspended stops its steady clock for as long.
        """
        if self.paused:
            return
        self._paused_until_ns = self.world.now_ns + true_ns
        self._stood_at_ns = self.local_ns if suspended else 0
        self.world.after(true_ns, self.resume)

    def resume(self) -> None:
        """Go on with what has queued up."""
        self._paused_until_ns = self.world.now_ns
        if self._stood_at_ns:
            self.clock.offset_ns -= self.local_ns - self._stood_at_ns
            self._stood_at_ns = 0
        backlog, self._backlog = self._backlog, []
        for life, action in backlog:
            self._do(life, action)

    def end_life(self) -> None:
        """Go down; everything that this life had planned is void."""
        self.up = False
        self.life += 1
        self._paused_until_ns = self._stood_at_ns = 0
        self._backlog.clear()
