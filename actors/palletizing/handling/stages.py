"""What a request asks of the robot: its stages, and a grounded net for each.

PURE: requests, plans and sightings in, nets out; `action_generator` runs it.

==============  ====================================================================================
stage           skeleton
==============  ====================================================================================
grasp           grasp_from_belt
regrasp         regrasp
place           place
push            push_into_contact
remove          remove_to_reject
aside           go_aside
==============  ====================================================================================

Rule a change must keep: a stage names its frames by entity; where these are is fixed when the net
is grounded and stays with the net, so that the robot moves by what was known then, and says so.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.palletizing.handling.grounding import PUSH_GAP_M, Job, easier_turn, ground
from actors.palletizing.handling.nets import NetError
from actors.palletizing.placing.finger_room import Gripper, open_m
from actors.palletizing.placing.grasps import size_of
from actors.palletizing.vocabulary import Candidate, product_entity
from enact_dist import Entity

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm
    from actors.geometry.shapes import Surface
    from actors.palletizing.handling.nets import Execution, Net
    from actors.palletizing.placing.finger_room import Beside, Grasp
    from actors.palletizing.placing.rows import Slot
    from actors.palletizing.vocabulary import (
        Attached,
        Deviation,
        GripCommand,
        GripState,
        Outcome,
        Plan,
        Planned,
        Request,
        Result,
        Sighting,
    )

    F64 = npt.NDArray[np.float64]

ASIDE: Final = "aside"
SKELETON_OF: Final = {
    "grasp": "grasp_from_belt",
    "regrasp": "regrasp",
    "place": "place",
    "push": "push_into_contact",
    "remove": "remove_to_reject",
}
STANDS: Final = ("placed", "accepted")
"""Results after which a place is filled."""
RISKY: Final = ("regrasp", "place", "push", "remove")
"""Stages that can spoil what stands on the tray, or leave something where it shall not be."""
HELD_M: Final = 0.006
"""A package between the fingers measures at most so much more or less than its width."""
FELT_SIDE: Final = {"blocked_left": 1.0, "blocked_right": -1.0}
"""To which side, along the grasp's axis, a package is of where it was seen."""
FELT_SHARE: Final = 0.9
"""Of what the open hand has room the next grasp goes farther: two grasps overlap."""
GONE: Final = {"reject": "rejected", "removed": "removed"}
"""Requests after which the package shall be seen nowhere, and what became of it then."""
NOT_ASIDE: Final = "the arm is not aside: "
"""What a look at the tray needs, and lacks."""
IDLE: Final = ("stop", "ask")
"""Kinds of requests that move nothing."""


def is_current(planned: Planned | None, results: Mapping[str, Result]) -> bool:
    """Return whether the plan of the places knows what became of all packages so far."""
    return planned is not None and planned.results == results_of(results)


def results_of(results: Mapping[str, Result]) -> dict[str, str]:
    """Return what became of each package, by name of its place."""
    return {place: result.result for place, result in results.items()}


def fills(width_m: float, grasp: Grasp) -> bool:
    """Return whether fingers that are so far apart hold a product by its faces."""
    return abs(width_m - grasp.width_m) < HELD_M


def is_held(grip: GripCommand | None, gripper: GripState | None, grasp: Grasp | None) -> bool:
    """Return whether the hand holds a package: it presses, and what is between is as wide.

    Neither the stage nor its result tells that: a net can end while it lifts, and a hand that was
    braked holds on.

    Args:
        grip: The last command to the gripper; None: there was none.
        gripper: What the gripper measures; None if it is not known: a hand that was ordered to
            press is not empty then.
        grasp: Of the product; None if nothing can be known to hold it.
    """
    if grip is None or grasp is None:
        return False
    opens = grip.kind == "width" and gripper is not None and gripper.number >= grip.number
    return not opens and (gripper is None or fills(gripper.width_m, grasp))


def felt(frame_from_product: F64, grasp: Grasp, felt_m: float) -> F64:
    """Return where a package is after a finger has come down on it, (4, 4), metres.

    Args:
        frame_from_product: Where it was seen.
        grasp: Of its product.
        felt_m: So far along the grasp's axis it is beside that, see `felt_on`.
    """
    pose = np.array(frame_from_product)
    pose[:3, 3] += felt_m * (pose[:3, :3] @ grasp.axis)
    return pose


def felt_on(felt_m: float, result: str, grasp: Grasp) -> float:
    """Return how far beside where it was seen a package is, by all fingers that came down on it.

    A finger comes down on a package that is farther off than the hand has room: anything beyond
    that is as likely the nearer it is, so the next grasp goes nearly one opening farther, and half
    of it when the fingers have been on both sides.

    Args:
        felt_m: By those before, metres along the grasp's axis.
        result: How the last grasp ended.
        grasp: Of its product.
    """
    step_m = FELT_SHARE * (open_m(grasp, Gripper(), on_belt=True) - grasp.width_m)
    side = FELT_SIDE.get(result, 0.0)
    return felt_m + side * step_m * (0.5 if side * felt_m < 0.0 else 1.0)


def gap_before(short_m: float) -> float:
    """Return how far short of its place a package is pushed from, metres.

    Args:
        short_m: So far short of it the package stands.
    """
    return max(PUSH_GAP_M, short_m)


def ended(attached: Attached, doing: Execution | None) -> str:
    """Return how the robot ended a net; empty while it has not."""
    return doing.result if doing is not None and doing.net_version == attached.number else ""


def way_aside(attached: Attached | None, doing: Execution | None) -> tuple[int, str]:
    """Return the number of the net that takes the arm aside and how it ended; (0, "") if none.

    An arm that ended otherwise than aside stands anywhere and hides what is below.
    """
    if attached is None or doing is None or attached.stage != ASIDE:
        return 0, ""
    return attached.number, ended(attached, doing)


def is_on_belt_first(request: Request, outcome: Outcome) -> bool:
    """Return whether the package of a request that has ended is looked for on the belt first."""
    missed = not outcome.success and outcome.stage == "grasp"
    return missed or (request.seen == "belt" and request.kind in {"look", "removed"})


def stages_of(request: Request, plan: Plan | None) -> tuple[str, ...]:
    """Return the stages of a request, in their order.

    Args:
        request: What is asked for.
        plan: Of its place; None if it is about none.
    """
    push = ("push",) if plan is not None and plan.push.any() else ()
    taken = {"belt": ("grasp",), "tray": ("regrasp",)}.get(request.seen, ())
    return {
        "pack": ("grasp", "place", *push),
        "retry": ("grasp", "place", *push),
        "regrasp": ("regrasp", "place", *push),
        "push_again": push,
        "reject": (*taken, "remove"),
    }.get(request.kind, ())


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the robot is with a request.

    Attributes:
        left: The stages that are left, in their order.
        stage: The last one that has ended; empty: none was begun.
        result: How it ended.
        success: Whether that is what it was for.
        turned: Whether the hand is turned round for it; None: none was begun.
    """

    left: tuple[str, ...]
    stage: str = ""
    result: str = ""
    success: bool = True
    turned: bool | None = None


def progress(
    request: Request, plan: Plan | None, attached: Attached | None, doing: Execution | None
) -> Progress | None:
    """Return how far the robot is; None while it is at a stage, or goes aside after the last one.

    Args:
        request: What is asked for.
        plan: Of its place; None if it is about none.
        attached: The net that the robot executes, for whatever request.
        doing: How far it is with its net.
    """
    stages = stages_of(request, plan)
    if attached is None or attached.request != request.number:
        return Progress(stages)
    result, stage = ended(attached, doing), attached.stage
    if stage == ASIDE or not result:
        return None
    left, success = stages[stages.index(stage) + 1 :], attached.net.outcome(result)
    return Progress(left, stage, result, success, attached.turned)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Where everything is.

    Attributes:
        cell: base_from_entity by name, see `vocabulary.FRAMES`.
        plans: By name of the place.
        sightings: By name of the package.
    """

    cell: Mapping[str, F64]
    plans: Mapping[str, Plan]
    sightings: Mapping[str, Sighting]

    @classmethod
    def about(
        cls,
        request: Request,
        cell: Mapping[str, F64],
        plans: Mapping[Entity, Plan],
        sightings: Mapping[Entity, Sighting],
        grasps: Mapping[Entity, Grasp],
    ) -> Known:
        """Return where what a request is about is, and no more: all of it becomes a cause.

        Args:
            request: What is asked for.
            cell: base_from_entity by name.
            plans: By place.
            sightings: By package.
            grasps: By product; along its grasp a package may have been felt beside where it was
                seen on the belt.
        """
        plan = plans.get(Entity(request.place)) if request.place else None
        seen = sightings.get(Entity(request.package)) if request.package else None
        if seen is not None and seen.frame == "belt" and request.felt_m:
            grasp = grasps.get(product_entity(seen.product))
            if grasp is not None:
                pose = felt(seen.frame_from_package, grasp, request.felt_m)
                seen = dataclasses.replace(seen, frame_from_package=pose)
        return cls(
            cell,
            {} if plan is None else {request.place: plan},
            {} if seen is None else {request.package: seen},
        )

    def __call__(self, entity: str) -> F64:
        """Return base_from_entity, (4, 4), metres.

        Raises:
            KeyError: It is not known.
        """
        if entity in self.plans:
            return np.asarray(self.cell["tray"] @ self.plans[entity].tray_from_product)
        if entity in self.sightings:
            seen = self.sightings[entity]
            return np.asarray(self.cell[seen.frame] @ seen.frame_from_package)
        return np.asarray(self.cell[entity])


@dataclass(frozen=True, slots=True, eq=False)
class Handled:
    """The package of a request.

    Attributes:
        grasp: Of its product.
        size_m: (3,), box of its product.
        beside: What stands beside it, see `grounding.Job`.
    """

    grasp: Grasp
    size_m: F64
    beside: Beside = ()


def handled_of(
    request: Request,
    known: Known,
    *,
    grasps: Mapping[Entity, Grasp],
    surfaces: Mapping[Entity, Surface],
    plans: Mapping[Entity, Plan],
    flags: Mapping[str, Deviation],
) -> Handled:
    """Return the package of a request, and what stands beside it where a hand goes down to it.

    Args:
        request: What is asked for.
        known: Where what it is about is.
        grasps: By product.
        surfaces: By product, those of neighbours included.
        plans: By place, those of neighbours included.
        flags: The last verdict on each place, by its name.

    Raises:
        NetError: It is not known what the package is, or how it is held; one line.
    """
    seen = known.sightings.get(request.package)
    if seen is None or not seen.product:
        raise NetError(f"{request.kind}: it is not known what {request.package or 'it'} is")
    product, plan = product_entity(seen.product), known.plans.get(request.place)
    if product not in grasps:
        raise NetError(f"{request.kind}: no grasp of {seen.product} is known")
    handled = Handled(grasps[product], size_of(surfaces[product]))
    # What has come by the belt has nothing beside it.
    is_taken = {"grasp", "regrasp"} & set(stages_of(request, plan))
    if request.kind == "pack" or not is_taken or plan is None:
        return handled
    beside = tuple(
        (
            place,
            known.cell["tray"] @ flag.tray_from_product,
            size_of(surfaces[product_entity(flag.product)]),
        )
        for place, flag in flags.items()
        if place != request.place and flag.verdict != "missing"
        if (other := plans.get(Entity(place))) is not None and other.tray == plan.tray
    )
    return dataclasses.replace(handled, beside=beside)


class Stages:
    """Grounds the stages of one request."""

    def __init__(
        self, request: Request, handled: Handled, known: Known, *, arm: Arm, gripper: Gripper
    ) -> None:
        plan = known.plans.get(request.place)
        push = None
        if plan is not None:
            push = known.cell["tray"][:3, :3] @ plan.push
        self._job = Job(
            package=request.package,
            grasp=handled.grasp,
            size_m=handled.size_m,
            beside=handled.beside,
            place=request.place,
            push=push,
            bin="bin",
            product=seen.product if (seen := known.sightings.get(request.package)) else "",
            gap_m=gap_before(request.short_m if request.kind == "push_again" else 0.0),
        )
        self._request, self._known = request, known
        self._arm, self._gripper = arm, gripper

    def candidate(
        self, left: tuple[str, ...], near_rad: F64, turned: bool | None = None
    ) -> Candidate:
        """Return the first stage that is left, grounded.

        Args:
            left: The stages that are left.
            near_rad: (7,), where the arm is.
            turned: Whether the hand is turned round; None: as it can go through all of them.

        Raises:
            NetError: It cannot be grounded; one line.
        """
        if turned is None:
            turned = self.turn(left, near_rad)
        net = self.net(left[0], turned=turned, near_rad=near_rad)
        frames = frames_of(net, self._known)
        return Candidate(self._request.number, left[0], net, "", frames, turned)

    def net(self, stage: str, *, turned: bool, near_rad: F64) -> Net:
        """Return the net of a stage.

        Args:
            stage: Which.
            turned: Whether the hand is turned round.
            near_rad: (7,), where the arm is.

        Raises:
            NetError: It cannot be grounded; one line.
        """
        return ground(
            SKELETON_OF[stage],
            dataclasses.replace(self._job, turned=turned),
            arm=self._arm,
            gripper=self._gripper,
            frames=self._known,
            near_rad=near_rad,
        )

    def turn(self, stages: tuple[str, ...], near_rad: F64) -> bool:
        """Return which way round the hand can go through all stages, the easier one if both.

        Raises:
            NetError: Neither; the reason of the easier one.
        """
        easier = False
        if stages[0] in {"grasp", "regrasp"}:
            easier = easier_turn(self._job, arm=self._arm, frames=self._known, near_rad=near_rad)
        errors = []
        for turned in (easier, not easier):
            try:
                for stage in stages:
                    self.net(stage, turned=turned, near_rad=near_rad)
            except NetError as error:
                errors.append(error)
            else:
                return turned
        raise errors[0]


def frames_of(net: Net, known: Known) -> dict[str, F64]:
    """Return where the entities of a net are, base_from_entity by name.

    Raises:
        NetError: It is not known.
    """
    names = {primitive.frame.entity for primitive in net.primitives.values()}
    try:
        return {name: known(name) for name in sorted(names - {"tool", "base"})}
    except KeyError as error:
        raise NetError(f"net {net.name}: it is not known where {error.args[0]} is") from None


def along_and_across(plan: Plan | Slot, tray_from_product: F64) -> tuple[float, float]:
    """Return how far beyond its place, and beside its row, a package stands, mm.

    Args:
        plan: Of the place.
        tray_from_product: (4, 4), metres, where it stands.
    """
    beside = 1e3 * (tray_from_product[:2, 3] - plan.tray_from_product[:2, 3])
    x, y = plan.push[:2] if plan.push.any() else np.array([1.0, 0.0])
    length = math.hypot(x, y)
    return float(beside @ [x, y]) / length, float(beside @ [-y, x]) / length
