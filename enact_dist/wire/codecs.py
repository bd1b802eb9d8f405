"""Codecs for data that are neither plain nor frozen dataclasses: one per Python type.

A codec turns a value into plain data (numbers, text, bytes, lists, dicts, arrays) and back::

    register_codec(Pose, "pose", encode=lambda pose: pose.matrix, decode=Pose.from_matrix)

The name travels and is stored; the Python type may be renamed or moved without harm.
Rule to keep: a program that reads an aspect must have registered the same name before.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from enact_dist.errors import MisuseError
from enact_dist.terms import CODED

T = TypeVar("T")

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,99}\Z")
_OWN: Final = frozenset({int, float, bool, str, bytes, list, dict, tuple, type(None), object})


@dataclass(frozen=True, slots=True)
class Codec:
    """How values of `datum_type` become plain data and back."""

    datum_type: type[Any]
    name: str
    encode: Callable[[Any], object]
    decode: Callable[[Any], object]


by_type: dict[type[Any], Codec] = {}
"""The codec of exactly this type."""
_by_name: dict[str, Codec] = {}
changed: list[Callable[[], None]] = []
"""Called after each registration: a type read before may have another shape now."""


def register_codec(
    datum_type: type[T],
    name: str,
    *,
    encode: Callable[[T], object],
    decode: Callable[[Any], T],
) -> None:
    """Let values of `datum_type` be data of aspects, and fields of dataclasses.

    Registering the same type under the same name again replaces its functions.

    Args:
        datum_type: The type; its subclasses are encoded by the same codec.
        name: Name of the type on the wire: letters, digits, ``_ . -``, at most 100.
        encode: Makes plain data of a value: int, float, bool, str, bytes, lists and dicts of
            them, numpy arrays.
        decode: Restores the value from these; arrays in them are read-only.

    Raises:
        MisuseError: The name is not allowed or belongs to another type, or the type is plain.
    """
    if not isinstance(datum_type, type) or datum_type in _OWN:
        raise MisuseError(f"{datum_type!r} needs no codec: it is plain, or no class at all")
    if not _NAME.match(name):
        raise MisuseError(f"{name!r} cannot name a codec; use letters, digits, '_', '.', '-'")
    other, before = _by_name.get(name), by_type.get(datum_type)
    if other is not None and _identity(other.datum_type) != _identity(datum_type):
        raise MisuseError(
            f"the codec name {name!r} belongs to {_identity(other.datum_type)}; asked for"
            f" {_identity(datum_type)}; choose another name"
        )
    if before is not None and before.name != name:
        raise MisuseError(
            f"{_identity(datum_type)} has the codec {before.name!r} already; asked for {name!r}"
        )
    codec = Codec(datum_type, name, encode, decode)
    by_type[datum_type] = _by_name[name] = codec
    CODED.add(datum_type)
    for tell in changed:
        tell()


def _identity(datum_type: type[Any]) -> str:
    return f"{datum_type.__module__}.{datum_type.__qualname__}"
