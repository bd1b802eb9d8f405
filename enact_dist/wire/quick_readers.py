"""Readers of the messages of every lock as straight-line code, made from annotations at import.

A quick reader accepts what is certainly right and leaves all else to the reader of `message_parts`,
which says what is wrong.  It does in 2 us what takes that one 4, and each update reads four
messages.  In source it is what one would write by hand, for `Validate`::

    def read(raw, bodies):
        if type(raw) is not tuple or len(raw) != 3:
            return judge(raw, bodies)
        raw0, raw1, raw2, = raw
        if not (type(raw2) is tuple and len(raw2) <= 4096):
            return judge(raw, bodies)
        if type(raw0) is not tuple or len(raw0) != 3:
            return judge(raw, bodies)
        raw00, raw01, raw02, = raw0
        …
        return Validate(new(LockId, raw0), new(Token, raw1),
                        tuple([raw2_read(one, bodies) for one in raw2]))

Rule to keep: nothing of the payload is taken before every check of this level is done, so that the
judge begins where the quick reader began.
"""

from __future__ import annotations

from typing import Any, Final, get_args, get_origin

from enact_dist.core.datum import Datum
from enact_dist.wire.limits import INTEGER_MAX
from enact_dist.wire.message_parts import (
    SCALARS,
    Read,
    annotated,
    lengths_of,
    reader_of,
    reader_of_each,
    without_none,
)

_JUDGE: Final = "        return judge(raw, bodies)"


def quick_reader_of(cls: type[Any]) -> Read:
    """Return a reader that does what `reader_of(cls)` does, sooner."""
    names: dict[str, Any] = {"judge": reader_of(cls), "new": tuple.__new__}
    lines: list[str] = ["def read(raw, bodies):"]
    value = _checked(cls, "raw", lines, names)
    lines.append(f"    return {value}")
    # Made of the names of our own classes and of numbers only.
    exec("\n".join(lines), names)  # noqa: S102
    read: Read = names["read"]
    return read


def _checked(cls: type[Any], raw: str, lines: list[str], names: dict[str, Any]) -> str:
    """Add the checks of a message or part; return the expression that builds it after them."""
    fields = annotated(cls)
    found = [f"{raw}{index}" for index in range(len(fields))]
    lines += [f"    if type({raw}) is not tuple or len({raw}) != {len(fields)}:", _JUDGE]
    if not fields:
        return f"{_named(cls, names)}()"
    lines.append(f"    {', '.join(found)}, = {raw}")
    lengths = dict(lengths_of(cls))
    conditions = [
        condition
        for index, (one, (_, kind)) in enumerate(zip(found, fields, strict=True))
        if (condition := _condition(kind, one, lengths.get(index)))
    ]
    if conditions:
        lines += [f"    if not ({' and '.join(conditions)}):", _JUDGE]
    values = [_value(kind, one, lines, names) for one, (_, kind) in zip(found, fields, strict=True)]
    name = _named(cls, names)
    if not issubclass(cls, tuple):
        return f"{name}({', '.join(values)})"
    if values == found:
        return f"new({name}, {raw})"
    return f"new({name}, ({', '.join(values)},))"


def _condition(kind: Any, one: str, length_max: int | None) -> str:
    """Return what must hold of a field before it is looked into; "" where its own part says it."""
    inner = without_none(kind)
    if inner not in SCALARS and inner is kind and _is_part(inner):
        return ""
    raw_type = inner.__name__ if inner in SCALARS else "tuple"
    conditions = [f"type({one}) is {raw_type}"]
    if inner is int:
        conditions.append(f"{one} <= {INTEGER_MAX}")
    if length_max is not None:
        conditions.append(f"len({one}) <= {length_max}")
    said = " and ".join(conditions)
    return said if inner is kind else f"({one} is None or {said})"


def _is_part(kind: Any) -> bool:
    return kind is not Datum and get_origin(kind) is not tuple


def _value(kind: Any, one: str, lines: list[str], names: dict[str, Any]) -> str:
    """Return the expression for the value of a field; adds the checks of a part to `lines`."""
    inner = without_none(kind)
    if inner in SCALARS:
        return one
    if inner is Datum:
        value = f"bodies.take({one})"
    elif get_origin(inner) is tuple:
        (each,) = (arg for arg in get_args(inner) if arg is not Ellipsis)
        name = f"{one}_read"
        if each in SCALARS:
            names[name] = reader_of_each(each)
            value = f"{name}({one}, bodies)"
        else:
            names[name] = quick_reader_of(each)
            value = f"tuple([{name}(each, bodies) for each in {one}])"
    elif inner is kind:
        return _checked(inner, one, lines, names)
    else:
        names[f"{one}_read"] = quick_reader_of(inner)
        value = f"{one}_read({one}, bodies)"
    return value if inner is kind else f"None if {one} is None else {value}"


def _named(cls: type[Any], names: dict[str, Any]) -> str:
    names[cls.__name__] = cls
    return cls.__name__
