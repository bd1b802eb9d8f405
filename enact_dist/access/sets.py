"""The sets of data of a `Together`: which are complete and wait for a run, which stay incomplete.

PURE: time arrives as an argument.  Rules that a change must keep:

1. A set is complete when all members have shown a stamp of it, the same or within `within_ns` of
   each other; complete sets run one by one, in order.  A datum joins the nearest set that lacks it.
2. It is finally over when each missing member has shown a stamp too new for it, or when more
   than `open_max` sets are open and it is the oldest.  It is counted once, with its missing
   members.
3. One that is over, or older than `least_after_ns` by the actor's clock, and has `least` of its
   data runs without the others: that is counted, too (`partial`).
4. Data that fit no set are counted, too: a datum without a stamp, one whose set is over (`late`), a
   second one for the same set (`skipped`), a complete set that newer ones replaced (`skipped`).
   With `newest_only` a set is skipped, too, if a newer one may run before it, or if it is older
   than the last one that ran.
5. Sets that were incomplete before the actor started are ignored: at the start only the newest
   complete set runs.
6. Stamps of one member grow.  Where those of more than half of the members fall by more than
   `SET_BACK_NS`, the clock of their sensors was set back: counting starts again from there.  One
   member alone that falls back is late, as in rule 4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from enact_dist.access.trigger import WHOLE, Trigger
from enact_dist.terms import Entity

TOLD_MAX: Final = 16
"""Incomplete sets that are kept by name."""
SET_BACK_NS: Final = 1_000_000_000
"""Versions of one datum are captured out of order by less than this."""


class Capture(NamedTuple):
    """One version of a slot: when it was committed and when its datum was captured.

    `captured_ns` is 0 if unknown; `null` versions have no datum.
    """

    version: int
    committed_ns: int
    captured_ns: int
    null: bool = False


@dataclass(frozen=True, slots=True)
class IncompleteSet:
    """A set that never ran: its capture stamp and the names of what was missing."""

    stamp_ns: int
    missing: tuple[str, ...]

    def __str__(self) -> str:
        return f"set of stamp {self.stamp_ns}: without {', '.join(self.missing)}"


@dataclass(slots=True)
class _Set:
    """A set that is open or over: the stamp of each member, 0 of those that are missing."""

    stamps: list[int]
    since_ns: int = 0
    low_ns: int = 0
    high_ns: int = 0
    count: int = field(default=0)

    def add(self, member: int, stamp_ns: int) -> None:
        self.low_ns = min(self.low_ns, stamp_ns) if self.count else stamp_ns
        self.high_ns = max(self.high_ns, stamp_ns)
        self.stamps[member] = stamp_ns
        self.count += 1

    def fits(self, stamp_ns: int, within_ns: int) -> bool:
        return self.high_ns - within_ns <= stamp_ns <= self.low_ns + within_ns

    def missing(self) -> list[int]:
        return [member for member, stamp_ns in enumerate(self.stamps) if not stamp_ns]


class PendingSets:
    """The sets of one `Together` trigger.

    Args:
        names: Names of the members.
        entity: Entity of the runs, for code that needs one.
        open_max: Sets that are open at once, and complete sets that wait at once.
        within_ns: How far the stamps of one set may lie apart.
        least: With how many of its data a set may run; None: with all.
        least_after_ns: How long after its first datum it then runs.
        newest_only: Of the sets that may run, only the newest does.

    Attributes:
        incomplete: Number of incomplete sets that are over.
        told: The newest of them, as reported.
        partial: Sets that run, or ran, without some of their data.
        last_partial: The newest of them, or nothing.
        skipped: Data, or complete sets, that no update saw because of newer ones.
        late: Data that came after their set was over.
        unstamped: Data without a capture stamp.
    """

    __slots__ = (
        "_due_ns", "_entity", "_floor_ns", "_known", "_last", "_least", "_least_after_ns", "_names",
        "_newest", "_newest_only", "_open", "_open_max", "_over", "_ready", "_taken_ns",
        "_unstamped", "_within_ns",
        "incomplete", "last_partial", "late", "partial", "skipped", "told", "unstamped",
    )  # fmt: skip

    def __init__(
        self,
        names: Sequence[str],
        *,
        entity: Entity,
        open_max: int,
        within_ns: int = 0,
        least: int | None = None,
        least_after_ns: int = 0,
        newest_only: bool = False,
    ) -> None:
        self._names = tuple(names)
        self._entity = entity
        self._open_max = open_max
        self._within_ns = within_ns
        self._least = len(self._names) if least is None else least
        self._least_after_ns = least_after_ns
        self._newest_only = newest_only
        self._known: dict[int, tuple[int, int]] = {}
        self._newest = [0] * len(self._names)
        self._last = [0] * len(self._names)
        self._unstamped = [0] * len(self._names)
        self._open: list[_Set] = []
        self._over: list[_Set] = []
        self._floor_ns = 0
        self._ready: deque[Trigger] = deque()
        self._due_ns = self._taken_ns = 0
        self.incomplete = self.partial = self.skipped = self.late = self.unstamped = 0
        self.last_partial = ""
        self.told: deque[IncompleteSet] = deque(maxlen=TOLD_MAX)

    def __len__(self) -> int:
        return len(self._ready)

    @property
    def unstamped_from(self) -> tuple[str, ...]:
        """The members that came without a stamp."""
        return tuple(
            name for name, count in zip(self._names, self._unstamped, strict=True) if count
        )

    def enough(self, missing: Sequence[int]) -> bool:
        """Whether a set may run without these of its data."""
        return len(self._names) - len(missing) >= self._least

    def start(self, versions: Sequence[Sequence[Capture]], now_ns: int = 0) -> None:
        """Take what there is when the actor starts; of each member, in the order of the names."""
        for member, each in enumerate(self._newest_of(versions)):
            self._take(member, each, now_ns)
        newest = max(self._ready, key=lambda ready: ready.captured_ns, default=None)
        self._ready = deque([newest] if newest is not None else [])
        rest = [one for one in self._open if one.count >= self._least]
        if newest is None and rest:
            self._run(max(rest, key=lambda one: one.low_ns))
        before_ns = self._ready[-1].captured_ns if self._ready else 0
        for one in sorted(self._open, key=lambda one: one.low_ns):
            if one.low_ns < before_ns or self._is_hopeless(one):
                self._close(one)
        self.skipped = self.late = self.unstamped = self.partial = 0
        self._unstamped = [0] * len(self._names)

    def _newest_of(self, versions: Sequence[Sequence[Capture]]) -> list[list[Capture]]:
        """Return the newest versions of each member, and those of the newest set of one stamp."""
        common_ns = newest_set_ns(versions)
        first = [len(each) - 8 * self._open_max for each in versions]
        return [
            [one for at, one in enumerate(each) if at >= start or one.captured_ns == common_ns]
            for start, each in zip(first, versions, strict=True)
        ]

    def misses(self, member: int, version: int) -> bool:
        """Whether versions before this one were not seen; then the retained ones are to be asked.

        After a restart of a shard versions may start again, which counts as a gap too.
        """
        known = self._known.get(member, (0, 0))[0]
        return version not in (known, known + 1)

    def captured(self, member: int, versions: Iterable[Capture], now_ns: int = 0) -> bool:
        """Take versions of one member, oldest first; return whether there is more to wait for.

        True where a set waits for its run, or now runs after a while without the missing ones.
        """
        self._take(member, versions, now_ns)
        return self._settle(now_ns)

    def captured_all(self, versions: Sequence[Iterable[Capture]], now_ns: int = 0) -> bool:
        """Take versions of all members, in the order of the names; as `captured`."""
        for member, each in enumerate(versions):
            self._take(member, each, now_ns)
        return self._settle(now_ns)

    def _settle(self, now_ns: int) -> bool:
        """End what cannot become complete, is too old or too much; as `captured`."""
        self._open.sort(key=lambda one: one.low_ns)
        for one in [one for one in self._open if self._is_hopeless(one)]:
            self._end(one)
        self._age(now_ns)
        while len(self._open) > self._open_max:
            self._end(self._open[0])
        self._order()
        return self.due_ns() is not None

    def _age(self, now_ns: int) -> None:
        """Run the sets that are old enough, and have enough."""
        for one in [one for one in self._open if self._runs_ns(one) <= now_ns]:
            self._run(one)

    def _runs_ns(self, one: _Set) -> float:
        return one.since_ns + self._least_after_ns if one.count >= self._least else float("inf")

    def _order(self) -> None:
        """Sort the sets that wait for their run, and skip the oldest of too many."""
        if len(self._ready) > 1:
            self._ready = deque(sorted(self._ready, key=lambda ready: ready.captured_ns))
        while len(self._ready) > (1 if self._newest_only else self._open_max):
            self._ready.popleft()
            self.skipped += 1

    def gone(self, stamp_ns: int, missing: Sequence[int]) -> None:
        """Count a complete set whose data were outside retention before its update could run."""
        self._tell(stamp_ns, missing)

    def _take(self, member: int, versions: Iterable[Capture], now_ns: int) -> None:
        for version, committed_ns, captured_ns, null in versions:
            if committed_ns <= self._known.get(member, (0, 0))[1]:
                continue
            self._known[member] = (version, committed_ns)
            if null:
                continue
            if not captured_ns:
                self.unstamped += 1
                self._unstamped[member] += 1
                continue
            self._last[member] = captured_ns
            self._newest[member] = max(self._newest[member], captured_ns)
            self._notice_set_back()
            self._arrived(member, captured_ns, now_ns)

    def _notice_set_back(self) -> None:
        """Start counting again where the sensors' clock was set back (rule 6)."""
        each = list(zip(self._last, self._newest, strict=True))
        back = [last_ns for last_ns, newest_ns in each if last_ns < newest_ns - SET_BACK_NS]
        if 2 * len(back) <= len(each):
            return
        now_ns = max(back)
        self._newest = [min(last_ns, now_ns) for last_ns in self._last]
        self._over, self._floor_ns, self._taken_ns = [], 0, 0
        self.skipped += sum(ready.captured_ns > now_ns for ready in self._ready)
        self._ready = deque(ready for ready in self._ready if ready.captured_ns <= now_ns)
        for one in [one for one in self._open if one.low_ns > now_ns]:
            self._open.remove(one)
            self._tell(one.low_ns, one.missing())

    def _arrived(self, member: int, stamp_ns: int, now_ns: int) -> None:
        within_ns = self._within_ns
        if stamp_ns <= self._floor_ns or any(
            one.stamps[member] == stamp_ns
            or (not one.stamps[member] and one.fits(stamp_ns, within_ns))
            for one in self._over
        ):
            self.late += 1
            return
        if any(one.stamps[member] == stamp_ns for one in self._open):
            self.skipped += 1
            return
        near = [
            one for one in self._open if not one.stamps[member] and one.fits(stamp_ns, within_ns)
        ]
        if near:
            found = min(near, key=lambda one: abs(one.low_ns + one.high_ns - 2 * stamp_ns))
        else:
            found = _Set([0] * len(self._names), now_ns)
            self._open.append(found)
        found.add(member, stamp_ns)
        if found.count == len(self._names):
            self._run(found)

    def _is_hopeless(self, one: _Set) -> bool:
        last_ns = one.low_ns + self._within_ns
        return all(self._newest[member] > last_ns for member in one.missing())

    def _end(self, one: _Set) -> None:
        """Run a set without what is missing, or give it up."""
        if one.count >= self._least:
            self._run(one)
        else:
            self._close(one)
            self._tell(one.low_ns, one.missing())

    def _run(self, one: _Set) -> None:
        self._close(one)
        if self._newest_only and one.low_ns < self._taken_ns:
            self.skipped += 1
            return
        if missing := one.missing():
            self.partial += 1
            self.last_partial = str(self._incomplete(one.low_ns, missing))
        self._ready.append(
            Trigger(WHOLE, self._entity, captured_ns=one.low_ns, members=tuple(one.stamps))
        )

    def _close(self, one: _Set) -> None:
        """Remember that a set is over; very old ones are remembered as a whole, by a floor."""
        self._open.remove(one)
        self._over.append(one)
        while len(self._over) > 4 * self._open_max:
            lowest = min(self._over, key=lambda each: each.low_ns)
            if lowest.low_ns > min((each.low_ns for each in self._open), default=lowest.low_ns):
                return  # an older one is open still, and data of this one must stay late
            self._over.remove(lowest)
            self._floor_ns = max(self._floor_ns, lowest.low_ns)

    def _tell(self, stamp_ns: int, missing: Sequence[int]) -> None:
        self.incomplete += 1
        self.told.append(self._incomplete(stamp_ns, missing))

    def _incomplete(self, stamp_ns: int, missing: Sequence[int]) -> IncompleteSet:
        return IncompleteSet(stamp_ns, tuple(self._names[m] for m in missing))

    # ---------------------------------------------------------------- runs

    def take(self, now_ns: int) -> Trigger | None:
        """Return the oldest set that is to run if it is due, and forget it."""
        if not self._ready:
            self._age(now_ns)
            self._order()
        if not self._ready or now_ns < self._due_ns:
            return None
        self._due_ns = 0
        trigger = self._ready.popleft()
        self._taken_ns = trigger.captured_ns
        return trigger

    def postpone(self, trigger: Trigger, due_ns: int) -> None:
        """Put a set back that was refused; it stays the next one, save where a newer one waits."""
        trigger.refused += 1
        self._ready.appendleft(trigger)
        self._order()
        self._due_ns = due_ns

    def due_ns(self) -> int | None:
        """Return when `take` will have something: 0 for now, None for not before a change."""
        if self._ready:
            return self._due_ns
        runs_ns = min(map(self._runs_ns, self._open), default=float("inf"))
        return None if runs_ns == float("inf") else int(runs_ns)


def newest_set_ns(versions: Sequence[Sequence[Capture]]) -> int:
    """Return the largest capture stamp that all of them have, 0 if there is none."""
    stamps = [{one.captured_ns for one in each if one.captured_ns} for each in versions]
    return max(set.intersection(*stamps), default=0)
