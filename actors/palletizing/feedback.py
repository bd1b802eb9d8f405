"""Feedback: tells the user what was found, and where a robot packs, decides what follows."""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING, Final

from actors.palletizing.handling import IDLE, along_and_across, is_held
from actors.palletizing.reactions import Case, Reaction, choices_of, react
from actors.palletizing.vocabulary import (
    DECISION,
    DEVIATIONS,
    EXECUTION,
    GRASP,
    LOOK,
    NOTICES,
    OUTCOME,
    PACKAGES,
    PLACES,
    PLAN,
    PRODUCTS,
    QUESTION,
    REQUEST,
    RESULTS,
    ROBOT,
    SIGHTING,
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
    from actors.palletizing.vocabulary import Outcome, Sighting
    from enact_dist import Lock

UNTAKEN: Final = ("tipped", "missing")
"""Verdicts on packages that the robot cannot take to the bin."""
AGAIN: Final = {"reject": 1, "retry": 3, "regrasp": 3, "push_again": 2}
"""How often each is done for one place at most, by the operator or by rule."""
NO_NET: Final = "it cannot be done:"
HANDS: Final = ("removed", "replaced")
"""Answers of an operator who has moved the package by hand."""


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
    is done only when the operator has decided so.
    """

    training, online = World("training"), World("online")
    plans = ViewEach(training, PLACES, PLAN)
    grasps = ViewEach(training, PRODUCTS, GRASP)
    sightings = ViewEach(online, PACKAGES, SIGHTING)
    outcome = View(online, SYSTEM, OUTCOME)
    look = View(online, SYSTEM, LOOK)
    flags = View(online, SYSTEM, DEVIATIONS)
    execution = View(online, ROBOT, EXECUTION)
    decision = View(online, SYSTEM, DECISION)
    request = Write(online, SYSTEM, REQUEST)
    results = Write(online, SYSTEM, RESULTS)
    notices = Write(online, USER, NOTICES)
    question = Write(online, USER, QUESTION)
    triggers = (sightings, outcome, look, flags, decision)

    def update(self, lock: Lock) -> None:
        """Decide, if everything that the decision needs is there."""
        last = lock.get(self.request)
        if last is None or last.place in lock.get(self.results, {}):
            self._next(lock, last)
        elif last.kind == "ask":
            decision = lock.get(self.decision)
            if decision is not None and decision.request == last.number:
                self._decided(lock, last, decision.choice)
        elif last.kind not in IDLE:
            self._react(lock, last)

    def _next(self, lock: Lock, last: Request | None) -> None:
        """Request the next package, if it has come."""
        number = len(lock.get(self.results, {}))
        place = place_entity(number)
        if place not in lock[self.plans]:
            return
        for package, seen in lock[self.sightings].items():
            if seen.first_stop == number:
                first = Request(
                    0 if last is None else last.number, "", place.name, package.name, ""
                )
                wanted = lock[self.plans][place].product
                if seen.product == wanted:
                    self._ask_robot(lock, first, "pack", f"{wanted} has come", ())
                else:
                    found = seen.product or "something unknown"
                    self._question(lock, first, f"{found} has come in place of {wanted}", "", ())

    def _react(self, lock: Lock, last: Request) -> None:
        outcome, look = lock.get(self.outcome), lock.get(self.look)
        if outcome is None or outcome.request != last.number:
            return
        tried = (*last.tried, last.kind)
        case = Case(outcome.stage, outcome.result, outcome.success, tried=Counter(tried[1:]))
        reaction = react(case)
        if reaction.kind == "stop":
            self._stop(lock, last, reaction.reason)
            return
        if look is None or look.request != last.number:
            return
        flag = lock.get(self.flags, {}).get(last.place)
        if look.captured_ns and (flag is None or flag.captured_ns != look.captured_ns):
            return
        if last.kind in {"reject", "look"} and outcome.success:
            self._close(lock, last, "rejected" if last.kind == "reject" else "removed", last.reason)
            return
        judged = flag if look.captured_ns else None
        case = self._case(lock, last, outcome, look.seen, judged)
        reaction = react(case)
        if outcome.result.startswith("no_net:"):
            reaction = Reaction("ask", outcome.result.replace("no_net:", NO_NET))
        if last.kind == "reject" and reaction.kind != "ask":
            reaction = Reaction("ask", f"it could not be rejected: {outcome.result}")
        self._tell(lock, last.place, judged, f"{reaction.kind}: {reaction.reason}")
        if reaction.kind == "go_on":
            self._close(lock, last, "placed", reaction.reason)
        elif reaction.kind == "ask":
            verdict = case.verdict
            self._question(lock, last, reaction.reason, verdict, tried, seen=case.seen)
        else:
            self._ask_robot(lock, last, reaction.kind, reaction.reason, tried, seen=case.seen)

    def _case(
        self, lock: Lock, last: Request, outcome: Outcome, seen: str, flag: Deviation | None
    ) -> Case:
        """Return what is known of the place."""
        along = across = turn = 0.0
        if flag is not None and flag.verdict != "missing":
            plan = lock[self.plans][Entity(last.place)]
            along, across = along_and_across(plan, flag.tray_from_product)
            turn = flag.turn_deg
        sighting = lock[self.sightings][Entity(last.package)]
        if not outcome.success and self._is_held(lock, sighting, outcome.stage):
            seen = "hand"
        return Case(
            outcome.stage,
            outcome.result,
            outcome.success,
            verdict="" if flag is None else flag.verdict,
            along_mm=along,
            across_mm=across,
            turn_deg=turn,
            seen=seen,
            tried=Counter((*last.tried, last.kind)[1:]),
        )

    def _is_held(self, lock: Lock, sighting: Sighting, stage: str) -> bool:
        """Return whether the fingers stand as far apart as the package is wide."""
        grasp = lock[self.grasps].get(product_entity(sighting.product))
        doing = lock.get(self.execution)
        return doing is not None and is_held(stage, doing.width_m, grasp)

    def _decided(self, lock: Lock, last: Request, choice: str) -> None:
        """Do what the operator has decided."""
        reason = f"the operator: {choice}"
        if choice == "go_on":
            stands = lock[self.sightings][Entity(last.package)].frame == "tray"
            self._close(lock, last, "accepted" if stands else "skipped", reason)
        elif choice == "removed":
            self._ask_robot(lock, last, "look", reason, last.tried, seen=last.seen)
        elif choice == "stop":
            self._stop(lock, last, reason)
        else:
            self._ask_robot(lock, last, choice, reason, last.tried, seen=last.seen)

    def _ask_robot(
        self,
        lock: Lock,
        last: Request,
        kind: str,
        reason: str,
        tried: tuple[str, ...],
        *,
        seen: str = "belt",
    ) -> None:
        lock[self.request] = Request(
            last.number + 1, kind, last.place, last.package, reason, seen, tried
        )

    def _question(
        self,
        lock: Lock,
        last: Request,
        reason: str,
        verdict: str,
        tried: tuple[str, ...],
        *,
        seen: str = "belt",
    ) -> None:
        """Ask the operator; nothing moves until the answer comes."""
        self._ask_robot(lock, last, "ask", reason, tried, seen=seen)
        text = f"{last.place}: {reason}"
        added = ("removed", "stop") if verdict in UNTAKEN else ("reject", "removed", "stop")
        refused = {word for word, most in AGAIN.items() if tried.count(word) >= most}
        if reason.startswith(NO_NET):
            refused |= AGAIN.keys()
        refused.add("replaced")  # it is to be seen what the robot can do
        if seen == "belt":
            refused.add("go_on")  # it would come again
        words = dict.fromkeys((*choices_of(verdict), *added))
        choices = tuple(word for word in words if word not in refused)
        lock[self.question] = Question(last.number + 1, text, choices)

    def _stop(self, lock: Lock, last: Request, reason: str) -> None:
        """Stop, and ask how to go on: nothing moves by itself after the robot has stopped."""
        outcome, sighting = lock.get(self.outcome), lock[self.sightings][Entity(last.package)]
        stage = "" if outcome is None else outcome.stage
        seen = "hand" if self._is_held(lock, sighting, stage) else sighting.frame
        self._question(lock, last, reason, "", (*last.tried, last.kind), seen=seen)
        self._tell(lock, last.place, None, f"stop: {reason}")

    def _close(self, lock: Lock, last: Request, result: str, reason: str) -> None:
        """Note what became of the package; the next one can be packed."""
        flag = lock.get(self.flags, {}).get(last.place)
        sighting = lock[self.sightings].get(Entity(last.package))
        tried = tuple(kind for kind in (*last.tried, last.kind) if kind and kind != "ask")
        closed = Result(
            package=last.package,
            product="" if sighting is None else sighting.product,
            verdict="" if flag is None else flag.verdict,
            result=result,
            reactions=tried[1:],
            reason=reason,
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
