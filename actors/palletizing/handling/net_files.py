"""Nets as readable text: TOML in and out, exact both ways.

    name = "place"
    start = "touch"

    [ends]
    placed = true
    no_floor = false

    [primitives.touch]
    frame = { entity = "place/3", at_m = [0.0, 0.0, 0.04] }
    axes = { z = "-0.05 m/s", rx = "180 deg" }
    tool = "keep"
    speed_m_s = 0.1
    tare = true
    limit_s = 3.0
    exits = [
        { when = ["force_z > 6 N for 0.032 s"], to = "placed" },
        { when = ["distance > 0.03 m"], to = "no_floor" },
    ]

The unit of an axis tells its mode: m and rad are positions, m/s and rad/s velocities, N and Nm
forces.  An axis that is left out holds (0 m/s or 0 rad/s).  `frame` takes `at_m` and `turn_deg`
(roll, pitch, yaw) or a whole `offset` of four rows, and `follows`.  `tool` is "keep", "width 0.1 m"
or "force 45 N".  Left out, `tool` is "keep" and `tare` and `follows` are false.

Errors name the file and the key, or the line of what is no TOML.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.geometry.poses import turned
from actors.palletizing.handling.nets import (
    AXES,
    QUANTITIES,
    TOOLS,
    UNITS,
    Axis,
    Condition,
    Exit,
    Net,
    NetError,
    Primitive,
    TaskFrame,
    unit_of,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_VALUE: Final = re.compile(rf"({NUMBER})\s*(\S+)")
_CONDITION: Final = re.compile(
    rf"(\w+)\s*(\S+?)\s*({NUMBER})\s*([A-Za-z/]+)(?:\s+for\s+({NUMBER})\s*s)?"
)
_MODES: Final = {
    (unit, turns): mode for mode, units in UNITS.items() for turns, unit in enumerate(units)
}
_LARGE_BYTES: Final = 1_000_000


def read_net(path: str | Path) -> Net:
    """Return the net of a file.

    Raises:
        NetError: One line with the file and the key or line that is wrong.
        OSError: The file cannot be read.
    """
    return net_of_document(read_document(path), str(path))


def write_net(net: Net, path: str | Path) -> None:
    """Write a net to a file that `read_net` reads back equal.

    Raises:
        OSError: The file cannot be written.
    """
    Path(path).write_text(text_of_net(net), "utf-8")


def net_of_text(text: str, source: str = "net") -> Net:
    """Return the net of a text; `source` names it in errors.

    Raises:
        NetError: One line with the source and the key or line that is wrong.
    """
    return net_of_document(document_of_text(text, source), source)


def read_document(path: str | Path) -> dict[str, Any]:
    """Return the TOML document of a file; of a skeleton, with its parameters unbound.

    Raises:
        NetError: It is too large, no UTF-8 or no TOML.
        OSError: The file cannot be read.
    """
    data = Path(path).read_bytes()
    if len(data) > _LARGE_BYTES:
        raise NetError(f"{path}: {len(data)} bytes; a net has at most {_LARGE_BYTES}")
    try:
        return document_of_text(data.decode("utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise NetError(f"{path}: byte {error.start} is no UTF-8") from None


def document_of_text(text: str, source: str) -> dict[str, Any]:
    """Return the TOML document of a text.

    Raises:
        NetError: It is no TOML; the message has the line.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise NetError(f"{source}: no TOML: {error}") from None


def net_of_document(document: dict[str, Any], source: str) -> Net:
    """Return the net that a document describes.

    Raises:
        NetError: One line with the source and the key that is wrong.
    """
    table = _Table(source, "", document)
    name, start = table.text("name"), table.text("start")
    ends = {key: table.of("ends").flag(key) for key in table.of("ends").keys}
    bound = table.of("grounded", {})
    grounded = {key: bound.text(key) for key in bound.keys}
    tables = table.of("primitives")
    primitives = {key: _primitive(tables.of(key)) for key in tables.keys}
    table.only("name", "start", "ends", "grounded", "primitives")
    try:
        return Net(name, start, primitives, ends, grounded)
    except NetError as error:
        raise NetError(f"{source}: {error}") from None


def text_of_net(net: Net) -> str:
    """Return the text of a net; `net_of_text` gives the net back, each number exact."""
    lines = [f"name = {_quoted(net.name)}", f"start = {_quoted(net.start)}", "", "[ends]"]
    lines += [f"{name} = {str(success).lower()}" for name, success in net.ends.items()]
    if net.grounded:
        lines += ["", "[grounded]"]
        lines += [f"{_quoted(key)} = {_quoted(entity)}" for key, entity in net.grounded.items()]
    for name, primitive in net.primitives.items():
        lines += ["", f"[primitives.{name}]", *_primitive_lines(primitive)]
    return "\n".join([*lines, ""])


class _Table:
    """A table of the document that knows where it stands."""

    def __init__(self, source: str, key: str, values: Any) -> None:
        self._source, self._key, self._values = source, key, values
        if not isinstance(values, dict):
            raise self.fault("", f"it is {values!r}; it must be a table")

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self._values)

    def fault(self, key: str, text: str) -> NetError:
        """Return an error about one of its keys; about itself for an empty key."""
        return NetError(f"{self._source}: {self._at(key)}: {text}")

    def get(self, key: str, default: Any = None) -> Any:
        value = self._values.get(key, default)
        if value is None:
            raise self.fault(key, "it is missing")
        return value

    def of(self, key: str, default: Any = None) -> _Table:
        return _Table(self._source, self._at(key), self.get(key, default))

    def each(self, key: str) -> Iterator[_Table]:
        for number, value in enumerate(self._list(key, self.get(key)), 1):
            yield _Table(self._source, f"{self._at(key)}[{number}]", value)

    def text(self, key: str, default: str | None = None) -> str:
        value = self.get(key, default)
        if not isinstance(value, str):
            raise self.fault(key, f"it is {value!r}; it must be a string")
        return value

    def texts(self, key: str) -> Iterator[tuple[str, str]]:
        for number, value in enumerate(self._list(key, self.get(key)), 1):
            if not isinstance(value, str):
                raise self.fault(f"{key}[{number}]", f"it is {value!r}; it must be a string")
            yield f"{key}[{number}]", value

    def flag(self, key: str, default: bool | None = None) -> bool:
        value = self.get(key, default)
        if not isinstance(value, bool):
            raise self.fault(key, f"it is {value!r}; it must be true or false")
        return value

    def number(self, key: str) -> float:
        return self._number(key, self.get(key))

    def numbers(self, key: str, default: Sequence[float]) -> list[float]:
        values = self._list(key, self.get(key, default), len(default))
        return [self._number(key, value) for value in values]

    def matrix(self, key: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        rows = [self._list(key, row, 4) for row in self._list(key, self.get(key), 4)]
        return np.array([[self._number(key, value) for value in row] for row in rows])

    def only(self, *known: str) -> None:
        """Refuse keys that mean nothing."""
        for key in self._values:
            if key not in known:
                raise self.fault(key, f"unknown key; known: {', '.join(known)}")

    def _number(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fault(key, f"it is {value!r}; it must be a number")
        return float(value)

    def _list(self, key: str, value: Any, length: int | None = None) -> list[Any]:
        if not isinstance(value, list | tuple) or length not in {None, len(value)}:
            many = "" if length is None else f" of {length}"
            raise self.fault(key, f"it is {value!r}; it must be an array{many}")
        return list(value)

    def _at(self, key: str) -> str:
        return f"{self._key}.{key}".strip(".")


def _primitive(table: _Table) -> Primitive:
    table.only("frame", "axes", "tool", "speed_m_s", "tare", "limit_s", "exits")
    kind, value = _tool(table)
    return Primitive(
        frame=_frame(table.of("frame")),
        axes=_axes(table.of("axes", {})),
        tool=kind,
        tool_value=value,
        speed_m_s=table.number("speed_m_s"),
        tare=table.flag("tare", default=False),
        exits=tuple(_exit(way) for way in table.each("exits")),
        limit_s=table.number("limit_s"),
    )


def _frame(table: _Table) -> TaskFrame:
    table.only("entity", "at_m", "turn_deg", "offset", "follows")
    entity, follows = table.text("entity"), table.flag("follows", default=False)
    if "offset" in table.keys:
        for key in ("at_m", "turn_deg"):
            if key in table.keys:
                raise table.fault(key, "the offset holds it already; leave one of them out")
        return TaskFrame(entity, table.matrix("offset"), follows)
    offset = np.eye(4)
    turn_deg = table.numbers("turn_deg", (0.0, 0.0, 0.0))
    if any(turn_deg):
        offset[:3, :3] = turned(*np.deg2rad(turn_deg))
    offset[:3, 3] = table.numbers("at_m", (0.0, 0.0, 0.0))
    return TaskFrame(entity, offset, follows)


def _axes(table: _Table) -> tuple[Axis, ...]:
    table.only(*AXES)
    return tuple(_axis(table, name) for name in AXES)


def _axis(table: _Table, name: str) -> Axis:
    turns = name.startswith("r")
    text = table.text(name, f"0 {UNITS['velocity'][turns]}")
    matched = _VALUE.fullmatch(text.strip())
    value, unit = (float(matched[1]), matched[2]) if matched else (0.0, "")
    if turns and unit == "deg":
        value, unit = float(np.deg2rad(value)), "rad"
    if (unit, turns) not in _MODES:
        units = ", ".join(unit for unit, turning in _MODES if turning == turns)
        raise table.fault(name, f"{text!r} is no number with one of the units {units}")
    return Axis(_MODES[unit, turns], value)


def _tool(table: _Table) -> tuple[str, float]:
    text = table.text("tool", "keep")
    kind, _, rest = text.strip().partition(" ")
    if kind == "keep" and not rest:
        return kind, 0.0
    matched = _VALUE.fullmatch(rest.strip())
    if not matched or TOOLS.get(kind) != matched[2]:
        raise table.fault("tool", f'{text!r} is neither "keep" nor "width … m" nor "force … N"')
    return kind, float(matched[1])


def _exit(table: _Table) -> Exit:
    table.only("when", "to")
    when = tuple(_condition(table, key, text) for key, text in table.texts("when"))
    return Exit(when, table.text("to"))


def _condition(table: _Table, key: str, text: str) -> Condition:
    matched = _CONDITION.fullmatch(text.strip())
    if not matched:
        raise table.fault(key, f'{text!r} is no condition such as "force_z > 6 N for 0.032 s"')
    quantity, relation, value, unit, hold = matched.groups()
    if quantity not in QUANTITIES:
        known = ", ".join(QUANTITIES)
        raise table.fault(key, f"{text!r}: unknown quantity {quantity!r}; known: {known}")
    if unit != QUANTITIES[quantity]:
        wanted = QUANTITIES[quantity]
        raise table.fault(key, f"{text!r}: {quantity} has the unit {wanted}, not {unit}")
    return Condition(quantity, relation, float(value), float(hold or 0.0))


def _primitive_lines(primitive: Primitive) -> Iterator[str]:
    yield f"frame = {_frame_text(primitive.frame)}"
    units = [unit_of(name, axis.mode) for name, axis in zip(AXES, primitive.axes, strict=True)]
    axes = zip(AXES, primitive.axes, units, strict=True)
    shown = ", ".join(f'{name} = "{axis.value!r} {unit}"' for name, axis, unit in axes)
    yield f"axes = {{ {shown} }}"
    value = f" {primitive.tool_value!r} {TOOLS[primitive.tool]}" if TOOLS[primitive.tool] else ""
    yield f'tool = "{primitive.tool}{value}"'
    yield f"speed_m_s = {primitive.speed_m_s!r}"
    yield f"tare = {str(primitive.tare).lower()}"
    yield f"limit_s = {primitive.limit_s!r}"
    yield "exits = ["
    for way in primitive.exits:
        when = ", ".join(_quoted(_condition_text(condition)) for condition in way.when)
        yield f"    {{ when = [{when}], to = {_quoted(way.to)} }},"
    yield "]"


def _frame_text(frame: TaskFrame) -> str:
    offset = np.asarray(frame.offset, np.float64)
    parts = [f"entity = {_quoted(frame.entity)}"]
    if not np.array_equal(offset[:3, :3], np.eye(3)):
        parts.append(f"offset = {offset.tolist()}")
    elif offset[:3, 3].any():
        parts.append(f"at_m = {offset[:3, 3].tolist()}")
    if frame.follows:
        parts.append("follows = true")
    return f"{{ {', '.join(parts)} }}"


def _condition_text(condition: Condition) -> str:
    unit = QUANTITIES[condition.quantity]
    held = f" for {condition.hold_s!r} s" if condition.hold_s else ""
    return f"{condition.quantity} {condition.relation} {condition.value!r} {unit}{held}"


def _quoted(text: str) -> str:
    """Return a basic string of TOML; JSON's differs in one character only."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
