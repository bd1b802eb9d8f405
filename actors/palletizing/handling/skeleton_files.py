"""Skeletons: net files with parameters, and putting values into them.

A skeleton has a table `[parameters]`, name by name with a type: "entity", "pose" (4 x 4) or a unit.
A text holds ``{name}`` where the parameter stands; a number may be a sum, such as
``"-{push.gap_m} - 0.5 * {grasp.width_m} m"``, of parameters that all have the unit that follows.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from actors.palletizing.handling.net_files import NUMBER
from actors.palletizing.handling.nets import NetError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy.typing as npt

    Value = str | float | npt.NDArray[np.float64]

_UNSIGNED: Final = NUMBER.removeprefix("[-+]?")
_TERM: Final = rf"(?:{_UNSIGNED}\s*\*\s*)?\{{[\w.]+\}}|{_UNSIGNED}"
_SUM: Final = re.compile(rf"(?:[-+]\s*)?(?:{_TERM})(?:\s*[-+]\s*(?:{_TERM}))*")
_PART: Final = re.compile(rf"([-+]?)\s*(?:(?:({_UNSIGNED})\s*\*\s*)?\{{([\w.]+)\}}|({_UNSIGNED}))")
_UNIT: Final = re.compile(r"\s*(m/s|rad/s|rad|Nm|m|N|s)\b")
_WHOLE: Final = re.compile(r"\{([\w.]+)\}")
_KEY_UNITS: Final = {"speed_m_s": "m/s", "limit_s": "s"}
TYPES: Final = ("entity", "pose", "m", "rad", "m/s", "rad/s", "N", "Nm", "s")


def bind(document: dict[str, Any], values: Mapping[str, Value], source: str) -> dict[str, Any]:
    """Return the document of a net, each parameter of the skeleton replaced by its value.

    Args:
        document: Of the skeleton.
        values: By name; what the skeleton does not name is not used.
        source: Names the skeleton in errors.

    Raises:
        NetError: A parameter has an unknown type, is not declared, not bound, or ill-typed.
    """
    types = document.get("parameters", {})
    for name, kind in types.items() if isinstance(types, dict) else ():
        if kind not in TYPES:
            known = ", ".join(TYPES)
            raise NetError(f"{source}: parameters.{name}: unknown type {kind!r}; known: {known}")
        if name not in values:
            bound = ", ".join(values)
            raise NetError(f"{source}: parameter {name} ({kind}) is not bound; bound: {bound}")
        if not _is(kind, values[name]):
            raise NetError(f"{source}: parameter {name} is {values[name]!r}; it must be: {kind}")
    rest = {key: part for key, part in document.items() if key != "parameters"}
    bound = _Binding(source, types, values).tree(rest, "")
    assert isinstance(bound, dict)
    return bound


@dataclass(frozen=True, slots=True, eq=False)
class _Binding:
    """Puts values into the texts of a document."""

    source: str
    types: Mapping[str, str]
    values: Mapping[str, Value]

    def tree(self, part: Any, key: str) -> Any:
        if isinstance(part, dict):
            return {
                name: self.tree(value, f"{key}.{name}".strip(".")) for name, value in part.items()
            }
        if isinstance(part, list):
            return [self.tree(value, f"{key}[{n}]") for n, value in enumerate(part, 1)]
        return self._text(part, key) if isinstance(part, str) and "{" in part else part

    def _text(self, text: str, key: str) -> Any:
        whole = _WHOLE.fullmatch(text)
        if whole:
            kind = self._kind(whole[1], key)
            wanted = _KEY_UNITS.get(key.rpartition(".")[2])
            if wanted not in {None, kind}:
                raise self._fault(key, f"{whole[1]} has the type {kind}, not {wanted}")
            value = self.values[whole[1]]
            return value.tolist() if isinstance(value, np.ndarray) else value
        return _SUM.sub(lambda found: self._sum(found, text, key), text)

    def _sum(self, found: re.Match[str], text: str, key: str) -> str:
        """Return the number that a sum of parameters gives; numbers alone stay as they are."""
        if "{" not in found[0]:
            return found[0]
        unit = _UNIT.match(text, found.end())
        total = 0.0
        for sign, factor, name, number in _PART.findall(found[0]):
            if name:
                kind, value = self._kind(name, key), self.values[name]
                if kind in {"entity", "pose"} or (unit and unit[1] != kind):
                    wanted = unit[1] if unit else "a number"
                    raise self._fault(key, f"{name} has the type {kind}, not {wanted}")
                assert isinstance(value, float | int)
                term = float(factor or 1.0) * value
            else:
                term = float(number)
            total += -term if sign == "-" else term
        return repr(float(total))

    def _kind(self, name: str, key: str) -> str:
        if name not in self.types:
            known = ", ".join(self.types) or "(none)"
            raise self._fault(key, f"parameter {name} is not declared; declared: {known}")
        return self.types[name]

    def _fault(self, key: str, text: str) -> NetError:
        return NetError(f"{self.source}: {key}: {text}")


def _is(kind: str, value: Value) -> bool:
    if kind == "entity":
        return isinstance(value, str) and bool(value)
    if kind == "pose":
        fits = isinstance(value, np.ndarray) and value.shape == (4, 4)
        return fits and bool(np.isfinite(value).all())
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
