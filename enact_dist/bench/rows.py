"""What a bench measures and how it is judged: samples, goals, cases and the rows of the table."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

Key: TypeAlias = tuple[str, str]
"""Name of the bench and the variant in it."""
FLOOR: Final = "floor"
"""The bench of what the machine and the bare transports do by themselves."""


@dataclass(frozen=True, slots=True)
class Timings:
    """Many times of the same act.

    Attributes:
        median_us: Half of them took no longer, microseconds.
        p99_us: 99 of 100 took no longer, microseconds.
        n: How many there are.
        rounds_us: The median of each round in which they were measured, microseconds.
    """

    median_us: float
    p99_us: float
    n: int
    rounds_us: tuple[float, ...] = ()


Figures: TypeAlias = Mapping[Key, Timings]


def sample_of(times_us: Sequence[float]) -> Timings:
    """Return what many times have in common.

    Raises:
        ValueError: There are none.
    """
    if not times_us:
        raise ValueError("nothing was measured")
    ordered = sorted(times_us)
    at = min(len(ordered) - 1, int(len(ordered) * 0.99))
    return Timings(statistics.median(ordered), ordered[at], len(ordered))


@dataclass(frozen=True, slots=True)
class Goal:
    """What a figure should keep to.

    Attributes:
        text: For people.
        limit_us: The longest median, from the other figures of the same run; None where those
            were not measured.
        p99_us: The longest 99th percentile; None where none is set.
        needs: The figures that `limit_us` depends on.
    """

    text: str
    limit_us: Callable[[Figures], float | None]
    p99_us: float | None = None
    needs: tuple[Key, ...] = ()

    def met(self, sample: Timings, figures: Figures) -> bool | None:
        """Say whether `sample` keeps to it; None where this run does not show it."""
        limit_us = self.limit_us(figures)
        if limit_us is None:
            return None
        return sample.median_us <= limit_us and (
            self.p99_us is None or sample.p99_us <= self.p99_us
        )


def at_most(limit_us: float, text: str, *, p99_us: float | None = None) -> Goal:
    """Return a goal of a fixed time in microseconds."""
    return Goal(text, lambda _figures: limit_us, p99_us)


def times(factor: float, of: Key, text: str, *, plus: tuple[float, Key] | None = None) -> Goal:
    """Return a goal of so many times another median, plus so many times a further one."""

    def limit_us(figures: Figures) -> float | None:
        if of not in figures or (plus is not None and plus[1] not in figures):
            return None
        more_us = plus[0] * figures[plus[1]].median_us if plus is not None else 0.0
        return factor * figures[of].median_us + more_us

    return Goal(text, limit_us, needs=(of,) if plus is None else (of, plus[1]))


@dataclass(frozen=True, slots=True)
class Case:
    """One line of a bench.

    Attributes:
        name: The bench.
        variant: What is different in this line.
        measure: Acts for so many seconds, and returns the time of each act in microseconds.
        floor: The figure that this one is divided by.
        goal: What it should keep to, if anything.
        bytes: How many each act moves, where the speed is of interest; else 0.
        beside: Another row that this one is to be seen beside, and what it is called there.
    """

    name: str
    variant: str
    measure: Callable[[float], Sequence[float]]
    floor: Key | None = None
    goal: Goal | None = None
    bytes: int = 0
    beside: tuple[Key, str] | None = None

    @property
    def key(self) -> Key:
        """Under which its figure is kept."""
        return (self.name, self.variant)

    @property
    def needs(self) -> set[Key]:
        """The figures of the same run without which it is not judged."""
        return {*(self.goal.needs if self.goal else ()), *((self.floor,) if self.floor else ())}


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table; what it does not have is None.

    Attributes:
        name: The bench.
        variant: What is different in this line.
        median_us: Microseconds; None for a figure that is no time.
        p99_us: Microseconds.
        n: Of how many.
        ratio: The median over that of the floor of the same run.
        goal: In words.
        met: Whether it is kept to; None without one, or where this run cannot tell.
        value: The figure that is no time.
        unit: Of `value`.
        note: What a reader should know beside it.
        mb_s: Megabytes (10^6 bytes) per second of the median, where the speed is of interest.
        beside: So many times another row that its goal does not name, in words.
        spread_us: The lowest and the highest median of a round, microseconds.
    """

    name: str
    variant: str
    median_us: float | None
    p99_us: float | None
    n: int
    ratio: float | None = None
    goal: str | None = None
    met: bool | None = None
    value: float | None = None
    unit: str | None = None
    note: str = ""
    mb_s: float | None = None
    beside: str = ""
    spread_us: tuple[float, float] | None = None

    def as_json(self) -> dict[str, object]:
        """Return the row as it stands in JSON; what only some rows have, only where it is."""
        found = {name: getattr(self, name) for name in TIME_FIELDS}
        if self.value is not None:
            found |= {"value": self.value, "unit": self.unit}
        if self.mb_s is not None:
            found["mb_s"] = self.mb_s
        if self.spread_us is not None:
            found["spread_us"] = self.spread_us
        found |= {name: text for name in TEXT_FIELDS if (text := getattr(self, name))}
        return found


def value_row(
    name: str,
    variant: str,
    value: float | None,
    unit: str,
    n: int,
    goal: str | None = None,
    *,
    met: bool | None = None,
    note: str = "",
) -> Row:
    """Return a row of a figure that is no time; None: it has no value, and a note says why."""
    return Row(name, variant, None, None, n, None, goal, met, value, unit, note)


TIME_FIELDS: Final = ("name", "variant", "median_us", "p99_us", "n", "ratio", "goal", "met")
TEXT_FIELDS: Final = ("beside", "note")


def row_of(case: Case, figures: Figures) -> Row:
    """Return the line of a case that was measured."""
    sample = figures[case.key]
    floor = figures.get(case.floor) if case.floor is not None else None
    return Row(
        case.name,
        case.variant,
        round(sample.median_us, 2),
        round(sample.p99_us, 2),
        sample.n,
        round(sample.median_us / floor.median_us, 3) if floor is not None else None,
        case.goal.text if case.goal is not None else None,
        case.goal.met(sample, figures) if case.goal is not None else None,
        mb_s=round(case.bytes / sample.median_us, 1) if case.bytes else None,
        beside=_beside(case, sample, figures),
        spread_us=_spread_us(sample),
    )


def _spread_us(sample: Timings) -> tuple[float, float] | None:
    rounds_us = sample.rounds_us
    return (round(min(rounds_us), 2), round(max(rounds_us), 2)) if len(rounds_us) > 1 else None


def _beside(case: Case, sample: Timings, figures: Figures) -> str:
    if case.beside is None or case.beside[0] not in figures:
        return ""
    key, name = case.beside
    return f"{sample.median_us / figures[key].median_us:.2f} x {name}"


def shown_spread(spread_us: Sequence[float]) -> str:
    """Return the lowest and the highest median of a round."""
    lowest_us, highest_us = spread_us
    return f"{shown_us(lowest_us)} to {shown_us(highest_us)}"


def shown_us(value_us: float) -> str:
    """Return a time with three digits and its unit."""
    for unit, size_us in (("µs", 1.0), ("ms", 1e3), ("s", 1e6)):
        value = value_us / size_us
        if value < 1000.0 or unit == "s":
            digits = 0 if value >= 100.0 else 1 if value >= 10.0 else 2
            return f"{value:.{digits}f} {unit}"
    raise AssertionError
