"""A continuous diff: reports when data of two world contexts start and stop to differ.

It follows both contexts with one watch.  It compares changed slots again, both sides in one
consistent snapshot, and reports those whose result differs from the last report.  Like an actor's
trigger it is level-based: the newest data count, and a difference that is over before the next
comparison is not reported.
"""

from __future__ import annotations

import time
from collections import deque
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from enact_dist.access.watch import Following, Watch
from enact_dist.compare.diff import DiffKind, Pair, compared, pairs_of, repeated
from enact_dist.compare.two_worlds import SideView, aspects_of, both_sides, past_ns_of
from enact_dist.errors import MisuseError
from enact_dist.terms import Entities

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.compare.diff import Comparison
    from enact_dist.compare.two_worlds import Place, Viewable
    from enact_dist.terms import Aspect

PLACES_MAX: Final = 512
"""Most slots that are compared together; other changed slots wait for the next comparison."""


class DiffWatch(Following["Comparison"]):
    """An iterator of `Comparison`; also a context manager.  One thread at a time may iterate.

    First come the slots that differ now by more than their tolerance.  Then comes every slot whose
    kind has changed since: `DiffKind.EQUAL` when it does not differ any more.  A past side is read
    once; it is read again only if its shard has restarted.
    """

    def __init__(
        self,
        left: Viewable,
        right: Viewable,
        pattern: str,
        aspects: Sequence[Aspect[Any] | str],
    ) -> None:
        self._left, self._right = left, right
        self._worlds = left, right
        present = [world for world in self._worlds if not past_ns_of(world)]
        if not present or left.session is not right.session:
            why = "they are of two connections" if present else "both are past and never change"
            raise MisuseError(f"{left!r} and {right!r} cannot be watched: {why}; use diff")
        self._types = aspects_of(self._worlds, aspects or None, later=True)
        self._pattern = str(Entities(pattern))
        self._reported: dict[Place, DiffKind] = {}
        self._seen: dict[tuple[str, Place], int] = {}
        self._changed: dict[Place, None] = {}
        self._pending: deque[Comparison] = deque()
        self._past_world = next((world for world in self._worlds if past_ns_of(world)), None)
        self._past: SideView | None = None
        names = tuple(dict.fromkeys(world.name for world in present))
        wanted = tuple(self._types) if aspects else ()
        # Before the first comparison, so that no change falls between the two.
        self._watch = Watch(left.session.client, names, (self._pattern,), wanted)
        try:
            repeated(self._compare_all, self._release_past)
        except BaseException:
            self.close()
            raise

    @property
    def missed(self) -> int:
        """How many versions were skipped so far, over all slots of both contexts."""
        return self._watch.missed

    def next(self, timeout_s: float | None = None) -> Comparison | None:
        """Return the next slot whose comparison has changed, or None if there is none in time.

        Args:
            timeout_s: How long to wait; None waits until `close`, 0 takes what has arrived.

        Raises:
            ForgottenError: A shard of the past side has restarted, and does not know it any more.
            UnknownWorldError: One of the contexts was dropped.
            ShardUnreachableError: A shard does not answer; the next call compares the changed slots
                again.
            MisuseError: The cell was closed.
        """
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._pending and not self._watch.closed:
            left_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            self._take_changes(0.0 if self._changed else left_s)
            if self._changed:
                repeated(self._compare_changed, self._release_past)
            elif left_s is None or self._watch.closed:
                continue
            if left_s == 0.0 and not self._pending:
                return None
        return self._pending.popleft() if self._pending and not self._watch.closed else None

    def _take_changes(self, wait_s: float | None) -> None:
        """Note which slots have changed since they were compared; wait for a first one."""
        change = self._watch.next(wait_s)
        while change is not None:
            place = change.entity.name, change.aspect
            if self._seen.get((change.world, place)) != change.position.stamp_ns:
                self._changed[place] = None
            change = self._watch.next(0.0) if len(self._changed) < PLACES_MAX else None

    # ---------------------------------------------------------------- comparing

    def _compare_all(self) -> None:
        places = [(self._pattern, name) for name in self._types]
        with self._both(places, each=True) as (first, second):
            pairs = pairs_of(first.of(self._left.name), second.of(self._right.name))
            self._report(compared(pairs, first, second, self._types))

    def _compare_changed(self) -> None:
        places = list(self._changed)[:PLACES_MAX]
        new = {aspect for _, aspect in places} - self._types.keys()
        if new:
            self._types |= aspects_of(self._worlds, new)
        with self._both(places, each=False) as (first, second):
            left, right = first.of(self._left.name), second.of(self._right.name)
            pairs = [Pair(place, left.get(place), right.get(place)) for place in places]
            self._report(compared(pairs, first, second, self._types))
        for place in places:
            del self._changed[place]

    @contextmanager
    def _both(self, places: Sequence[Place], *, each: bool) -> Iterator[tuple[SideView, SideView]]:
        """View both sides; a past one only once."""
        past = self._past_world
        if past is None:
            with both_sides(*self._worlds, places, each=each) as views:
                yield views
            return
        if self._past is None:
            everything = [(self._pattern, name) for name in self._types]
            self._past = SideView([past], everything, each=True)
        present = self._right if past is self._left else self._left
        with SideView([present], places, each=each) as view:
            yield (self._past, view) if past is self._left else (view, self._past)

    def _report(self, found: Iterable[tuple[Comparison, bool]]) -> None:
        """Record the results of slots; those that differ from the last report are reported next."""
        for row, _ in found:
            place = row.entity.name, row.aspect
            for world, side in zip(self._worlds, (row.left, row.right), strict=True):
                if world is not self._past_world:
                    stamp_ns = side.position.stamp_ns if side is not None else 0
                    self._seen[world.name, place] = stamp_ns
            if row.kind is self._reported.get(place, DiffKind.EQUAL):
                continue
            self._pending.append(row)
            if row.kind is DiffKind.EQUAL:
                del self._reported[place]
            else:
                self._reported[place] = row.kind

    # ---------------------------------------------------------------- end

    def _release_past(self) -> None:
        past, self._past = self._past, None
        if past is not None:
            past.close()

    def close(self) -> None:
        """End the watch; a `next` that waits returns None within 0.1 s.  Twice is harmless."""
        self._watch.close()
        self._release_past()
