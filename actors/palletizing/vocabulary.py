"""Entities and aspects of the palletizing cell (ENACT 4.2, Figure 7), with their units and frames.

======================  ============================================================  =========
entity                  stands for                                                    contexts
======================  ============================================================  =========
`product/<name>`        a kind of food package: what to scan, its complete surface    training
`view/<product>/<i>`    one viewpoint of the eye-in-hand robot around a product       training
`place/<n>`             n-th place of the plan: expected content; what was seen       both
`tray`, `belt`          their empty images                                            training
`cell`                  where tray, belt and reject bin stand                         training
`conveyor`              the conveyor: its present stop, what has arrived              online
`package/<id>`          one real thing on belt or tray                                online
`system`                the cell: flags, requests, the net, its outcome, decisions    online
`robot`, `gripper`      what the arm and its gripper do                               online
`user`                  the operator: notices, questions                              online
======================  ============================================================  =========

Frames: *product* has its origin on the base, z up; *tray* has its origin in the middle of the
tray, z up; *belt* on the belt in its light barrier, x where it moves to; *base* is the arm's.
Stop n of the conveyor brings the package for place n; places go on counting over trays, so that a
place has one package for ever.

What the robot does goes round: feedback writes `request`, the action generator grounds a net for
each of its stages (`candidate`), action attaches it to the system (`net`), the robot executes it
(`execution`), and when the last stage ends the action generator writes the `outcome`, upon which
perception looks, deviation detection judges, and feedback requests what comes next.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

import math
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from actors.comparators import CloudDistance, SurfaceDistance
from actors.geometry.recognition.deviation import Limits
from actors.geometry.shapes import Acquisition, DepthFrame, PointCloud, Surface
from actors.palletizing.handling.data import Arrival as Arrival  # noqa: PLC0414
from actors.palletizing.handling.data import Attached as Attached  # noqa: PLC0414
from actors.palletizing.handling.data import BeltLooks as BeltLooks  # noqa: PLC0414
from actors.palletizing.handling.data import Candidate as Candidate  # noqa: PLC0414
from actors.palletizing.handling.data import Control as Control  # noqa: PLC0414
from actors.palletizing.handling.data import Decision as Decision  # noqa: PLC0414
from actors.palletizing.handling.data import GripCommand as GripCommand  # noqa: PLC0414
from actors.palletizing.handling.data import GripState as GripState  # noqa: PLC0414
from actors.palletizing.handling.data import Look as Look  # noqa: PLC0414
from actors.palletizing.handling.data import Outcome as Outcome  # noqa: PLC0414
from actors.palletizing.handling.data import Planned as Planned  # noqa: PLC0414
from actors.palletizing.handling.data import Question as Question  # noqa: PLC0414
from actors.palletizing.handling.data import Request as Request  # noqa: PLC0414
from actors.palletizing.handling.data import Result as Result  # noqa: PLC0414
from actors.palletizing.handling.data import Sight as Sight  # noqa: PLC0414
from actors.palletizing.handling.nets import Execution
from actors.palletizing.placing.finger_room import Grasp
from enact_dist import Aspect, Durability, Entities, Entity, Retention, Tolerance
from enact_dist import Outcome as NetOutcome

PRODUCTS: Final = Entities("product/*")
VIEWS: Final = Entities("view/*/*")
PLACES: Final = Entities("place/*")
PACKAGES: Final = Entities("package/*")
TRAY: Final = Entity("tray")
CONVEYOR: Final = Entity("conveyor")
BELT: Final = Entity("belt")
CELL: Final = Entity("cell")
ROBOT: Final = Entity("robot")
GRIPPER: Final = Entity("gripper")
SYSTEM: Final = Entity("system")
USER: Final = Entity("user")


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """From where a view was taken.

    Attributes:
        acquisition: Camera and pose; the world is the product frame.
        captured_ns: When, nanoseconds since 1970.
    """

    acquisition: Acquisition
    captured_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What shall stand at a place.

    Attributes:
        product: Name of the product.
        tray: Number of the tray; a place of another tray is out of sight.
        tray_from_product: Where on it, (4, 4) float64, metres.
        push: (3,) float64, level unit vector, tray frame: where it is pushed to once it stands;
            zeros: it is not pushed.
    """

    product: str
    tray: int
    tray_from_product: npt.NDArray[np.float64]
    push: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What the overhead sensor saw when a package had been put to its place.

    Attributes:
        frame: The image; its world is the tray frame.
        before_mm: (H, W), the image of the stop before, millimetres; of the empty tray for the
            first package of a tray.  Where a robot packs, float32: the tray without this package.
        packages: Names of the package entities that are new in it.
        captured_ns: When, nanoseconds since 1970.
    """

    frame: DepthFrame
    before_mm: npt.NDArray[Any]
    packages: tuple[str, ...]
    captured_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Where a package was seen.

    Attributes:
        tray: Number of the tray that it is on or for.
        frame_from_package: (4, 4) float64, metres; on the tray what its outline suggests, x along
            its length; on the belt the pose of the product that it was recognised as.
        first_stop: Stop or arrival at which it was seen first.
        last_stop: Stop or arrival at which it was seen last.
        frame: "tray" or "belt"; "" when it has left the cell.
        product: What it was recognised as; empty: nothing was looked for.
        unfit: Why no hand takes it from the belt, in words: it lies, or leans; empty if one does.
    """

    tray: int
    frame_from_package: npt.NDArray[np.float64]
    first_stop: int
    last_stop: int
    frame: str = "tray"
    product: str = ""
    unfit: str = ""


@dataclass(frozen=True, slots=True)
class Standing:
    """What stands at a place: in training as planned, in online as judged.

    The one aspect of a place that both world contexts have, so that their difference is what is
    wrong on the tray.

    Attributes:
        product: Name of the product.
        state: "ok" as planned; online the verdict.
        shift_mm: Distance from the planned position.
        turn_deg: Turn against the planned pose.
    """

    product: str
    state: str
    shift_mm: float
    turn_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """The flag of one judged place.

    Attributes:
        package: Entity that was judged; empty if nothing came.
        product: What it should be.
        verdict: "ok", "missing", "extra", "tipped", "moved" or "deformed".
        deviation_mm: By how much, see `actors.geometry.recognition.deviation.Finding`.
        area_mm2: Area of the deviating region.
        shift_mm: Distance from the planned position.
        turn_deg: Turn against the planned pose.
        captured_ns: When the judged image was taken, nanoseconds since 1970.
        tray_from_product: (4, 4) float64, metres, where it stands; as planned if it is missing.
    """

    package: str
    product: str
    verdict: str
    deviation_mm: float
    area_mm2: float
    shift_mm: float
    turn_deg: float
    captured_ns: int
    tray_from_product: npt.NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, slots=True)
class Notice:
    """A notice to the user about a place.

    Attributes:
        text: The line.
        captured_ns: When the image was taken that it is about, nanoseconds since 1970.
        latency_ms: From the capture of the image to the telling.
    """

    text: str
    captured_ns: int
    latency_ms: float


SCAN: Final = Aspect("scan", int)
"""How many views of a product are wanted (product/*)."""
CLOUD: Final = Aspect("cloud", PointCloud, compare=CloudDistance(tolerance_m=0.004))
"""Points: of a view in its camera's frame (view/*), of a package in the tray frame (package/*)."""
VIEWPOINT: Final = Aspect("viewpoint", Viewpoint)
"""Acquisition pose (view/*)."""
SURFACE: Final = Aspect("surface", Surface, compare=SurfaceDistance(tolerance_m=0.002))
"""Boundary representation: of a view in its camera's frame, of a product in the product frame."""
NEWEST_VIEW: Final = Aspect("newest_view_ns", int)
"""When the newest view in a product's surface was taken (product/*), ns since 1970."""
PLAN: Final = Aspect("plan", Plan)
"""What shall stand at a place (place/*, training)."""
EMPTY: Final = Aspect("empty", DepthFrame)
"""Image of the empty tray (tray, training)."""
STOP: Final = Aspect("stop", int)
"""Number of the conveyor's stop (conveyor)."""
OBSERVATION: Final = Aspect("observation", Observation, Durability.OS)
"""What was seen at a place (place/*, online)."""
SIGHTING: Final = Aspect("sighting", Sighting, Durability.OS)
"""Where a package was seen (package/*)."""
REGION: Final = Aspect("region", np.ndarray, Durability.OS)
"""(H, W) bool, the deviating pixels of the observation (place/*, online)."""
STANDING: Final = Aspect(
    "standing",
    Standing,
    compare=Tolerance(
        fields={
            "shift_mm": Tolerance(absolute=1000.0 * Limits().moved_m, unit="mm"),
            "turn_deg": Tolerance(absolute=math.degrees(Limits().turned_rad), unit="deg"),
        }
    ),
)
"""Expected content (place/*, both): ``training.diff(online, PLACES, STANDING)`` names the
deviations.
"""
DEVIATIONS: Final = Aspect("deviation", dict[str, Deviation])
"""The flags, by name of the place (system)."""
NOTICES: Final = Aspect("notices", dict[str, Notice])
"""Notices, by name of the place (user)."""
GRASP: Final = Aspect("grasp", Grasp)
"""Where and how a product is held (product/*, training)."""
FRAMES: Final = Aspect("frames", dict[str, npt.NDArray[np.float64]])
"""base_from_tray, base_from_belt and base_from_bin, (4, 4) float64, metres, under "tray", "belt"
and "bin" (cell, training)."""
PLANNED: Final = Aspect("planned", Planned)
"""What the plan of the places takes into account (cell, training)."""
ARRIVAL: Final = Aspect("arrival", Arrival)
"""What has come last (conveyor)."""
SIGHT: Final = Aspect("sight", Sight)
"""Whether what came last was seen (conveyor)."""
LOOKS: Final = Aspect("looks", BeltLooks)
"""The looks at the belt for what came last (conveyor)."""
REQUEST: Final = Aspect("request", Request)
"""What the robot shall do (system)."""
CANDIDATE: Final = Aspect("candidate", Candidate)
"""The next stage of the request, grounded (system)."""
NET: Final = Aspect("net", Attached)
"""What the robot executes (system)."""
OUTCOME: Final = Aspect("outcome", Outcome)
"""How the last request ended (system)."""
LOOK: Final = Aspect("look", Look)
"""What was seen when the last request had ended (system)."""
RESULTS: Final = Aspect("results", dict[str, Result])
"""What became of each package, by name of its place (system)."""
LAST: Final = Aspect("last", DepthFrame, Durability.OS)
"""The newest image of the tray with the arm aside (tray, online)."""
QUESTION: Final = Aspect("question", Question)
"""What the operator is asked (user)."""
DECISION: Final = Aspect("decision", Decision)
"""What the operator answered last (system)."""
EXECUTION: Final = Aspect("execution", Execution, Durability.OS)
"""How far the robot is with its net (robot)."""
NET_OUTCOME: Final = Aspect("net_outcome", NetOutcome)
"""Which version of `net` was taken, so that it is executed once at most (robot)."""
CONTROL: Final = Aspect("control", Control, Durability.VOLATILE, retention=Retention(versions=10))
"""How regularly the robot is controlled (robot)."""
COMMAND: Final = Aspect("command", GripCommand, Durability.VOLATILE)
"""What the gripper shall do (gripper)."""
STATE: Final = Aspect("state", GripState, Durability.VOLATILE)
"""What the gripper does (gripper)."""


def view_entity(product: str, number: int) -> Entity:
    """Return the entity of one viewpoint around a product."""
    return Entity(f"view/{product}/{number}")


def product_of_view(view: Entity) -> str:
    """Return the name of the product that a view shows."""
    return view.name.split("/")[1]


def product_entity(product: str) -> Entity:
    """Return the entity of a product."""
    return Entity(f"product/{product}")


def place_entity(stop: int) -> Entity:
    """Return the entity of the place that the package of a stop is for."""
    return Entity(f"place/{stop}")
