"""Scenarios of the simulated cell: who comes, what they do, what breaks; data, no behaviour.

`scenario_of` gives each by name and seed.  The seed moves the points of a way by a few centimetres
and changes speed and height a little; scenario and seed say everything about a run's truth.

=====  =======================================================================================
name   what happens
=====  =======================================================================================
visit  the default: a person enters, reaches over the table, goes around the cabinet, leaves
S1     the cell stays empty
S2     a person enters at 1.2 m/s, walks past and leaves; another one at 1.6 m/s
S3     a person reaches over the table towards the tool and stays
S4     a person hides in a walk-in cabinet, where no camera sees, and comes out towards the robot
S5     a person stands still for a long time
S6     a person leaves a box and goes
S7     while a person walks, a camera dies, another freezes, the image of a third is stuck
S8     while a person walks, reconstruction, speed control and a shard die in turn
S9     a person crosses the robot's way; the operator tries the planner with other predictions
S10    the light drops by 30 % at once
S11    two people walk on different sides
S12    a person stops the robot; the stop is traced back to its images
=====  =======================================================================================
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np

from enact_dist.errors import ConfigError

DEFAULT: Final = "visit"
"""The scenario of a plain run."""
SECONDS: Final = 60.0
"""How long a plain run lasts."""
JITTER_M: Final = 0.04
"""Standard deviation of the points of a way over the seeds."""


@dataclass(frozen=True, slots=True)
class Pause:
    """A stop on a way.

    Attributes:
        waypoint: Number of the point of the way where it takes place, from 0.
        seconds: Duration.
        reach_m: Target of the right hand during the stop, x, y, z in the cell frame; None: no
            target.
        lean_rad: How far the trunk leans forward.
        facing_rad: Viewing direction, from x towards y; None: the walking direction.
    """

    waypoint: int
    seconds: float
    reach_m: tuple[float, float, float] | None = None
    lean_rad: float = 0.0
    facing_rad: float | None = None


@dataclass(frozen=True, slots=True)
class Walk:
    """What one person does.

    Attributes:
        way_m: Points x, y in the cell frame, in order; first and last lie outside the workspace
            unless the person stays.
        begin_s: When the person appears at the first point.
        speed_m_s: Walking speed.
        height_m: Height of the person.
        pauses: Stops, in the order of the way.
        repeats: After the last point the person walks the way again from its start.
    """

    way_m: tuple[tuple[float, float], ...]
    begin_s: float = 1.0
    speed_m_s: float = 1.2
    height_m: float = 1.75
    pauses: tuple[Pause, ...] = ()
    repeats: bool = False


@dataclass(frozen=True, slots=True)
class Thing:
    """A box that is placed in the cell.

    Attributes:
        centre_m: x, y, z in the cell frame.
        half_m: Half of its edges.
        from_s: When it appears.
    """

    centre_m: tuple[float, float, float]
    half_m: tuple[float, float, float]
    from_s: float


@dataclass(frozen=True, slots=True)
class Fault:
    """What the harness does to a process while the scenario runs.

    Attributes:
        at_s: When.
        kind: "kill" (SIGKILL), "freeze" (SIGSTOP), "stuck" (the image repeats).
        target: Name of an actor or shard of `cell.toml`.
        seconds: How long a freeze or a stuck image lasts.
    """

    at_s: float
    kind: str
    target: str
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Scenario:
    """One scenario of one seed.

    Attributes:
        name: Its name in the table above.
        seed: Its seed.
        seconds: Duration.
        walks: One per person, in the order of their numbers.
        things: Boxes that are left in the cell.
        light: (seconds, factor): start and factor of a change in brightness of all images.
        faults: The faults that occur.
        walk_in: Whether a person can walk into the cabinet.
    """

    name: str
    seed: int
    seconds: float
    walks: tuple[Walk, ...] = ()
    things: tuple[Thing, ...] = ()
    light: tuple[float, float] | None = None
    faults: tuple[Fault, ...] = ()
    walk_in: bool = False


_ROUND: Final = (
    (-2.8, -1.85),
    (1.6, -1.85),
    (1.75, -0.3),
    (1.6, 0.9),
    (0.2, 1.75),
    (-1.55, 1.75),
    (-1.7, 0.6),
    (-1.3, -0.4),
    (-2.9, -0.9),
)
"""Around the robot, past conveyor, table and cabinet, and out again."""
_PAST: Final = ((1.75, -2.9), (1.65, 0.0), (1.75, 2.9))
_WEST: Final = ((-1.6, -2.9), (-1.5, 0.0), (-1.6, 2.9))
_ACROSS: Final = ((2.9, 1.2), (1.75, 1.0), (1.7, -1.0), (2.9, -1.4))
_TO_TABLE: Final = ((2.9, -0.9), (1.75, -0.3))
_TO_CORNER: Final = ((-2.9, -1.9), (0.3, -1.9), (1.5, -1.6))
_INTO_CABINET: Final = ((-2.9, 1.5), (-0.9, 1.5))
_TO_ROBOT: Final = ((-2.35, 1.5), (-2.3, 0.25), (-0.95, -0.25), (-2.9, -0.4))
_REACH: Final = Pause(2, 6.0, reach_m=(0.75, -0.25, 1.0), lean_rad=0.25, facing_rad=np.pi)


def _walks(name: str, seconds: float) -> tuple[Walk, ...]:
    """Return who comes in a scenario, before the seed has moved anything."""
    table = dataclasses.replace(_REACH, waypoint=1, seconds=max(seconds - 12.0, 4.0))
    cross = Walk(_ACROSS, repeats=True)
    walks: dict[str, tuple[Walk, ...]] = {
        "visit": (Walk(_ROUND, pauses=(_REACH,), repeats=True),),
        "S1": (),
        "S2": (Walk(_PAST, 1.0, 1.2), Walk(_PAST, seconds / 2.0, 1.6, 1.82)),
        "S3": (Walk((*_TO_TABLE, _TO_TABLE[0]), pauses=(table,)),),
        "S4": (
            Walk(
                (*_INTO_CABINET, *_TO_ROBOT),
                pauses=(Pause(1, min(20.0, seconds / 2.0)),),
            ),
        ),
        "S5": (Walk(((2.9, 1.6), (1.55, 1.5)), pauses=(Pause(1, seconds),)),),
        "S6": (Walk((*_TO_CORNER, *_TO_CORNER[1::-1]), pauses=(Pause(2, 2.0),)),),
        "S7": (cross,),
        "S8": (cross,),
        "S9": (cross,),
        "S10": (Walk(_PAST, 1.0),),
        "S11": (Walk(_PAST, repeats=True), Walk(_WEST, 2.0, 1.0, 1.68, repeats=True)),
        "S12": (Walk((*_TO_TABLE, _TO_TABLE[0]), pauses=(table,)),),
    }
    return walks[name]


SCENARIOS: Final = (DEFAULT, *(f"S{number}" for number in range(1, 13)))
"""The names of all scenarios."""


def scenario_of(name: str, seed: int, seconds: float = SECONDS) -> Scenario:
    """Return a scenario of a seed.

    Args:
        name: One of `SCENARIOS`.
        seed: Any whole number; the same one gives the same scenario.
        seconds: How long it lasts; faults and changes of light come at shares of it.

    Raises:
        ConfigError: There is no scenario of that name, `seconds` is not positive, or `seed` is
            negative.
    """
    if name not in SCENARIOS:
        raise ConfigError(f"no scenario {name!r}; there are {', '.join(SCENARIOS)}")
    if not seconds > 0.0:
        raise ConfigError(f"a scenario lasts {seconds} s; it needs more than 0")
    if seed < 0:
        raise ConfigError(f"the seed is {seed}; it must be a whole number, 0 or above")
    generator = np.random.default_rng([seed, SCENARIOS.index(name)])
    walks = tuple(_moved(walk, generator) for walk in _walks(name, seconds))
    left = (
        (Thing((1.5, -1.05, 0.15), (0.15, 0.15, 0.15), _arrival_s(walks[0], 2) + 1.0),)
        if name == "S6"
        else ()
    )
    share = seconds / 10.0
    return Scenario(
        name=name,
        seed=seed,
        seconds=seconds,
        walks=walks,
        things=left,
        walk_in=name == "S4",
        light=(5.0 * share, 0.7) if name == "S10" else None,
        faults={
            "S7": (
                Fault(2.0 * share, "kill", "camera-3"),
                Fault(4.0 * share, "freeze", "camera-5", 2.0 * share),
                Fault(7.0 * share, "stuck", "camera-1", 2.0 * share),
            ),
            "S8": (
                Fault(2.0 * share, "kill", "reconstruction"),
                Fault(4.5 * share, "kill", "speed"),
                Fault(7.0 * share, "kill", "cell"),
            ),
        }.get(name, ()),
    )


def _moved(walk: Walk, generator: np.random.Generator) -> Walk:
    """Return a walk with the points, speed and height of one seed."""
    shift = generator.normal(0.0, JITTER_M, (len(walk.way_m), 2)).clip(-0.1, 0.1)
    return dataclasses.replace(
        walk,
        way_m=tuple(
            (round(x + dx, 4), round(y + dy, 4))
            for (x, y), (dx, dy) in zip(walk.way_m, shift.tolist(), strict=True)
        ),
        speed_m_s=round(walk.speed_m_s * float(generator.uniform(0.95, 1.0)), 4),
        height_m=round(walk.height_m + float(generator.uniform(-0.06, 0.06)), 4),
    )


def _arrival_s(walk: Walk, waypoint: int) -> float:
    """Return when a person arrives at a point of the way, if no pause comes before."""
    steps = np.linalg.norm(np.diff(np.array(walk.way_m[: waypoint + 1]), axis=0), axis=1)
    return walk.begin_s + float(steps.sum()) / walk.speed_m_s
