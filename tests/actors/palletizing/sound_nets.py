"""Nets for tests: small ones by hand, and random sound ones."""

import numpy as np
from hypothesis import strategies as st

from actors.geometry.poses import turned
from actors.palletizing.handling.nets import (
    AXES,
    QUANTITIES,
    UNITS,
    Axis,
    Condition,
    Exit,
    Net,
    Primitive,
    TaskFrame,
)

HOLD = tuple(Axis("velocity", 0.0) for _ in AXES)
SPANS = {"m": 0.2, "rad": 3.0, "m/s": 1.0, "rad/s": 2.0, "N": 50.0, "Nm": 10.0, "s": 5.0}


def axes(**given):
    """Return six axes: those given as (mode, value), the others hold."""
    return tuple(Axis(*given[name]) if name in given else HOLD[0] for name in AXES)


def way(to, *conditions):
    """Return an exit; conditions are "quantity relation value [hold_s]"."""
    parts = (text.split() for text in conditions)
    return Exit(tuple(Condition(q, r, *map(float, numbers)) for q, r, *numbers in parts), to)


def primitive(*exits, frame="base", at=(0.0, 0.0, 0.0), follows=False, **changes):
    """Return a primitive that holds, with what is changed."""
    offset = np.eye(4)
    offset[:3, 3] = at
    values = {"axes": HOLD, "tool": "keep", "tool_value": 0.0, "speed_m_s": 0.2, "tare": False}
    values |= {"limit_s": 3.0, **changes}
    return Primitive(frame=TaskFrame(frame, offset, follows), exits=exits, **values)


def net(primitives, *, ends=None, name="trial"):
    """Return a net that starts with its first primitive; ends are done and failed."""
    return Net(name, next(iter(primitives)), primitives, ends or {"done": True, "failed": False})


def _spread(unit, least=0.0):
    return st.floats(least * SPANS[unit], SPANS[unit])


@st.composite
def _axis(draw, name):
    mode = draw(st.sampled_from(sorted(UNITS)))
    return Axis(mode, draw(_spread(UNITS[mode][name.startswith("r")], -1.0)))


@st.composite
def _condition(draw):
    quantity = draw(st.sampled_from(sorted(QUANTITIES)))
    value = draw(_spread(QUANTITIES[quantity]))
    hold_s = draw(st.sampled_from([0.0, 0.032, 0.1]))
    return Condition(quantity, draw(st.sampled_from("<>")), value, hold_s)


@st.composite
def sound_nets(draw):
    """Return a net that its check accepts: a chain with further exits anywhere."""
    names = [f"p{number}" for number in range(draw(st.integers(1, 5)))]
    ends = {"done": True, "lost": False}
    primitives = {}
    for number, name in enumerate(names):
        to = [names[number + 1]] if number + 1 < len(names) else ["done", "lost"]
        to += draw(st.lists(st.sampled_from([*names, *ends]), max_size=2))
        offset = np.eye(4)
        if draw(st.booleans()):
            offset[:3, :3] = turned(*(draw(_spread("rad", -1.0)) for _ in range(3)))
        offset[:3, 3] = [draw(_spread("m", -1.0)) for _ in range(3)]
        tool = draw(st.sampled_from(["keep", "width", "force"]))
        primitives[name] = Primitive(
            frame=TaskFrame(
                draw(st.sampled_from(["place/3", "tool"])), offset, draw(st.booleans())
            ),
            axes=tuple(draw(_axis(axis)) for axis in AXES),
            tool=tool,
            tool_value=draw(st.floats(0.0, 0.2)) if tool != "keep" else 0.0,
            speed_m_s=draw(st.floats(0.001, 1.5)),
            tare=draw(st.booleans()),
            exits=tuple(
                Exit(tuple(draw(st.lists(_condition(), min_size=1, max_size=2))), aim) for aim in to
            ),
            limit_s=draw(st.floats(6.0, 60.0)),
        )
    return Net("random", names[0], primitives, ends, {"package": "package/17"})


def as_plain(value):
    """Return a net, or a part of it, as tuples and lists that compare by value."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return [(key, as_plain(part)) for key, part in value.items()]
    if isinstance(value, tuple):
        return [as_plain(part) for part in value]
    if hasattr(value, "__dataclass_fields__"):
        return [as_plain(getattr(value, name)) for name in value.__dataclass_fields__]
    return value
