"""Which request follows: from what has come, how the last one ended, what was seen and decided.

PURE: a situation in, what follows out; `feedback` runs it, `reactions` has the table of reasons.

Rules a change must keep: what could make it worse is done only when the operator has decided so;
every request and every result says why.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from actors.palletizing.handling.data import TAKEN_OUT, UNRECOGNISED
from actors.palletizing.handling.reactions import (
    BY_ITSELF,
    CANNOT,
    MOST,
    NO_NET,
    UNFIT_ON_BELT,
    Case,
    Reaction,
    choices_of,
    react,
    worst,
)
from actors.palletizing.handling.stages import (
    FELT_SIDE,
    GONE,
    IDLE,
    NOT_ASIDE,
    RISKY,
    STANDS,
    along_and_across,
    felt_on,
    is_current,
    is_held,
)
from actors.palletizing.vocabulary import (
    Question,
    Request,
    Result,
    place_entity,
    product_entity,
)
from enact_dist import Entity

if TYPE_CHECKING:
    from collections.abc import Mapping

    from actors.palletizing.placing.finger_room import Grasp
    from actors.palletizing.vocabulary import (
        Decision,
        Deviation,
        GripCommand,
        GripState,
        Look,
        Outcome,
        Plan,
        Planned,
        Sight,
        Sighting,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """What is known when it is decided what follows; None: not yet.

    Attributes:
        request: The last one.
        results: What became of each package so far, by name of its place.
        plans: By place.
        planned: What the plans take into account.
        grasps: By product.
        sightings: By package.
        sight: Whether what came last was seen.
        outcome: How the last request ended.
        look: What was seen then.
        flags: The last verdict on each place, by its name.
        grip: The last command to the gripper.
        gripper: What it measures.
        decision: The operator's last one.
    """

    request: Request | None
    results: dict[str, Result]
    plans: Mapping[Entity, Plan]
    planned: Planned | None
    grasps: Mapping[Entity, Grasp]
    sightings: Mapping[Entity, Sighting]
    sight: Sight | None
    outcome: Outcome | None
    look: Look | None
    flags: Mapping[str, Deviation]
    grip: GripCommand | None
    gripper: GripState | None
    decision: Decision | None

    def sighting(self, package: str) -> Sighting | None:
        """Return where a package was seen last, by its name; None if it has none."""
        return self.sightings.get(Entity(package)) if package else None

    def grasp(self, seen: Sighting) -> Grasp | None:
        """Return how what was seen is held; None if that is not known."""
        return self.grasps.get(product_entity(seen.product))

    def is_taken_out(self, last: Request) -> bool:
        """Return whether what has come for a place was taken away before it was recognised."""
        return (
            self.sight is not None
            and not last.package
            and (last.place, TAKEN_OUT) == (place_entity(self.sight.number).name, self.sight.error)
        )

    def spoiled(self) -> str | None:
        """Return the worst place that stood as was decided, and has been judged otherwise since."""
        return worst(
            {
                place: flag.verdict
                for place, result in self.results.items()
                if result.result in STANDS
                and (flag := self.flags.get(place)) is not None
                and flag.captured_ns > result.captured_ns
                and flag.verdict != result.verdict
            }
        )


@dataclass(frozen=True, slots=True)
class Said:
    """One line for the user about a place.

    Attributes:
        place: Its name.
        flag: The verdict on it that this follows from, if any.
        text: What follows, and why.
    """

    place: str
    flag: Deviation | None
    text: str


@dataclass(frozen=True, slots=True)
class FollowUp:
    """What follows from a situation.

    Attributes:
        request: The next one; None: none yet.
        question: To the operator; None: none.
        results: What became of each package, by name of its place; None: as before.
        said: The lines for the user, in this order.
    """

    request: Request | None = None
    question: Question | None = None
    results: dict[str, Result] | None = None
    said: tuple[Said, ...] = ()

    def after(self, results: dict[str, Result]) -> FollowUp:
        """Return the same with these results, unless it has changed them further."""
        return self if self.results is not None else replace(self, results=results)

    def told(self, place: str, flag: Deviation | None, text: str) -> FollowUp:
        """Return the same with a line for the user before the others."""
        return replace(self, said=(Said(place, flag, text), *self.said))


def follow_up(now: Situation) -> FollowUp:
    """Return what follows; nothing while something that the decision needs is not there.

    Before the next package comes, a place is opened again whose package was sound and has been
    spoiled by what was done beside it.
    """
    last = now.request
    if last is None or last.place in now.results:
        return _next(now, last)
    if last.kind == "ask" and now.is_taken_out(last):
        return _close(now, last, "removed", TAKEN_OUT)
    if last.kind in IDLE:
        if now.decision is None or now.decision.request != last.number:
            return FollowUp()
        return _decided(now, last, now.decision.choice)
    return _ended(now, last)


# What comes next


def _next(now: Situation, last: Request | None) -> FollowUp:
    """Reopen a place that was spoiled; or request the next package, if it has come."""
    spoiled = now.spoiled()
    if spoiled is not None and last is not None:
        return _reopen(now, last, spoiled)
    number, place = len(now.results), place_entity(len(now.results))
    if place not in now.plans or not is_current(now.planned, now.results):
        return FollowUp()
    first = Request(0 if last is None else last.number, "", place.name, "", "", seen="")
    for package, seen in now.sightings.items():
        if seen.first_stop == number:
            first = replace(first, package=package.name, seen="belt")
            wanted = now.plans[place].product
            if seen.product == wanted:
                return _request(first, "pack", f"{wanted} has come")
            if seen.unfit:
                return _ask(now, first, seen.unfit, UNFIT_ON_BELT)
            return _ask(now, first, f"{seen.product} has come in place of {wanted}")
    if now.is_taken_out(first):
        return _close(now, first, "removed", TAKEN_OUT)
    if now.sight is not None and now.sight.number == number and now.sight.error:
        return _request(first, "look", now.sight.error)
    if last is not None and last.place == place.name:  # a look for what has come has ended
        return _saw_nothing(now, last, UNRECOGNISED)
    return FollowUp()


def _reopen(now: Situation, last: Request, place: str) -> FollowUp:
    """Return what is to be done about a package that was placed."""
    before, flag = now.results[place], now.flags[place]
    now = replace(now, results={name: one for name, one in now.results.items() if name != place})
    sighting = now.sighting(before.package)
    seen = "" if sighting is None else sighting.frame
    opened = Request(last.number, "", place, before.package, "", seen, before.reactions)
    case = _case(now, opened, Case("beside", last.place, success=True, seen=seen), flag)
    return _answer(now, opened, case, flag, react(case)).after(now.results)


def _close(now: Situation, last: Request, result: str, reason: str) -> FollowUp:
    """Note what became of the package; the next one can be packed."""
    flag, sighting = now.flags.get(last.place), now.sighting(last.package)
    closed = Result(
        package=last.package,
        product="" if sighting is None else sighting.product,
        verdict="" if flag is None else flag.verdict,
        result=result,
        reactions=tuple(kind for kind in last.tried if kind not in {"", "pack", *IDLE}),
        reason=reason,
        captured_ns=0 if flag is None else flag.captured_ns,
    )
    now = replace(now, results={**now.results, last.place: closed})
    return _next(now, last).after(now.results)


# What follows from a request that has ended


def _ended(now: Situation, last: Request) -> FollowUp:
    """Return what follows once the last request has ended and perception has looked."""
    outcome, look = now.outcome, now.look
    if outcome is None or outcome.request != last.number:
        return FollowUp()
    case = Case(outcome.stage, outcome.result, outcome.success)
    if outcome.result.startswith(BY_ITSELF):
        return _stopped(now, last, react(case).reason)
    if look is None or look.request != last.number:
        return FollowUp()
    if look.error:
        return _saw_nothing(now, last, look.error)
    judged = [now.flags[place].captured_ns for place in look.judged if place in now.flags]
    if judged != [look.captured_ns] * len(look.judged):
        return FollowUp()  # deviation detection is not done with this picture
    if not last.package:
        return _next(now, last)
    done = replace(last, tried=(*last.tried, last.kind))
    if last.kind in GONE and outcome.success and not look.seen:
        return _close(now, done, GONE[last.kind], last.reason)
    flag = now.flags[last.place] if last.place in look.judged else None
    done = replace(done, felt_m=_felt_m(now, last, outcome.result))
    case = _case(now, done, replace(case, seen=look.seen), flag)
    reaction = react(case)
    if last.kind in GONE and not case.result.startswith(NO_NET):
        why = f"it is still seen: {case.seen}" if case.success else case.result
        reaction = Reaction("ask", f"it could not be {GONE[last.kind]}: {why}")
    return _answer(now, done, case, flag, reaction)


def _felt_m(now: Situation, last: Request, result: str) -> float:
    """Return how far beside where it was seen the package is, by all that was felt."""
    sighting = now.sighting(last.package)
    if sighting is None or result not in FELT_SIDE:
        return last.felt_m
    grasp = now.grasp(sighting)
    return last.felt_m if grasp is None else felt_on(last.felt_m, result, grasp)


def _case(now: Situation, last: Request, case: Case, flag: Deviation | None) -> Case:
    """Return a case with what was found at the place."""
    along = across = turn = 0.0
    if flag is not None and flag.verdict != "missing":
        along, across = along_and_across(now.plans[Entity(last.place)], flag.tray_from_product)
        turn = flag.turn_deg
    sighting = now.sighting(last.package)
    return replace(
        case,
        unfit=sighting.unfit if sighting is not None and case.seen == "belt" else "",
        verdict="" if flag is None else flag.verdict,
        along_mm=along,
        across_mm=across,
        turn_deg=turn,
        tried=Counter(last.tried),
    )


def _answer(
    now: Situation, done: Request, case: Case, flag: Deviation | None, reaction: Reaction
) -> FollowUp:
    """Let a reaction follow what was done, and tell it."""
    last = replace(done, seen=case.seen, short_m=max(0.0, -case.along_mm) / 1e3)
    if reaction.kind == "go_on":
        found = _close(now, done, "placed", reaction.reason)
    elif reaction.kind == "ask":
        verdict = UNFIT_ON_BELT if case.unfit else case.verdict
        found = _ask(now, last, reaction.reason, verdict)
    else:
        found = _request(last, reaction.kind, reaction.reason)
    return found.told(done.place, flag, f"{reaction.kind}: {reaction.reason}")


def _saw_nothing(now: Situation, last: Request, error: str) -> FollowUp:
    """Look again, and ask the operator when that was tried often enough."""
    tried = (*last.tried, last.kind)
    done = replace(last, tried=tried)
    outcome, looks = now.outcome, tried.count("look")
    if outcome is not None and outcome.request == last.number and outcome.stage in RISKY:
        done = replace(done, seen="")  # where it was taken up the next one may stand
    if error == TAKEN_OUT:
        found = _close(now, done, "removed", error)
    elif error.startswith(NOT_ASIDE):
        found = _ask(now, done, error)
    elif looks >= MOST["look"]:
        found = _ask(now, done, f"{error}; look was tried {looks} times")
    else:
        found = _request(done, "look", error)
    return found.told(last.place, None, error)


def _stopped(now: Situation, last: Request, reason: str) -> FollowUp:
    """Ask how to go on: nothing moves by itself after the robot has stopped."""
    sighting = now.sighting(last.package)
    seen = "" if sighting is None else sighting.frame
    if sighting is not None and is_held(now.grip, now.gripper, now.grasp(sighting)):
        seen = "hand"
    done = replace(last, tried=(*last.tried, last.kind), seen=seen)
    return _ask(now, done, reason).told(last.place, None, f"stop: {reason}")


# The operator


def _decided(now: Situation, last: Request, choice: str) -> FollowUp:
    """Do what the operator has decided."""
    reason = f"the operator: {choice}"
    if choice == "go_on":
        return _close(now, last, "accepted" if last.seen == "tray" else "skipped", reason)
    found = _request(last, choice, reason)
    if choice != "stop":
        return found
    text = f"{last.place}: stopped; look: the arm goes aside, and what is seen decides"
    return replace(found, question=Question(last.number + 1, text, ("look",)))


def _request(last: Request, kind: str, reason: str) -> FollowUp:
    """Request something about the same place."""
    return FollowUp(replace(last, number=last.number + 1, kind=kind, reason=reason))


def _ask(now: Situation, last: Request, reason: str, verdict: str = "") -> FollowUp:
    """Ask the operator; nothing moves until the answer comes.

    A package that was not judged now is on the tray as it was judged last.
    """
    choices: tuple[str, ...] = ("stop", "look")
    if not verdict and last.seen == "tray" and last.place in now.flags:
        verdict = now.flags[last.place].verdict
    if last.package:
        can_take = not reason.startswith(CANNOT)
        choices = choices_of(verdict, last.seen, last.tried, can_take=can_take)
    question = Question(last.number + 1, f"{last.place}: {reason}", choices)
    return replace(_request(last, "ask", reason), question=question)
