"""A watch: the present data, then every change in order; gaps are always reported.

Notices are small, best effort and numbered without a gap per shard and epoch.  A number that is
skipped, a number that a keep-alive knows and no notice brought, or a new epoch means that some
were missed: the watch then lists the slots again and yields one change per slot that moved, whose
`gap` says how many versions were skipped.

Where a watch asks for data, a notice over a socket brings those that are small, and the names of
those in shared memory.  A watch that is behind gets bare notices, so they take no memory.

A shard that is added to the cell is listed as soon as this client knows of it.  Entities may have
moved to it: a state that moved unchanged is no change.

Versions that a restarted shard did not store start again, so its new epoch makes each state a
new one: its number does not continue the old count, and how many versions were lost is unknown.
"""

from __future__ import annotations

import contextlib
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeVar

from enact_dist.access.arguments import check_seconds
from enact_dist.core.client.plan import Reading
from enact_dist.core.protocol.datum import Position, Slot
from enact_dist.core.protocol.messages import Notice, Ping, SlotState, Survey, Surveyed
from enact_dist.core.state.clock import STAMP_NS_MAX, is_kept, is_older
from enact_dist.errors import LinkError, MisuseError, ShardUnreachableError
from enact_dist.link.notices import Interest, Skipped
from enact_dist.terms import Durability, Entities, Entity

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from enact_dist.core.protocol.datum import Datum
    from enact_dist.link.client.locks import CellClient

POLL_S: Final = 0.1
"""How often a watch that lacks notices checks whether they have come."""
QUIET_S: Final = 0.5
"""How often a quiet watch checks whether it lacks any: as often as keep-alives come."""
RESYNC_S: Final = 1.0
"""How long one attempt to list the slots of a shard again may take."""
MISSING_S: Final = 0.2
"""How long a shard that was missing has to answer, so that it delays no change of another."""
VANISHED: Final = (0, 0)
"""Version and stamp of a slot that its shard does not know any more."""


T = TypeVar("T")
_open: weakref.WeakSet[Watch] = weakref.WeakSet()


class Closing(ABC):
    """A context manager that is closed at the end of its block."""

    @abstractmethod
    def close(self) -> None:
        """End it; twice is harmless."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class Following(Closing, Generic[T]):
    """Also an iterator: of what `next` returns, until it is closed."""

    @abstractmethod
    def next(self, timeout_s: float | None = None) -> T | None:
        """Return the next item, or None if none comes in time or it is closed."""

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> T:
        found = self.next()
        if found is None:
            raise StopIteration
        return found


class _Known(NamedTuple):
    """The known state of a slot, the epoch of its shard, and whether it was reported.

    A slot that was null at the start is not reported: its earlier versions are no gap.
    """

    epoch: int
    state: tuple[int, int]
    told: bool = True


@dataclass(frozen=True, slots=True)
class Change:
    """One slot has a new state.

    Attributes:
        entity: The entity.
        aspect: Name of the aspect.
        version: The slot's version; starts again for volatile aspects when their shard restarts.
        position: Position of the commit.
        gap: How many versions of this slot were skipped before this one; at least 1 where its
            versions started again, since this watch may have missed the last ones before that.
        null: Whether the slot is null now.
        captured_ns: When the datum was captured, according to its writer (0: unknown, or null).
        world: Name of the world context.
        carried: The datum, encoded, if it came with the notice; see `Watch.value`.
    """

    entity: Entity
    aspect: str
    version: int
    position: Position
    gap: int
    null: bool
    captured_ns: int = 0
    world: str = ""
    carried: Reading | None = field(default=None, repr=False, compare=False)


@dataclass(slots=True)
class _Following:
    """The notices of one shard: all up to `number` of `epoch` are accounted for.

    `behind` is a later number from a keep-alive, and the time of that keep-alive.
    """

    epoch: int = -1
    number: int = 0
    listed: bool = False
    behind: tuple[tuple[int, int], float] | None = None


def _is_after(told: tuple[int, int], known: tuple[int, int]) -> bool:
    """Whether a shard has sent more, by epoch and number, than is accounted for."""
    return told > known or (told[0] > 0 and is_kept(told[0]) != is_kept(known[0]))


class Watch(Following[Change]):
    """An iterator of `Change`; also a context manager.  One thread at a time may iterate.

    With `lenient` it begins without the shards that do not answer, and lists each once it does.
    """

    def __init__(
        self,
        client: CellClient,
        contexts: tuple[str, ...],
        patterns: tuple[str, ...],
        aspects: tuple[str, ...],
        *,
        lenient: bool = False,
        read: Callable[[Change], Any] | None = None,
    ) -> None:
        self._client, self._lenient, self._read = client, lenient, read
        named = tuple(str(Entities(pattern)) for pattern in patterns)
        self._survey = Survey(contexts, named, aspects, data=read is not None)
        self._interest = Interest(self._survey)
        self._known: dict[Slot, _Known] = {}
        self._following: dict[str, _Following] = {}
        self._placement = client.core.placement
        self._pending: deque[Change] = deque()
        self._closed = threading.Event()
        self._missed = 0
        # Subscribed before the first listing, so that nothing falls between the two.
        self._feed = client.subscribe(self._survey)
        try:
            for shard in client.shards():
                self._following[shard] = _Following()
                if not lenient:
                    self._list_again(shard, timeout_s=10.0)
                elif self._answers(shard, RESYNC_S):
                    self._try_list_again(shard)
        except BaseException:
            self._feed.close()
            raise
        _open.add(self)

    @property
    def closed(self) -> bool:
        """Whether it has ended."""
        return self._closed.is_set()

    @property
    def missed(self) -> int:
        """How many versions were skipped so far, over all slots."""
        return self._missed

    def next(self, timeout_s: float | None = None) -> Change | None:
        """Return the next change, or None if none comes in time or the watch is closed.

        Args:
            timeout_s: How long to wait; None waits until `close`, 0 takes what has arrived.

        Raises:
            MisuseError: The cell was closed, or `timeout_s` is no number of seconds.
        """
        if timeout_s is not None:
            check_seconds("timeout_s", timeout_s)
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        try:
            return self._next(deadline_s)
        except MisuseError:
            if self._closed.is_set():  # before its cell was
                return None
            raise

    def _next(self, deadline_s: float | None) -> Change | None:
        while not self._closed.is_set():
            if self._pending:
                return self._pending.popleft()
            pause_s = POLL_S if any(one.behind for one in self._following.values()) else QUIET_S
            left_s = pause_s if deadline_s is None else deadline_s - time.monotonic()
            notice = self._feed.get(timeout_s=max(0.0, min(pause_s, left_s)))
            if notice is not None:
                self._account_for(notice)
                continue
            # A closed cell's feed answers None at once: without this the loop would spin.
            self._client.check_usable()
            self._look_for_missed_tail()
            if left_s <= 0 and not self._pending:
                return None
        return None

    def value(self, change: Change) -> Any:
        """Return the datum of a change, None if it is null.

        It is that of this version if its notice brought it, else the newest one, by a view.

        Raises:
            MisuseError: The watch was made without ``data=True``.
        """
        if self._read is None:
            raise MisuseError("this watch tells only of changes; make it with data=True")
        return None if change.null else self._read(change)

    @property
    def within_notice(self) -> bool:
        """Whether further changes came with the last one, of the same commit if it was one."""
        return bool(self._pending)

    def next_here(self) -> Change | None:
        """Return the next change of those that came with an earlier one, or None."""
        while not self._pending:
            notice = None if self._closed.is_set() else self._feed.get_here()
            if notice is None:
                return None
            self._account_for(notice)
        return self._pending.popleft()

    def _account_for(self, notice: Notice | Skipped) -> None:
        if isinstance(notice, Skipped):
            self._pass_over(notice)
        else:
            self._take(notice)

    def _take(self, notice: Notice) -> None:
        self._follow_placement()
        following = self._following.get(notice.shard)
        if following is None:
            return
        same_epoch = notice.epoch == following.epoch
        if same_epoch and notice.number <= following.number:
            return
        if is_older(notice.epoch, following.epoch):
            return
        no_stamps = any(not 0 < change.stamp_ns <= STAMP_NS_MAX for change in notice.changes)
        if not same_epoch or notice.number > following.number + 1 or no_stamps:
            self._try_list_again(notice.shard)
            return
        following.number = notice.number
        for slot, version, stamp_ns, null, captured_ns, datum in notice.changes:
            if self._interest.wants(slot) and not self._is_past(slot, version, stamp_ns):
                known = _Known(notice.epoch, (version, stamp_ns))
                self._note(notice.shard, slot, known, null, captured_ns, datum)

    def _is_past(self, slot: Slot, version: int, stamp_ns: int) -> bool:
        """Whether a later state is known: a long listing ends after the notice it begins with."""
        known = self._known.get(slot)
        return known is not None and version < known.state[0] and stamp_ns < known.state[1]

    def _pass_over(self, skipped: Skipped) -> None:
        """Account for notices of other slots; a gap before them remains a gap."""
        following = self._following.get(skipped.shard)
        if (
            following is not None
            and skipped.epoch == following.epoch
            and skipped.after <= following.number < skipped.number
        ):
            following.number = skipped.number

    def _follow_placement(self) -> None:
        """Follow the shards that the cell has now; a new one counts as behind until listed."""
        placement = self._client.core.placement
        if placement is self._placement:
            return
        self._placement, before = placement, self._following
        # Whatever a newcomer has was written while this watch was open.
        self._following = {
            shard: before.get(shard) or _Following(listed=True) for shard in self._client.shards()
        }

    def _look_for_missed_tail(self) -> None:
        """Compare with what the keep-alives know; they come every quarter of a TTL."""
        self._client.renewal.used()
        self._follow_placement()
        for shard, following in self._following.items():
            known = (following.epoch, following.number)
            behind = following.behind
            if behind is None or not _is_after(behind[0], known):
                told = self._client.notice_numbers.get(shard, (0, 0))
                after = _is_after(told, known)
                behind = following.behind = (told, time.monotonic()) if after else None
            if behind is None or time.monotonic() - behind[1] < self._feed.late_s:
                continue
            missing = self._lenient and following.epoch < 0
            if not missing or self._answers(shard, MISSING_S):
                self._try_list_again(shard)

    def _answers(self, shard: str, timeout_s: float) -> bool:
        """Whether a shard answers in time; if not, it is left alone for a while."""
        with contextlib.suppress(LinkError):
            if self._client.call_once([(shard, Ping())], timeout_s=timeout_s)[0] is not None:
                return True
        self._following[shard].behind = ((0, 0), time.monotonic() + RESYNC_S)
        return False

    def _try_list_again(self, shard: str) -> None:
        try:
            self._list_again(shard, timeout_s=RESYNC_S)
        except ShardUnreachableError:
            # It stays behind what the keep-alives will say, so this comes round again.
            self._following[shard].epoch = -1

    def _list_again(self, shard: str, *, timeout_s: float) -> None:
        answer = self._client.call(shard, self._survey, timeout_s=timeout_s)
        if not isinstance(answer, Surveyed):
            return
        states: list[SlotState] = sorted(answer.states, key=lambda state: state.stamp_ns)
        for state in states:
            null = bool(state.null_reason)
            known = _Known(answer.epoch, (state.version, state.stamp_ns))
            if null and state.slot not in self._known:
                if not self._following[shard].listed:
                    self._known[state.slot] = known._replace(told=False)
                continue
            self._note(shard, state.slot, known, null, state.captured_ns)
        self._note_vanished(shard, answer.epoch, {state.slot for state in states})
        self._feed.not_beyond(shard, answer.epoch, answer.notice_number)
        self._following[shard] = _Following(answer.epoch, answer.notice_number, listed=True)

    def _note_vanished(self, shard: str, epoch: int, listed: set[Slot]) -> None:
        """Report slots that a shard no longer lists: it kept them in memory and restarted.

        Slots that moved to another shard are listed there.
        """
        gone = self._gone_from(shard, listed)
        if gone and epoch != self._following[shard].epoch:
            # It may have restarted with other shards beside it, which its welcome tells.
            self._client.call_once([(shard, self._client.core.hello(shard))])
            gone = self._gone_from(shard, listed)
        for slot, known in gone:
            if known.told:
                self._note(shard, slot, _Known(epoch, VANISHED), null=True)
            else:
                del self._known[slot]

    def _gone_from(self, shard: str, listed: set[Slot]) -> list[tuple[Slot, _Known]]:
        """Return the known slots that a shard should list and does not, and that are no news."""
        return [
            (slot, known)
            for slot, known in self._known.items()
            if slot not in listed
            and known.state != VANISHED
            and self._client.shard_of(slot.entity) == shard
        ]

    def _note(
        self,
        shard: str,
        slot: Slot,
        state: _Known,
        null: bool,
        captured_ns: int = 0,
        datum: Datum | None = None,
    ) -> None:
        """Add a change unless it is known.

        A state is known by version and stamp: durable slots keep both over a restart of their
        shard, volatile ones start counting again with a later stamp.
        """
        known = self._known.get(slot)
        if known is not None and known.state == state.state:
            self._known[slot] = state._replace(told=known.told)
            return
        self._known[slot] = state
        version, stamp_ns = state.state
        if known is None:
            gap = version - 1 if self._following[shard].listed else 0
        elif known.epoch != state.epoch and not self._goes_on(shard, slot, state.epoch):
            gap = max(1, version - 1)
        else:
            last = known.state[0]
            gap = version - last - 1 if version > last else version - 1
        gap = max(0, gap)
        self._missed += gap
        position, carried = Position(stamp_ns, shard), None
        if datum is not None:
            named, size = bool(datum.file), datum.size
            shown = SlotState(slot, version, stamp_ns, size, datum, False, named, "", captured_ns)
            carried = Reading(shard, state.epoch, shown)
        entity = Entity(slot.entity)
        self._pending.append(
            Change(
                entity,
                slot.aspect,
                version,
                position,
                gap,
                null,
                captured_ns,
                slot.context,
                carried,
            )
        )

    def _goes_on(self, shard: str, slot: Slot, epoch: int) -> bool:
        """Whether a restarted shard continues the version numbers of a slot."""
        if slot.aspect not in self._client.aspect_entries():
            # Another program registered it after this client had greeted the shard.
            self._client.call_once([(shard, self._client.core.hello(shard))])
        entry = self._client.aspect_entries().get(slot.aspect)
        kept = entry is not None and entry.durability != Durability.VOLATILE.value
        return kept and is_kept(epoch)

    def close(self) -> None:
        """End the watch; a `next` that waits returns None within 0.1 s."""
        self._closed.set()
        self._feed.close()


def end_watches() -> None:
    """End all watches before their cells: the process ends, which no thread has asked for."""
    for watch in list(_open):
        watch._closed.set()  # noqa: SLF001 - of this module; each cell closes its feeds
