"""Was everything that committed strictly serializable?  Judges a history, wherever it comes from.

A history is what each lock read, wrote and had as answers (`LockStory`), and per slot the states
that it went through, oldest first (`ChainState`).  Slot versions give the exact dependencies: who
wrote after whom (ww), who read whose write (wr), whose read was overwritten by whom (rw).  Real
time gives the rest: what ended before another began comes before it.  An order exists exactly if
the graph has no cycle; it is searched in linear time.

Nothing here knows the core: the simulator (`simulation.judges`) and the runner of real processes
(`chaos.evidence`) tell their histories in the words of this module.
"""

from __future__ import annotations

import enum
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import (
        Callable,
        Collection,
        Hashable,
        Iterable,
        Iterator,
        Mapping,
        Sequence,
    )

    Slot = Hashable
    Name = Hashable
    Writer = Hashable

NOTHING: Final = None
"""Name of what a slot holds before its first state."""


class LockOutcome(enum.Enum):
    """The outcome of a lock as its thread learned it."""

    COMMITTED = "committed"
    NOT = "not committed"
    UNKNOWN = "unknown"
    """Or nothing: its process died."""


class ChainState(NamedTuple):
    """One state of a slot.

    Attributes:
        name: What readers know it by; unique within the slot.
        writer: Id of the lock, or of the event (a restart), that set it.
        version: Counts the committed writes of the slot.
        captured_ns: The capture stamp of its datum; 0 without one.
    """

    name: Name
    writer: Writer
    version: int
    captured_ns: int = 0


class StateRead(NamedTuple):
    """One state that a lock was shown; the name may be `NOTHING`."""

    slot: Slot
    name: Name


class CapturedRead(NamedTuple):
    """One state that a lock was shown by its capture stamp; `NOTHING` where none was retained."""

    slot: Slot
    name: Name
    captured_ns: int


@dataclass(slots=True, eq=False)
class LockStory:
    """One lock as its thread tells it.

    Attributes:
        id: The lock; what it wrote names it as writer.
        begun_ns: When it was asked for, on a clock that all stories share.
        ended_ns: When its thread learned how it ended; None: never.
        told: The outcome that its thread learned.
        reads: What it read under protection: reads, what it overwrote, views it expected.
        views: What it saw without protection.
        writes: The slots in which all readers must find it once it has committed.
        outlives_restarts: A promise over shards: held over restarts, which empty volatile slots.
        captured: What it saw by capture stamp.
    """

    id: Writer
    begun_ns: int
    ended_ns: int | None
    told: LockOutcome
    reads: Sequence[StateRead] = ()
    views: Sequence[StateRead] = ()
    writes: Sequence[Slot] = ()
    outlives_restarts: bool = False
    captured: Sequence[CapturedRead] = ()


class Anomaly(NamedTuple):
    """One rule that a history breaks, and lines that show where."""

    rule: str
    facts: tuple[str, ...]

    def __str__(self) -> str:
        return "\n  ".join((self.rule, *self.facts))


class Edge(NamedTuple):
    """Why one lock comes before another: `kind` is ww, wr, rw or time."""

    one: Writer
    other: Writer
    kind: str
    where: object

    def __str__(self) -> str:
        return f"{self.one} --{self.kind} {self.where}--> {self.other}"


class _Moment(NamedTuple):
    """A node of the chain of time."""

    number: int


class Checker:
    """Judges one history.

    Args:
        stories: All locks.
        chains: The states of each slot, oldest first.
        events: Writers that are no locks, with the time from which to which each took place.
        lost: Locks of which parts may be gone, as their aspects declare.
        applied: The locks that became visible; those that wrote a state unless given.
    """

    def __init__(
        self,
        stories: Iterable[LockStory],
        chains: Mapping[Any, Sequence[ChainState]],
        *,
        events: Mapping[Any, tuple[int, int]] | None = None,
        lost: Collection[Writer] = (),
        applied: Collection[Writer] | None = None,
    ) -> None:
        self._stories = {story.id: story for story in stories}
        self._chains = chains
        self._events = events or {}
        self._lost = lost
        self._written: dict[Writer, dict[Slot, int]] = {}
        self._positions: dict[Slot, dict[Name, int]] = {}
        for slot, chain in chains.items():
            positions: dict[Name, int] = {NOTHING: -1}
            for index, state in enumerate(chain):
                positions[state.name] = index
                self._written.setdefault(state.writer, {})[slot] = index
            self._positions[slot] = positions
        visible = self._written if applied is None else applied
        self.committed = [
            story
            for story in self._stories.values()
            if story.told is LockOutcome.COMMITTED or story.id in visible
        ]
        self.views_checked = 0
        self.sets_checked = 0
        self._after: dict[Writer, dict[Writer, tuple[str, object]]] = {}

    # ---------------------------------------------------------------- all rules

    def anomalies(self) -> list[Anomaly]:
        """Return every rule that is broken; of cycles, a shortest one through the first found."""
        found = [
            *self.chain_anomalies(),
            *self.told_anomalies(),
            *self.reading_anomalies(),
            *self.view_anomalies(),
            *self.set_anomalies(),
        ]
        cycle = self.cycle()
        if cycle is not None:
            found.append(Anomaly(name_of(cycle), tuple(map(str, cycle))))
        return found

    def chain_anomalies(self) -> Iterator[Anomaly]:
        """Versions count the writes of a slot, one by one, each by a lock that there is."""
        for slot, chain in self._chains.items():
            before = 0
            for state in chain:
                if state.writer in self._events:
                    before = state.version  # a restart may empty a slot
                    continue
                if state.version == before:
                    yield Anomaly("one version was written twice", (f"{slot}: {state}",))
                elif state.version != before + 1:
                    yield Anomaly("versions have a gap", (f"{slot}: {state} after {before}",))
                if state.writer not in self._stories:
                    yield Anomaly("written by no lock", (f"{slot}: {state}",))
                before = state.version

    def told_anomalies(self) -> Iterator[Anomaly]:
        """I3, I5: confirmed commits are there, refused ones are not, and none is there by half."""
        for story in self._stories.values():
            if story.id in self._lost:
                continue
            where = self._written.get(story.id, {})
            if story.told is LockOutcome.NOT and where:
                yield Anomaly("told not committed, but visible", (f"{story.id}: {list(where)}",))
                continue
            missed = [slot for slot in story.writes if slot not in where]
            if where and missed:
                facts = (f"{story.id}: in {list(where)}", f"not in {missed}")
                yield Anomaly("half a commit", facts)
            elif missed and story.told is LockOutcome.COMMITTED:
                yield Anomaly("told committed, but lost", (f"{story.id}: not in {missed}",))

    def reading_anomalies(self) -> Iterator[Anomaly]:
        """What a committed lock read, and what any lock viewed, was committed by some lock."""
        for story in self.committed:
            for slot, name in (*story.reads, *story.views):
                if name not in self._positions.get(slot, _ONLY_NOTHING):
                    yield Anomaly("dirty read", (f"{story.id} read {name} of {slot}",))

    def view_anomalies(self) -> Iterator[Anomaly]:
        """Every view shows all that a commit has written, or nothing of it."""
        for story in self.committed:
            seen = self._seen_by_views(story)
            if len(seen) < 2:
                continue
            self.views_checked += 1
            for lock in {self._chains[s][i].writer: None for s, i in seen.items() if i >= 0}:
                if lock not in self._stories or lock in self._lost:
                    continue
                written = self._written[lock].items()
                missed = [slot for slot, index in written if seen.get(slot, index) < index]
                if missed:
                    facts = (f"{story.id} sees {lock}", f"but not in {missed}")
                    yield Anomaly("a view shows half a commit", facts)

    def set_anomalies(self) -> Iterator[Anomaly]:
        """What is asked by stamp bears it, and a commit that is seen is seen under its stamp.

        A commit may have left retention in one slot and not in another; but a datum that is older
        than what a visible commit captured at the same stamp is half of that commit.
        """
        for story in self.committed:
            shown = {
                one.slot: (self._positions.get(one.slot, _ONLY_NOTHING).get(one.name), one)
                for one in story.captured
                if one.name is not NOTHING
            }
            seen = self._seen_by_views(story)
            writers = {self._chains[s][i].writer: None for s, i in seen.items() if i >= 0}
            for slot, (index, one) in shown.items():
                if index is None:
                    yield Anomaly("dirty read", (f"{story.id} read {one.name} of {slot}",))
                    continue
                state = self._chains[slot][index]
                if state.captured_ns not in (0, one.captured_ns):
                    yield Anomaly("another stamp was shown", (f"{story.id}: {one}: {state}",))
                writers[state.writer] = None
            self.sets_checked += len(shown) > 1
            yield from self._halves_of_sets(story, shown, writers)

    def _halves_of_sets(
        self,
        story: LockStory,
        shown: Mapping[Slot, tuple[int | None, CapturedRead]],
        writers: Iterable[Writer],
    ) -> Iterator[Anomaly]:
        for lock in writers:
            if lock not in self._stories or lock in self._lost:
                continue
            for slot, written in self._written[lock].items():
                index, one = shown.get(slot, (None, None))
                if index is None or one is None or index >= written:
                    continue
                if self._chains[slot][written].captured_ns == one.captured_ns:
                    facts = (f"{story.id} sees {lock}", f"but something older in {slot}")
                    yield Anomaly("a set shows half a commit", facts)

    def _seen_by_views(self, story: LockStory) -> dict[Slot, int]:
        """Return which state of each viewed slot a lock saw, those set by events left out."""
        seen: dict[Slot, int] = {}
        for slot, name in story.views:
            index = self._positions.get(slot, _ONLY_NOTHING).get(name)
            if index is None:
                continue
            if index >= 0 and self._chains[slot][index].writer not in self._stories:
                continue
            seen[slot] = index
        return seen

    # ---------------------------------------------------------------- the graph

    def cycle(self) -> list[Edge] | None:
        """Return a shortest cycle through the first one found, or None if there is an order."""
        if not self._after:
            self._add_edges()
        found = self._search()
        return None if found is None else self._shortened(found)

    def _add_edges(self) -> None:
        for slot, chain in self._chains.items():
            for older, newer in pairwise(chain):
                self._edge(older.writer, newer.writer, "ww", slot)
        for story in self.committed:
            for slot, name in story.reads:
                self._add_read(story, slot, name)
        self._add_real_time()

    def _edge(self, one: Writer, other: Writer, kind: str, where: object) -> None:
        if one != other:
            self._after.setdefault(one, {}).setdefault(other, (kind, where))

    def _add_read(self, story: LockStory, slot: Slot, name: Name) -> None:
        index = self._positions.get(slot, _ONLY_NOTHING).get(name)
        if index is None:
            return  # a dirty read, which is reported as such
        chain = self._chains.get(slot, ())
        if index >= 0:
            self._edge(chain[index].writer, story.id, "wr", slot)
        if index + 1 < len(chain):
            after = chain[index + 1].writer
            if after in self._stories or not story.outlives_restarts:
                self._edge(story.id, after, "rw", slot)

    def _add_real_time(self) -> None:
        """What ended leads to a moment, each moment to the next and to what begins after it."""
        points: list[tuple[int, int, int, Writer]] = []
        for story in self.committed:
            points.append((story.begun_ns, 0, len(points), story.id))
            if story.told is LockOutcome.COMMITTED and story.ended_ns is not None:
                points.append((story.ended_ns, 1, len(points), story.id))
        for writer, (begun_ns, ended_ns) in self._events.items():
            points.append((begun_ns, 0, len(points), writer))
            points.append((ended_ns, 1, len(points), writer))
        points.sort()
        number = 0
        for when_ns, ends, _, one in points:
            if ends:
                self._edge(_Moment(number), _Moment(number + 1), "time", when_ns)
                number += 1
                self._edge(one, _Moment(number), "time", when_ns)
            else:
                self._edge(_Moment(number), one, "time", when_ns)

    # ---------------------------------------------------------------- cycles

    def _search(self) -> list[Writer] | None:
        """Return the nodes of some cycle, in order."""
        after, known = self._after, {}
        for root in after:
            if root in known:
                continue
            path = [(root, iter(after[root]))]
            known[root] = 1
            while path:
                node, others = path[-1]
                for other in others:
                    if known.get(other) == 1:
                        nodes = [one for one, _ in path]
                        return nodes[nodes.index(other) :]
                    if other not in known:
                        known[other] = 1
                        path.append((other, iter(after.get(other, ()))))
                        break
                else:
                    known[node] = 2
                    path.pop()
        return None

    def _shortened(self, nodes: list[Writer]) -> list[Edge]:
        """Return a short cycle near `nodes`; steps in the chain of time are free.

        The cycle that was found may lead through thousands of locks.  The shortest one through one
        of them leads through few, and the shortest ones through these are looked at in turn.
        """
        best: list[Edge] = []
        locks = [node for node in nodes if not isinstance(node, _Moment)][:1]
        while True:
            found = min((self._edges_of(self._way_back(lock)) for lock in locks), key=len)
            if best and len(found) >= len(best):
                return best
            best = found
            locks = [edge.one for edge in best]

    def _way_back(self, start: Writer) -> list[Writer]:
        """Return the shortest way from `start` to itself, `start` at both ends."""
        came_from: dict[Writer, Writer] = {}
        todo = deque([start])
        done = set()
        while todo:
            node = todo.popleft()
            if node in done:
                continue
            done.add(node)
            for other in self._after.get(node, ()):
                if other == start:
                    way = [start, node]
                    while way[-1] != start:
                        way.append(came_from[way[-1]])
                    return way[::-1]
                if other not in done:
                    if isinstance(other, _Moment) and isinstance(node, _Moment):
                        came_from[other] = node
                        todo.appendleft(other)
                    elif other not in came_from:
                        came_from[other] = node
                        todo.append(other)
        return []

    def _edges_of(self, way: list[Writer]) -> list[Edge]:
        """Return a way as edges between locks: what lies between two moments is one edge."""
        edges: list[Edge] = []
        ended_ns: object = None
        from_lock = way[0]
        for one, other in pairwise(way):
            kind, where = self._after[one][other]
            if isinstance(other, _Moment):
                ended_ns = where if not isinstance(one, _Moment) else ended_ns
                continue
            if isinstance(one, _Moment):
                edges.append(Edge(from_lock, other, "time", f"{_s(ended_ns)} < {_s(where)}"))
            else:
                edges.append(Edge(one, other, kind, where))
            from_lock = other
        return edges


_ONLY_NOTHING: Final[dict[object, int]] = {NOTHING: -1}


def _s(when_ns: object) -> str:
    return f"{when_ns / 1e9:.6f} s" if isinstance(when_ns, int) else "?"


def name_of(cycle: Sequence[Edge]) -> str:
    """Return the common name of what a cycle shows."""
    count: Callable[[str], int] = [edge.kind for edge in cycle].count
    if count("rw") > 1:
        return "write skew"
    if count("rw") == 1:
        if count("time"):
            return "stale read"
        return "half of a commit was read" if count("wr") else "lost update"
    return "real time order is broken" if count("time") else "circular dependency"
