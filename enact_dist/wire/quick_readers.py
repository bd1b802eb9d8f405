"""Readers of the messages of every lock as straight-line code, made from annotations at import.

A quick reader accepts what is certainly right and leaves all else to the reader of
`core.protocol.parts`, which says what is wrong.  It does in 2 us what takes that one 4, and each
update reads four messages.  In source it is what one would write by hand, for `Validate`::

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

In a request the quick reader also sees that each text can be printed; what cannot goes to the
judge, who refuses unsafe texts.

Rule to keep: nothing of the payload is taken before every check of this level is done, so that the
judge begins where the quick reader began.
"""

from __future__ import annotations

from typing import Any, Final, get_args, get_origin

from enact_dist.core.protocol.datum import Datum
from enact_dist.errors import ProtocolError
from enact_dist.wire.bodies import BodyReader
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
from enact_dist.wire.texts import refuse_unsafe

_JUDGE: Final = "        return judge(raw, bodies)"


def quick_reader_of(cls: type[Any], judge: Read, *, printable: bool = False) -> Read:
    """Return a reader that does what `judge` does, sooner.

    Args:
        cls: The message.
        judge: Reads any array, `reader_of(cls)` at heart, and says what is wrong with it.
        printable: Whether the judge decides on each text that cannot be printed.
    """
    names: dict[str, Any] = {"judge": judge, "new": tuple.__new__}
    lines: list[str] = ["def read(raw, bodies):"]
    value = _Code(names, lines, printable=printable).checked(cls, "raw")
    if printable:  # the judge looks at all texts before it looks at any part
        lines += ["    start = bodies.end", "    try:", f"        return {value}"]
        lines += ["    except ProtocolError:", "        bodies.end = start", _JUDGE]
        names["ProtocolError"] = ProtocolError
    else:
        lines.append(f"    return {value}")
    # Made of the names of our own classes and of numbers only.
    exec("\n".join(lines), names)  # noqa: S102
    read: Read = names["read"]
    return read


class _Code:
    """The source of one reader, as far as it is written."""

    def __init__(self, names: dict[str, Any], lines: list[str], *, printable: bool) -> None:
        self._names = names
        self._lines = lines
        self._printable = printable

    def checked(self, cls: type[Any], raw: str) -> str:
        """Add the checks of a message or part; return the expression that builds it after them."""
        fields = annotated(cls)
        found = [f"{raw}{index}" for index in range(len(fields))]
        self._lines += [f"    if type({raw}) is not tuple or len({raw}) != {len(fields)}:", _JUDGE]
        if not fields:
            return f"{self._named(cls)}()"
        self._lines.append(f"    {', '.join(found)}, = {raw}")
        lengths = dict(lengths_of(cls))
        conditions = [
            condition
            for index, (one, (_, kind)) in enumerate(zip(found, fields, strict=True))
            if (condition := self._condition(kind, one, lengths.get(index)))
        ]
        if conditions:
            self._lines += [f"    if not ({' and '.join(conditions)}):", _JUDGE]
        values = [self._value(kind, one) for one, (_, kind) in zip(found, fields, strict=True)]
        name = self._named(cls)
        if not issubclass(cls, tuple):
            return f"{name}({', '.join(values)})"
        if values == found:
            return f"new({name}, {raw})"
        return f"new({name}, ({', '.join(values)},))"

    def _condition(self, kind: Any, one: str, length_max: int | None) -> str:
        """Return what must hold of a field before it is looked into; "" where its own part says it.

        A list of texts goes to the judge unless it is empty, where texts must be printable.
        """
        inner = without_none(kind)
        if inner not in SCALARS and inner is kind and _is_part(inner):
            return ""
        raw_type = inner.__name__ if inner in SCALARS else "tuple"
        conditions = [f"type({one}) is {raw_type}"]
        if inner is int:
            conditions.append(f"{one} <= {INTEGER_MAX}")
        if length_max is not None:
            conditions.append(f"len({one}) <= {length_max}")
        if self._printable and inner is str:
            conditions.append(f"{one}.isprintable()")
        elif self._printable and get_origin(inner) is tuple and get_args(inner)[0] is str:
            conditions.append(f"not {one}")
        said = " and ".join(conditions)
        return said if inner is kind else f"({one} is None or {said})"

    def _value(self, kind: Any, one: str) -> str:
        """Return the expression for the value of a field; adds the checks of a part."""
        inner = without_none(kind)
        if inner in SCALARS:
            return one
        if inner is Datum:
            value = f"bodies.take({one})"
        elif get_origin(inner) is tuple:
            (each,) = (arg for arg in get_args(inner) if arg is not Ellipsis)
            name = f"{one}_read"
            if each in SCALARS:
                self._names[name] = reader_of_each(each)
                value = f"({name}({one}, bodies) if {one} else ())"
            else:
                self._names[name] = self._reader_of(each)
                one_alone = f"({name}({one}[0], bodies),) if len({one}) == 1"
                value = f"{one_alone} else tuple([{name}(each, bodies) for each in {one}])"
                value = f"(() if not {one} else {value})"
        elif inner is kind:
            return self.checked(inner, one)
        else:
            self._names[f"{one}_read"] = self._reader_of(inner)
            value = f"{one}_read({one}, bodies)"
        return value if inner is kind else f"None if {one} is None else {value}"

    def _reader_of(self, cls: type[Any]) -> Read:
        read = reader_of(cls)
        return quick_reader_of(
            cls, safe_reader(read) if self._printable else read, printable=self._printable
        )

    def _named(self, cls: type[Any]) -> str:
        self._names[cls.__name__] = cls
        return cls.__name__


def safe_reader(read: Read) -> Read:
    """Return a reader that refuses unsafe texts before it does what `read` does."""

    def safe(raw: Any, bodies: BodyReader) -> Any:
        if type(raw) is tuple:
            refuse_unsafe(raw)
        return read(raw, bodies)

    return safe


def _is_part(kind: Any) -> bool:
    return kind is not Datum and get_origin(kind) is not tuple
