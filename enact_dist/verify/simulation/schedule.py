"""The faults of a run as single events with names, so that a run can be repeated with some of them.

A fault has the name of its place and its number there: `crash.3` is the fourth planned crash,
`c1-s0.37` what befalls message 37 from c1 to s0.  What befalls at a place is a function of the
seed, the place and the number alone.  So a fault that is left out changes nothing else, except
through what the cell then does.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class PartOfRun:
    """What of a run takes place; None stands for all of it.

    Attributes:
        only: Names of the faults.
        locks: Names of the locks: `c1/0.5` is lock 5 of lane 0 of c1.
        clients: Numbers of the clients, from 1 on.
        until_s: When the last lock begins, in simulated seconds.
    """

    only: frozenset[str] | None = None
    locks: frozenset[str] | None = None
    clients: frozenset[int] | None = None
    until_s: float | None = None

    def options(self) -> list[str]:
        """Return the options of `enact verify` that ask for this part."""
        words = []
        lists = {"only": self.only, "locks": self.locks, "clients": self.clients}
        for option, names in lists.items():
            if names is not None:
                text = ",".join(map(str, sorted(names, key=_in_order)))
                words += [f"--{option}", text or NO_NAME]
        if self.until_s is not None:
            words += ["--until", f"{self.until_s:g}"]
        return words


NO_NAME = "none"
"""What stands for an empty list of names on the command line."""


def names_in(text: str) -> frozenset[str]:
    """Read a list of names as `PartOfRun.options` writes it."""
    return frozenset() if text == NO_NAME else frozenset(text.split(","))


def _in_order(name: str | int) -> tuple[str, int]:
    place, _, number = str(name).rpartition(".")
    return place, int(number)


WHOLE = PartOfRun()


class Happening(NamedTuple):
    """A fault that took place, at a moment of true time."""

    name: str
    at_ns: int
    text: str

    def __str__(self) -> str:
        """Return the fault as a line of a schedule."""
        return f"{self.at_ns / 1e9:10.6f} s  {self.name:14}  {self.text}"


class FaultPlace:
    """Where faults may take place one after the other, each with luck of its own."""

    __slots__ = ("_draw", "name", "newest_delivered", "number")

    def __init__(self, seed: int, name: str) -> None:
        self.name = name
        self.number = -1
        self.newest_delivered = -1
        self._draw = Random(f"{seed}/{name}").getrandbits

    def next(self) -> int:
        """Go on to the next number; return its luck, 128 bits."""
        self.number += 1
        return self._draw(128)

    @property
    def fault(self) -> str:
        """What a fault at the present number is called."""
        return f"{self.name}.{self.number}"


@dataclass(slots=True)
class Schedule:
    """Which faults may take place in a run, and which did."""

    seed: int
    part: PartOfRun = WHOLE
    happened: dict[str, Happening] = field(default_factory=dict)
    locks: list[str] = field(default_factory=list)
    _places: dict[str, FaultPlace] = field(default_factory=dict)

    def place(self, name: str) -> FaultPlace:
        """Return the place of that name."""
        found = self._places.get(name)
        if found is None:
            found = self._places[name] = FaultPlace(self.seed, name)
        return found

    def stream(self, name: str) -> Random:
        """Return randomness that belongs to `name` alone."""
        return Random(f"{self.seed}/{name}")

    def allows(self, fault: str) -> bool:
        """Whether a fault may take place."""
        return self.part.only is None or fault in self.part.only

    def note(self, fault: str, at_ns: int, text: str) -> None:
        """Note that a fault took place; what the same fault did before stays noted."""
        before = self.happened.get(fault)
        if before is not None:
            text, at_ns = f"{before.text}; {text}", before.at_ns
        self.happened[fault] = Happening(fault, at_ns, text)

    def begins(self, lock: str) -> bool:
        """Whether a lock is asked for in this run; if so it is noted."""
        if self.part.locks is not None and lock not in self.part.locks:
            return False
        self.locks.append(lock)
        return True
