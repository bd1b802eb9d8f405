"""Action generator: parametrizes grounded action skeletons in the form of nets (ENACT 4.2)."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from actors.palletizing.control.controller import open_controller
from actors.palletizing.handling.expectation import Expectations
from actors.palletizing.handling.grounding import aside_net
from actors.palletizing.handling.nets import NetError
from actors.palletizing.handling.reactions import BY_ITSELF, NO_NET
from actors.palletizing.handling.stages import (
    ASIDE,
    IDLE,
    RISKY,
    Handled,
    Known,
    Stages,
    felt,
    frames_of,
    stages_of,
)
from actors.palletizing.placing.finger_room import Gripper
from actors.palletizing.placing.grasps import size_of
from actors.palletizing.vocabulary import (
    CANDIDATE,
    CELL,
    DEVIATIONS,
    EXECUTION,
    FRAMES,
    GRASP,
    NET,
    OUTCOME,
    PACKAGES,
    PLACES,
    PLAN,
    PRODUCTS,
    REQUEST,
    ROBOT,
    SIGHTING,
    SURFACE,
    SYSTEM,
    Candidate,
    Outcome,
    product_entity,
)
from actors.workcell.vocabulary import JOINTS
from enact_dist import Actor, Entity, View, ViewEach, World, Write
from enact_dist.actor.binding import joined

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from actors.palletizing.control.controller import ArmController
    from actors.palletizing.placing.finger_room import Beside
    from actors.palletizing.vocabulary import Attached, Request
    from enact_dist import Lock


class ActionGenerator(Actor):
    """Ground the next stage of the request; say how the request ended, and take the arm aside.

    Before each stage that can spoil what stands on the tray it forks the online context and writes
    there what it expects, see `expectation`.

    Args:
        controller: Address of the arm, for its kinematics, see `open_controller`.
    """

    training, online = World("training"), World("online")
    request = View(online, SYSTEM, REQUEST)
    attached = View(online, SYSTEM, NET)
    execution = View(online, ROBOT, EXECUTION)
    joints = View(online, ROBOT, JOINTS)
    cell_frames = View(training, CELL, FRAMES)
    plans = ViewEach(training, PLACES, PLAN)
    grasps = ViewEach(training, PRODUCTS, GRASP)
    surfaces = ViewEach(training, PRODUCTS, SURFACE)
    sightings = ViewEach(online, PACKAGES, SIGHTING)
    flags = View(online, SYSTEM, DEVIATIONS)
    candidate = Write(online, SYSTEM, CANDIDATE)
    outcome = Write(online, SYSTEM, OUTCOME)
    triggers = (request, attached, execution)

    def __init__(self, controller: str) -> None:
        self.controller, self.expectations = controller, Expectations()
        self._arm: ArmController | None = None

    def start(self) -> None:
        """Look up the arm; it is not started here."""
        self._arm = open_controller(self.controller)

    def update(self, lock: Lock) -> None:
        """Go on with the request, if the robot has ended what it did for it."""
        request, attached = lock.get(self.request), lock.get(self.attached)
        if request is None or request.kind in IDLE:
            return
        mine = attached if attached is not None and attached.request == request.number else None
        result = "" if mine is None else self._result(lock, mine)
        if mine is not None and (mine.stage == ASIDE or not result):
            return
        stages = self._stages(lock, request)
        success = mine is None or mine.net.outcome(result)
        left = stages if mine is None else stages[stages.index(mine.stage) + 1 :]
        if success and left:
            error = self._propose(lock, request, left, mine)
            if not error:
                return
            self._end(lock, request, left[0], f"{NO_NET} {error}", success=False)
        else:
            error = ""
            self._end(lock, request, "" if mine is None else mine.stage, result, success=success)
        if not result.startswith(BY_ITSELF):
            self._clear(lock, request, error, turned=mine is not None and mine.turned)

    def _result(self, lock: Lock, attached: Attached) -> str:
        """Return how the robot ended a net; empty while it has not."""
        found = lock.get(self.execution)
        return found.result if found is not None and found.net_version == attached.number else ""

    def _stages(self, lock: Lock, request: Request) -> tuple[str, ...]:
        plan = lock[self.plans].get(Entity(request.place)) if request.place else None
        return stages_of(request, plan)

    def _propose(
        self, lock: Lock, request: Request, left: tuple[str, ...], before: Attached | None
    ) -> str:
        """Write the candidate of the first stage that is left; return why that cannot be."""
        known = self._known(lock, request)
        try:
            stages = self._ground(lock, request, known)
            near_rad = self._near_rad(lock)
            turned = stages.turn(left, near_rad) if before is None else before.turned
            net = stages.net(left[0], turned=turned, near_rad=near_rad)
            frames = frames_of(net, known)
        except NetError as error:
            return str(error)
        if left[0] in RISKY:
            flags = lock.get(self.flags, {})
            self.expectations.before(joined(self), request, left[0], known, flags)
        self._write(lock, Candidate(request.number, left[0], net, "", frames, turned))
        return ""

    def _clear(self, lock: Lock, request: Request, error: str, *, turned: bool) -> None:
        """Propose to take the arm aside, so that the sensors see everything."""
        net = aside_net(turned=turned)
        frames = {"belt": lock[self.cell_frames]["belt"]}
        self._write(lock, Candidate(request.number, ASIDE, net, error, frames))

    def _write(self, lock: Lock, candidate: Candidate) -> None:
        before = lock.get(self.candidate)
        same = before is not None and (before.request, before.stage) == (
            candidate.request,
            candidate.stage,
        )
        if not same:
            lock[self.candidate] = candidate

    def _end(self, lock: Lock, request: Request, stage: str, result: str, *, success: bool) -> None:
        before = lock.get(self.outcome)
        if before is None or before.request != request.number:
            lock[self.outcome] = Outcome(request.number, stage, result, success, time.time_ns())

    def _known(self, lock: Lock, request: Request) -> Known:
        """Return where what the request is about is, and no more: all of it becomes a cause."""
        plans, sightings, place = {}, {}, Entity(request.place) if request.place else None
        if place is not None and place in lock[self.plans]:
            plans[request.place] = lock[self.plans][place]
        seen = lock[self.sightings].get(Entity(request.package)) if request.package else None
        if seen is not None:
            grasp = lock[self.grasps].get(product_entity(seen.product))
            if seen.frame == "belt" and grasp is not None and request.felt_m:
                pose = felt(seen.frame_from_package, grasp, request.felt_m)
                seen = replace(seen, frame_from_package=pose)
            sightings[request.package] = seen
        return Known(lock.get(self.cell_frames, {}), plans, sightings)

    def _ground(self, lock: Lock, request: Request, known: Known) -> Stages:
        seen = known.sightings.get(request.package)
        if seen is None or not seen.product:
            raise NetError(f"{request.kind}: it is not known what {request.package or 'it'} is")
        product = product_entity(seen.product)
        if product not in lock[self.grasps]:
            raise NetError(f"{request.kind}: no grasp of {seen.product} is known")
        size_m = size_of(lock[self.surfaces][product])
        handled = Handled(lock[self.grasps][product], size_m, self._beside(lock, request))
        assert self._arm is not None
        return Stages(request, handled, known, arm=self._arm.model, gripper=Gripper())

    def _beside(self, lock: Lock, request: Request) -> Beside:
        """Return what stands beside a package that is not where packages come.

        One that has come by the belt has nothing beside it.
        """
        if request.kind == "pack" or not {"grasp", "regrasp"} & set(self._stages(lock, request)):
            return ()
        plans, base_from_tray = lock[self.plans], lock[self.cell_frames]["tray"]
        tray = plans[Entity(request.place)].tray
        return tuple(
            (place, base_from_tray @ flag.tray_from_product, size_of(lock[self.surfaces][product]))
            for place, flag in lock.get(self.flags, {}).items()
            if place != request.place and flag.verdict != "missing"
            if (plan := plans.get(Entity(place))) is not None and plan.tray == tray
            for product in [product_entity(flag.product)]
        )

    def _near_rad(self, lock: Lock) -> npt.NDArray[np.float64]:
        joints = lock.get(self.joints)
        assert self._arm is not None
        return self._arm.posture_rad if joints is None else joints.q[-1]
