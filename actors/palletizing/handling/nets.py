"""Manipulation primitive nets as data: what a robot with a gripper does, and when it goes on.

A *primitive* moves the tool in a task frame, each of the six axes by position, velocity or force,
and ends by one of its exits.  A *net* leads from primitive to primitive to an end, which is a
success or a named failure (ENACT 4.2, after the task frame formalism).  A net is a datum like any
other: stored, compared, drawn, replayed.  `net_files` is its readable form, `execution` runs it.

Conventions that a change must keep:

- *Task frame*: base_from_entity @ offset.  "base" is the arm's base, "tool" the tool as it stands
  at the start of the primitive (or now, if the frame follows).
- *Axes* x, y, z move the tool's point along the axes of the task frame.  rx, ry, rz as positions
  are roll, pitch and yaw: the tool's turn in the task frame is Rz(rz) Ry(ry) Rx(rx).  A velocity
  axis starts from where it is; 0 holds it there.
- *Forces* are those that act on the tool: pressing down gives a positive force_z in a frame with z
  up.  A force axis moves until this force is its value.
- *Tare*: at the start of a primitive with `tare` the wrench of that moment becomes zero.
- *Exits* are asked in order; the first whose conditions all hold is taken.  Past `limit_s` the net
  ends with "timeout:PRIMITIVE", a failure that every net has.
"""

# The wire reads these annotations: they stay real types, without `from __future__`.

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

AXES: Final = ("x", "y", "z", "rx", "ry", "rz")
UNITS: Final = {"position": ("m", "rad"), "velocity": ("m/s", "rad/s"), "force": ("N", "Nm")}
"""Unit of an axis's value by mode: of x, y, z, and of rx, ry, rz."""
QUANTITIES: Final = {
    "distance": "m",
    "error": "m",
    "turn_error": "rad",
    "force": "N",
    "force_x": "N",
    "force_y": "N",
    "force_z": "N",
    "torque_x": "Nm",
    "torque_y": "Nm",
    "torque_z": "Nm",
    "width": "m",
    "width_rate": "m/s",
    "elapsed_s": "s",
}
"""What a condition may ask for, with its unit; see `Condition`."""
RELATIONS: Final = (">", "<")
TOOLS: Final = {"keep": "", "width": "m", "force": "N"}
"""Commands to the gripper, with the unit of the value."""
SPEED_M_S_MAX: Final = 1.5
FORCE_N_MAX: Final = 100.0
WIDTH_M_MAX: Final = 0.2
LIMIT_S_MAX: Final = 600.0
REACH_M_MAX: Final = 3.0
"""No cell is larger, seen from any of its frames."""
_UNIT_MAX: Final = {
    "m": REACH_M_MAX,
    "rad": math.pi,
    "m/s": SPEED_M_S_MAX,
    "rad/s": 3.0,
    "N": FORCE_N_MAX,
    "Nm": 20.0,
    "s": LIMIT_S_MAX,
}
_NAME: Final = re.compile(r"[A-Za-z0-9_-]+")
_RIGID: Final = 1e-6
_LATER: Final = ("elapsed_s", ">")


class NetError(ValueError):
    """A net cannot be run: one line with the net, the primitive, what was asked and found."""


@dataclass(frozen=True, slots=True, eq=False)
class TaskFrame:
    """The frame in which a primitive moves the tool.

    Attributes:
        entity: "package/17", "place/3", "tray", "tool", "base".
        offset: (4, 4) float64, metres, entity_from_frame.
        follows: Whether the frame moves with the entity, or stays where it was at the start.
    """

    entity: str
    offset: npt.NDArray[np.float64]
    follows: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """What one axis of the task frame does.

    Attributes:
        mode: "position", "velocity" or "force".
        value: m or rad, m/s or rad/s, N or Nm.
    """

    mode: str
    value: float


@dataclass(frozen=True, slots=True)
class Condition:
    """A bound on something measured.

    Attributes:
        quantity: "distance" (m, of the tool in the task frame since the start of the primitive),
            "error" (m, over the axes x, y, z by position), "turn_error" (rad, over rx, ry, rz by
            position), "force_x" … "torque_z" (N, Nm, on the tool, in the task frame, since the
            tare), "force" (N, norm), "width" (m), "width_rate" (m/s), "elapsed_s".
        relation: ">" or "<".
        value: In the unit of the quantity.
        hold_s: So long it has to hold without a break.
    """

    quantity: str
    relation: str
    value: float
    hold_s: float = 0.0

    def __str__(self) -> str:
        unit = QUANTITIES.get(self.quantity, "")
        held = f" for {self.hold_s:g} s" if self.hold_s else ""
        return f"{self.quantity} {self.relation} {self.value:.4g} {unit}{held}"


@dataclass(frozen=True, slots=True)
class Exit:
    """A way out of a primitive.

    Attributes:
        when: Conditions that all have to hold.
        to: A primitive or an end.
    """

    when: tuple[Condition, ...]
    to: str

    def __str__(self) -> str:
        return " and ".join(map(str, self.when))


@dataclass(frozen=True, slots=True, eq=False)
class Primitive:
    """One hybrid move with its tool command and its exits.

    Attributes:
        frame: The task frame.
        axes: Six, in the order of `AXES`.
        tool: "keep", "width" or "force".
        tool_value: m or N; 0 for "keep".
        speed_m_s: Greatest speed of the tool's point.
        tare: Whether the wrench is zeroed at the start.
        exits: Asked in this order.
        limit_s: After that long the net ends with "timeout:PRIMITIVE".
    """

    frame: TaskFrame
    axes: tuple[Axis, ...]
    tool: str
    tool_value: float
    speed_m_s: float
    tare: bool
    exits: tuple[Exit, ...]
    limit_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Net:
    """Primitives and the ways between them; checked when it is made.

    Attributes:
        name: Of the skeleton it was made from.
        start: The first primitive.
        primitives: By name.
        ends: Names of the ends; true: a success, false: a failure.
        grounded: Which entity each parameter of the skeleton was bound to.

    Raises:
        NetError: See `check`.
    """

    name: str
    start: str
    primitives: dict[str, Primitive]
    ends: dict[str, bool]
    grounded: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.check()

    def check(self) -> None:
        """Raise on the first fault.

        Raises:
            NetError: A name, mode, quantity, relation or unit's range is wrong, a primitive has no
                exit or no time limit, an exit leads nowhere or is never taken, a primitive or an
                end cannot be reached, or neither a success nor a failure can.
        """
        for fault in self._faults():
            raise NetError(f"net {self.name}: {fault}")

    def outcome(self, result: str) -> bool:
        """Return whether a result is a success; every result that is no end is a failure."""
        return self.ends.get(result, False)

    def reachable(self, start: str) -> tuple[str, ...]:
        """Return the primitives and ends that can be reached from one, itself first."""
        found = [start]
        for name in found:
            if name in self.primitives:
                ways = (way.to for way in self.primitives[name].exits)
                found += [to for to in dict.fromkeys(ways) if to not in found]
        return tuple(found)

    def _faults(self) -> Iterator[str]:
        for name in (self.name, *self.primitives, *self.ends):
            if not _NAME.fullmatch(name):
                yield f"{name!r} is no name; use letters, digits, _ and -"
        for name in self.primitives.keys() & self.ends.keys():
            yield f"{name} is both a primitive and an end; rename one"
        if self.start not in self.primitives:
            yield f"it starts with {self.start!r}, which is no primitive; {self._known()}"
        for name, primitive in self.primitives.items():
            for fault in _primitive_faults(primitive):
                yield f"primitive {name}: {fault}"
            for number, way in enumerate(primitive.exits, 1):
                if way.to not in self.primitives and way.to not in self.ends:
                    yield (
                        f"primitive {name}: exit {number} leads to {way.to!r}, which is neither a"
                        f" primitive nor an end; {self._known()}"
                    )
        yield from self._unreached()

    def _unreached(self) -> Iterator[str]:
        found = self.reachable(self.start)
        for name in self.primitives:
            if name not in found:
                yield f"primitive {name}: no exit leads to it from {self.start}"
            elif not any(to in self.ends for to in self.reachable(name)):
                yield f"primitive {name}: no end can be reached from it"
        for name in self.ends:
            if name not in found:
                yield f"end {name}: no exit leads to it from {self.start}"
        for wanted, kind in ((True, "success"), (False, "failure")):
            if wanted not in self.ends.values():
                yield f"it has no {kind} among its ends {', '.join(self.ends) or '(none)'}"

    def _known(self) -> str:
        return f"known: {', '.join((*self.primitives, *self.ends))}"


@dataclass(frozen=True, slots=True)
class TraceStep:
    """A primitive that was left.

    Attributes:
        primitive: Its name.
        to: The primitive or end that followed, or the result that ended the net.
        elapsed_s: How long it took.
        because: The conditions of the exit, or why the net ended.
    """

    primitive: str
    to: str
    elapsed_s: float
    because: str


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """How far the robot is with a net (robot).

    Attributes:
        net_name: The net.
        net_version: Version of the datum that held it.
        primitive: What it executes, or executed last.
        since_ns: Stamp of the measurement with which that primitive started.
        trace: The primitives before.
        result: "" while it runs; an end of the net; "timeout:PRIMITIVE", "braked:REASON",
            "interrupted:PRIMITIVE", "no_frame:ENTITY", "sensor:REASON", "not_following:JOINT" or
            "refused:REASON".
        wrench: (6,) float64, N and Nm, on the tool, in the base frame, since the tare.
        width_m: Of the gripper.
        tcp: (4, 4) float64, metres, base_from_tool.
    """

    net_name: str
    net_version: int
    primitive: str
    since_ns: int
    trace: tuple[TraceStep, ...]
    result: str
    wrench: npt.NDArray[np.float64]
    width_m: float
    tcp: npt.NDArray[np.float64]


def unit_of(axis: str, mode: str) -> str:
    """Return the unit of an axis's value.

    Raises:
        KeyError: No such mode.
    """
    return UNITS[mode][axis.startswith("r")]


def _primitive_faults(primitive: Primitive) -> Iterator[str]:
    yield from _frame_faults(primitive.frame)
    if len(primitive.axes) != len(AXES):
        yield f"it has {len(primitive.axes)} axes; a primitive has {len(AXES)}: {', '.join(AXES)}"
    for name, axis in zip(AXES, primitive.axes, strict=False):
        if axis.mode not in UNITS:
            yield f"axis {name}: unknown mode {axis.mode!r}; known: {', '.join(UNITS)}"
        else:
            unit = unit_of(name, axis.mode)
            yield from _range_faults(f"axis {name}", axis.value, unit, -_UNIT_MAX[unit])
    if primitive.tool not in TOOLS:
        yield f"unknown tool command {primitive.tool!r}; known: {', '.join(TOOLS)}"
    elif primitive.tool == "keep":
        if primitive.tool_value:
            yield f"tool: keep has the value {primitive.tool_value!r}; it has none"
    else:
        most = WIDTH_M_MAX if primitive.tool == "width" else FORCE_N_MAX
        unit = TOOLS[primitive.tool]
        yield from _range_faults(f"tool {primitive.tool}", primitive.tool_value, unit, 0.0, most)
    if not primitive.speed_m_s > 0.0:
        yield f"speed_m_s is {primitive.speed_m_s!r}; it must be greater than 0"
    yield from _range_faults("speed_m_s", primitive.speed_m_s, "m/s", 0.0)
    if not primitive.limit_s > 0.0:
        yield f"limit_s is {primitive.limit_s!r}; every primitive needs a time limit over 0 s"
    yield from _range_faults("limit_s", primitive.limit_s, "s", 0.0)
    if not primitive.exits:
        yield "it has no exit"
    for number, way in enumerate(primitive.exits, 1):
        if not way.when:
            yield f"exit {number} to {way.to} has no condition"
        for condition in way.when:
            for fault in _condition_faults(condition, primitive.limit_s):
                yield f"exit {number} to {way.to}: {fault}"


def _frame_faults(frame: TaskFrame) -> Iterator[str]:
    if not frame.entity:
        yield "its frame names no entity"
    offset = np.asarray(frame.offset)
    if offset.shape != (4, 4) or not np.isfinite(offset).all():
        yield f"the offset of its frame has shape {offset.shape}; it must be (4, 4) and finite"
        return
    turn = offset[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _RIGID and np.linalg.det(turn) > 0.0
    if not (rigid and np.array_equal(offset[3], [0.0, 0.0, 0.0, 1.0])):
        yield "the offset of its frame is no rigid transform"
    far_m = float(np.linalg.norm(offset[:3, 3]))
    yield from _range_faults("the offset of its frame", far_m, "m", 0.0)


def _condition_faults(condition: Condition, limit_s: float) -> Iterator[str]:
    quantity, relation = condition.quantity, condition.relation
    if quantity not in QUANTITIES:
        yield f"unknown quantity {quantity!r}; known: {', '.join(QUANTITIES)}"
        return
    if relation not in RELATIONS:
        yield f"{quantity}: unknown relation {relation!r}; known: {' '.join(RELATIONS)}"
    unit = QUANTITIES[quantity]
    most = WIDTH_M_MAX if quantity == "width" else _UNIT_MAX[unit]
    signed = quantity[-2:] in {"_x", "_y", "_z"} or quantity == "width_rate"
    yield from _range_faults(quantity, condition.value, unit, -most if signed else 0.0, most)
    yield from _range_faults(f"hold_s of {quantity}", condition.hold_s, "s", 0.0)
    late_s = condition.hold_s + (condition.value if (quantity, relation) == _LATER else 0.0)
    if late_s >= limit_s:
        yield f"{condition} is never met: the time limit is {limit_s:g} s"


def _range_faults(
    what: str, value: float, unit: str, least: float, most: float | None = None
) -> Iterator[str]:
    most = _UNIT_MAX[unit] if most is None else most
    if not least - 1e-12 <= value <= most + 1e-12:
        yield f"{what} is {value:g} {unit}; {least:g} to {most:g} {unit} is allowed"
