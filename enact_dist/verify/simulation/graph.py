"""The end of a simulated run, told in the words of the checker.

A restart counts as one more writer: it sets every volatile slot to null, and after a power cut the
slots of class `os` to an older state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.phase import Phase
from enact_dist.terms import NullReason
from enact_dist.verify.checker import (
    NOTHING,
    Captured,
    Checker,
    LockStory,
    Reading,
    State,
    Told,
)
from enact_dist.verify.simulation.history import TOLD_NOT
from enact_dist.verify.simulation.reader_judge import stamp_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core import lock_parts
    from enact_dist.core.datum import Slot
    from enact_dist.verify.simulation.history import Entry, History
    from enact_dist.verify.simulation.model import Model


class Graph:
    """Everything that committed in a simulated run, and in which order it can have done so."""

    def __init__(self, history: History, model: Model) -> None:
        self._model = model
        self._positions: dict[Slot, dict[tuple[int, int], list[tuple[int, int]]]] = {}
        chains: dict[Slot, list[State]] = {}
        for picture in model.pictures.values():
            for slot, chain in picture.chains.items():
                chains[slot] = [
                    State(i, s.writer, s.version, stamp_of(s.datum)) for i, s in enumerate(chain)
                ]
                positions = self._positions[slot] = {}
                for index, state in enumerate(chain):
                    positions.setdefault(state.name, []).append((state.epoch, index))
        pictures = model.pictures.values()
        restarts = [restart for picture in pictures for restart in picture.restarts]
        self._checker = Checker(
            map(self._story, history.entries.values()),
            chains,
            events={writer: (begun_ns, ended_ns) for writer, begun_ns, ended_ns in restarts},
            lost=model.permitted_losses,
            applied={lock for picture in pictures for lock in picture.applied},
        )

    def _story(self, entry: Entry) -> LockStory:
        reads = self._readings(entry.readings())
        for (_, slot), (epoch, name) in self._model.absent.get(entry.id, {}).items():
            reads.append(Reading(slot, self._position(slot, epoch, name)))
        return LockStory(
            entry.id,
            entry.begun_ns,
            entry.ended_ns,
            _told(entry.told),
            reads,
            self._readings(entry.views()),
            outlives_restarts=entry.id in self._model.decided,
            captured=self._captured(entry),
        )

    def _readings(self, found: Iterable[lock_parts.Reading]) -> list[Reading]:
        readings = []
        for _, epoch, state in found:
            name = (state.version, state.stamp_ns)
            readings.append(Reading(state.slot, self._position(state.slot, epoch, name)))
        return readings

    def _captured(self, entry: Entry) -> list[Captured]:
        stamps, found = entry.stamps(), []
        for _, epoch, state in entry.lock.states if stamps else ():
            captured_ns = stamps.get(state.slot)
            if captured_ns is not None:
                gone = state.null_reason == NullReason.OUTSIDE_RETENTION.name
                name = None if gone else self._position(state.slot, epoch, state[1:3])
                found.append(Captured(state.slot, name, captured_ns))
        return found

    def _position(self, slot: Slot, epoch: int, name: tuple[int, int]) -> int | None:
        """Return which state of the slot a reader of this epoch knew by this name."""
        found = self._positions.get(slot, {}).get(name, ())
        return max((index for since, index in found if since <= epoch), default=NOTHING)

    def check_views(self) -> None:
        """Every view and every set shows all that a commit has written, or nothing of it."""
        for rule, facts in self._checker.view_anomalies():
            self._model.fail(rule, *facts)
        for rule, facts in self._checker.set_anomalies():
            self._model.fail(rule, *facts)
        self._model.count("views over several slots checked", self._checker.views_checked)
        self._model.count("sets of one stamp checked", self._checker.sets_checked)

    def cycle(self) -> list[str] | None:
        """Return a cycle as lines to read, or None if there is an order."""
        found = self._checker.cycle()
        return None if found is None else [str(edge) for edge in found]


def _told(phase: Phase | None) -> Told:
    if phase is Phase.COMMITTED:
        return Told.COMMITTED
    return Told.NOT if phase in TOLD_NOT else Told.UNKNOWN
