"""The replaced states of one slot: what was when, and what was captured when.

::

    kept   kept   | loose  loose | held  held  held | newest (in the slot itself)
                  └────────── states ───────────────┘
                    within 2 s     its retention

`states` has no holes, so any stamp from its first one on can be answered.  What is kept under a
label stays beyond that, alone: it was current at its own stamp, and longer where that is known.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import deque
from itertools import islice, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.records import Content

_stamp_ns = attrgetter("stamp_ns")


class KeptVersion:
    """A version that labels keep; `until_ns` as in `VersionEntry`, 0 while it is in `states`."""

    __slots__ = ("content", "labels", "until_ns")

    def __init__(self, content: Content, until_ns: int = 0) -> None:
        self.content = content
        self.until_ns = until_ns
        self.labels: set[str] = set()


class SlotHistory:
    """What is known of the replaced states of one slot.  `History` changes it.

    Attributes:
        number: Unique number of the slot, for sorting.
        states: The replaced states up to the newest one, oldest first, without holes.
        held: How many of them, the latest, are within the slot's retention.
        size: Bytes of their data.
        young: How many states have been replaced so lately that cuts may ask for them.
        until_ns: The stamp of the newest state, which replaced the last of `states`.
        stored: Whether the versions are stored on the disk, too.
        queued: Whether the slot is in the queue of its aspect.
        kept: Versions that labels keep, by number; in `states` or not.
    """

    __slots__ = (
        "_captures",
        "held",
        "kept",
        "number",
        "queued",
        "size",
        "slot",
        "states",
        "stored",
        "until_ns",
        "young",
    )

    def __init__(self, slot: Slot, number: int, *, stored: bool) -> None:
        self.slot = slot
        self.number = number
        self.stored = stored
        self.states: deque[Content] = deque()
        self.kept: dict[int, KeptVersion] = {}
        self.held = self.size = self.young = self.until_ns = 0
        self.queued = False
        self._captures: list[tuple[int, int]] = []

    # ---------------------------------------------------------------- as of a stamp

    def at(self, at_ns: int) -> Content | None:
        """Return the replaced state that was current at a stamp before that of the newest one."""
        index = bisect_right(self.states, at_ns, key=_stamp_ns)
        return self.states[index - 1] if index else self.kept_at(at_ns)

    def kept_at(self, at_ns: int) -> Content | None:
        """Return a kept version that is known to have been current at a stamp."""
        for kept in self.kept.values():
            if kept.content.stamp_ns <= at_ns < max(kept.until_ns, kept.content.stamp_ns + 1):
                return kept.content
        return None

    # ---------------------------------------------------------------- versions

    def known(self) -> Iterator[tuple[Content, int]]:
        """Yield what is retained or kept, oldest first, with the stamp until which it was current.

        The stamp is the version's own one where no later one is known of.
        """
        first = self.states[-self.held].version if self.held else None
        for version in sorted(self.kept):
            until_ns = self.until_ns_of(version)
            if until_ns and (first is None or version < first):
                yield self.kept[version].content, until_ns
        held = self.retained()
        for content, after in pairwise(held):
            yield content, after.stamp_ns
        if held:
            yield held[-1], self.until_ns

    def retained(self) -> list[Content]:
        """Return the versions within the slot's retention, oldest first."""
        return list(islice(self.states, len(self.states) - self.held, None))

    def until_ns_of(self, version: int) -> int:
        """Return until when a kept version was current, 0 where it is the newest one."""
        if not self.states or version < self.states[0].version:
            return self.kept[version].until_ns
        index = version - self.states[0].version
        if index >= len(self.states):
            return 0
        return self.states[index + 1].stamp_ns if index + 1 < len(self.states) else self.until_ns

    def find(self, version: int) -> Content | None:
        """Return a replaced version that is retained or kept."""
        if self.is_held(version):
            return self.states[version - self.states[0].version]
        kept = self.kept.get(version)
        return kept.content if kept is not None else None

    def find_known(self, version: int) -> Iterator[tuple[Content, int]]:
        """Yield what `known` tells of one version, without a look at the others."""
        content = self.find(version)
        until_ns = self.until_ns_of(version) if content is not None else 0
        if content is not None and until_ns:
            yield content, until_ns

    def is_held(self, version: int) -> bool:
        """Whether a version is within the slot's retention."""
        return bool(self.held) and self.states[-self.held].version <= version <= (
            self.states[-1].version
        )

    def held_until_ns(self) -> int:
        """Return when the oldest version within retention was replaced."""
        return self.states[1 - self.held].stamp_ns if self.held > 1 else self.until_ns

    # ---------------------------------------------------------------- by capture stamp

    def index(self, content: Content) -> None:
        """Let a version within retention be found by its capture stamp, which it has."""
        assert content.datum is not None
        insort(self._captures, (content.datum.stamp_ns, content.version))

    def unindex(self, content: Content) -> None:
        """Let a version not be found by its capture stamp any more."""
        assert content.datum is not None
        del self._captures[bisect_left(self._captures, (content.datum.stamp_ns, content.version))]

    def captured(self, captured_ns: int, *, version_max: int) -> Content | None:
        """Return the latest version up to `version_max` that was captured then."""
        index = bisect_right(self._captures, (captured_ns, version_max)) - 1
        if index < 0 or self._captures[index][0] != captured_ns:
            return None
        return self.find(self._captures[index][1])

    def nearest(self, captured_ns: int, *, version_max: int) -> tuple[Content, ...]:
        """Return the versions up to `version_max` that were captured next to a stamp.

        At most one at or before it and one after it.
        """
        captures = self._captures
        middle = bisect_right(captures, (captured_ns, version_max))
        found = []
        for indices in (range(middle - 1, -1, -1), range(middle, len(captures))):
            near = next((i for i in indices if captures[i][1] <= version_max), None)
            if near is not None:
                stamp_ns = captures[near][0]
                found.append(self.captured(stamp_ns, version_max=version_max))
        return tuple([content for content in found if content is not None])

    def assert_invariants(self) -> None:
        """Assert the bookkeeping.  For tests and simulation."""
        versions = [state.version for state in self.states]
        first = versions[0] if versions else 0
        assert versions == list(range(first, first + len(versions))), versions
        stamps = [state.stamp_ns for state in self.states]
        assert stamps == sorted(set(stamps)), stamps
        held = [state for state in self.states if self.is_held(state.version)]
        assert len(held) == self.held, (len(held), self.held)
        assert self.size == sum(state.datum.size for state in held if state.datum is not None)
        right = [
            (state.datum.stamp_ns, state.version)
            for state in held
            if state.datum is not None and state.datum.stamp_ns
        ]
        assert self._captures == sorted(right), (self._captures, right)
