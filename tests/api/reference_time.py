"""What world contexts in time should answer: every slot a plain list of dicts, searched from its end.

Nothing is ever taken out of a list.  A version that retention has let go of is marked so, and an
answer that would need it is `Past`: forgotten, with the stamp from which on all is known.  Both
state machines, that of a shard alone and that of a whole cell, ask this model.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

LOOSE_NS = 2_000_000_000
"""So long after it was replaced any version can be seen as of a stamp, retained or not."""
NO_LIMIT = 1 << 62

Place = tuple[str, str, str]
"""World context, entity and aspect."""


class Rule(NamedTuple):
    """How much of each slot's history an aspect retains, and whether it survives a restart."""

    versions: int = NO_LIMIT
    age_ns: int = NO_LIMIT
    size: int = NO_LIMIT
    stored: bool = True


class Past(NamedTuple):
    """The answer that something is forgotten: all that was asked is known from a stamp on."""

    since_ns: int


class Nothing(NamedTuple):
    """The answer that a datum is null, and why."""

    reason: str


NEVER = Nothing("NEVER_SET")
LOST = Nothing("LOST")
OUTSIDE = Nothing("OUTSIDE_RETENTION")
LOST_STATE: dict[str, Any] = {
    "version": 0,
    "stamp_ns": 0,
    "until_ns": 0,
    "value": None,
    "reason": "LOST",
    "size": 0,
    "captured_ns": 0,
    "cause": None,
    "until_known": True,
}


@dataclass
class Line:
    """One slot: all that it ever was.

    Attributes:
        states: What it was, oldest first.
        base: The largest version that any slot had in an earlier world context of that name.
        lost_ns: At which stamp a restart has lost what was before; 0: none has.
    """

    states: list[dict[str, Any]] = field(default_factory=list)
    base: int = 0
    lost_ns: int = 0


class TimeModel:
    """World contexts with all that they ever were, and what of it must still be known.

    Args:
        rules: What each aspect retains.
        worlds: World contexts that cannot be dropped.
    """

    def __init__(self, rules: dict[str, Rule], worlds: tuple[str, ...]) -> None:
        self.rules = rules
        self.worlds: dict[str, tuple[str, int]] = dict.fromkeys(worlds, ("", 0))
        self.lines: dict[Place, Line] = {}
        self.bases: dict[str, int] = {}
        self.labels: dict[str, set[tuple[Place, int]]] = {}

    def line(self, place: Place) -> Line:
        """Return a slot, made where there is none."""
        if place not in self.lines:
            self.lines[place] = Line(base=self.bases.get(place[0], 0))
        return self.lines[place]

    def places(self, world: str) -> list[Place]:
        """Return the slots of a world context that were ever set."""
        return sorted(
            place for place, line in self.lines.items() if place[0] == world and _is(line)
        )

    # ---------------------------------------------------------------- what changes

    def set(
        self,
        place: Place,
        stamp_ns: int,
        value: object,
        *,
        size: int = 0,
        captured_ns: int = 0,
        cause: object = None,
        reason: str = "DELETED",
    ) -> int:
        """Let a slot have another datum (None: null) from a stamp on; return its version."""
        line = self.line(place)
        version = line.states[-1]["version"] + 1 if line.states else line.base + 1
        if line.states:
            line.states[-1]["until_ns"] = stamp_ns
        line.states.append(
            {
                "version": version,
                "stamp_ns": stamp_ns,
                "until_ns": 0,
                "value": value,
                "reason": reason if value is None else "",
                "size": size,
                "captured_ns": captured_ns if value is not None else 0,
                "cause": cause,
                "held": True,
                "near": True,
                "until_known": True,
            }
        )
        self._let_go_of_old(place, stamp_ns, by_age=False)
        return version

    def pass_time(self, now_ns: int) -> None:
        """Let go of what has become too old by a stamp."""
        for place in self.lines:
            self._let_go_of_old(place, now_ns, by_age=True)

    def _let_go_of_old(self, place: Place, now_ns: int, *, by_age: bool) -> None:
        rule = self.rules[place[2]]
        held = near = True
        count = size = 0
        for state in reversed(self.lines[place].states[:-1]):
            count, size = count + 1, size + state["size"]
            held = held and state["held"] and count < rule.versions and size <= rule.size
            if by_age:
                held = held and state["until_ns"] >= now_ns - rule.age_ns
            near = near and state["near"] and state["until_ns"] >= now_ns - LOOSE_NS
            state["held"], state["near"] = held, near

    def keep(self, label: str, place: Place, version: int) -> bool:
        """Keep a version under a label; False where it is forgotten."""
        line = self.lines.get(place)
        state = next((s for s in line.states if s["version"] == version), None) if line else None
        if state is None or not self._listed(place, state):
            return False
        self.labels.setdefault(label, set()).add((place, version))
        return True

    def let_go(self, label: str) -> None:
        """Keep nothing under a label any more."""
        for place, version in self.labels.pop(label, ()):
            self._end_unlisted(place, version)

    def _end_unlisted(self, place: Place, version: int) -> None:
        """What nobody keeps and no retention holds is gone for good."""
        for state in self.lines[place].states[:-1]:
            if state["version"] == version and not self._listed(place, state):
                state["held"] = False

    def fork(self, name: str, source: str, at_ns: int, cause: Any) -> Past | int:
        """Make a world context of another one as of a stamp; return the number of its slots."""
        found = {place: self.at(place, at_ns) for place in self.places(source)}
        late = [one for one in found.values() if isinstance(one, Past)]
        if late:
            return max(late)
        self.worlds[name] = source, at_ns
        made = 0
        for place, shown in found.items():
            if shown == NEVER:
                continue
            made += 1
            assert not isinstance(shown, Past)
            new = (name, *place[1:])
            if isinstance(shown, Nothing):
                read = self._read(place, at_ns)
                self.set(new, at_ns, None, cause=cause(read), reason=shown.reason)
            else:
                self.set(
                    new,
                    at_ns,
                    shown["value"],
                    size=shown["size"],
                    captured_ns=shown["captured_ns"],
                    cause=cause(self._read(place, at_ns)),
                )
        return made

    def _read(self, place: Place, at_ns: int) -> tuple[Place, int, int]:
        """Return which version of a slot was current at a stamp."""
        state = next(
            (s for s in reversed(self.lines[place].states) if s["stamp_ns"] <= at_ns), None
        )
        return place, *((state["version"], state["stamp_ns"]) if state else (0, 0))

    def drop(self, name: str) -> int:
        """Forget a world context; return how many slots it had."""
        del self.worlds[name]
        gone = self.places(name)
        tops = [s[-1]["version"] if (s := self.lines[place].states) else 0 for place in gone]
        # The null that a drop tells its watchers of counts as a version of each slot.
        self.bases[name] = max([self.bases.get(name, 0), *(top + 1 for top in tops)])
        for place in [place for place in self.lines if place[0] == name]:
            del self.lines[place]
        for label, versions in list(self.labels.items()):
            versions -= {one for one in versions if one[0][0] == name}
            if not versions:
                del self.labels[label]
        return len(gone)

    def restart(self, now_ns: int) -> None:
        """Lose what is volatile, and what was only remembered for a while.

        Args:
            now_ns: The first stamp after.
        """
        for place, line in self.lines.items():
            stored = self.rules[place[2]].stored
            if not stored and _is(line):
                line.states, line.lost_ns = [], now_ns
            for state in line.states[:-1]:
                state["near"] = False
        for label, versions in list(self.labels.items()):
            versions -= {one for one in versions if not self.rules[one[0][2]].stored}
            if not versions:
                del self.labels[label]
        for place, line in self.lines.items():
            for state, after in pairwise(line.states):
                if not state["held"]:
                    state["until_known"] = self._listed(place, after)

    # ---------------------------------------------------------------- what is asked

    def kept(self, place: Place, version: int) -> tuple[str, ...]:
        """Return the labels that keep a version."""
        return tuple(
            sorted(label for label, found in self.labels.items() if (place, version) in found)
        )

    def _listed(self, place: Place, state: dict[str, Any]) -> bool:
        newest = self.lines[place].states[-1]
        return state is newest or state["held"] or bool(self.kept(place, state["version"]))

    def history(self, place: Place) -> list[dict[str, Any]]:
        """Return the versions that are listed, oldest first; version 0 where all are lost."""
        line = self.lines.get(place, Line())
        if line.lost_ns and not line.states:
            return [LOST_STATE]
        return [state for state in line.states if self._listed(place, state)]

    def since_ns(self, place: Place) -> Past:
        """Return from when on all of a slot is known; 0: from ever."""
        line = self.lines.get(place, Line())
        if not line.states:
            return Past(line.lost_ns)
        tail = [s for s in line.states if s is line.states[-1] or s["held"] or s["near"]]
        first = tail[0]
        if first is line.states[0]:
            return Past(line.lost_ns)
        return Past(first["stamp_ns"])

    def at(self, place: Place, at_ns: int) -> dict[str, Any] | Nothing | Past:
        """Return what a slot was at a stamp."""
        line = self.lines.get(place, Line())
        since = self.since_ns(place)
        current = next((s for s in reversed(line.states) if s["stamp_ns"] <= at_ns), None)
        if at_ns < since.since_ns:
            alone = current is not None and bool(self.kept(place, current["version"]))
            if not alone or not (current["until_known"] or at_ns == current["stamp_ns"]):
                return since
        if current is None:
            return LOST if line.lost_ns else NEVER
        return current if current["value"] is not None else Nothing(current["reason"])

    def view(self, places: list[Place], at_ns: int) -> dict[Place, Any] | Past:
        """Return what slots were at a stamp, or that one of them is forgotten."""
        found = {place: self.at(place, at_ns) for place in places}
        if not any(isinstance(one, Past) for one in found.values()):
            return found
        return max(self.since_ns(place) for place in places)

    def captured(
        self, place: Place, captured_ns: int, *, nearest: bool
    ) -> dict[str, Any] | Nothing:
        """Return the latest retained version captured at a stamp, or nearest to it.

        What only a label keeps is not found: others of its stamp may have been forgotten.
        """
        line = self.lines.get(place, Line())
        found = [s for s in line.states if (s is line.states[-1] or s["held"]) and s["captured_ns"]]
        if not nearest:
            found = [s for s in found if s["captured_ns"] == captured_ns]
        if found:
            return min(
                found,
                key=lambda s: (
                    abs(s["captured_ns"] - captured_ns),
                    -s["captured_ns"],
                    -s["version"],
                ),
            )
        if not line.states:
            return LOST if line.lost_ns else NEVER
        newest = line.states[-1]
        return Nothing(newest["reason"]) if newest["value"] is None else OUTSIDE

    def diff(self, left: str, right: str, at_ns: int = 0) -> dict[tuple[str, str], str] | Past:
        """Return how slots of two world contexts differ that do, by entity and aspect.

        Args:
            left: One of them, as it is.
            right: The other one.
            at_ns: As of which stamp the other one is seen; 0: as it is.
        """
        other = self.view(self.places(right), at_ns or NO_LIMIT)
        if isinstance(other, Past):
            return other
        data = {
            "only left": self._data(self.view(self.places(left), NO_LIMIT)),
            "only right": self._data(other),
        }
        found = {
            place: side
            for side, shown in data.items()
            for place in shown
            if any(place not in of_side for of_side in data.values())
        }
        for place, value in data["only left"].items():
            if data["only right"].get(place, value) != value:
                found[place] = "changed"
        return found

    @staticmethod
    def _data(view: dict[Place, Any] | Past) -> dict[tuple[str, str], Any]:
        assert not isinstance(view, Past)
        return {
            (entity, aspect): state["value"]
            for (_, entity, aspect), state in view.items()
            if isinstance(state, dict)
        }


def _is(line: Line) -> bool:
    return bool(line.states or line.lost_ns)
