"""How changes reach a running actor whose locks do not wait for news: one watch per world context.

An actor with one watch follows it in its own thread while it is idle: no other thread has to be
woken first, and changes that arrive during an update wait in the watch's feed.  If there are
several watches, each has a thread that fills the actor's inbox, because a watch blocks.  A watch
whose shard is away is opened again after growing pauses; its snapshot then repeats known states,
which `PendingTriggers` ignores.
"""

from __future__ import annotations

import logging
import random
import threading
from typing import TYPE_CHECKING, Any, Final, Generic, Self, TypeVar

from enact_dist.access.session import session_of
from enact_dist.access.sets import Capture, IncompleteSet, PendingSets
from enact_dist.access.together import OPEN_LIMIT, captured_versions
from enact_dist.actor.report import ERROR_LENGTH_MAX, Repeated
from enact_dist.actor.triggers import BackOff, PendingTriggers
from enact_dist.core.protocol.messages import DatumRead
from enact_dist.errors import LinkError
from enact_dist.link.clock import monotonic_ns
from enact_dist.patterns import pattern_matches
from enact_dist.terms import Entity, View
from enact_dist.world.context import watch_patterns

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from enact_dist.access.trigger import Trigger
    from enact_dist.access.watch import Change, Watch
    from enact_dist.actor.binding import BoundActor, Watched
    from enact_dist.core.client.plan import Reading
    from enact_dist.core.protocol.datum import Slot

log = logging.getLogger("enact.actor")

AT_ONCE_MAX: Final = 1000
"""Changes that an actor notes before it looks for a run again."""
FOLLOW_S: Final = 0.5
"""How long a thread waits for a change before it looks whether the actor has ended."""

P = TypeVar("P", PendingTriggers, PendingSets)


class _Box(Generic[P]):
    """Pending runs: watching threads add changes, the actor's thread takes runs."""

    def __init__(self, pending: P) -> None:
        self._pending: P = pending
        self._filled = threading.Condition()
        self._error: Exception | None = None

    @property
    def skipped(self) -> int:
        """States that no update saw, so far."""
        return self._pending.skipped

    def postpone(self, trigger: Trigger, due_ns: int) -> None:
        """Put a refused run back until `due_ns`."""
        with self._filled:
            self._pending.postpone(trigger, due_ns)

    def due_ns(self) -> int | None:
        """Return when `take` will have something; None for not before a change."""
        with self._filled:
            return self._pending.due_ns()

    def note(self, index: int, change: Change) -> None:
        """Take note of a change of the datum of a trigger, by the trigger's index."""
        raise NotImplementedError

    def fail(self, error: Exception) -> None:
        """Make the actor's thread raise the error that ended a watch."""
        with self._filled:
            self._error = error
            self._filled.notify_all()

    def take(self, wait_s: float) -> Trigger | None:
        """Return the next run that is due, waiting at most `wait_s` for one; else None.

        Raises:
            Exception: The error that ended a watch.
        """
        until_ns = monotonic_ns() + round(wait_s * 1e9)
        with self._filled:
            while True:
                if self._error is not None:
                    raise self._error
                now_ns = monotonic_ns()
                if trigger := self._pending.take(now_ns):
                    return trigger
                due_ns = self._pending.due_ns()
                wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
                if now_ns >= until_ns:
                    return None
                self._filled.wait((wake_ns - now_ns) / 1e9)


class Inbox(_Box[PendingTriggers]):
    """`PendingTriggers` that the watching threads fill and the actor's thread empties.

    Args:
        per_entity: As for `PendingTriggers`.
        each: The indices of the triggers that look at a set of data, not at one.
    """

    meanwhile = False
    """Whether it needs changes during an update, and therefore a separate thread."""

    def __init__(self, *, per_entity: bool, each: Collection[int] = ()) -> None:
        super().__init__(PendingTriggers(per_entity=per_entity))
        self._of_sets = each

    def note(self, index: int, change: Change) -> None:
        """Take note of a change; states that were lost before it are counted as skipped."""
        entity, state = change.entity, (change.version, change.position.stamp_ns)
        with self._filled:
            if change.null:
                in_set = index in self._of_sets
                news = self._pending.vanished(index, entity, state, in_set=in_set)
            else:
                self._pending.skipped += change.gap
                news = self._pending.changed(index, entity, state)
            if news:
                self._filled.notify_all()

    def used(
        self, states: Mapping[tuple[int, Entity], tuple[int, int]], *, standing: bool = False
    ) -> None:
        """Note which states the update that has just ended had seen.

        Args:
            states: Version and stamp of each datum, by trigger and entity.
            standing: Whether its lock waited for news, so that no watch has counted the versions
                between.
        """
        with self._filled:
            for (source, entity), state in states.items():
                if standing:
                    self._pending.passed(source, entity, state[0])
                self._pending.used(source, entity, state)

    def seen(self, slots: Sequence[Slot]) -> tuple[DatumRead, ...]:
        """Return what an update has seen of each trigger's slot, for `ActorLock.after`."""
        with self._filled:
            states = [self._pending.seen(at, Entity(one.entity)) for at, one in enumerate(slots)]
        return tuple(
            DatumRead(slot, *(state if isinstance(state, tuple) else (0, 0)))
            for slot, state in zip(slots, states, strict=True)
        )


class SetInbox(_Box[PendingSets]):
    """`PendingSets` that the watching threads fill and the actor's thread empties."""

    meanwhile = False

    def __init__(self, sets: PendingSets, views: tuple[View[Any], ...] = ()) -> None:
        super().__init__(sets)
        self._views = views
        self._carried: list[dict[int, Reading]] = [{} for _ in views]
        self._repeated = Repeated()

    @property
    def sets(self) -> PendingSets:
        """The account of the sets, for its counters."""
        return self._pending

    def start(self) -> None:
        """Take what there is when the actor starts.

        Raises:
            ShardUnreachableError: A shard does not answer.
        """
        versions = captured_versions(session_of(self._views), self._views)
        with self._filled:
            self._pending.start(versions, monotonic_ns())

    def note(self, index: int, change: Change) -> None:
        """Take a change of a member; where versions were missed, what is retained of it."""
        stamp_ns = change.position.stamp_ns
        versions = [Capture(change.version, stamp_ns, change.captured_ns, change.null)]
        with self._filled:
            misses = self._pending.misses(index, change.version)
            carried = self._carried[index]
            carried.pop(change.captured_ns, None)
            if change.carried is not None:
                carried[change.captured_ns] = change.carried
                if len(carried) > OPEN_LIMIT:
                    del carried[next(iter(carried))]
        if misses:
            view = self._views[index]
            (versions,) = captured_versions(session_of((view,)), (view,))
        self.captured(index, versions)

    def shown(self, members: Sequence[int]) -> tuple[Reading, ...]:
        """Return the data of a set as notices of one shard have brought them; () if one is missing.

        They are one cut: its notices are noted whole, in order, and without a gap.
        """
        with self._filled:
            each = zip(self._carried, members, strict=True)
            found = [carried.get(stamp_ns) for carried, stamp_ns in each]
        shown = tuple(one for one in found if one is not None)
        one_shard = len({(one.shard, one.epoch) for one in shown}) == 1
        return shown if one_shard and len(shown) == len(members) else ()

    def captured(self, member: int, versions: Sequence[Capture]) -> None:
        """Take versions of one member of the set, oldest first."""
        with self._filled:
            before, unstamped = self._pending.incomplete, self._pending.unstamped_from
            if self._pending.captured(member, versions, monotonic_ns()):
                self._filled.notify_all()
            given_up = self._pending.incomplete - before
            told = list(self._pending.told)[-given_up:] if given_up else []
            counts = [self._count("", incomplete) for incomplete in told]
            news = [one for one in self._pending.unstamped_from if one not in unstamped]
        for name in news:
            log.warning(
                "%s comes without a capture stamp, so no set can have it; its writer has to give"
                " one: lock.put(…, stamp_ns=…)", name
            )  # fmt: skip
        for incomplete, count in zip(told, counts, strict=True):
            _tell(f"incomplete {incomplete}", count)

    def gone(self, stamp_ns: int, missing: Sequence[int]) -> None:
        """Count a complete set whose data were outside retention before its update could run."""
        with self._filled:
            self._pending.gone(stamp_ns, missing)
            told = self._pending.told[-1]
            count = self._count("gone", told)
        _tell(f"incomplete, outside retention before its update: {told}", count)

    def _count(self, how: str, incomplete: IncompleteSet) -> int | None:
        """Return the count to report now for sets without the same data, as `Repeated`."""
        return self._repeated.tell((how, incomplete.missing), str(incomplete), monotonic_ns())

    def counts(self) -> dict[str, object]:
        """Return what `ActorStatistics` shows of the sets."""
        sets = self._pending
        return {
            "incomplete": sets.incomplete,
            "last_incomplete": str(sets.told[-1])[:ERROR_LENGTH_MAX] if sets.told else "",
            "late": sets.late,
            "unstamped": sets.unstamped,
            "unstamped_from": ", ".join(sets.unstamped_from)[:ERROR_LENGTH_MAX],
            "partial": sets.partial,
            "last_partial": sets.last_partial[:ERROR_LENGTH_MAX],
        }

    def tell_left(self) -> None:
        """Log the incomplete sets that have only been counted so far."""
        with self._filled:
            left = self._repeated.left()
        for count, newest in left:
            log.warning("%d more incomplete sets, the newest a %s", count, newest)


def _tell(line: str, count: int | None) -> None:
    """Log an incomplete set: the first one, or `count` sets that lack the same data."""
    if count is not None:
        log.warning("%s%s", line, f" ({count} like it since the last line)" if count else "")


class _Follower:
    """One watch of an actor, opened again with growing pauses while its shard is away."""

    def __init__(
        self,
        bound: BoundActor,
        watched: Sequence[Watched],
        inbox: Inbox | SetInbox,
        over: threading.Event,
    ) -> None:
        self._bound, self._watched, self._inbox, self._over = bound, watched, inbox, over
        self._watch: Watch | None = None
        self._again_ns = 0
        self._refused = 0

    def run(self) -> None:
        """Follow the watch until the actor ends, in a thread of its own."""
        try:
            while not self._over.is_set():
                self.follow(FOLLOW_S)
        except Exception as error:  # noqa: BLE001 (raised again in the actor's thread)
            if not self._over.is_set():
                self._inbox.fail(error)
        finally:
            self.close()

    def follow(self, wait_s: float) -> None:
        """Wait so long for a change, and note all that have arrived by then."""
        try:
            watch = self._watch  # `close` is called by another thread, too
            if watch is None:
                left_s = (self._again_ns - monotonic_ns()) / 1e9
                if left_s > 0:
                    self._over.wait(min(left_s, wait_s))
                    return
                watch = self._watch = self._opened()
            change, noted = watch.next(timeout_s=wait_s), 0
            while change is not None:
                self._refused = 0
                self._note(change)
                noted += 1
                change = watch.next_here() if noted < AT_ONCE_MAX or watch.within_notice else None
        except LinkError as error:
            self.close()
            pause_s = BackOff().wait_s(self._refused, random.random())  # noqa: S311 (spreads retries)
            self._refused += 1
            self._again_ns = monotonic_ns() + round(pause_s * 1e9)
            log.warning(
                "watch of %s in %s broke, again in %.2f s: %s",
                ", ".join(str(watched.entities) for watched in self._watched),
                self._watched[0].context.name, pause_s, error,
            )  # fmt: skip

    def close(self) -> None:
        """Close the watch, which ends a wait for its next change."""
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.close()

    def _opened(self) -> Watch:
        patterns = dict.fromkeys(str(watched.entities) for watched in self._watched)
        aspects = {aspect.name: aspect for watched in self._watched for aspect in watched.aspects}
        context, data = self._watched[0].context, self._bound.views_one_set
        return watch_patterns(context, patterns, aspects.values(), data=data)

    def _note(self, change: Change) -> None:
        if not self._bound.covers(change.entity):
            return
        for watched in self._watched:
            if pattern_matches(str(watched.entities), change.entity.name):
                for index in watched.triggers.get(str(change.aspect), ()):
                    self._inbox.note(index, change)


class Watching:
    """All watches of one actor while it runs; a context manager.

    Args:
        bound: The actor.
        inbox: Where its changes go.
        own: Whether the actor's thread itself follows the watch; None: where there is only one.

    Attributes:
        own: Whether it does.
    """

    def __init__(
        self, bound: BoundActor, inbox: Inbox | SetInbox, *, own: bool | None = None
    ) -> None:
        self._inbox = inbox
        self._over = threading.Event()
        groups: dict[str, list[Watched]] = {}
        for each in bound.watched():
            groups.setdefault(each.context.name, []).append(each)
        self.own = len(groups) == 1 and not inbox.meanwhile if own is None else own
        self._followers = [_Follower(bound, group, inbox, self._over) for group in groups.values()]
        self._threads = [
            threading.Thread(target=follower.run, name=f"watch {name}", daemon=True)
            for name, follower in zip(groups, self._followers, strict=True)
            if not self.own
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for follower in self._followers:
            follower.close()
        for thread in self._threads:
            thread.join()

    def take(self, wait_s: float) -> Trigger | None:
        """Return the next run that is due, waiting at most `wait_s` for one; else None.

        Raises:
            Exception: The error that ended a watch.
        """
        if not self.own:
            return self._inbox.take(wait_s)
        until_ns = monotonic_ns() + round(wait_s * 1e9)
        while True:
            due_ns = self._inbox.due_ns()
            wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
            self._followers[0].follow(max(0, wake_ns - monotonic_ns()) / 1e9)
            trigger = self._inbox.take(0.0)
            if trigger is not None or monotonic_ns() >= until_ns:
                return trigger
