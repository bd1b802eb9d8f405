"""When an actor's update runs: pending triggers, a source's fixed rate, back-off after a refusal.

PURE: time and random numbers arrive as arguments, nothing here waits, so that every rule below is
tested without a thread.  Rules that a change must keep:

1. Triggers are levels, not events: per key at most one run is pending, for the newest datum.
   What was passed over is counted (`skipped`), never lost silently.
2. First come, first served: a key that changes again while it waits keeps its place, one that
   changes while it runs goes to the end.  So a busy entity cannot starve a quiet one.
3. A state that was already handed in is no change: a watch that was opened again repeats its
   snapshot without running everything again.
4. A source's ticks lie on one grid, the multiples of its period: no drift, sources of one period
   tick together, and after a late update there is no bunch of ticks to catch up.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import TYPE_CHECKING

from enact_dist.access.trigger import WHOLE, Trigger

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence

    from enact_dist.core.protocol.messages import DatumRead
    from enact_dist.terms import Entity


class PendingTriggers:
    """Which entities an actor still has to look at; coalesced, in order, without duplicates.

    Args:
        per_entity: Whether each entity has a run of its own.  Else no request depends on the
            triggering entity, one run sees every change, and all changes share one pending run.

    Attributes:
        skipped: States that no update saw, because the same datum had a newer one by then.
    """

    __slots__ = ("_late", "_later", "_order", "_per_entity", "_ready", "_seen", "skipped")

    def __init__(self, *, per_entity: bool) -> None:
        self._per_entity = per_entity
        self._ready: dict[str, Trigger] = {}
        self._later: dict[str, Trigger] = {}
        self._late: list[tuple[int, int, str]] = []
        self._order = 0
        self._seen: dict[tuple[int, str], Hashable] = {}
        self.skipped = 0

    def __len__(self) -> int:
        return len(self._ready) + len(self._later)

    def changed(self, source: int, entity: Entity, state: Hashable) -> bool:
        """Take note that a trigger datum of `entity` is in a new state.

        Returns:
            Whether this was news.
        """
        slot = (source, entity.name)
        if self._seen.get(slot) == state:
            return False
        self._seen[slot] = state
        key = self._key(entity)
        waiting = self._ready.get(key) or self._later.get(key)
        if waiting is None:
            waiting = self._ready[key] = Trigger(key, entity)
        self.skipped += slot in waiting.states
        waiting.entity = entity
        waiting.states[slot] = state
        return True

    def vanished(
        self, source: int, entity: Entity, state: Hashable, *, in_set: bool = False
    ) -> bool:
        """Take note that a trigger datum is null.

        Where the trigger looks at one datum there is nothing left to run for; a run that also
        waits for another trigger datum still happens.  Where it looks at a set (`in_set`), the
        set has changed, if the datum was known to be in it.

        Returns:
            Whether this was news.
        """
        slot = (source, entity.name)
        if slot not in self._seen:
            return False
        if in_set:
            return self.changed(source, entity, state)
        del self._seen[slot]
        self.skipped += self._withdraw(slot)
        return True

    def seen(self, source: int, entity: Entity) -> Hashable | None:
        """Return the newest state of a trigger datum that was noted; None of one that was not."""
        return self._seen.get((source, entity.name))

    def passed(self, source: int, entity: Entity, version: int) -> None:
        """Count the versions between the one that was seen last and the one seen now."""
        before = self._seen.get((source, entity.name))
        if isinstance(before, tuple):
            self.skipped += max(0, version - before[0] - 1)

    def used(self, source: int, entity: Entity, state: Hashable) -> None:
        """Take note that an update that just ended has seen this state already.

        The lock is granted after the trigger was taken and shows what is newest then.  Without
        this the notice of that newest state would run the same datum twice.
        """
        slot = (source, entity.name)
        self._seen[slot] = state
        waiting = self._ready.get(self._key(entity))
        if waiting is not None and waiting.states.get(slot) == state:
            self._withdraw(slot)

    def take(self, now_ns: int) -> Trigger | None:
        """Return the next run that is due and forget it, or None."""
        while self._late and self._late[0][0] <= now_ns:
            key = heapq.heappop(self._late)[2]
            if trigger := self._later.pop(key, None):
                self._ready[key] = trigger
        if not self._ready:
            return None
        return self._ready.pop(next(iter(self._ready)))

    def postpone(self, trigger: Trigger, due_ns: int) -> None:
        """Put a run back that was refused, not to be taken before `due_ns`.

        If its key changed meanwhile the newer state is run, at the same time: a change does not
        shorten the back-off.
        """
        if newer := self._ready.pop(trigger.key, None):
            self.skipped += len(trigger.states.keys() & newer.states.keys())
            trigger.entity = newer.entity
            trigger.states |= newer.states
        trigger.refused += 1
        self._later[trigger.key] = trigger
        self._order += 1
        heapq.heappush(self._late, (due_ns, self._order, trigger.key))

    def due_ns(self) -> int | None:
        """Return when `take` will have something: 0 for now, None for not before a change."""
        if self._ready:
            return 0
        while self._late and self._late[0][2] not in self._later:
            heapq.heappop(self._late)
        return self._late[0][0] if self._late else None

    def _key(self, entity: Entity) -> str:
        return entity.name if self._per_entity else WHOLE

    def _withdraw(self, slot: tuple[int, str]) -> bool:
        """Forget that a run waits for this slot; the run too, if it waits for no other."""
        key = slot[1] if self._per_entity else WHOLE
        for pending in (self._ready, self._later):
            waiting = pending.get(key)
            if waiting is not None and waiting.states.pop(slot, None) is not None:
                if not waiting.states:
                    del pending[key]
                return True
        return False


class FixedRate:
    """Ticks of a source on the multiples of its period since 1970, by the wall clock.

    So sources of one period tick together, on any host whose clock is right.  The first tick is due
    at once, as one that is late: a tick that is late runs at once, and those that passed before it
    are counted as missed and do not run.  Time is measured by the monotonic clock; at each tick the
    grid follows the wall clock, where that was set too, without counting that as missed ticks.

    Args:
        every_s: The period.
        now_ns: Monotonic time.
        wall_ns: Wall-clock time, since 1970.
        in_phase: False lets the grid begin now, apart from those of other sources.

    Attributes:
        missed: Ticks that never ran.
    """

    __slots__ = ("_ahead_ns", "_every_ns", "_next", "_offset_ns", "missed")

    def __init__(self, every_s: float, *, now_ns: int, wall_ns: int, in_phase: bool = True) -> None:
        self._every_ns = max(1, round(every_s * 1e9))
        self._offset_ns = 0 if in_phase else wall_ns % self._every_ns
        self._ahead_ns = wall_ns - now_ns
        self._next = self._index(wall_ns)
        self.missed = 0

    def due_ns(self) -> int:
        """Return when the next tick is due, in monotonic time."""
        return self._next * self._every_ns + self._offset_ns - self._ahead_ns

    def tick(self, now_ns: int, wall_ns: int) -> int:
        """Take a tick if one is due; return when it was due, in ns since 1970, else 0."""
        if now_ns < self.due_ns():
            return 0
        latest = self._index(now_ns + self._ahead_ns)
        self.missed += latest - self._next
        ahead_ns = wall_ns - now_ns
        if abs(ahead_ns - self._ahead_ns) > self._every_ns // 2:
            latest = self._index(wall_ns)  # the wall clock was set
        self._ahead_ns = ahead_ns
        self._next = latest + 1
        return latest * self._every_ns + self._offset_ns

    def _index(self, wall_ns: int) -> int:
        return (wall_ns - self._offset_ns) // self._every_ns


def tick_before(wall_ns: int, every_s: float) -> int:
    """Return the newest tick of a source of this period, in ns since 1970."""
    return FixedRate(every_s, now_ns=0, wall_ns=wall_ns).tick(0, wall_ns)


def is_news(after: Sequence[DatumRead], seen: Mapping[tuple[int, Entity], tuple[int, int]]) -> bool:
    """Whether a lock that waited for news after what an actor had seen shows some.

    It may show none: it did not wait if the placement changed meanwhile, or if its shard may not
    show a commit of this process yet.
    """
    return any(state != after[index][1:] for (index, _), state in seen.items())


@dataclass(frozen=True, slots=True)
class BackOff:
    """How long to wait after the n-th refusal in a row: doubling, limited, spread.

    The spread keeps actors that were refused together from asking together again.

    Args:
        first_s: After the first refusal.
        max_s: At most; a shard that restarts is found again within this time.
        spread: Part of the wait that is drawn at random, 0 to 1.
    """

    first_s: float = 0.05
    max_s: float = 2.0
    spread: float = 0.5

    def wait_s(self, refused: int, draw: float) -> float:
        """Return how long to wait.

        Args:
            refused: How often in a row before this refusal, from 0.
            draw: Random number in [0, 1).
        """
        whole = min(self.max_s, self.first_s * 2.0 ** min(refused, 30))
        return whole * (1.0 - self.spread * draw)
