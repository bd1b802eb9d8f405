"""What is noted of a packed tray, for the score: verdicts, requests, what became of each package.

Rule a change must keep: all of it goes through JSON and back.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict on a place beside what was true at that moment.

    Attributes:
        place: Number of the place.
        verdict: What was seen: "ok", "missing", "moved", "tipped", "deformed", "extra".
        truth: What was so, with the same values.
        shift_mm: Of the true pose against the plan.
        turn_deg: The same turn.
        pose_error_mm: Of the found against the true position; NaN if nothing was found.
        dent_mm: True depth of the deepest dent that the sensor could see.
        at_s: When, simulated time.
    """

    place: int
    verdict: str
    truth: str
    shift_mm: float
    turn_deg: float
    pose_error_mm: float
    dent_mm: float
    at_s: float


@dataclass(frozen=True, slots=True)
class Step:
    """One request, what became of it, and what followed.

    Attributes:
        request: "pack", "retry", ...
        stages: Skeleton and result of each net.
        succeeded: Whether the last of them did what it is for.
        reaction: What followed.
        reason: Why.
        choice: What the operator chose; "" if not asked.
        seconds: Simulated time that it took, looking included.
        before: What was true of the package before.
        after: What was true afterwards.
        harmed: How many other packages on the tray are worse off afterwards.
        at_s: When it ended, simulated time.
    """

    request: str
    stages: tuple[tuple[str, str], ...]
    succeeded: bool
    reaction: str
    reason: str
    choice: str
    seconds: float
    before: str
    after: str
    harmed: int
    at_s: float


@dataclass(slots=True, eq=False)
class Packed:
    """What became of one package.

    Attributes:
        number: From 0.
        product: Its name.
        friction: Coefficient of its contacts.
        knock: What it was provoked to, see `simulation.knocks`; "" if it was not.
        steps: All that was done.
        judgements: All verdicts on its place, until a person put another package there.
        cycle_s: From its first net until the hand was free for the next package, with all that had
            to be repaired because of it.
        by_hand: The operator had to touch it.
        rejected: It was taken to the reject bin.
        along_mm, across_mm, turn_deg: Against its place, in the end; NaN if it is not on the tray.
        gap_mm: To its neighbour, or the rim, in the end; NaN if it was not pushed.
        dents_mm: Depth of each dent, also of a package that was replaced.
        dented_by: What made them.
    """

    number: int
    product: str
    friction: float
    knock: str = ""
    steps: list[Step] = field(default_factory=list)
    judgements: list[Judgement] = field(default_factory=list)
    cycle_s: float = float("nan")
    by_hand: bool = False
    rejected: bool = False
    along_mm: float = float("nan")
    across_mm: float = float("nan")
    turn_deg: float = float("nan")
    gap_mm: float = float("nan")
    dents_mm: tuple[float, ...] = ()
    dented_by: tuple[str, ...] = ()


def line_of(packed: Sequence[Packed]) -> str:
    """Return what became of packages as one line of JSON."""
    return json.dumps([asdict(each) for each in packed])


def packed_of(line: str) -> list[Packed]:
    """Return what `line_of` was given."""
    return [_packed(each) for each in json.loads(line)]


def _packed(fields: Mapping[str, Any]) -> Packed:
    steps = [
        Step(**{**each, "stages": tuple(map(tuple, each["stages"]))}) for each in fields["steps"]
    ]
    lists = {name: tuple(fields[name]) for name in ("dents_mm", "dented_by")}
    judgements = [Judgement(**each) for each in fields["judgements"]]
    return Packed(**{**fields, **lists, "steps": steps, "judgements": judgements})
