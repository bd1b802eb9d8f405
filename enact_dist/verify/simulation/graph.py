"""The end of a run: was everything that committed strictly serializable?

Slot versions give the exact dependencies: who wrote what after whom, who read whose write, whose
read was overwritten by whom.  Real time gives the rest: what ended before another began comes
before it.  The order exists exactly if the graph has no cycle.

A restart counts as one more writer: it sets every volatile slot to null, and after a power cut the
slots of class `os` to an older state.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from enact_dist.core.datum import LockId
from enact_dist.core.multilock import Phase

if TYPE_CHECKING:
    from collections.abc import Hashable

    from enact_dist.core.datum import Slot
    from enact_dist.verify.simulation.history import Entry, History
    from enact_dist.verify.simulation.model import Model
    from enact_dist.verify.simulation.picture import Picture, State

NEVER = 1 << 63


class Graph:
    """Dependencies between everything that committed."""

    def __init__(self, history: History, model: Model) -> None:
        self._model = model
        self.after: dict[Hashable, dict[Hashable, str]] = {}
        self._entries = [entry for entry in history.entries.values() if self._counts(entry)]
        for picture in model.pictures.values():
            for chain in picture.chains.values():
                for older, newer in pairwise(chain):
                    self._edge(older.writer, newer.writer, "ww")
        for entry in self._entries:
            self._add_reads(entry)
        self._add_real_time()

    def _counts(self, entry: Entry) -> bool:
        if entry.told is Phase.COMMITTED:
            return True
        return any(entry.id in picture.applied for picture in self._model.pictures.values())

    def _edge(self, one: Hashable, other: Hashable, why: str) -> None:
        if one != other:
            self.after.setdefault(one, {}).setdefault(other, why)

    # ---------------------------------------------------------------- reads

    def _add_reads(self, entry: Entry) -> None:
        pictures = self._model.pictures
        for reading in entry.readings():
            name = (reading.state.version, reading.state.stamp_ns)
            self._add_read(entry, pictures[reading.shard], reading.state.slot, reading.epoch, name)
        for (shard, slot), (epoch, name) in self._model.absent.get(entry.id, {}).items():
            self._add_read(entry, pictures[shard], slot, epoch, name)

    def _add_read(
        self, entry: Entry, picture: Picture, slot: Slot, epoch: int, name: tuple[int, int]
    ) -> None:
        chain = picture.chains.get(slot, [])
        index = -1
        for position, state in enumerate(chain):
            if state.epoch <= epoch and state.name == name:
                index = position
        if index >= 0:
            self._edge(chain[index].writer, entry.id, f"wr {slot}")
        if index + 1 < len(chain):
            after = chain[index + 1].writer
            # A prepared lock outlives a restart, which may empty volatile slots that it has read.
            if isinstance(after, LockId) or entry.id not in self._model.decided:
                self._edge(entry.id, after, f"rw {slot}")

    def check_views(self) -> None:
        """Every view shows all that a commit has written, or nothing of it."""
        chains = {s: c for p in self._model.pictures.values() for s, c in p.chains.items()}
        written: dict[LockId, dict[Slot, int]] = {}
        for slot, chain in chains.items():
            for index, state in enumerate(chain):
                if isinstance(state.writer, LockId):
                    written.setdefault(state.writer, {})[slot] = index
        for entry in self._entries:
            seen = self._seen_by_views(entry, chains)
            for lock in {chains[s][i].writer for s, i in seen.items() if i >= 0}:
                if isinstance(lock, LockId) and lock not in self._model.permitted_losses:
                    missed = [
                        slot
                        for slot, index in written[lock].items()
                        if slot in seen and seen[slot] < index
                    ]
                    if missed:
                        self._model.fail("a view shows half a commit", entry.id, lock, missed)

    def _seen_by_views(self, entry: Entry, chains: dict[Slot, list[State]]) -> dict[Slot, int]:
        """Return which state of each viewed slot a lock saw, those of restarts left out."""
        seen: dict[Slot, int] = {}
        for reading in entry.views():
            slot, name = reading.state.slot, (reading.state.version, reading.state.stamp_ns)
            chain = chains.get(slot, [])
            found = [
                i
                for i, state in enumerate(chain)
                if state.name == name and state.epoch <= reading.epoch
            ]
            if found and isinstance(chain[found[-1]].writer, str):
                continue
            seen[slot] = found[-1] if found else -1
        if len(seen) > 1:
            self._model.count("views over several slots checked")
        return seen

    # ---------------------------------------------------------------- real time

    def _add_real_time(self) -> None:
        """What ended leads to a moment, each moment to the next and to what begins after it."""
        spans: list[tuple[int, int, Hashable]] = []
        for entry in self._entries:
            told = entry.told is Phase.COMMITTED and entry.ended_ns is not None
            ended_ns = entry.ended_ns if told and entry.ended_ns is not None else NEVER
            spans.append((entry.begun_ns, ended_ns, entry.id))
        for picture in self._model.pictures.values():
            spans += [(begun, ended, writer) for writer, begun, ended in picture.restarts]
        points = sorted(
            [(begun_ns, 0, str(one), one) for begun_ns, _, one in spans]
            + [(ended_ns, 1, str(one), one) for _, ended_ns, one in spans if ended_ns < NEVER]
        )
        moment = 0
        for when_ns, ends, _, one in points:
            if ends:
                self._edge(("moment", moment), ("moment", moment + 1), "time")
                moment += 1
                self._edge(one, ("moment", moment), f"ended {when_ns / 1e9:.6f}")
            else:
                self._edge(("moment", moment), one, f"began {when_ns / 1e9:.6f}")

    # ---------------------------------------------------------------- cycles

    def cycle(self) -> list[str] | None:
        """Return a cycle as lines to read, or None if there is an order."""
        state: dict[Hashable, int] = {}
        for root in self.after:
            if root in state:
                continue
            path = [(root, iter(self.after.get(root, ())))]
            state[root] = 1
            while path:
                one, others = path[-1]
                for other in others:
                    if state.get(other) == 1:
                        return self._told([node for node, _ in path], other)
                    if other not in state:
                        state[other] = 1
                        path.append((other, iter(self.after.get(other, ()))))
                        break
                else:
                    state[one] = 2
                    path.pop()
        return None

    def _told(self, path: list[Hashable], back_to: Hashable) -> list[str]:
        around = path[path.index(back_to) :]
        return [
            f"{one} --{self.after[one][other]}--> {other}"
            for one, other in zip(around, [*around[1:], back_to], strict=True)
        ]
