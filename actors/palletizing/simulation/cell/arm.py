"""The controller of the simulated arm and gripper: takes commands, keeps limits, measures.

It stands where the cabinet of a real robot stands.  Commands come at any time from any thread and
are taken at the next cycle; `measured` returns the state of the last one.

Rules a change must keep: the drives' set points never exceed the limits of speed, acceleration
and jerk, whatever is commanded; without commands the arm comes to rest; after `brake` it takes
none before the next `start`; no clock: the cell says what time it is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.palletizing.control.controller import (
    ArmMeasured,
    ControllerError,
    GripperMeasured,
    Measured,
)
from actors.palletizing.simulation.cell.scene import (
    ARM,
    DAMPING_NM_S_RAD,
    HOME_RAD,
    JOINT_DAMPING,
    OPEN_M,
    STEP_S,
    STIFFNESS_NM_RAD,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm

    F64 = npt.NDArray[np.float64]

STEPS: Final = 2
"""Steps of physics in a cycle of control."""
CYCLE_S: Final = STEPS * STEP_S
DDQ_MAX: Final = np.minimum(ARM.ddq_max, 10.0)
"""Acceleration of the joints, rad/s²."""
DDDQ_MAX: Final = 200.0 * DDQ_MAX
"""Jerk of the joints, rad/s³: full acceleration after 5 ms, a third of what such arms allow."""
AHEAD_CYCLES: Final = 3
"""So many cycles does the arm go on as before when the next command is late."""
GRIP_MAX_N: Final = 100.0
FINGER_M_S: Final = 0.08
"""Speed of each finger."""
NOISE_N: Final = 0.05
NOISE_NM: Final = 0.002
"""Standard deviations of the wrist sensor, per axis and cycle."""


class JointLimiter:
    """Follows commanded joints within limits of speed, acceleration and jerk.

    A joint whose command keeps the limits gets just that; any other one gets there by the
    quickest motion that keeps them (ruckig).

    Args:
        q_rad: (7,), where the arm is, at rest.

    Attributes:
        q_rad: (7,), set points of the drives now.
        dq_rad_s: (7,), its speed.
        ddq_rad_s2: (7,), its acceleration.
    """

    def __init__(self, q_rad: F64) -> None:
        import ruckig

        self._interfaces = ruckig.ControlInterface
        self._ruckig = ruckig.Ruckig(7, CYCLE_S)
        self._state, self._next = ruckig.InputParameter(7), ruckig.OutputParameter(7)
        self._state.synchronization = ruckig.Synchronization.No
        self._state.max_acceleration = [float(v) for v in DDQ_MAX]
        self._state.max_jerk = [float(v) for v in DDDQ_MAX]
        self._goal_rad = np.array(q_rad, float)
        self._goal_rad_s = np.zeros(7)
        self._since = 1
        self.q_rad = np.array(q_rad, float)
        self.dq_rad_s, self.ddq_rad_s2 = np.zeros(7), np.zeros(7)

    def aim(self, q_rad: F64) -> None:
        """Command where to be after the next cycle; the speed there is that since the last one."""
        if self._since > AHEAD_CYCLES:
            self._goal_rad_s = np.zeros(7)
        elif self._since:
            moved = (q_rad - self._goal_rad) / (self._since * CYCLE_S)
            self._goal_rad_s = np.clip(moved, -0.98 * ARM.dq_max, 0.98 * ARM.dq_max)
        self._goal_rad, self._since = np.array(q_rad, float), 0

    def advance(self, *, braking: bool) -> None:
        """Move on by one cycle."""
        if braking and np.abs(self.dq_rad_s).max() < 1e-12:
            q, dq, ddq = self.q_rad, np.zeros(7), np.zeros(7)
            self._goal_rad, self._goal_rad_s = q, dq
        elif braking:
            self._goal_rad, self._goal_rad_s = self.q_rad, np.zeros(7)
            q, dq, ddq = self._quickest(None, np.zeros(7))
        else:
            late = self._since >= AHEAD_CYCLES
            speed = np.zeros(7) if late else self._goal_rad_s
            goal = self._goal_rad + self._since * CYCLE_S * speed
            dq = (goal - self.q_rad) / CYCLE_S
            ddq = (dq - self.dq_rad_s) / CYCLE_S
            follows = np.abs(dq) <= ARM.dq_max
            follows &= np.abs(ddq) <= DDQ_MAX
            follows &= np.abs(ddq - self.ddq_rad_s2) <= DDDQ_MAX * CYCLE_S
            # A joint that comes upon its goal too fast to stay there would swing about it.
            after = (speed - dq) / CYCLE_S
            follows &= np.abs(after) <= DDQ_MAX
            follows &= np.abs(after - ddq) <= DDDQ_MAX * CYCLE_S
            q = goal
            if not follows.all():
                quickest = self._quickest(goal, speed)
                q, dq, ddq = (
                    np.where(follows, own, other)
                    for own, other in zip((goal, dq, ddq), quickest, strict=True)
                )
        self.q_rad, self.dq_rad_s, self.ddq_rad_s2 = q, dq, ddq
        self._since += 1

    def _quickest(self, goal: F64 | None, speed: F64) -> tuple[F64, F64, F64]:
        """Return the next state on the quickest way to a goal that moves on, or to rest.

        It is planned as the goal sees it: planned to where the goal is now, it would be behind
        by the same distance for ever.

        Args:
            goal: (7,), where it is after the next cycle; None: to come to rest, wherever that is.
            speed: (7,), of the goal.
        """
        state = self._state
        here = self.q_rad if goal is None else self.q_rad - (goal - speed * CYCLE_S)
        state.current_position = here
        state.current_velocity = self.dq_rad_s - speed
        state.current_acceleration = self.ddq_rad_s2
        state.target_position, state.target_velocity = np.zeros(7), np.zeros(7)
        state.max_velocity = ARM.dq_max - speed
        state.min_velocity = -ARM.dq_max - speed
        state.control_interface = (
            self._interfaces.Velocity if goal is None else self._interfaces.Position
        )
        result = self._ruckig.update(state, self._next)
        assert int(result) >= 0, f"ruckig refuses {state} with {result}"
        q, dq, ddq = (
            np.array(values)
            for values in (
                self._next.new_position,
                self._next.new_velocity,
                self._next.new_acceleration,
            )
        )
        return (q if goal is None else q + goal), dq + speed, ddq


class ArmOfCell:
    """What is known of the cell's arm without asking it."""

    @property
    def cycle_s(self) -> float:
        """Period of control."""
        return CYCLE_S

    @property
    def model(self) -> Arm:
        """Kinematics and limits."""
        return ARM

    @property
    def posture_rad(self) -> F64:
        """Where the joints go as far as the tool leaves it open."""
        return np.array(HOME_RAD)


class SimulatedArm(ArmOfCell):
    """Arm and gripper of the cell: an `ArmController` and a `GripperController` in one.

    Args:
        model: MuJoCo's model of the cell.
        data: Its state; this class sets the joints to their home.
        mul_m: MuJoCo's product of the mass matrix with a vector.
        seed: Seed of the wrist sensor's noise.

    Attributes:
        gripping: Whether the gripper is to press, not to stand at a width.
        gripping_cycles: Since how many cycles.
    """

    def __init__(
        self, model: Any, data: Any, mul_m: Callable[[Any, Any, F64, F64], None], *, seed: int
    ) -> None:
        self._model, self._data = model, data
        self._random = np.random.default_rng([seed, 12])
        self._tool = model.site("tool").id
        self._fingers = [int(model.joint(name).qposadr[0]) for name in ("left", "right")]
        self._finger_speeds = [int(model.joint(name).dofadr[0]) for name in ("left", "right")]
        self._lead_s = (np.array(DAMPING_NM_S_RAD) + JOINT_DAMPING) / STIFFNESS_NM_RAD
        self._torques = np.zeros(model.nv)
        self._accelerations = np.zeros(model.nv)
        self._mul_m = mul_m
        data.qpos[:7] = HOME_RAD
        for address in self._fingers:
            data.qpos[address] = (OPEN_M[1] - OPEN_M[0]) / 2.0
        self._limiter = JointLimiter(np.array(HOME_RAD))
        self._commanded: F64 | None = None
        self._started = False
        self._width_m, self._force_n = OPEN_M[1], 20.0
        self._finger_m = (OPEN_M[1] - OPEN_M[0]) / 2.0
        self._measured: Measured | None = None
        self.gripping, self.gripping_cycles = False, 0

    @property
    def limiter(self) -> JointLimiter:
        """Set points of the drives."""
        return self._limiter

    def start(self) -> None:
        """Take commands from now on."""
        self._commanded = None
        self._started = True

    def measured(self) -> Measured:
        """Return the state of the last cycle."""
        assert self._measured is not None, "the cell measures when it is made"
        return self._measured

    def arm_measured(self) -> ArmMeasured:
        """Return the state of the last cycle without the gripper's."""
        now = self.measured()
        return ArmMeasured(now.stamp_ns, now.q, now.dq, now.tcp, now.wrench)

    def gripped(self) -> GripperMeasured:
        """Return the gripper's state of the last cycle."""
        now = self.measured()
        return GripperMeasured(now.stamp_ns, now.width_m, now.width_rate_m_s, now.grip_force_n)

    def command(self, q: F64) -> None:
        """Command where the joints are to be one cycle from now.

        Raises:
            ControllerError: Out of range, not finite, or the arm is braked.
        """
        q = np.array(q, np.float64)
        if not self._started:
            raise ControllerError("the arm is braked and takes no positions; call start() first")
        if q.shape != (7,) or not np.isfinite(q).all():
            raise ControllerError(f"asked for the position {q}; a position is seven finite numbers")
        beyond = np.abs(q) > ARM.q_max
        if beyond.any():
            joint = int(np.argmax(beyond))
            raise ControllerError(
                f"asked for joint {joint + 1} at {np.degrees(q[joint]):.1f}°; its range is"
                f" ±{np.degrees(ARM.q_max[joint]):.0f}°"
            )
        self._commanded = q

    def grip_width(self, width_m: float, force_limit_n: float) -> None:
        """Move the fingers to a distance.

        Raises:
            ControllerError: The distance or the force is out of range.
        """
        if not OPEN_M[0] <= width_m <= OPEN_M[1]:
            raise ControllerError(
                f"asked for {1e3 * width_m:.1f} mm between the fingers; this gripper opens from"
                f" {1e3 * OPEN_M[0]:.0f} to {1e3 * OPEN_M[1]:.0f} mm"
            )
        self._check_force(force_limit_n)
        self._width_m, self._force_n, self.gripping = width_m, force_limit_n, False

    def grip_force(self, force_n: float) -> None:
        """Close the fingers until they press with a force.

        Raises:
            ControllerError: The force is out of range.
        """
        self._check_force(force_n)
        self._force_n = force_n
        if not self.gripping:
            self.gripping, self.gripping_cycles = True, 0

    def brake(self) -> None:
        """Stop the arm; the gripper goes on holding."""
        self._started, self._commanded = False, None

    def close(self) -> None:
        """Stop the arm."""
        self.brake()

    def drive(self, *, slack: bool = False) -> None:
        """Set the drives' set points for the next cycle.

        Args:
            slack: The fingers open, whatever they were commanded.
        """
        commanded, self._commanded = self._commanded, None
        if commanded is not None and self._started:
            self._limiter.aim(commanded)
        self._limiter.advance(braking=not self._started)
        limiter, data = self._limiter, self._data
        # A drive gives way to loads that are not in its set point: so speed and inertia are added.
        self._accelerations[:7] = limiter.ddq_rad_s2
        self._mul_m(self._model, data, self._torques, self._accelerations)
        data.ctrl[:7] = (
            limiter.q_rad
            + self._lead_s * limiter.dq_rad_s
            + self._torques[:7] / np.array(STIFFNESS_NM_RAD)
        )
        self.gripping_cycles += 1
        goal_m = (self._width_m - OPEN_M[0]) / 2.0
        # A finger's set point stays within reach of where it is, so that it presses at once less
        # when it is opened.
        reach_m = 1.2 * self._force_n / self._model.actuator_gainprm[7, 0]
        if slack:
            goal_m = (OPEN_M[1] - OPEN_M[0]) / 2.0
        elif self.gripping:
            goal_m = -reach_m
        finger_m = float(data.qpos[self._fingers].mean())
        step_m = FINGER_M_S * CYCLE_S
        told_m = self._finger_m + float(np.clip(goal_m - self._finger_m, -step_m, step_m))
        self._finger_m = float(np.clip(told_m, finger_m - reach_m - step_m, finger_m + reach_m))
        data.ctrl[7:9] = self._finger_m
        self._model.actuator_forcerange[7:9] = -self._force_n, self._force_n

    def measure(self, stamp_ns: int) -> None:
        """Take the present state of physics as measured."""
        data = self._data
        tcp = np.eye(4)
        tcp[:3, :3] = data.site_xmat[self._tool].reshape(3, 3)
        tcp[:3, 3] = data.site_xpos[self._tool]
        noise = self._random.standard_normal(6)
        noise[:3] *= NOISE_N
        noise[3:] *= NOISE_NM
        self._measured = Measured(
            stamp_ns=stamp_ns,
            q=np.array(data.qpos[:7]),
            dq=np.array(data.qvel[:7]),
            tcp=tcp,
            wrench=noise - data.sensordata[:6],
            width_m=OPEN_M[0] + float(data.qpos[self._fingers].sum()),
            width_rate_m_s=float(data.qvel[self._finger_speeds].sum()),
            grip_force_n=-float(data.actuator_force[7:9].mean()),
        )

    @staticmethod
    def _check_force(force_n: float) -> None:
        if not 0.0 < force_n <= GRIP_MAX_N:
            raise ControllerError(
                f"asked for a grip of {force_n:g} N; this gripper presses with up to"
                f" {GRIP_MAX_N:.0f} N"
            )
