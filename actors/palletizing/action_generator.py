"""Action generator: parametrizes grounded action skeletons in the form of nets (ENACT 4.2)."""

from __future__ import annotations

import time
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
    Known,
    Stages,
    handled_of,
    progress,
)
from actors.palletizing.placing.finger_room import Gripper
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
)
from actors.workcell.vocabulary import JOINTS
from enact_dist import Actor, Entity, View, ViewEach, World, Write
from enact_dist.actor.binding import joined

if TYPE_CHECKING:
    from actors.palletizing.control.controller import ArmController
    from actors.palletizing.handling.stages import Progress
    from actors.palletizing.vocabulary import Request
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
        plan = lock[self.plans].get(Entity(request.place)) if request.place else None
        at = progress(request, plan, attached, lock.get(self.execution))
        if at is None:
            return
        stage, result, success, error = at.stage, at.result, at.success, ""
        if success and at.left:
            try:
                self._propose(lock, request, at)
            except NetError as why:
                error = str(why)
                stage, result, success = at.left[0], f"{NO_NET} {error}", False
            else:
                return
        before = lock.get(self.outcome)
        if before is None or before.request != request.number:
            lock[self.outcome] = Outcome(request.number, stage, result, success, time.time_ns())
        if not at.result.startswith(BY_ITSELF):  # so that the sensors see everything
            net = aside_net(turned=bool(at.turned))
            frames = {"belt": lock[self.cell_frames]["belt"]}
            self._write(lock, Candidate(request.number, ASIDE, net, error, frames))

    def _propose(self, lock: Lock, request: Request, at: Progress) -> None:
        """Write the candidate of the first stage that is left.

        Raises:
            NetError: It cannot be grounded; one line.
        """
        arm, joints, flags = self._arm, lock.get(self.joints), lock.get(self.flags, {})
        assert arm is not None
        plans, grasps, frames = lock[self.plans], lock[self.grasps], lock.get(self.cell_frames, {})
        known = Known.about(request, frames, plans, lock[self.sightings], grasps)
        handled = handled_of(
            request, known,
            grasps=grasps, surfaces=lock[self.surfaces], plans=plans, flags=flags,
        )  # fmt: skip
        stages = Stages(request, handled, known, arm=arm.model, gripper=Gripper())
        near_rad = arm.posture_rad if joints is None else joints.q[-1]
        candidate = stages.candidate(at.left, near_rad, at.turned)
        if candidate.stage in RISKY:
            self.expectations.before(joined(self), request, candidate.stage, known, flags)
        self._write(lock, candidate)

    def _write(self, lock: Lock, candidate: Candidate) -> None:
        before = lock.get(self.candidate)
        new = candidate.request, candidate.stage
        if before is None or (before.request, before.stage) != new:
            lock[self.candidate] = candidate
