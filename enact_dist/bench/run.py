"""One run of benches: measures cases in rounds, and makes the rows.

Two cores of a shared machine swing by a factor of two within seconds.  So all cases of a bench are
measured in turn, several times over: a figure and its floor meet the same moments of the machine.
Median and 99th percentile are those of all rounds together, and the spread is that of the medians
of all rounds: a figure of the best round alone would hide what a user sees.

A cell on another host has another disk and other ways than this machine, whose floors say nothing
of it then: no ratio is given and no goal judged, but for what runs in this process alone.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from enact_dist.bench.floors import Floors
from enact_dist.bench.place import EMBEDDED, Place
from enact_dist.bench.rows import FLOOR, Case, Key, Row, Timings, row_of, sample_of

ROUNDS: Final = 3
_PLAIN: Final = tuple(
    ("update", f"{way}, volatile") for way in ("socket", "auto", "zenoh", EMBEDDED)
)
ANSWER: Final[dict[str, tuple[Key, ...]]] = {
    "update": _PLAIN,
    "repeat read": (("fetch", "0.9 MB, seen before"),),
    "4 slots": tuple((name, f"{variant}, 4 slots") for name, variant in _PLAIN),
    "wake-up": (("wakeup", "64 B"),),
    "pipeline": (("pipeline", "image stored to 8 masks read"),),
}
"""The five figures that come first, each the first of these rows that was measured."""
HERE: Final = frozenset((FLOOR, "core"))
"""What is measured of this machine, wherever the cell is."""


class PackingOptions(NamedTuple):
    """What is to be packed.

    Attributes:
        packages: How many.
        seed: Of all that is random.
        processes: How many trays are packed side by side.
        spread: How far the belt's sensor is off (one sigma, mm) and friction; None: several.
        perception: Whether perception alone is scored, on drawn packages without physics.
        provoke: Errors that are provoked, see `actors.palletizing.simulation.knocks`.
        out: Folder for what became of each tray, as it comes, and pictures of provoked errors.
    """

    packages: int = 36
    seed: int = 1
    processes: int = 2
    spread: tuple[float, float] | None = None
    perception: bool = False
    provoke: tuple[str, ...] = ()
    out: Path | None = None


class Answer(NamedTuple):
    """One of the five figures that come first.

    Attributes:
        what: Its name there.
        row: The row of the table that it repeats.
        floor: The raw floor beside it; empty if the cell is on another host.
        floor_us: Median of that floor in the same run, microseconds; None if there is none.
    """

    what: str
    row: Row
    floor: str
    floor_us: float | None

    def as_json(self) -> dict[str, object]:
        """Return the figure as it stands in JSON."""
        row = self.row
        return {
            "what": self.what,
            "name": row.name,
            "variant": row.variant,
            "median_us": row.median_us,
            "spread_us": row.spread_us,
            "floor": self.floor,
            "floor_us": self.floor_us,
            "ratio": row.ratio,
        }


def _place_of(key: Key) -> int:
    """Return the place of a row in its part of the table: floors in their own order."""
    return Floors.every().index(key) if key[0] == FLOOR else 0


class Run:
    """What one command measures.

    Args:
        place: Where the cell is.
        floors: What the machine and the transport can do.
        seconds_s: Measuring time of each case, all rounds together.
        told: Called with what is being measured.
        seeds: How many seeds are played, where a bench plays any.
        packing: What is packed, where a bench packs.
    """

    def __init__(
        self,
        place: Place,
        floors: Floors,
        *,
        seconds_s: float,
        told: Callable[[str], None],
        seeds: int = 1,
        packing: PackingOptions | None = None,
    ) -> None:
        self.place, self.floors = place, floors
        self.seconds_s = seconds_s
        self.told, self.seeds = told, seeds
        self.packing = packing or PackingOptions()
        self._figures: dict[Key, Timings] = {}
        self._times_us: dict[Key, list[float]] = {}
        self._cases: dict[Key, Case] = {}
        self._others: list[Row] = []

    def measure(self, cases: Sequence[Case], *, rounds: int = ROUNDS) -> None:
        """Measure all cases in turn, with the floors that they and their goals depend on."""
        floors = {key for case in cases for key in case.needs if key[0] == FLOOR}
        every = [self.floors.case(floor[1]) for floor in sorted(floors)] + list(cases)
        for number in range(rounds):
            for case in every:
                self.told(f"{case.name}: {case.variant} ({number + 1} of {rounds})")
                self.add(case, self._measured(case, self.seconds_s / rounds))

    @staticmethod
    def _measured(case: Case, seconds_s: float) -> Sequence[float]:
        # A collection in the middle is the program's cost only if the act itself makes garbage
        # cycles; what earlier cases left behind is collected before.
        gc.collect()
        return case.measure(seconds_s)

    def add(self, case: Case, times_us: Sequence[float]) -> None:
        """Add what was measured of a case, here or elsewhere."""
        self._cases.setdefault(case.key, case)
        before = self._figures.get(case.key)
        rounds_us = (*(before.rounds_us if before else ()), sample_of(times_us).median_us)
        every_us = self._times_us.setdefault(case.key, [])
        every_us += times_us
        self._figures[case.key] = replace(sample_of(every_us), rounds_us=rounds_us)

    def add_row(self, row: Row) -> None:
        """Add a figure that is no time."""
        self._others.append(row)

    def rows(self) -> list[Row]:
        """Return all lines so far, floors first."""
        found = [row_of(case, self._figures) for case in self._cases.values()]
        if not self.place.near:
            found = [
                row if row.name in HERE else replace(row, ratio=None, met=None) for row in found
            ]
        names = list(dict.fromkeys(row.name for row in (*found, *self._others)))
        names.sort(key=lambda name: name != FLOOR)
        ordered = sorted(found, key=lambda row: _place_of((row.name, row.variant)))
        return [row for name in names for row in (*ordered, *self._others) if row.name == name]

    def answer(self) -> list[Answer]:
        """Return those of the five figures of `ANSWER` that were measured."""
        rows = {(row.name, row.variant): row for row in self.rows()}
        found = []
        for what, keys in ANSWER.items():
            key = next((one for one in keys if one in self._figures), None)
            if key is not None:
                floor = self._cases[key].floor if rows[key].ratio is not None else None
                floor_us = round(self._figures[floor].median_us, 2) if floor is not None else None
                found.append(Answer(what, rows[key], floor[1] if floor else "", floor_us))
        return found
