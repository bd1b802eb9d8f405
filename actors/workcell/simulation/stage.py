"""What is where at each moment of a scenario: people, things, light; the truth of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from actors.workcell.simulation.drawing.render import person_colours, robot_colours
from actors.workcell.simulation.human import Person
from actors.workcell.simulation.room import THING_COLOUR, Box, boxes_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from actors.workcell.scenarios import Scenario

    F64 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a camera can see at one moment.

    Attributes:
        capsules: (n, 7), cell: the arm first, then the people in order.
        colours: (n, 3), blue, green, red, 0 to 1.
        boxes: Static boxes in the room.
    """

    capsules: F64
    colours: F64
    boxes: tuple[Box, ...]


class Stage:
    """A scenario as it plays."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.people = tuple(Person(walk) for walk in scenario.walks)
        self._things = tuple(
            Box(f"thing-{number}", thing.centre_m, thing.half_m, THING_COLOUR)
            for number, thing in enumerate(scenario.things)
        )

    @property
    def boxes(self) -> tuple[Box, ...]:
        """The obstacles in the room that the cell knows from the start."""
        return boxes_of(self.scenario)

    @property
    def rooms(self) -> tuple[tuple[Box, ...], ...]:
        """The successive obstacles in the room, including objects left there."""
        times = sorted(thing.from_s for thing in self.scenario.things)
        return (self.boxes, *(self.boxes + self.things_at(at_s) for at_s in times))

    def things_at(self, at_s: float) -> tuple[Box, ...]:
        """Return what was left in the cell until a time of the scenario."""
        pairs = zip(self._things, self.scenario.things, strict=True)
        return tuple(box for box, thing in pairs if at_s >= thing.from_s)

    def bodies_at(self, at_s: float) -> dict[int, F64]:
        """Return the bodies that are there at a time, (17, 7) each, by number of the person."""
        found = {number: one.capsules_at(at_s) for number, one in enumerate(self.people)}
        return {number: capsules for number, capsules in found.items() if capsules is not None}

    def brightness_at(self, at_s: float) -> float:
        """Return how bright images are at a time; 1 at the start."""
        light = self.scenario.light
        return light[1] if light is not None and at_s >= light[0] else 1.0

    def scene_at(self, at_s: float, robot: F64 | None = None) -> Scene:
        """Return what a camera can see.

        Args:
            at_s: Time of the scenario; before 0 no person is present.
            robot: (n, 7) capsules of the arm, cell; None: it is not shown.
        """
        bodies = self.bodies_at(at_s)
        arm = np.empty((0, 7)) if robot is None else robot
        colours = [robot_colours(len(arm))] if len(arm) else []
        colours += [person_colours(number) for number in bodies]
        return Scene(
            capsules=np.concatenate([arm, *bodies.values()]),
            colours=np.concatenate(colours) if colours else np.empty((0, 3)),
            boxes=self.boxes + self.things_at(at_s),
        )
