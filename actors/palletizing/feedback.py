"""Feedback: tells the user what was found, and where a robot packs, decides what follows."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final

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
    STANDS,
    TAKEN_OUT,
    UNRECOGNISED,
    along_and_across,
    felt_on,
    is_current,
    is_held,
)
from actors.palletizing.vocabulary import (
    CELL,
    COMMAND,
    CONVEYOR,
    DECISION,
    DEVIATIONS,
    GRASP,
    GRIPPER,
    LOOK,
    NOTICES,
    OUTCOME,
    PACKAGES,
    PLACES,
    PLAN,
    PLANNED,
    PRODUCTS,
    QUESTION,
    REQUEST,
    RESULTS,
    SIGHT,
    SIGHTING,
    STATE,
    SYSTEM,
    USER,
    Deviation,
    Notice,
    Question,
    Request,
    Result,
    place_entity,
    product_entity,
)
from enact_dist import Actor, Entity, View, ViewEach, World, Write

if TYPE_CHECKING:
    from enact_dist import Lock


TAKEN_UP: Final = ("regrasp", "place", "push", "remove")
"""Stages after which a package need not be where it was seen before."""


class Feedback(Actor):
    """Notify the user of every judged place, deviating or not, once (ENACT 4.2)."""

    online = World("online")
    flags = View(online, SYSTEM, DEVIATIONS)
    notices = Write(online, USER, NOTICES)
    triggers = (flags,)

    def update(self, lock: Lock) -> None:
        """Notify the user of verdicts that have not been reported yet."""
        before: dict[str, Notice] = lock.get(self.notices, {})
        told = dict(before)
        for place, flag in lock[self.flags].items():
            if place not in told or flag.captured_ns != told[place].captured_ns:
                text = sentence(place, flag)
                print(text, flush=True)
                latency_ms = (time.time_ns() - flag.captured_ns) / 1e6
                told[place] = Notice(text, flag.captured_ns, latency_ms)
        lock[self.notices] = told


def sentence(place: str, flag: Deviation) -> str:
    """Return what a person should read about a place."""
    said = {
        "ok": f"{flag.product} stands as planned",
        "missing": f"{flag.product} did not arrive",
        "extra": f"something {flag.deviation_mm:.0f} mm high lies beside {flag.product}",
        "tipped": f"{flag.product} has tipped",
        "moved": f"{flag.product} stands {flag.deviation_mm:.0f} mm beside its place,"
        f" turned by {flag.turn_deg:.0f} degrees",
        "deformed": f"{flag.product} is deformed by {flag.deviation_mm:.1f} mm"
        f" over {flag.area_mm2 / 100.0:.0f} cm2",
    }
    return f"{place}: {said[flag.verdict]}"


class HandlingFeedback(Actor):
    """Decide what the robot does next, by how the last request ended and by what was seen.

    `reactions` has the table; every request and every result says why.  What could make it worse
    is done only when the operator has decided so.  Before the next package comes, a place is
    opened again whose package was sound and has been spoiled by what was done beside it.
    """

    training, online = World("training"), World("online")
    plans = ViewEach(training, PLACES, PLAN)
    planned = View(training, CELL, PLANNED)
    grasps = ViewEach(training, PRODUCTS, GRASP)
    sightings = ViewEach(online, PACKAGES, SIGHTING)
    sight = View(online, CONVEYOR, SIGHT)
    outcome = View(online, SYSTEM, OUTCOME)
    look = View(online, SYSTEM, LOOK)
    flags = View(online, SYSTEM, DEVIATIONS)
    grip = View(online, GRIPPER, COMMAND)
    gripper = View(online, GRIPPER, STATE)
    decision = View(online, SYSTEM, DECISION)
    request = Write(online, SYSTEM, REQUEST)
    results = Write(online, SYSTEM, RESULTS)
    notices = Write(online, USER, NOTICES)
    question = Write(online, USER, QUESTION)
    triggers = (planned, sightings, sight, outcome, look, flags, decision)

    def update(self, lock: Lock) -> None:
        """Decide, if everything that the decision needs is there."""
        last = lock.get(self.request)
        if last is None or last.place in lock.get(self.results, {}):
            self._next(lock, last)
        elif last.kind == "ask" and self._is_taken_out(lock, last):
            self._close(lock, last, "removed", TAKEN_OUT)
        elif last.kind in IDLE:
            decision = lock.get(self.decision)
            if decision is not None and decision.request == last.number:
                self._decided(lock, last, decision.choice)
        else:
            self._react(lock, last)

    # What comes next

    def _next(self, lock: Lock, last: Request | None) -> None:
        """Reopen a place that was spoiled; or request the next package, if it has come."""
        results = lock.get(self.results, {})
        spoiled = worst({place: self._flag(lock, place).verdict for place in self._spoiled(lock)})
        if spoiled is not None and last is not None:
            self._reopen(lock, last, spoiled)
            return
        number, place = len(results), place_entity(len(results))
        if place not in lock[self.plans] or not is_current(lock.get(self.planned), results):
            return
        first = Request(0 if last is None else last.number, "", place.name, "", "", seen="")
        for package, seen in lock[self.sightings].items():
            if seen.first_stop == number:
                first = replace(first, package=package.name, seen="belt")
                wanted = lock[self.plans][place].product
                if seen.product == wanted:
                    self._ask_robot(lock, first, "pack", f"{wanted} has come")
                elif seen.unfit:
                    self._question(lock, first, seen.unfit, UNFIT_ON_BELT)
                else:
                    self._question(lock, first, f"{seen.product} has come in place of {wanted}")
                return
        sight = lock.get(self.sight)
        if self._is_taken_out(lock, first):
            self._close(lock, first, "removed", TAKEN_OUT)
        elif sight is not None and sight.number == number and sight.error:
            self._ask_robot(lock, first, "look", sight.error)
        elif last is not None and last.place == place.name:  # a look for what has come has ended
            self._see_nothing(lock, last, UNRECOGNISED)

    def _is_taken_out(self, lock: Lock, last: Request) -> bool:
        """Return whether what has come for a place was taken away before it was recognised."""
        sight = lock.get(self.sight)
        return (
            sight is not None
            and not last.package
            and (last.place, TAKEN_OUT) == (place_entity(sight.number).name, sight.error)
        )

    def _spoiled(self, lock: Lock) -> list[str]:
        """Return the places that stood as was decided, and have been judged otherwise since."""
        flags = lock.get(self.flags, {})
        return [
            place
            for place, result in lock.get(self.results, {}).items()
            if result.result in STANDS
            and place in flags
            and flags[place].captured_ns > result.captured_ns
            and flags[place].verdict != result.verdict
        ]

    def _reopen(self, lock: Lock, last: Request, place: str) -> None:
        """Do what is to be done about a package that was placed."""
        results, flag = lock.get(self.results, {}), self._flag(lock, place)
        before = results[place]
        lock[self.results] = {name: one for name, one in results.items() if name != place}
        sighting = lock[self.sightings].get(Entity(before.package)) if before.package else None
        seen = "" if sighting is None else sighting.frame
        opened = Request(last.number, "", place, before.package, "", seen, before.reactions)
        spoiled = Case("beside", last.place, success=True, seen=seen)
        case = self._case(lock, opened, spoiled, flag)
        self._follow(lock, opened, case, flag, react(case))

    # What follows from a request

    def _react(self, lock: Lock, last: Request) -> None:
        outcome, look = lock.get(self.outcome), lock.get(self.look)
        if outcome is None or outcome.request != last.number:
            return
        case = Case(outcome.stage, outcome.result, outcome.success)
        if outcome.result.startswith(BY_ITSELF):
            self._stop(lock, last, react(case).reason)
            return
        if look is None or look.request != last.number:
            return
        if look.error:
            self._see_nothing(lock, last, look.error)
            return
        flags = lock.get(self.flags, {})
        judged = [flags[place].captured_ns for place in look.judged if place in flags]
        if judged != [look.captured_ns] * len(look.judged):
            return  # deviation detection is not done with this picture
        if not last.package:
            self._next(lock, last)
        elif last.kind in GONE and outcome.success and not look.seen:
            done = replace(last, tried=(*last.tried, last.kind))
            self._close(lock, done, GONE[last.kind], last.reason)
        else:
            flag = flags[last.place] if last.place in look.judged else None
            self._answer(lock, last, replace(case, seen=look.seen), flag)

    def _answer(self, lock: Lock, last: Request, case: Case, flag: Deviation | None) -> None:
        """Do what follows from how a request ended and from what was seen."""
        felt_m = self._felt_m(lock, last, case.result)
        done = replace(last, tried=(*last.tried, last.kind), felt_m=felt_m)
        case = self._case(lock, done, case, flag)
        reaction = react(case)
        if last.kind in GONE and not case.result.startswith(NO_NET):
            why = f"it is still seen: {case.seen}" if case.success else case.result
            reaction = Reaction("ask", f"it could not be {GONE[last.kind]}: {why}")
        self._follow(lock, done, case, flag, reaction)

    def _felt_m(self, lock: Lock, last: Request, result: str) -> float:
        """Return how far beside where it was seen the package is, by all that was felt."""
        sighting = lock[self.sightings].get(Entity(last.package)) if last.package else None
        if sighting is None or result not in FELT_SIDE:
            return last.felt_m
        grasp = lock[self.grasps].get(product_entity(sighting.product))
        return last.felt_m if grasp is None else felt_on(last.felt_m, result, grasp)

    def _follow(
        self, lock: Lock, done: Request, case: Case, flag: Deviation | None, reaction: Reaction
    ) -> None:
        """Let a reaction follow what was done, and tell it."""
        self._tell(lock, done.place, flag, f"{reaction.kind}: {reaction.reason}")
        now = replace(done, seen=case.seen, short_m=max(0.0, -case.along_mm) / 1e3)
        if reaction.kind == "go_on":
            self._close(lock, done, "placed", reaction.reason)
        elif reaction.kind == "ask":
            verdict = UNFIT_ON_BELT if case.unfit else case.verdict
            self._question(lock, now, reaction.reason, verdict)
        else:
            self._ask_robot(lock, now, reaction.kind, reaction.reason)

    def _case(self, lock: Lock, last: Request, case: Case, flag: Deviation | None) -> Case:
        """Return a case with what was found at the place."""
        along = across = turn = 0.0
        if flag is not None and flag.verdict != "missing":
            plan = lock[self.plans][Entity(last.place)]
            along, across = along_and_across(plan, flag.tray_from_product)
            turn = flag.turn_deg
        sighting = lock[self.sightings].get(Entity(last.package)) if last.package else None
        return replace(
            case,
            unfit=sighting.unfit if sighting is not None and case.seen == "belt" else "",
            verdict="" if flag is None else flag.verdict,
            along_mm=along,
            across_mm=across,
            turn_deg=turn,
            tried=Counter(last.tried),
        )

    def _see_nothing(self, lock: Lock, last: Request, error: str) -> None:
        """Look again, and ask the operator when that was tried often enough."""
        tried = (*last.tried, last.kind)
        now = replace(last, tried=tried)
        outcome = lock.get(self.outcome)
        if outcome is not None and outcome.request == last.number and outcome.stage in TAKEN_UP:
            now = replace(now, seen="")  # where it was taken up the next one may stand
        self._tell(lock, last.place, None, error)
        looks = tried.count("look")
        if error == TAKEN_OUT:
            self._close(lock, now, "removed", error)
        elif error.startswith(NOT_ASIDE):
            self._question(lock, now, error)
        elif looks >= MOST["look"]:
            self._question(lock, now, f"{error}; look was tried {looks} times")
        else:
            self._ask_robot(lock, now, "look", error)

    # The operator

    def _decided(self, lock: Lock, last: Request, choice: str) -> None:
        """Do what the operator has decided."""
        reason = f"the operator: {choice}"
        if choice == "go_on":
            self._close(lock, last, "accepted" if last.seen == "tray" else "skipped", reason)
        elif choice == "stop":
            self._ask_robot(lock, last, "stop", reason)
            text = f"{last.place}: stopped; look: the arm goes aside, and what is seen decides"
            lock[self.question] = Question(last.number + 1, text, ("look",))
        else:
            self._ask_robot(lock, last, choice, reason)

    def _ask_robot(self, lock: Lock, last: Request, kind: str, reason: str) -> None:
        """Request something about the same place."""
        lock[self.request] = replace(last, number=last.number + 1, kind=kind, reason=reason)

    def _question(self, lock: Lock, last: Request, reason: str, verdict: str = "") -> None:
        """Ask the operator; nothing moves until the answer comes.

        A package that was not judged now is on the tray as it was judged last.
        """
        self._ask_robot(lock, last, "ask", reason)
        choices: tuple[str, ...] = ("stop", "look")
        flags = lock.get(self.flags, {})
        if not verdict and last.seen == "tray" and last.place in flags:
            verdict = flags[last.place].verdict
        if last.package:
            can_take = not reason.startswith(CANNOT)
            choices = choices_of(verdict, last.seen, last.tried, can_take=can_take)
        lock[self.question] = Question(last.number + 1, f"{last.place}: {reason}", choices)

    def _stop(self, lock: Lock, last: Request, reason: str) -> None:
        """Ask how to go on: nothing moves by itself after the robot has stopped."""
        sighting = lock[self.sightings].get(Entity(last.package)) if last.package else None
        seen = "" if sighting is None else sighting.frame
        if sighting is not None:
            grasp = lock[self.grasps].get(product_entity(sighting.product))
            held = is_held(lock.get(self.grip), lock.get(self.gripper), grasp)
            seen = "hand" if held else seen
        now = replace(last, tried=(*last.tried, last.kind), seen=seen)
        self._question(lock, now, reason)
        self._tell(lock, last.place, None, f"stop: {reason}")

    # What the user reads

    def _flag(self, lock: Lock, place: str) -> Deviation:
        """Return the last verdict on a place."""
        flags: dict[str, Deviation] = lock.get(self.flags, {})
        return flags[place]

    def _close(self, lock: Lock, last: Request, result: str, reason: str) -> None:
        """Note what became of the package; the next one can be packed."""
        flag = lock.get(self.flags, {}).get(last.place)
        sighting = lock[self.sightings].get(Entity(last.package)) if last.package else None
        tried = tuple(kind for kind in last.tried if kind not in {"", "pack", *IDLE})
        closed = Result(
            package=last.package,
            product="" if sighting is None else sighting.product,
            verdict="" if flag is None else flag.verdict,
            result=result,
            reactions=tried,
            reason=reason,
            captured_ns=0 if flag is None else flag.captured_ns,
        )
        lock[self.results] = {**lock.get(self.results, {}), last.place: closed}
        self._next(lock, last)

    def _tell(self, lock: Lock, place: str, flag: Deviation | None, text: str) -> None:
        """Tell the user about a place."""
        if flag is not None:
            text = f"{sentence(place, flag)}; {text}"
            latency_ms = (time.time_ns() - flag.captured_ns) / 1e6
        else:
            text, latency_ms = f"{place}: {text}", 0.0
        print(text, flush=True)
        stamp_ns = time.time_ns() if flag is None else flag.captured_ns
        told: dict[str, Notice] = lock.get(self.notices, {})
        lock[self.notices] = {**told, place: Notice(text, stamp_ns, latency_ms)}
