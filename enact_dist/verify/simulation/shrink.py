"""Makes a failure small: fewer faults, fewer locks, fewer clients, a shorter run, the same rule.

Each step leaves something out, runs the seed again and keeps what still breaks the same rule: first
whole kinds of faults, then halves, quarters and so on down to single ones (delta debugging).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from enact_dist.verify.simulation.scenario import Scenario
from enact_dist.verify.simulation.schedule import WHOLE, PartOfRun

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from enact_dist.verify.simulation.scenario import Result

    Keep = Callable[[list[str]], list[str] | None]

RUNS_MAX = 1000


@dataclass(frozen=True, slots=True)
class Shrunk:
    """The smallest run found that breaks the same rule.

    Attributes:
        part: What of the seed's run takes place.
        result: What that run shows.
        whole: What the whole run showed.
        runs: How many runs it took.
    """

    part: PartOfRun
    result: Result
    whole: Result
    runs: int

    @property
    def command(self) -> str:
        """The command line that repeats the small run."""
        return command(self.result.seed, self.part)

    def lines(self) -> list[str]:
        """Return the schedule as lines to read."""
        faults, locks = len(self.whole.faults), len(self.whole.locks)
        head = (
            f"still breaks with {len(self.result.faults)} of {faults} faults and"
            f" {len(self.result.locks)} of {locks} locks (found in {self.runs} runs):"
        )
        return [
            head,
            *(f"  {fault}" for fault in self.result.faults),
            f"  locks: {', '.join(self.result.locks)}",
            *(f"  {line}" for line in self.result.violation.splitlines()),
        ]


def command(seed: int, part: PartOfRun = WHOLE) -> str:
    """Return the command line that runs a seed again."""
    return " ".join(["enact verify --seed", str(seed), *part.options()])


def run_part(seed: int, part: PartOfRun) -> Result:
    """Run a part of a seed's run."""
    return Scenario(seed, part=part).run()


def shrink(
    whole: Result, *, seconds: float, run: Callable[[int, PartOfRun], Result] = run_part
) -> Shrunk:
    """Look for a small part of a run that still breaks its rule.

    Args:
        whole: A run that broke a rule.
        seconds: How long to look.
        run: How to run a part.
    """
    shrinker = _Shrinker(whole, seconds, run)
    shrinker.shrink()
    return Shrunk(shrinker.part, shrinker.best, whole, shrinker.runs)


class _Shrinker:
    def __init__(
        self, whole: Result, seconds: float, run: Callable[[int, PartOfRun], Result]
    ) -> None:
        self.best, self.part, self.runs = whole, WHOLE, 0
        self._rule = whole.rule
        self._run = run
        self._end_s = time.monotonic() + seconds

    @property
    def _over(self) -> bool:
        return self.runs >= RUNS_MAX or time.monotonic() >= self._end_s

    def _breaks(self, part: PartOfRun) -> bool:
        """Whether a part still breaks the rule; if so it is the best so far."""
        if self._over:
            return False
        self.runs += 1
        result = self._run(self.best.seed, part)
        if result.rule != self._rule:
            return False
        self.best, self.part = result, part
        return True

    def shrink(self) -> None:
        """Leave out what can be left out, in turn, until nothing more can."""
        self._shorten()
        before = -1
        while not self._over and before != self._size():
            before = self._size()
            self._fewer_faults()
            self._fewer_locks()
            self._fewer_clients()
            self._shorten()

    def _size(self) -> int:
        return len(self.best.faults) + len(self.best.locks)

    def _fewer_faults(self) -> None:
        def keep(names: list[str]) -> list[str] | None:
            if not self._breaks(replace(self.part, only=frozenset(names))):
                return None
            return [fault.name for fault in self.best.faults]

        names = [fault.name for fault in self.best.faults]
        for kind in sorted({_kind(name) for name in names}):
            rest = [name for name in names if _kind(name) != kind]
            names = keep(rest) or names if len(rest) < len(names) else names
        reduced(names, keep)

    def _fewer_locks(self) -> None:
        def keep(names: list[str]) -> list[str] | None:
            if not self._breaks(replace(self.part, locks=frozenset(names))):
                return None
            return list(self.best.locks)

        reduced(list(self.best.locks), keep)

    def _fewer_clients(self) -> None:
        """Leave out the clients that ask for nothing any more."""
        busy = frozenset(
            int(lock.partition("/")[0][1:].partition("_")[0]) for lock in self.best.locks
        )
        if busy != self.part.clients:
            self._breaks(replace(self.part, clients=busy))

    def _shorten(self) -> None:
        """End the run earlier: where the rule broke, or in the middle, as often as it helps."""
        until_s = self.part.until_s if self.part.until_s is not None else 25.0
        broke_s = round(self.best.simulated_s + 0.05, 1)
        if broke_s < until_s and self._breaks(replace(self.part, until_s=broke_s)):
            until_s = broke_s
        while until_s > 0.2 and self._breaks(replace(self.part, until_s=round(until_s / 2, 1))):
            until_s = round(until_s / 2, 1)


def _kind(name: str) -> str:
    """Return the kind of a fault: its place, whichever host that belongs to."""
    place = name.rpartition(".")[0]
    _, dash, what = place.partition("-")
    if not dash:
        return place
    return what if what in {"disk", "late", "write"} else "message"


def reduced(names: Sequence[str], keep: Keep) -> list[str]:
    """Return a short list that `keep` accepts (delta debugging).

    Args:
        names: A list that is known to be good enough.
        keep: Returns what is left of a list that is good enough, None for one that is not.
    """
    found = list(names)
    size = len(found)
    while found and size:
        start = 0
        while start < len(found):
            rest = keep(found[:start] + found[start + size :])
            if rest is None or len(rest) >= len(found):
                start += size
            else:
                found = rest
        size //= 2
    return found
