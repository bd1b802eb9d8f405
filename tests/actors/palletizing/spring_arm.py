"""A kinematic stand-in for arm and gripper: joints that lag, and contacts that are springs."""

import dataclasses

import numpy as np

from actors.geometry.arms.kinematics import tool_poses
from actors.palletizing.control.controller import Measured
from actors.palletizing.control.execution import Executor
from actors.workcell.simulation.arm import ARM as WORKCELL_ARM

ARM = dataclasses.replace(WORKCELL_ARM, base=np.eye(4))
"""The workcell's arm with its base in the origin."""
HOME_RAD = np.array([0.0, 0.5, 0.0, -1.4, 0.0, 1.2, 0.0])
CYCLE_S = 0.004
DOWN = np.diag([1.0, -1.0, -1.0])


class SpringArm:
    """Joints follow their commands after `lag_s`; walls press back with 4 N per millimetre.

    A wall is (point (3,), normal (3,)) in the base frame and stops the tool's point alone.
    `held_m` is the width of what stands between the fingers, None for nothing.
    """

    def __init__(self, q_rad=HOME_RAD, *, lag_s=0.06, walls=(), stiffness_n_m=4000.0, held_m=None):
        self.q, self.dq = np.array(q_rad, float), np.zeros(7)
        self.lag_s, self.walls, self.stiffness_n_m = lag_s, list(walls), stiffness_n_m
        self.held_m, self.width_m, self.width_rate_m_s, self.goal_m = held_m, 0.12, 0.0, 0.12
        self.weight_n, self.now_s, self.frozen = 8.0, 0.0, False
        self.speed_share_max = self.acceleration_max = self.jerk_max = 0.0
        self.commanded, self._speed = np.array(q_rad, float), np.zeros(7)
        self._acceleration = np.zeros(7)
        self._stamp_ns = 0

    @property
    def tcp(self):
        return tool_poses(ARM, self.q)[0]

    def force(self):
        """Return what presses on the tool, (3,), N, base frame: walls, and the hand's weight."""
        point, force = self.tcp[:3, 3], np.array([0.0, 0.0, -self.weight_n])
        for at, normal in self.walls:
            depth_m = max(0.0, float((np.asarray(at) - point) @ normal))
            force = force + self.stiffness_n_m * depth_m * np.asarray(normal)
        return force

    def measured(self):
        tcp = self.tcp
        if not self.frozen:
            self._stamp_ns = round(self.now_s * 1e9) + 1
        wrench = np.concatenate((tcp[:3, :3].T @ self.force(), np.zeros(3)))
        return Measured(
            self._stamp_ns, self.q.copy(), self.dq.copy(), tcp, wrench,
            self.width_m, self.width_rate_m_s, 0.0,
        )  # fmt: skip

    def obey(self, command):
        """Be one cycle later."""
        speed = (command.q - self.commanded) / CYCLE_S
        acceleration = (speed - self._speed) / CYCLE_S
        jerk = np.abs(acceleration - self._acceleration).max() / CYCLE_S
        self.speed_share_max = max(self.speed_share_max, float((np.abs(speed) / ARM.dq_max).max()))
        self.acceleration_max = max(self.acceleration_max, float(np.abs(acceleration).max()))
        self.jerk_max = max(self.jerk_max, float(jerk))
        self.commanded, self._speed = command.q.copy(), speed
        self._acceleration = acceleration
        share = -np.expm1(-CYCLE_S / self.lag_s) if self.lag_s else 1.0
        self.dq = (command.q - self.q) * share / CYCLE_S
        self.q = self.q + self.dq * CYCLE_S
        if command.grip is not None:
            self.goal_m = command.grip.value if command.grip.kind == "width" else 0.065
        before_m = self.width_m
        self.width_m += float(np.clip(self.goal_m - self.width_m, -0.0006, 0.0006))
        if self.held_m is not None:
            self.width_m = max(self.width_m, self.held_m)
        self.width_rate_m_s = (self.width_m - before_m) / CYCLE_S
        self.now_s += CYCLE_S


def run(net, arm, frames=None, *, until_s=30.0, each=None, scale=None, **options):
    """Execute a net; return the executor once it has ended and the arm rests."""
    known = frames or {}
    poses = known if callable(known) else known.__getitem__
    executor = Executor(net, ARM, poses, **options)
    while arm.now_s < until_s:
        if each is not None:
            each(arm, executor)
        share = 1.0 if scale is None else scale(arm.now_s)
        command = executor.step(arm.measured(), arm.now_s, share)
        arm.obey(command)
        if command.result is not None and command.at_rest:
            return executor
    raise AssertionError(f"the net runs after {until_s} s: {executor.trace}")


def pose(x, y, z, turn=None):
    """Return a (4, 4) pose."""
    made = np.eye(4)
    made[:3, 3] = x, y, z
    if turn is not None:
        made[:3, :3] = turn
    return made
