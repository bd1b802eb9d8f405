"""What follows from how an action ended and from what the camera saw: one table of reasons.

=============================  =====================================================================
what happened                  what follows
=============================  =====================================================================
sound                          go on
missed, lost, blocked          retry when it stands on the belt, regrasp when upright on the tray
lies or leans on the belt      ask the operator: no hand takes it
blocked, no floor, in hand     reject: it is still held
moved, short of its neighbour  push again, once, up to `SHORT_MM`, if it is in its row
moved up to `NEAR_MM`          regrasp, also up to `SHORT_MM` short of its neighbour
moved farther, tipped,         ask the operator
deformed, extra
anything a second or third     ask the operator
time, or unforeseen
no net can be grounded         ask the operator
robot stopped by itself        stop
=============================  =====================================================================

Rule a change must keep: nothing that could make it worse is done without the operator being asked;
every reaction has its reason in words.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

from collections.abc import Container, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

Place = TypeVar("Place", bound=Hashable)

REACTIONS: Final = ("go_on", "push_again", "regrasp", "retry", "reject", "stop", "ask")
BY_ITSELF: Final = ("sensor:", "not_following:", "no_frame:", "braked:", "interrupted:")
"""Results of a robot that has stopped by itself: it must not move before someone has looked."""
NO_NET: Final = "no_net:"
"""Result of a request that cannot be grounded; the reason follows."""
CANNOT: Final = "it cannot be done:"
"""Begin of the reason of the question that follows: the robot cannot take the package."""
NEAR_MM: Final = 30.0
"""A package that stands farther from its place has not just slipped."""
SHORT_MM: Final = 70.0
"""Within its row it may stand farther off."""
ACROSS_MM: Final = 8.0
"""A push leaves a package as far beside its row as it is: what stands farther off is taken anew."""
TURNED_DEG: Final = 20.0
"""A package that is turned by more is nothing that the robot may take by itself."""
MOST: Final = {"push_again": 1, "regrasp": 2, "retry": 2, "reject": 1, "look": 2}
"""How often each is tried for one place."""
WORST: Final = ("tipped", "deformed", "extra", "moved", "missing")
"""Verdicts that something follows from, the worst first."""
CHOICES: Final = {
    "belt": ("retry", "reject"),
    "tray": ("regrasp", "go_on", "reject"),
    "hand": ("reject",),
    "": ("go_on",),
}
"""What an operator may let the robot do with a package, by where it is."""
UNFIT: Final = {
    "tipped": ("regrasp", "retry", "reject"),
    "deformed": ("regrasp",),
    "extra": ("regrasp",),
}
"""What the robot cannot do with a package, by how it stands."""
UNFIT_ON_BELT: Final = "tipped"
"""What a package on the belt is that lies or leans there, for `choices_of`."""
AGAIN: Final = {"reject": 1, "retry": 3, "regrasp": 3, "removed": 3}
"""How often each is done for one place at most, by the operator or by rule."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is known of a place after an action.

    Attributes:
        stage: Skeleton of the last net: "grasp_from_belt", "place", "push_into_contact" ...
        result: How it ended.
        success: Whether that is what it was for.
        verdict: Of the place: "ok", "missing", "moved", "tipped", "deformed", "extra"; "" if it
            was not judged.
        along_mm: How far beyond its place the package stands along the push; negative: short of it.
        across_mm: The same beside its row, to the left of the push.
        turn_deg: Turn against its place.
        seen: Where the package was seen last: "belt", "tray", "hand", or "" if nowhere.
        tried: How often each reaction was tried for this place.
        unfit: Why no hand takes it from the belt where it is seen there; empty if one does.
    """

    stage: str
    result: str
    success: bool
    verdict: str = ""
    along_mm: float = 0.0
    across_mm: float = 0.0
    turn_deg: float = 0.0
    seen: str = ""
    tried: Mapping[str, int] = field(default_factory=dict)
    unfit: str = ""


@dataclass(frozen=True, slots=True)
class Reaction:
    """What follows.

    Attributes:
        kind: One of `REACTIONS`.
        reason: Why, in one line.
    """

    kind: str
    reason: str


def react(case: Case) -> Reaction:
    """Return what follows from a case."""
    if case.result.startswith(BY_ITSELF):
        return Reaction("stop", f"{case.stage} ended with {case.result}")
    if case.result.startswith(NO_NET):
        return Reaction("ask", case.result.replace(NO_NET, CANNOT))
    if case.seen == "hand":
        return _if_left(case, "reject", f"{case.stage}: {case.result}, the package is still held")
    if case.verdict in {"tipped", "deformed", "extra"}:
        return Reaction("ask", f"it is {case.verdict}")
    if case.verdict == "ok":
        return Reaction("go_on", "it stands as planned")
    if case.verdict == "moved":
        return _moved(case)
    what = case.result if not case.success else "not at its place"
    if case.seen == "belt" and case.unfit:
        return Reaction("ask", f"{case.stage}: {what}; {case.unfit}")
    if case.seen == "belt":
        return _if_left(case, "retry", f"{case.stage}: {what}; it is on the belt")
    if case.seen == "tray":
        return _if_left(case, "regrasp", f"{case.stage}: {what}; it lies on the tray")
    return Reaction("ask", f"{case.stage}: {what}; it is seen nowhere")


def worst(verdicts: Mapping[Place, str], but: Container[Place] = ()) -> Place | None:
    """Return the place that something is to be done about first, None if all are sound.

    A push can spoil what stood before, so it is asked about all places, not only the newest.

    Args:
        verdicts: Of each place.
        but: Places that are left out.
    """
    left = [place for place, verdict in verdicts.items() if verdict in WORST and place not in but]
    return min(left, key=lambda place: WORST.index(verdicts[place]), default=None)


def choices_of(
    verdict: str, seen: str, tried: Sequence[str] = (), *, can_take: bool = True
) -> tuple[str, ...]:
    """Return what an operator may answer: what can be carried out now, and no more.

    Args:
        verdict: Of the place; "" if it was not judged.
        seen: Where the package is: "belt", "tray", "hand", or "" if nowhere.
        tried: What was done for the place so far.
        can_take: Whether the robot can hold and reach it.
    """
    robots = CHOICES[seen] if can_take else tuple({"go_on"} & set(CHOICES[seen]))
    refused = {word for word, most in AGAIN.items() if tried.count(word) >= most}
    refused |= set(UNFIT.get(verdict, ()))
    looks = ("look",) if can_take else ()
    return tuple(word for word in (*robots, "removed", "stop", *looks) if word not in refused)


def _moved(case: Case) -> Reaction:
    where = f"{case.along_mm:+.0f} mm along the push, {case.across_mm:+.0f} mm across"
    if abs(case.turn_deg) > TURNED_DEG:
        return Reaction("ask", f"it is turned by {case.turn_deg:.0f}°")
    near = -SHORT_MM < case.along_mm < NEAR_MM and abs(case.across_mm) < NEAR_MM
    if not near:
        return Reaction("ask", f"{where}: too far away to be taken for a slip")
    short = case.along_mm < -abs(case.across_mm) and abs(case.across_mm) < ACROSS_MM
    if short and case.tried.get("push_again", 0) < MOST["push_again"]:
        return Reaction("push_again", f"{where}: short of its neighbour")
    return _if_left(case, "regrasp", where)


def _if_left(case: Case, kind: str, reason: str) -> Reaction:
    """Return a reaction, or the question of the operator when it was tried often enough."""
    tried = case.tried.get(kind, 0)
    if tried >= MOST[kind]:
        return Reaction("ask", f"{reason}; {kind} was tried {tried} times")
    return Reaction(kind, reason)
