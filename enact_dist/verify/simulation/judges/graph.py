"""The end of a simulated run, told in the words of the checker.

A restart counts as one more writer: it sets every volatile slot to null, and after a power cut the
slots of class `os` to an older state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.client.plan import Phase
from enact_dist.terms import NullReason
from enact_dist.verify.checker import (
    NOTHING,
    CapturedRead,
    ChainState,
    Checker,
    LockOutcome,
    LockStory,
    StateRead,
)
from enact_dist.verify.simulation.judges.history import TOLD_NOT
from enact_dist.verify.simulation.judges.picture import DROP, NEVER_SET
from enact_dist.verify.simulation.judges.readers import stamp_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from enact_dist.core.client import plan as lock_parts
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.verify.simulation.judges.history import Entry, Observations, RunHistory


class DependencyGraph:
    """Everything that committed in a simulated run, and in which order it can have done so."""

    def __init__(self, history: RunHistory, observed: Observations) -> None:
        self._observed = observed
        self._positions: dict[Slot, dict[tuple[int, int], list[tuple[int, int]]]] = {}
        self._drops: dict[Slot, list[tuple[str, int]]] = {}
        self._events: dict[str, tuple[int, int]] = {}
        chains: dict[Slot, list[ChainState]] = {}
        for picture in observed.pictures.values():
            for slot, chain in picture.chains.items():
                chains[slot] = [
                    ChainState(i, s.writer, s.version, stamp_of(s.datum))
                    for i, s in enumerate(chain)
                ]
                positions = self._positions[slot] = {}
                for index, state in enumerate(chain):
                    if str(state.writer).startswith(DROP):
                        self._drops.setdefault(slot, []).append((str(state.writer), index))
                    else:
                        positions.setdefault(state.name, []).append((state.epoch, index))
        pictures = observed.pictures.values()
        events = self._events
        for writer, begun_ns, ended_ns in (one for picture in pictures for one in picture.restarts):
            begun, ended = events.get(writer, (begun_ns, ended_ns))  # a fork is on several shards
            events[writer] = min(begun, begun_ns), max(ended, ended_ns)
        self._checker = Checker(
            map(self._story, history.entries.values()),
            chains,
            events=events,
            lost=observed.permitted_losses,
            applied={lock for picture in pictures for lock in picture.applied},
        )

    def _story(self, entry: Entry) -> LockStory:
        reads = self._readings(entry, entry.readings())
        for (_, slot), (epoch, name) in self._observed.absent.get(entry.id, {}).items():
            reads.append(StateRead(slot, self._position(entry, slot, epoch, name)))
        return LockStory(
            entry.id,
            entry.begun_ns,
            entry.ended_ns,
            _told(entry.told),
            reads,
            self._readings(entry, entry.views()),
            outlives_restarts=entry.id in self._observed.decided,
            captured=self._captured(entry),
        )

    def _readings(self, entry: Entry, found: Iterable[lock_parts.Reading]) -> list[StateRead]:
        readings = []
        for _, epoch, state in found:
            name = (state.version, state.stamp_ns)
            readings.append(StateRead(state.slot, self._position(entry, state.slot, epoch, name)))
        return readings

    def _captured(self, entry: Entry) -> list[CapturedRead]:
        stamps, found = entry.stamps(), []
        for _, epoch, state in entry.lock.states if stamps else ():
            captured_ns = stamps.get(state.slot)
            if captured_ns is not None:
                gone = state.null_reason == NullReason.OUTSIDE_RETENTION.name
                name = None if gone else self._position(entry, state.slot, epoch, state[1:3])
                found.append(CapturedRead(state.slot, name, captured_ns))
        return found

    def _position(self, entry: Entry, slot: Slot, epoch: int, name: tuple[int, int]) -> int | None:
        """Return which state of the slot a reader of this epoch knew by this name."""
        found = self._positions.get(slot, {}).get(name, ())
        indices = [index for since, index in found if since <= epoch]
        if name == NEVER_SET.name:
            # No client has a lock in a context while it is dropped.
            drops = self._drops.get(slot, ())
            indices += [index for drop, index in drops if self._events[drop][0] < entry.begun_ns]
        return max(indices, default=NOTHING)

    def check_views(self) -> None:
        """Every view and every set shows all that a commit has written, or nothing of it."""
        for rule, facts in self._checker.view_anomalies():
            self._observed.fail(rule, *facts)
        for rule, facts in self._checker.set_anomalies():
            self._observed.fail(rule, *facts)
        self._observed.count("views over several slots checked", self._checker.views_checked)
        self._observed.count("sets of one stamp checked", self._checker.sets_checked)

    def cycle(self) -> list[str] | None:
        """Return a cycle as lines to read, or None if there is an order."""
        found = self._checker.cycle()
        return None if found is None else [str(edge) for edge in found]


def _told(phase: Phase | None) -> LockOutcome:
    if phase is Phase.COMMITTED:
        return LockOutcome.COMMITTED
    return LockOutcome.NOT if phase in TOLD_NOT else LockOutcome.UNKNOWN
