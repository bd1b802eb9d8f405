"""The truth of the simulated cell as a world context: bodies of the people, joints of the arm.

Only simulated cameras and the evaluation read it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from actors.workcell.scenarios import scenario_of
from actors.workcell.simulation.stage import Stage
from actors.workcell.vocabulary import (
    BODY,
    HUMANS,
    JOINTS,
    PERIOD_S,
    PLAYING,
    ROBOT,
    SCENARIO,
    Body,
    human_entity,
)
from enact_dist import Actor, Lock, View, World, Write, WriteEach

if TYPE_CHECKING:
    from actors.workcell.simulation.human import Person
    from actors.workcell.vocabulary import Playing


class TruthHuman(Actor):
    """Writes where everybody's body is at each tick, and takes away those who have left."""

    truth = World("truth")
    playing = View(truth, SCENARIO, PLAYING)
    bodies = WriteEach(truth, HUMANS, BODY)
    every_s = PERIOD_S

    def __init__(self) -> None:
        self._played: Playing | None = None
        self._stage: Stage | None = None

    def update(self, lock: Lock) -> None:
        """Write the bodies of the tick."""
        playing = lock.get(self.playing)
        if playing is None:
            return
        if playing != self._played:
            scenario = scenario_of(playing.scenario, playing.seed, playing.seconds)
            self._played, self._stage = playing, Stage(scenario)
        assert self._stage is not None
        at_s = (lock.tick_ns - playing.start_ns) / 1e9
        there = self._stage.people if 0.0 <= at_s < playing.seconds else ()
        found = {number: body_of(person, at_s) for number, person in enumerate(there)}
        bodies = lock[self.bodies]
        present = {human_entity(number): body for number, body in found.items() if body is not None}
        for entity in list(bodies):
            if entity not in present:
                del bodies[entity]
        for entity, body in present.items():
            bodies[entity] = body


class TruthRobot(Actor):
    """Writes the joints of the arm, which the simulated robot measures without error."""

    online, truth = World("online"), World("truth")
    measured = View(online, ROBOT, JOINTS)
    joints = Write(truth, ROBOT, JOINTS)
    triggers = (measured,)

    def update(self, lock: Lock) -> None:
        """Copy them."""
        lock[self.joints] = lock[self.measured]


def body_of(person: Person, at_s: float) -> Body | None:
    """Return the true body of a person at a time of the scenario; None while absent."""
    capsules, centre = person.capsules_at(at_s), person.centre_at(at_s)
    velocity = person.velocity_at(at_s)
    if capsules is None or centre is None or velocity is None:
        return None
    return Body(capsules.astype(np.float32), centre, velocity)
