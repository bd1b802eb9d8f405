"""Runs many seeds, on as many processes as wanted, and adds up what happened."""

from __future__ import annotations

import itertools
import multiprocessing
import signal
import time
from collections import Counter
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from enact_dist.verify.simulation.scenario import Result, Scenario

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_FRESH_NS = 1_000_000


def fresh_seed() -> int:
    """Return an unused first seed: milliseconds since 1970.

    No machine runs a thousand seeds per second, so that a later series never meets an earlier one.
    """
    return time.time_ns() // _FRESH_NS


@dataclass(slots=True)
class Totals:
    """What a series of seeds has shown.

    Attributes:
        cpu_s: Of all processes that ran seeds.
        interrupted: Ended with Ctrl-C, so that fewer seeds ran than were asked for.
    """

    first: int
    seeds: int = 0
    simulated_s: float = 0.0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    tally: Counter[str] = field(default_factory=Counter)
    failures: list[Result] = field(default_factory=list)
    interrupted: bool = False

    def add(self, result: Result, cpu_s: float) -> None:
        """Add what one seed has shown."""
        self.seeds += 1
        self.simulated_s += result.simulated_s
        self.cpu_s += cpu_s
        self.tally += result.tally
        if result.violation:
            self.failures.append(result)

    def join(self, other: Totals) -> None:
        """Add what a series that went on from this one has shown."""
        self.seeds += other.seeds
        self.simulated_s += other.simulated_s
        self.wall_s += other.wall_s
        self.cpu_s += other.cpu_s
        self.tally += other.tally
        self.failures += other.failures

    @property
    def crashes(self) -> int:
        """Shards that died, and clients that were killed."""
        return sum(self.tally[name] for name in ("crashes", "power cuts", "clients killed"))

    @property
    def partitions(self) -> int:
        """Links that were cut for a while."""
        return sum(n for name, n in self.tally.items() if name.startswith("partitions"))


def run_scenario(seed: int) -> Result:
    """Run one seed of the whole cell."""
    return Scenario(seed).run()


def run_series(
    first: int,
    *,
    count: int | None = None,
    seconds: float | None = None,
    at_least: int = 0,
    jobs: int = 1,
    step: int = 1,
    keep_going: bool = False,
    on_progress: Callable[[Totals], None] = lambda _totals: None,
    run: Callable[[int], Result] = run_scenario,
) -> Totals:
    """Run seeds until enough have run, the time is over or one breaks a rule.

    Args:
        first: The first seed.
        count: How many seeds at most.
        seconds: How long at most; what runs then is waited for.
        at_least: So many seeds run even if the time is over.
        jobs: Processes that run them.
        step: From one seed to the next.
        keep_going: Do not stop at a broken rule.
        on_progress: Called after every seed.
        run: Runs one seed; a function of a module, since other processes call it.
    """
    totals, started_s = Totals(first), time.monotonic()

    def wanted() -> Iterator[int]:
        """Give the next seed, as long as there is time for one and no reason to stop."""
        numbers = itertools.count() if count is None else iter(range(count))
        for number in numbers:
            over = seconds is not None and time.monotonic() - started_s >= seconds
            if over and number >= at_least:
                return
            if totals.failures and not keep_going:
                return
            yield first + number * step

    try:
        results = _here(run, wanted()) if jobs == 1 else _on_processes(run, wanted(), jobs)
        for result, cpu_s in results:
            totals.add(result, cpu_s)
            on_progress(totals)
    except KeyboardInterrupt:
        totals.interrupted = True
    totals.wall_s = time.monotonic() - started_s
    return totals


def _run(run: Callable[[int], Result], seed: int) -> tuple[Result, float]:
    before_s = time.process_time()
    result = run(seed)
    if not result.violation:
        result = replace(result, faults=(), locks=())
    return result, time.process_time() - before_s


def _here(run: Callable[[int], Result], seeds: Iterator[int]) -> Iterator[tuple[Result, float]]:
    for seed in seeds:
        yield _run(run, seed)


def _on_processes(
    run: Callable[[int], Result], seeds: Iterator[int], jobs: int
) -> Iterator[tuple[Result, float]]:
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context)
    under_way: set[Future[tuple[Result, float]]] = set()
    try:
        while True:
            # One more than there are processes, so that none waits for its next seed.
            for seed in itertools.islice(seeds, jobs + 1 - len(under_way)):
                with _interrupts_left_to_us():
                    under_way.add(pool.submit(_run, run, seed))
            if not under_way:
                return
            done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _interrupts_left_to_us() -> Iterator[None]:
    """Let processes that begin here never see Ctrl-C, not even while they import their modules.

    They inherit the mask; a signal that comes meanwhile comes after the block.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
