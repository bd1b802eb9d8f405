"""Names of ended payloads, which identify late slices."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import OrderedDict
from typing import Final

NUMBERS_MAX: Final = 4096
"""Names per series; beyond this, the half that was added first is dropped.

Not the lower half: a client numbers the payloads of each length in a row of its own.
"""
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
        self._numbers: OrderedDict[tuple[str, int], tuple[array[int], array[int]]] = OrderedDict()
        """Of each series the numbers of before, and the latest: both sorted."""

    def add(self, name: str) -> None:
        """Remember a name."""
        series, number = _parts(name)
        before, latest = self._numbers.setdefault(series, (array("Q"), array("Q")))
        at = bisect_left(latest, number)
        if at == len(latest) or latest[at] != number:
            latest.insert(at, number)
        if len(latest) >= NUMBERS_MAX // 2:
            before, latest = latest, array("Q")
        self._numbers[series] = before, latest
        self._numbers.move_to_end(series)
        if len(self._numbers) > SERIES_MAX:
            self._numbers.popitem(last=False)

    def __contains__(self, name: str) -> bool:
        series, number = _parts(name)
        for numbers in self._numbers.get(series, ()):
            at = bisect_left(numbers, number)
            if at < len(numbers) and numbers[at] == number:
                return True
        return False


def _parts(name: str) -> tuple[tuple[str, int], int]:
    session, _, digits = name.rpartition("-")
    number = int(digits, 16)
    return (session, number >= FIRST_STAGED), number
