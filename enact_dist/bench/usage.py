"""What processes use while they run: processor time, memory of their own, memory they share.

A process that starts takes memory for a while without end in sight; what counts as growth is the
slope after the warm-up, by the median of all pairs of samples, which a single hiccup cannot move.
"""

from __future__ import annotations

import contextlib
import itertools
import statistics
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from enact_dist.bench.rows import Row, value_row

WARM_UP_S: Final = 10.0
"""Samples of the first so many seconds say nothing about growth."""
SAMPLES: Final = 60
SAMPLES_MIN: Final = 5
"""From fewer samples after the warm-up, or in a shorter time than it, no growth is reported."""
GROWTH_MAX: Final = 50_000.0
"""Bytes per second that noise may look like; one image that stays per second is 18 times that."""
KINDS_OF_MEMORY: Final = {"RssAnon:": "private", "RssShmem:": "shared"}


@dataclass(frozen=True, slots=True)
class Used:
    """One sample of all processes of one kind: bytes, and seconds of processor time."""

    cpu_s: float
    private: int
    shared: int


@dataclass(frozen=True, slots=True)
class Sampled:
    """One moment: what each kind of process uses, and what lies in the shared folder."""

    at_s: float
    kinds: Mapping[str, Used]
    files: int
    files_bytes: int


class Usage:
    """Samples of a run.

    Args:
        pids: Process ids by kind.
        folder: The shared folder.
    """

    def __init__(self, pids: Mapping[str, Sequence[int]], folder: Path) -> None:
        self._pids = {kind: tuple(each) for kind, each in pids.items() if each}
        self._folder = folder
        self.samples: list[Sampled] = []

    def watch(self, seconds_s: float) -> None:
        """Take samples for so long."""
        begin_s = time.perf_counter()
        for number in range(SAMPLES + 1):
            left_s = begin_s + seconds_s * number / SAMPLES - time.perf_counter()
            time.sleep(max(0.0, left_s))
            self.samples.append(self._sample())

    def _sample(self) -> Sampled:
        files, files_bytes = folder_use(self._folder)
        kinds = {kind: _used(pids) for kind, pids in self._pids.items()}
        return Sampled(time.perf_counter(), kinds, files, files_bytes)

    @property
    def kinds(self) -> dict[str, int]:
        """How many processes there are of each kind."""
        return {kind: len(pids) for kind, pids in self._pids.items()}

    def cores(self, kind: str) -> float:
        """Return the processor time of a kind per time."""
        first, last = self.samples[0], self.samples[-1]
        return (last.kinds[kind].cpu_s - first.kinds[kind].cpu_s) / (last.at_s - first.at_s)

    def last(self) -> Sampled:
        """Return the newest sample."""
        return self.samples[-1]

    def growth(self, figure: Callable[[Sampled], float]) -> float | None:
        """Return by how much a figure grows per second after the warm-up; None if too short."""
        first_s, last_s = self.samples[0].at_s, self.samples[-1].at_s
        left = [one for one in self.samples if one.at_s >= first_s + WARM_UP_S]
        if last_s - first_s < 2 * WARM_UP_S or len(left) < SAMPLES_MIN:
            return None
        return slope([(one.at_s, figure(one)) for one in left])


def growth_row(
    usage: Usage,
    name: str,
    variant: str,
    figure: Callable[[Sampled], float],
    note: str = "after 10 s",
) -> Row:
    """Return the row of a figure in bytes that should not grow after the warm-up."""
    grown = usage.growth(figure)
    return value_row(
        name,
        variant,
        round((grown or 0.0) / 1e3, 1) + 0.0,
        "kB/s",
        len(usage.samples),
        f"none (≤ {GROWTH_MAX / 1e3:g} kB/s)",
        met=None if grown is None else grown <= GROWTH_MAX,
        note=note if grown is not None else "too short to tell",
    )


def slope(points: Sequence[tuple[float, float]]) -> float:
    """Return the median of the slopes between all pairs of points (Theil and Sen)."""
    return statistics.median(
        (after[1] - before[1]) / (after[0] - before[0])
        for before, after in itertools.combinations(points, 2)
        if after[0] > before[0]
    )


def _used(pids: Sequence[int]) -> Used:
    found = {"private": 0, "shared": 0}
    for pid in pids:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            name, _, value = line.partition("\t")
            if name in KINDS_OF_MEMORY:
                found[KINDS_OF_MEMORY[name]] += int(value.split()[0]) * 1024
    # The kernel has an exact clock for each process.
    cpu_s = sum(time.clock_gettime((~pid << 3) | 2) for pid in pids)
    return Used(cpu_s, found["private"], found["shared"])


def threads_ns(pid: int) -> Counter[str]:
    """Return the processor time of the threads of a process by their names, nanoseconds."""
    found: Counter[str] = Counter()
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # ended meanwhile
            on_ns = int((task / "schedstat").read_text().split()[0])
            found[(task / "comm").read_text().strip()] += on_ns
    return found


def private_bytes(pid: int) -> int:
    """Return the memory that a process has for itself."""
    return _used((pid,)).private


def folder_use(root: Path) -> tuple[int, int]:
    """Return how many regular files lie below a folder, and the memory under them in bytes."""
    count = total = 0
    for path in root.rglob("*") if root.is_dir() else ():
        try:
            found = path.lstat()
        except FileNotFoundError:  # went meanwhile
            continue
        if path.is_file():
            count += 1
            total += found.st_blocks * 512
    return count, total
