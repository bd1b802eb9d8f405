"""Feedback: tells the user what was found, and where a robot packs, requests what follows."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from actors.palletizing.handling.requests import Said, Situation, follow_up
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
)
from enact_dist import Actor, View, ViewEach, World, Write

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from enact_dist import Lock


class Feedback(Actor):
    """Notify the user of every judged place, deviating or not, once (ENACT 4.2)."""

    online = World("online")
    flags = View(online, SYSTEM, DEVIATIONS)
    notices = Write(online, USER, NOTICES)
    triggers = (flags,)

    def update(self, lock: Lock) -> None:
        """Notify the user of verdicts that have not been reported yet."""
        before: dict[str, Notice] = lock.get(self.notices, {})
        new = [
            Said(place, flag, "")
            for place, flag in lock[self.flags].items()
            if place not in before or flag.captured_ns != before[place].captured_ns
        ]
        lock[self.notices] = tell(before, new)


class HandlingFeedback(Actor):
    """Request what the robot does next, by how the last request ended and by what was seen.

    `requests` decides.
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
        """Publish what follows, if everything that the decision needs is there."""
        found = follow_up(
            Situation(
                request=lock.get(self.request),
                results=lock.get(self.results, {}),
                plans=lock[self.plans],
                planned=lock.get(self.planned),
                grasps=lock[self.grasps],
                sightings=lock[self.sightings],
                sight=lock.get(self.sight),
                outcome=lock.get(self.outcome),
                look=lock.get(self.look),
                flags=lock.get(self.flags, {}),
                grip=lock.get(self.grip),
                gripper=lock.get(self.gripper),
                decision=lock.get(self.decision),
            )
        )
        if found.request is not None:
            lock[self.request] = found.request
        if found.question is not None:
            lock[self.question] = found.question
        if found.results is not None:
            lock[self.results] = found.results
        if found.said:
            lock[self.notices] = tell(lock.get(self.notices, {}), found.said)


def tell(before: Mapping[str, Notice], said: Sequence[Said]) -> dict[str, Notice]:
    """Print what is new; return all notices, by name of the place."""
    notices = [notice_of(each, time.time_ns()) for each in said]
    for notice in notices:
        print(notice.text, flush=True)
    return {**before, **{each.place: one for each, one in zip(said, notices, strict=True)}}


def notice_of(said: Said, now_ns: int) -> Notice:
    """Return the notice of a line, at a time in ns since 1970; of a verdict with its latency."""
    if said.flag is None:
        return Notice(f"{said.place}: {said.text}", now_ns, 0.0)
    text = "; ".join(filter(None, (sentence(said.place, said.flag), said.text)))
    return Notice(text, said.flag.captured_ns, (now_ns - said.flag.captured_ns) / 1e6)


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
