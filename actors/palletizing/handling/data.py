"""The data by which a package is handled: requests, nets, outcomes, looks, questions, gripper.

`vocabulary` says which entity has which; everybody imports them from there.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from actors.palletizing.handling.nets import Net

UNSEEN_LOOKS: Final = 3
"""After so many looks that show nothing of what has come, the sight says so as an error."""
UNRECOGNISED: Final = "something is in the light barrier, but no package is recognised there"
"""What follows from looks at the belt, again and again, that show nothing."""
TAKEN_OUT: Final = "it was taken out of the light barrier: nothing is seen on the belt"
"""Why what has come is not asked about any more."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A package stands in the light barrier of the belt (conveyor).

    Attributes:
        number: How many came before it.
        stamp_ns: When, nanoseconds since 1970.
        is_gone: It was taken out of the light barrier before it was recognised.
    """

    number: int
    stamp_ns: int
    is_gone: bool = False


@dataclass(frozen=True, slots=True)
class Request:
    """What the robot shall do next (system).

    Attributes:
        number: Grows by one with each request.
        kind: "pack" (grasp from the belt, place, push), "retry" (the same after a new look at the
            belt), "push_again", "regrasp" (grasp on the tray, place, push), "reject" (from belt,
            tray or hand into the bin), "look" (only look again), "removed" (look whether it is
            gone), "stop" (nothing moves until the operator says so), "ask" (wait for the operator).
        place: Name of the entity; empty if it is about none.
        package: Name of the entity; empty if what has come was not seen yet.
        reason: Why, in words.
        seen: Where the package was seen last: "belt", "tray" or "hand"; "" if nowhere.
        tried: Kinds of the requests for this place before this one.
        felt_m: So far along its grasp's axis the package is beside where it was seen on the belt,
            by the sides on which fingers came down on it.
        short_m: So far short of its place it stands.
    """

    number: int
    kind: str
    place: str
    package: str
    reason: str
    seen: str = "belt"
    tried: tuple[str, ...] = ()
    felt_m: float = 0.0
    short_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A stage of a request, grounded (system).

    Attributes:
        request: Number of the request.
        stage: "grasp", "regrasp", "place", "push", "remove" or "aside".
        net: What the robot shall execute; None if it cannot be grounded.
        error: Why it cannot, in one line; empty if it can.
        frames: base_from_entity, (4, 4) float64, metres, of the entities that the net names.
        turned: Whether the package is held with the hand turned round, see `grounding.Job`.
    """

    request: int
    stage: str
    net: Net | None
    error: str
    frames: dict[str, npt.NDArray[np.float64]]
    turned: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Attached:
    """The net that the robot executes (system); its `Execution` names the number.

    Attributes:
        number: From 1; grows by one with each net.
        request: Number of the request that it is for.
        stage: As of `Candidate`.
        net: What to execute.
        frames: As of `Candidate`.
        turned: As of `Candidate`.
    """

    number: int
    request: int
    stage: str
    net: Net
    frames: dict[str, npt.NDArray[np.float64]]
    turned: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a request ended (system).

    Attributes:
        request: Number of the request.
        stage: The last stage that was executed, or could not be grounded.
        result: End of its net, "timeout:…", "interrupted:…", or "no_net:" with the reason.
        success: Whether all stages succeeded.
        stamp_ns: When, nanoseconds since 1970.
    """

    request: int
    stage: str
    result: str
    success: bool
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Look:
    """What perception saw when a request had ended (system).

    Attributes:
        request: Number of the request.
        seen: Where its package is: "belt", "tray", "hand", or "" if it was seen nowhere.
        captured_ns: Capture of the picture of the tray; 0: the tray was not looked at.
        judged: Names of the places that this picture shows anew: that of the package, and those
            of its neighbours that have moved.
        error: Why nothing was seen, in one line; empty if something could be seen.
    """

    request: int
    seen: str
    captured_ns: int
    judged: tuple[str, ...] = ()
    error: str = ""


@dataclass(frozen=True, slots=True)
class Sight:
    """Whether perception has seen what came last (conveyor).

    Attributes:
        number: Of the arrival.
        error: Why the sensor did not see it, in one line; empty if it looked.
    """

    number: int
    error: str


@dataclass(frozen=True, slots=True)
class BeltLooks:
    """The looks at the belt for what has come, and what they have shown (conveyor).

    Attributes:
        arrived_ns: Stamp of the arrival of the last one, nanoseconds since 1970.
        aside: Number of the net that had taken the arm aside before it; 0: none had.
        number: Of the package that it was for.
        unseen: How many for that package have shown nothing.
        is_seen: Whether the package is known now.
    """

    arrived_ns: int = 0
    aside: int = 0
    number: int = -1
    unseen: int = 0
    is_seen: bool = True

    def is_due(self, arrival: Arrival, aside: int) -> bool:
        """Return whether to look for what has come.

        At once, and as long as it was not seen, each time the arm has gone aside: an arm that
        stopped above the belt hides it.
        """
        again = not self.is_seen and aside not in {0, self.aside}
        return arrival.stamp_ns != self.arrived_ns or again

    def after(self, arrival: Arrival, aside: int, *, seen: bool, failed: bool) -> Self:
        """Return the looks after another one, which the sensor may have failed to take."""
        before = self.unseen if arrival.number == self.number else 0
        unseen = before + (not seen and not failed)
        return type(self)(arrival.stamp_ns, aside, arrival.number, unseen, seen)

    def error(self, *, is_gone: bool) -> str:
        """Return why the package is not known, in one line; empty if it is, or may be soon.

        Args:
            is_gone: It was taken out of the light barrier.
        """
        if self.is_seen:
            return ""
        if is_gone:
            return TAKEN_OUT
        return UNRECOGNISED if self.unseen >= UNSEEN_LOOKS else ""


@dataclass(frozen=True, slots=True)
class Result:
    """What became of the package for a place.

    Attributes:
        package: Name of its entity.
        product: What it was recognised as.
        verdict: The last verdict about the place; empty if it was not judged.
        result: "placed", "rejected", "removed" (by the operator), "skipped" or "accepted" (with
            its deviation, by the operator).
        reactions: Kinds of all requests for it.
        reason: Why the last of them.
        captured_ns: Capture of the picture of that verdict; a newer verdict reopens the place.
    """

    package: str
    product: str
    verdict: str
    result: str
    reactions: tuple[str, ...]
    reason: str
    captured_ns: int = 0


@dataclass(frozen=True, slots=True)
class GripCommand:
    """A command to the gripper.

    Attributes:
        number: Grows by one with each command.
        kind: "width" or "force".
        value: m or N.
    """

    number: int
    kind: str
    value: float


@dataclass(frozen=True, slots=True)
class GripState:
    """The state of the gripper.

    Attributes:
        number: Of the command that it follows.
        width_m: Distance between the fingers.
        width_rate_m_s: How fast it grows.
        force_n: With what force the fingers close.
        stamp_ns: When it was measured, nanoseconds since 1970.
    """

    number: int
    width_m: float
    width_rate_m_s: float
    force_n: float
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class Control:
    """How regularly the robot's inner loop has run since its start (robot).

    Attributes:
        cycles: How often.
        median_ms: Of its period.
        p99_ms: Of its period.
        longest_ms: Its longest period.
        late: Periods of more than 8 ms.
        locked_ms: How long at most its process needed for what it does under a lock; the loop
            itself takes none.
    """

    cycles: int
    median_ms: float
    p99_ms: float
    longest_ms: float
    late: int
    locked_ms: float


@dataclass(frozen=True, slots=True)
class Question:
    """A question to the operator (user).

    Attributes:
        request: Number of the request of kind "ask".
        text: What is the matter.
        choices: The answers that can be given.
    """

    request: int
    text: str
    choices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Decision:
    """What the operator has decided (system).

    Attributes:
        request: Number of the request of kind "ask".
        choice: One of the choices of the question.
        by: Who.
    """

    request: int
    choice: str
    by: str


@dataclass(frozen=True, slots=True)
class Planned:
    """What the plan of the places takes into account (cell, training).

    Attributes:
        results: What became of each package, by name of its place, when it was made; a plan
            that does not know all results is out of date.
        left_out: Numbers of the places that later ones have moved up to fill.
    """

    results: dict[str, str]
    left_out: tuple[int, ...]
