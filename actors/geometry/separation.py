"""Speed and separation monitoring: how fast a robot may be at a distance from a person.

The relation is that of ISO/TS 15066:2016, 5.5.4 (protective separation distance), for a robot that
stops with constant deceleration, in closed form both ways:

    S(v) = v_h (T_r + v/a) + v T_r + v²/(2a) + C + Z

======  ===============================================================  =================
symbol  is                                                               here
======  ===============================================================  =================
v_h     speed of a person towards the robot; 1.6 m/s where it is not     `human_m_s`
        monitored
T_r     time from an exposure until the robot begins to brake on what    `reaction_s`
        the image shows
a       deceleration of the quickest point of the arm                    `braking_m_s2`
C       how far a person reaches in before being seen                    `intrusion_m`
Z       uncertainty of the person's and the robot's position, together   `uncertainty_m`
======  ===============================================================  =================

T_r is not assumed but measured, see `Reaction`; a robot that brakes once its command is older than
`Reaction.valid_s` makes it true for every command, late ones too.

This shows the method of the specification.  It is no safety function in the sense of ISO 13849.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

LATEST_S: Final = 0.25
"""Oldest exposure on which a robot may move, whatever was measured."""
ENOUGH: Final = 20
"""Images whose age must be known before T_r is less than its greatest value."""


@dataclass(frozen=True, slots=True)
class Separation:
    """The quantities of ISO/TS 15066 5.5.4, see the module.

    Attributes:
        reaction_s: T_r, seconds.
        human_m_s: v_h, metres per second.
        braking_m_s2: a, metres per second squared, > 0.
        intrusion_m: C, metres.
        uncertainty_m: Z, metres: Z_d and Z_r together.

    Raises:
        ValueError: A quantity is negative or not finite, or `braking_m_s2` is not positive.
    """

    reaction_s: float = LATEST_S
    human_m_s: float = 1.6
    braking_m_s2: float = 6.0
    intrusion_m: float = 0.10
    uncertainty_m: float = 0.05

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} is {value!r}; it must be a finite number, not negative")
        if self.braking_m_s2 == 0.0:
            raise ValueError("braking_m_s2 is 0: a robot that cannot brake keeps no distance")

    def protective_m(self, speed_m_s: float) -> float:
        """Return S(v), the least distance at which the robot may have a speed, metres.

        Args:
            speed_m_s: Of the quickest point of the arm, >= 0.

        Raises:
            ValueError: The speed is negative.
        """
        if not speed_m_s >= 0.0:
            raise ValueError(f"a speed of {speed_m_s!r} m/s; it must be a number, not negative")
        stopping_s = speed_m_s / self.braking_m_s2
        human_m = self.human_m_s * (self.reaction_s + stopping_s)
        robot_m = speed_m_s * (self.reaction_s + stopping_s / 2.0)
        return human_m + robot_m + self.intrusion_m + self.uncertainty_m

    def speed_max_m_s(self, distance_m: float) -> float:
        """Return v_max(d), the greatest speed with S(v) <= d; 0 where not even S(0) is.

        Args:
            distance_m: From the person to the robot, metres; infinity without a person.

        Raises:
            ValueError: The distance is not a number.
        """
        if math.isnan(distance_m):
            raise ValueError("the distance is not a number")
        free_m = distance_m - self.protective_m(0.0)
        if free_m <= 0.0 or free_m == math.inf:
            return max(0.0, free_m)
        # v²/(2a) + (T_r + v_h/a) v = free; the root as a quotient, exact where `free` is small.
        linear = self.reaction_s + self.human_m_s / self.braking_m_s2
        root = math.sqrt(linear * linear + 2.0 * free_m / self.braking_m_s2)
        return 2.0 * free_m / (linear + root)


class Reaction:
    """T_r of a robot, from the ages that its images had when a speed was made of them.

    A speed is made of an image that is `age` old, holds until the next one is made (one period
    later, of an image as old), and is obeyed by the robot's loop::

        T_r = age of the newest image + one period + the robot's own time

    The age is the greatest one of the last `kept` images, and a margin for the way to the robot.
    Before `ENOUGH` images are known, and where it would be longer, T_r is that of `latest_s`.

    Args:
        period_s: Period of the images.
        robot_s: From the arrival of a command until the arm decelerates in full: the cycle of its
            loop and what its limit of jerk takes.
        margin_s: How much longer the way from here to the robot may take than it ever took.
        kept: How many images count.

    Attributes:
        latest_s: Greatest time from an exposure until the robot's loop refuses to go on.
    """

    def __init__(
        self,
        *,
        period_s: float,
        robot_s: float,
        margin_s: float = 0.03,
        kept: int = 600,
    ) -> None:
        self._period_s, self._margin_s, self._robot_s = period_s, margin_s, robot_s
        self._ages_s: deque[float] = deque(maxlen=kept)
        self._newest_ns: int | None = None
        self.latest_s = LATEST_S

    def seen(self, captured_ns: int, age_s: float) -> None:
        """Take note of the age that an image had when a speed was made of it, at last.

        Args:
            captured_ns: Its exposure, which tells it from others.
            age_s: Its age, seconds.
        """
        if captured_ns == self._newest_ns:
            self._ages_s.pop()
        self._newest_ns = captured_ns
        self._ages_s.append(age_s)

    @property
    def valid_s(self) -> float:
        """How long after its exposure the robot may move on a command, seconds."""
        if len(self._ages_s) < ENOUGH:
            return self.latest_s
        needed_s = max(self._ages_s) + self._period_s + self._margin_s
        return min(self.latest_s, max(0.0, needed_s))

    @property
    def reaction_s(self) -> float:
        """T_r, seconds."""
        return self.valid_s + self._robot_s
