"""Which sets of data with one capture stamp an actor still has to look at; which are incomplete.

PURE, as `actor_triggers`.  Rules that a change must keep:

1. A set is complete when all members have shown its stamp; complete sets run one by one, in order.
2. It is incomplete, for good, when each missing member has shown a newer stamp, or when more than
   `open_max` sets are open and it is the oldest.  It is counted once, with who was missing.
3. What can be in no set is counted too: a datum without a stamp, one whose set is over (`late`), a
   second one for the same set (`skipped`), a complete set that newer ones pushed out (`skipped`).
4. What was incomplete before the actor started is not its business: at the start only the newest
   complete set runs.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.actor_triggers import WHOLE, Trigger

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from enact_dist.terms import Entity
    from enact_dist.together import Captured

TOLD_MAX: Final = 16
"""Incomplete sets that are kept by name."""


@dataclass(frozen=True, slots=True)
class IncompleteSet:
    """A set that never ran: its capture stamp and the names of what was missing."""

    stamp_ns: int
    missing: tuple[str, ...]

    def __str__(self) -> str:
        return f"set of stamp {self.stamp_ns}: without {', '.join(self.missing)}"


class PendingSets:
    """The sets of one `Together` trigger.

    Args:
        names: What each member is called.
        entity: Stands in the runs, where an entity is asked for.
        open_max: Sets that are open at once, and complete sets that wait at once.

    Attributes:
        incomplete: Sets that were given up.
        told: The newest of them.
        skipped: Data, or complete sets, that no update saw because of newer ones.
        late: Data whose set was over when they came.
        unstamped: Data without a capture stamp.
    """

    __slots__ = (
        "_due_ns", "_entity", "_floor_ns", "_known", "_names", "_newest", "_open", "_open_max",
        "_over", "_ready", "incomplete", "late", "skipped", "told", "unstamped",
    )  # fmt: skip

    def __init__(self, names: Sequence[str], *, entity: Entity, open_max: int) -> None:
        self._names = tuple(names)
        self._entity = entity
        self._open_max = open_max
        self._known: dict[int, tuple[int, int]] = {}
        self._newest = [0] * len(self._names)
        self._open: dict[int, set[int]] = {}
        self._over: set[int] = set()
        self._floor_ns = 0
        self._ready: deque[Trigger] = deque()
        self._due_ns = 0
        self.incomplete = self.skipped = self.late = self.unstamped = 0
        self.told: deque[IncompleteSet] = deque(maxlen=TOLD_MAX)

    def __len__(self) -> int:
        return len(self._ready)

    def start(self, versions: Sequence[Iterable[Captured]]) -> None:
        """Take what there is when the actor starts; of each member, in the order of the names."""
        for member, each in enumerate(versions):
            self._take(member, each)
        newest = max(self._ready, key=lambda ready: ready.captured_ns, default=None)
        self._ready = deque([newest] if newest is not None else [])
        before_ns = self._ready[-1].captured_ns if self._ready else 0
        for stamp_ns in sorted(self._open):
            if stamp_ns < before_ns or self._is_hopeless(stamp_ns):
                self._close(stamp_ns)
        self.skipped = self.late = self.unstamped = 0

    def misses(self, member: int, version: int) -> bool:
        """Whether versions before this one were not seen; then the retained ones are to be asked.

        After a restart of a shard versions may start again, which counts as a gap too.
        """
        known = self._known.get(member, (0, 0))[0]
        return version not in (known, known + 1)

    def captured(self, member: int, versions: Iterable[Captured]) -> bool:
        """Take versions of one member, oldest first; return whether a complete set waits."""
        self._take(member, versions)
        return self._settle()

    def captured_all(self, versions: Sequence[Iterable[Captured]]) -> bool:
        """Take versions of all members, in the order of the names; as `captured`."""
        for member, each in enumerate(versions):
            self._take(member, each)
        return self._settle()

    def _settle(self) -> bool:
        """Give up what cannot become complete or is too much; whether a complete set waits."""
        for stamp_ns in sorted(self._open):
            if self._is_hopeless(stamp_ns):
                self._give_up(stamp_ns, self._missing(stamp_ns))
        while len(self._open) > self._open_max:
            oldest_ns = min(self._open)
            self._give_up(oldest_ns, self._missing(oldest_ns))
        if len(self._ready) > 1:
            self._ready = deque(sorted(self._ready, key=lambda ready: ready.captured_ns))
        while len(self._ready) > self._open_max:
            self._ready.popleft()
            self.skipped += 1
        return bool(self._ready)

    def gone(self, stamp_ns: int, missing: Sequence[int]) -> None:
        """Count a complete set whose data were outside retention before its update could run."""
        self._tell(stamp_ns, missing)

    def _take(self, member: int, versions: Iterable[Captured]) -> None:
        for version, committed_ns, captured_ns, null in versions:
            if committed_ns <= self._known.get(member, (0, 0))[1]:
                continue
            self._known[member] = (version, committed_ns)
            if null:
                continue
            if not captured_ns:
                self.unstamped += 1
                continue
            self._newest[member] = max(self._newest[member], captured_ns)
            self._arrived(member, captured_ns)

    def _arrived(self, member: int, stamp_ns: int) -> None:
        if stamp_ns <= self._floor_ns or stamp_ns in self._over:
            self.late += 1
            return
        members = self._open.setdefault(stamp_ns, set())
        self.skipped += member in members
        members.add(member)
        if len(members) == len(self._names):
            self._close(stamp_ns)
            self._ready.append(Trigger(WHOLE, self._entity, captured_ns=stamp_ns))

    def _missing(self, stamp_ns: int) -> list[int]:
        return [m for m in range(len(self._names)) if m not in self._open[stamp_ns]]

    def _is_hopeless(self, stamp_ns: int) -> bool:
        return all(self._newest[member] > stamp_ns for member in self._missing(stamp_ns))

    def _close(self, stamp_ns: int) -> None:
        """Remember that a set is over; of very old ones only that they are."""
        del self._open[stamp_ns]
        self._over.add(stamp_ns)
        while len(self._over) > 4 * self._open_max:
            lowest_ns = min(self._over)
            if lowest_ns > min(self._open, default=lowest_ns):
                return  # an older one is open still, and data of this one must stay late
            self._over.remove(lowest_ns)
            self._floor_ns = max(self._floor_ns, lowest_ns)

    def _give_up(self, stamp_ns: int, missing: Sequence[int]) -> None:
        self._close(stamp_ns)
        self._tell(stamp_ns, missing)

    def _tell(self, stamp_ns: int, missing: Sequence[int]) -> None:
        self.incomplete += 1
        self.told.append(IncompleteSet(stamp_ns, tuple(self._names[m] for m in missing)))

    # ---------------------------------------------------------------- runs

    def take(self, now_ns: int) -> Trigger | None:
        """Return the oldest complete set if it is due, and forget it."""
        if not self._ready or now_ns < self._due_ns:
            return None
        self._due_ns = 0
        return self._ready.popleft()

    def postpone(self, trigger: Trigger, due_ns: int) -> None:
        """Put a set back that was refused; it stays the next one."""
        trigger.refused += 1
        self._ready.appendleft(trigger)
        self._due_ns = due_ns

    def due_ns(self) -> int | None:
        """Return when `take` will have something: 0 for now, None for not before a change."""
        return self._due_ns if self._ready else None
