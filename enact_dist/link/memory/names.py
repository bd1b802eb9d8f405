"""Names of ended payloads, which identify late slices."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import OrderedDict
from typing import Final

NUMBERS_MAX: Final = 4096
"""Names per series, whose numbers mostly rise; beyond this, the lower half is dropped."""
SERIES_MAX: Final = 512
"""Remembered series; beyond this, the one that has been unused for longest is dropped."""
SERIES_BITS: Final = 60
"""Numbers below and above 1 << `SERIES_BITS` are two series."""
FIRST_STAGED: Final = 1 << SERIES_BITS
"""From here on a client numbers payloads sent in slices; below, files that it fills itself."""


class UsedNames:
    """Names ``SESSION-NUMBER``, the number in hexadecimal: 8 bytes each.  Not thread-safe."""

    __slots__ = ("_numbers",)

    def __init__(self) -> None:
        self._numbers: OrderedDict[tuple[str, int], array[int]] = OrderedDict()

    def add(self, name: str) -> None:
        """Remember a name."""
        series, number = _parts(name)
        numbers = self._numbers.setdefault(series, array("Q"))
        self._numbers.move_to_end(series)
        at = bisect_left(numbers, number)
        if at == len(numbers) or numbers[at] != number:
            numbers.insert(at, number)
        if len(numbers) > NUMBERS_MAX:
            del numbers[: NUMBERS_MAX // 2]
        if len(self._numbers) > SERIES_MAX:
            self._numbers.popitem(last=False)

    def __contains__(self, name: str) -> bool:
        series, number = _parts(name)
        numbers = self._numbers.get(series, ())
        at = bisect_left(numbers, number)
        return at < len(numbers) and numbers[at] == number


def _parts(name: str) -> tuple[tuple[str, int], int]:
    session, _, digits = name.rpartition("-")
    number = int(digits, 16)
    return (session, number >= FIRST_STAGED), number
