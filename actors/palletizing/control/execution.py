"""Executes a primitive net: measurements in, positions of the joints and gripper commands out.

PURE: no clock, no controller, no world context.  The robot's inner loop calls `Executor.step` every
4 ms with what its controller measured and sends on what comes back; tests do the same with a few
springs.  What the parts of a net mean stands in `nets`.

Rules a change must keep:

1. A net ends once.  Afterwards the arm brakes and rests, and the gripper keeps its command.
2. A net is never begun again: an executor that gets the `Execution` of an earlier process for the
   same net ends with "interrupted:PRIMITIVE" before anything moves.
3. A measurement that does not advance, or is no number, ends the net; so does a frame that gets
   lost and an arm that does not follow.
4. At most one exit is taken per step, so that each primitive lasts a cycle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from actors.geometry.poses import coordinates, turned
from actors.palletizing.control.resolved_rate import LEAD_M, ResolvedRate, rotation_vector
from actors.palletizing.handling.nets import Execution, NetError, TraceStep

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from actors.geometry.arms.joint_paths import Arm
    from actors.palletizing.control.controller import Measured
    from actors.palletizing.handling.nets import Exit, Net, Primitive

    F64 = npt.NDArray[np.float64]
    Frames = Callable[[str], F64]

GAIN_PER_S: Final = 6.0
"""Of the position error; the arm follows its commands after 75 ms, more would overshoot."""
TURN_GAIN_PER_S: Final = 5.0
BRAKING_M_S2: Final = 2.5
"""With which the tool comes to its target: within what the joints can."""
TURNING_RAD_S: Final = 1.5
"""Greatest turning speed of the tool."""
YIELD_M_S_N: Final = 0.001
"""How fast a force axis moves per newton that is missing."""
YIELD_RAD_S_NM: Final = 0.02
FILTER_S: Final = 0.018
"""Time constant of the wrench: fingers that touch ring for some milliseconds."""
FRAME_FILTER_S: Final = 0.05
"""Time constant of the speed of a frame that is followed."""
STALE_S: Final = 0.05
"""So long may the newest measurement be the same."""
FOLLOWING_RAD: Final = 0.35
"""A joint that is farther than this from its command does not follow."""
DT_S_MAX: Final = 0.02
"""A longer pause between two steps moves the arm no further than this."""


@dataclass(frozen=True, slots=True)
class Grip:
    """A command to the gripper.

    Attributes:
        kind: "width" or "force".
        value: m or N.
    """

    kind: str
    value: float


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What one step asks of the controller.

    Attributes:
        q: (n,) float64, joints, rad, for the next cycle.
        grip: What the gripper shall do from now on; None: what it does.
        result: How the net ended; None while it runs.
        at_rest: No joint is commanded to move: with a result, the net is over.
    """

    q: F64
    grip: Grip | None
    result: str | None
    at_rest: bool


@dataclass(slots=True, eq=False)
class _Phase:
    """The primitive that is being executed."""

    name: str
    primitive: Primitive
    start_s: float
    start_ns: int
    base_from_frame: F64
    start: F64
    """(6,): the tool in the task frame at the start: x, y, z, roll, pitch, yaw."""
    moved: F64 = field(default_factory=lambda: np.zeros(6))
    """(6,): how far the velocity axes have gone since."""
    frame_m_s: F64 = field(default_factory=lambda: np.zeros(3))
    paused_s: float = 0.0
    held_since_s: dict[tuple[int, int], float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """How far the tool is from where the axes want it, in the task frame."""

    way: F64
    """(3,), m; 0 on force axes."""
    turn: F64
    """(3,), rotation vector, rad."""
    wrench: F64
    """(3, 2), N and Nm on the tool by axis, since the tare."""


class Executor:
    """One execution of a net.

    Args:
        net: What to execute.
        arm: Kinematics and limits; its base is the frame of the measurements.
        frames: Returns base_from_entity, (4, 4), of an entity; KeyError if it is not known.
        net_version: Number under which the net was attached.
        posture_rad: Where the joints go as far as the tool leaves it open; default: where they are.
        from_rad: The last command to the arm; without it a net after another starts with a jerk.
        before: What an earlier process made of the same net, see the module's second rule.

    Attributes:
        result: "" while the net runs; see `Execution`.
        trace: The primitives that were left.
        quantities: What the conditions saw last, see `nets.Condition`.

    Raises:
        NetError: A frame of the net is not known.
    """

    def __init__(
        self,
        net: Net,
        arm: Arm,
        frames: Frames,
        *,
        net_version: int = 0,
        posture_rad: F64 | None = None,
        from_rad: F64 | None = None,
        before: Execution | None = None,
    ) -> None:
        self._net, self._arm, self._frames = net, arm, frames
        self._version, self._posture_rad, self._from_rad = net_version, posture_rad, from_rad
        self.result, self.trace = "", list[TraceStep]()
        self._rate: ResolvedRate | None = None
        self._phase: _Phase | None = None
        self._measured: Measured | None = None
        self._wrench, self._bias = np.zeros(6), np.zeros(6)
        self._now_s, self._fresh_s = math.nan, math.nan
        self._at, self.quantities = net.start, dict[str, float]()
        self._grip: Grip | None = None
        self._check_frames()
        if before is not None and before.net_version == net_version and not before.result:
            self._at, self.trace = before.primitive, list(before.trace)
            self._end(f"interrupted:{before.primitive}", "the robot was started again")

    def step(
        self, measured: Measured, now_s: float, scale: float = 1.0, *, waits: bool = False
    ) -> Command:
        """Go on for one cycle.

        Args:
            measured: The newest state of arm and gripper.
            now_s: Time of any clock that only goes on.
            scale: Share of all speeds, 0 to 1; at 0 the arm rests where it is, the time limit of
                the primitive waits, and the net goes on from there afterwards.
            waits: The gripper has not taken its last command yet: the move goes on, but no exit is
                taken and the primitive's time stands still.
        """
        dt_s = min(max(now_s - self._now_s, 0.0), DT_S_MAX) if now_s > self._now_s else 0.0
        self._grip = None
        rate = self._sense(measured, now_s, dt_s)
        errors = None if self.result else self._errors(dt_s, scale)
        if errors is not None:
            if waits:
                self._running.start_s += dt_s
            else:
                errors = self._ways_out(errors, dt_s, scale)
        if errors is None or scale <= 0.0:
            rate.brake(dt_s)
        else:
            speed_m_s = self._running.primitive.speed_m_s
            rate.move(self._twist(errors, scale), measured.tcp, speed_m_s, dt_s)
        return Command(rate.q_rad, self._grip, self.result or None, rate.at_rest)

    def brake(self, reason: str, because: str = "") -> None:
        """End the net with "braked:REASON"; the next steps bring the arm to rest.

        Args:
            reason: One word.
            because: The same in words, for the trace; by default the word.
        """
        if not self.result:
            self._end(f"braked:{reason}", because or reason)

    def execution(self) -> Execution:
        """Return how far the net is, as the datum that is published.

        Raises:
            RuntimeError: No step has been made.
        """
        measured, phase = self._measured, self._phase
        if measured is None:
            raise RuntimeError("there is no execution before the first step")
        return Execution(
            net_name=self._net.name,
            net_version=self._version,
            primitive=self._at,
            since_ns=measured.stamp_ns if phase is None else phase.start_ns,
            trace=tuple(self.trace),
            result=self.result,
            wrench=self._wrench - self._bias,
            width_m=measured.width_m,
            tcp=np.array(measured.tcp),
        )

    @property
    def _running(self) -> _Phase:
        assert self._phase is not None
        return self._phase

    def _check_frames(self) -> None:
        for name, primitive in self._net.primitives.items():
            entity = primitive.frame.entity
            if entity not in {"tool", "base"}:
                try:
                    self._frames(entity)
                except KeyError:
                    raise NetError(
                        f"net {self._net.name}: primitive {name}: it is not known where {entity} is"
                    ) from None

    def _sense(self, measured: Measured, now_s: float, dt_s: float) -> ResolvedRate:
        """Take a measurement; end the net if it cannot be relied on."""
        turn = measured.tcp[:3, :3]
        wrench = np.concatenate((turn @ measured.wrench[:3], turn @ measured.wrench[3:]))
        if self._rate is None:
            posture = measured.q if self._posture_rad is None else self._posture_rad
            start = measured.q if self._from_rad is None else self._from_rad
            self._rate = ResolvedRate(self._arm, start, posture)
            self._wrench = self._bias = wrench
        self._wrench = self._wrench + (wrench - self._wrench) * -math.expm1(-dt_s / FILTER_S)
        if self._measured is None or measured.stamp_ns != self._measured.stamp_ns:
            self._fresh_s = now_s
        self._measured, self._now_s = measured, now_s
        if self.result:
            return self._rate
        off_rad = np.abs(measured.q - self._rate.q_rad)
        if not math.isfinite(float(wrench.sum() + measured.tcp.sum()) + measured.width_m):
            self._end("sensor:not_a_number", "a measured value is no number")
        elif now_s - self._fresh_s > STALE_S:
            self._end("sensor:frozen", f"no new measurement for {now_s - self._fresh_s:.3f} s")
        elif not (off_rad <= FOLLOWING_RAD).all():
            joint = int(np.argmax(off_rad)) + 1
            self._end(f"not_following:{joint}", f"{off_rad[joint - 1]:.2f} rad off its command")
        elif self._phase is None:
            self._enter(self._net.start)
        return self._rate

    def _enter(self, name: str) -> None:
        primitive, measured = self._net.primitives[name], self._measured
        assert measured is not None
        self._at = name
        try:
            frame = self._frame(primitive)
        except KeyError:
            self._lost(primitive.frame.entity)
            return
        if primitive.tare:
            self._bias = self._wrench
        if primitive.tool != "keep":
            self._grip = Grip(primitive.tool, primitive.tool_value)
        start = coordinates(frame, measured.tcp)
        self._phase = _Phase(name, primitive, self._now_s, measured.stamp_ns, frame, start)

    def _frame(self, primitive: Primitive) -> F64:
        """Return base_from_frame now."""
        entity, offset = primitive.frame.entity, primitive.frame.offset
        if entity == "base":
            return np.array(offset)
        if entity == "tool":
            assert self._measured is not None
            return np.asarray(self._measured.tcp @ offset)
        return np.asarray(self._frames(entity) @ offset)

    def _errors(self, dt_s: float, scale: float) -> _Errors | None:
        """Return where the tool is, seen from where it shall be; None if the frame is lost."""
        phase, measured = self._running, self._measured
        assert measured is not None
        if phase.primitive.frame.follows and not self._followed(phase, dt_s):
            return None
        if scale <= 0.0:
            phase.paused_s += dt_s
        here = coordinates(phase.base_from_frame, measured.tcp)
        target = np.array(here)
        by_position = np.zeros(6, bool)
        for index, axis in enumerate(phase.primitive.axes):
            if axis.mode == "position":
                target[index], by_position[index] = axis.value, True
            elif axis.mode == "velocity":
                phase.moved[index] += axis.value * scale * dt_s
                target[index] = phase.start[index] + phase.moved[index]
        way = target[:3] - here[:3]
        bounded = np.where(by_position[:3], way, np.clip(way, -LEAD_M, LEAD_M))
        phase.moved[:3] += bounded - way
        turn_here = turned(*here[3:])
        turn = rotation_vector(turned(*target[3:]) @ turn_here.T)
        asked = np.where(by_position[3:], target[3:], here[3:])
        turn_error = rotation_vector(turned(*asked) @ turn_here.T)
        force = phase.base_from_frame[:3, :3].T @ (self._wrench - self._bias).reshape(2, 3).T
        self.quantities = {
            "distance": math.dist(here[:3], phase.start[:3]),
            "error": math.hypot(*bounded[by_position[:3]]),
            "turn_error": math.hypot(*turn_error),
            "force": math.hypot(*force[:, 0]),
            **{f"force_{axis}": float(force[index, 0]) for index, axis in enumerate("xyz")},
            **{f"torque_{axis}": float(force[index, 1]) for index, axis in enumerate("xyz")},
            "width": measured.width_m,
            "width_rate": measured.width_rate_m_s,
            "elapsed_s": self._now_s - phase.start_s,
        }
        return _Errors(bounded, turn, force)

    def _followed(self, phase: _Phase, dt_s: float) -> bool:
        """Move the task frame with its entity."""
        try:
            frame = self._frame(phase.primitive)
        except KeyError:
            self._lost(phase.primitive.frame.entity)
            return False
        if dt_s > 0.0 and phase.primitive.frame.entity != "tool":
            speed = (frame[:3, 3] - phase.base_from_frame[:3, 3]) / dt_s
            phase.frame_m_s += (speed - phase.frame_m_s) * -math.expm1(-dt_s / FRAME_FILTER_S)
        phase.base_from_frame = frame
        return True

    def _ways_out(self, errors: _Errors, dt_s: float, scale: float) -> _Errors | None:
        """Take the first exit whose conditions hold; return the errors of what runs then."""
        phase = self._running
        taken = None
        for number, way in enumerate(phase.primitive.exits):
            if self._holds(phase, number, way) and taken is None:
                taken = way
        elapsed_s = self.quantities["elapsed_s"]
        if taken is not None:
            values = (f"{c.quantity} {self.quantities[c.quantity]:.4g}" for c in taken.when)
            because = f"{taken}: {', '.join(values)}"
            if taken.to in self._net.ends:
                self._end(taken.to, because)
                return None
            self.trace.append(TraceStep(phase.name, taken.to, elapsed_s, because))
            self._enter(taken.to)
            return None if self.result else self._errors(0.0, scale)
        if elapsed_s - phase.paused_s > phase.primitive.limit_s:
            self._end(f"timeout:{phase.name}", f"over {phase.primitive.limit_s:g} s")
            return None
        return errors

    def _holds(self, phase: _Phase, number: int, way: Exit) -> bool:
        """Return whether all conditions of an exit have held for as long as each asks."""
        holds = True
        for index, condition in enumerate(way.when):
            value = self.quantities[condition.quantity]
            met = value > condition.value if condition.relation == ">" else value < condition.value
            if not met:
                phase.held_since_s.pop((number, index), None)
                holds = False
                continue
            since_s = phase.held_since_s.setdefault((number, index), self._now_s)
            holds = holds and self._now_s - since_s >= condition.hold_s - 1e-9
        return holds

    def _twist(self, errors: _Errors, scale: float) -> F64:
        """Return the speed that the tool shall have, (6,), base frame."""
        phase = self._running
        axes, turn = phase.primitive.axes, phase.base_from_frame[:3, :3]
        way_m = math.hypot(*errors.way[[axis.mode == "position" for axis in axes[:3]]])
        nearing_per_s = min(GAIN_PER_S, math.sqrt(2.0 * BRAKING_M_S2 / max(way_m, 1e-9)))
        speed, turning = np.zeros(3), TURN_GAIN_PER_S * errors.turn
        for at, (along, about) in enumerate(zip(axes[:3], axes[3:], strict=True)):
            if along.mode == "position":
                speed[at] = nearing_per_s * errors.way[at]
            elif along.mode == "velocity":
                speed[at] = along.value + GAIN_PER_S * errors.way[at]
            else:
                speed[at] = YIELD_M_S_N * (errors.wrench[at, 0] - along.value)
            if about.mode == "force":
                turning[at] += YIELD_RAD_S_NM * (errors.wrench[at, 1] - about.value)
        speed *= min(1.0, phase.primitive.speed_m_s / max(math.hypot(*speed), 1e-9))
        turning *= min(1.0, TURNING_RAD_S / max(math.hypot(*turning), 1e-9))
        return np.concatenate((turn @ speed + phase.frame_m_s, turn @ turning)) * scale

    def _lost(self, entity: str) -> None:
        self._end(f"no_frame:{entity}", f"it is not known any more where {entity} is")

    def _end(self, result: str, because: str) -> None:
        elapsed_s = 0.0 if self._phase is None else self._now_s - self._phase.start_s
        self.result = result
        self.trace.append(TraceStep(self._at, result, elapsed_s, because))
