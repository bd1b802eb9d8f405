"""How changes reach a running actor: one watch per world context.

An actor with one watch follows it by its own thread while it has nothing else to do.  Of several
watches each has a thread that only fills the actor's inbox, since a watch blocks.  A watch whose
shard is away is opened again with growing pauses; its snapshot then repeats what is known, which
`PendingTriggers` passes over.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from typing import TYPE_CHECKING, Final, Generic, Self, TypeVar

from enact_dist.access.session import session_of
from enact_dist.access.sets import Capture, PendingSets
from enact_dist.access.together import captured_versions
from enact_dist.access.trigger import Trigger
from enact_dist.actor.report import Repeated
from enact_dist.actor.triggers import BackOff, PendingTriggers
from enact_dist.errors import LinkError
from enact_dist.link.clock import monotonic_ns
from enact_dist.patterns import pattern_matches

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence

    from enact_dist.access.sets import IncompleteSet
    from enact_dist.access.watch import Change, Watch
    from enact_dist.actor.binding import BoundActor, Watched
    from enact_dist.terms import Entity

log = logging.getLogger("enact.actor")

AT_ONCE_MAX: Final = 1000
"""Changes that an idle actor notes before it looks for a run again."""

P = TypeVar("P", PendingTriggers, PendingSets)


class _Box(Generic[P]):
    """What is pending; the watching threads fill it, the actor's thread empties it."""

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
    """`PendingTriggers` that the watching threads fill and the actor's thread empties."""

    meanwhile = False
    """Whether it needs changes during an update, and therefore a separate thread."""

    def __init__(self, *, per_entity: bool) -> None:
        super().__init__(PendingTriggers(per_entity=per_entity))

    def changed(self, source: int, entity: Entity, state: Hashable, *, missed: int = 0) -> None:
        """Take note of a change; `missed` states before it were lost on the way."""
        with self._filled:
            self._pending.skipped += missed
            if self._pending.changed(source, entity, state):
                self._filled.notify_all()

    def vanished(self, source: int, entity: Entity, state: Hashable, *, in_set: bool) -> None:
        """Take note that a trigger datum is null."""
        with self._filled:
            if self._pending.vanished(source, entity, state, in_set=in_set):
                self._filled.notify_all()

    def used(self, states: Mapping[tuple[int, Entity], Hashable]) -> None:
        """Take note of the states that an update that just ended has seen already."""
        with self._filled:
            for (source, entity), state in states.items():
                self._pending.used(source, entity, state)


class SetInbox(_Box[PendingSets]):
    """`PendingSets` that the watching threads fill and the actor's thread empties."""

    def __init__(self, sets: PendingSets) -> None:
        super().__init__(sets)
        self._repeated = Repeated()

    @property
    def sets(self) -> PendingSets:
        """The account of the sets, for its counters."""
        return self._pending

    def start(self, versions: Sequence[Sequence[Capture]]) -> None:
        """Take what there is when the actor starts."""
        with self._filled:
            self._pending.start(versions, monotonic_ns())

    def misses(self, member: int, version: int) -> bool:
        """Whether versions before this one were not seen."""
        with self._filled:
            return self._pending.misses(member, version)

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

    def tell_left(self) -> None:
        """Tell of the incomplete sets that were only counted so far."""
        with self._filled:
            left = self._repeated.left()
        for count, newest in left:
            log.warning("%d more incomplete sets, the newest a %s", count, newest)


def _tell(line: str, count: int | None) -> None:
    """Write a line about an incomplete set: the first, or one for `count` without the same data."""
    if count is not None:
        log.warning("%s%s", line, f" ({count} like it since the last line)" if count else "")


def _by_context(watched: Iterable[Watched]) -> dict[str, list[Watched]]:
    """Return what one watch can follow together, by the name of the world context."""
    groups: dict[str, list[Watched]] = {}
    for each in watched:
        groups.setdefault(each.context.name, []).append(each)
    return groups


def _watch_of(group: Sequence[Watched]) -> Watch:
    patterns = dict.fromkeys(str(watched.entities) for watched in group)
    aspects = {aspect.name: aspect for watched in group for aspect in watched.aspects}
    return group[0].context.watch_all(patterns, aspects.values())


def _broke_s(group: Sequence[Watched], error: Exception, refused: int) -> float:
    """Say that a watch broke, and return how long to wait before it is opened again."""
    wait_s = BackOff().wait_s(refused, random.random())  # noqa: S311 (spreads retries)
    log.warning(
        "watch of %s in %s broke, again in %.2f s: %s",
        ", ".join(str(watched.entities) for watched in group),
        group[0].context.name,
        wait_s,
        error,
    )
    return wait_s


def watching(bound: BoundActor, inbox: Inbox | SetInbox) -> Watching | OwnWatch:
    """Return what follows an actor's triggers: by its own thread where one watch sees them all."""
    one = len(_by_context(bound.watched())) == 1
    own = one and not (isinstance(inbox, Inbox) and inbox.meanwhile)
    return OwnWatch(bound, inbox) if own else Watching(bound, inbox)


class Watching:
    """All watches of one actor while it runs; a context manager.

    Args:
        bound: The actor.
        inbox: Where its changes go.
    """

    def __init__(self, bound: BoundActor, inbox: Inbox | SetInbox) -> None:
        self._bound = bound
        self._inbox = inbox
        self._over = threading.Event()
        self._guard = threading.Lock()
        self._open: list[Watch] = []
        self._threads = [
            threading.Thread(target=self._follow, args=(group,), name=f"watch {name}", daemon=True)
            for name, group in _by_context(bound.watched()).items()
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._guard:
            self._over.set()
            opened = tuple(self._open)
        for watch in opened:
            watch.close()
        for thread in self._threads:
            thread.join()

    def _follow(self, group: Sequence[Watched]) -> None:
        refused = 0
        while not self._over.is_set():
            try:
                for change in self._changes(group):
                    refused = 0
                    self._note_in_all(group, change)
            except LinkError as error:
                self._over.wait(_broke_s(group, error, refused))
                refused += 1
            except Exception as error:  # noqa: BLE001 (raised again in the actor's thread)
                if not self._over.is_set():
                    self._inbox.fail(error)
                return

    def _changes(self, group: Sequence[Watched]) -> Iterator[Change]:
        with _watch_of(group) as watch:
            with self._guard:
                if self._over.is_set():
                    return
                self._open.append(watch)
            try:
                yield from watch
            finally:
                with self._guard:
                    self._open.remove(watch)

    def take(self, wait_s: float) -> Trigger | None:
        """Return the next run that is due, waiting at most `wait_s` for one; else None.

        Raises:
            Exception: The error that ended a watch.
        """
        return self._inbox.take(wait_s)

    def _note_in_all(self, group: Sequence[Watched], change: Change) -> None:
        for watched in group:
            if pattern_matches(str(watched.entities), change.entity.name):
                self._note(watched, change)

    def _note(self, watched: Watched, change: Change) -> None:
        declaration = self._bound.declaration
        if not self._bound.covers(change.entity):
            return
        if isinstance(self._inbox, SetInbox):
            for index in watched.triggers.get(str(change.aspect), ()):
                self._note_in_set(self._inbox, index, change)
            return
        state = (change.version, change.position.stamp_ns)
        for index in watched.triggers.get(str(change.aspect), ()):
            if change.null:
                in_set = declaration.triggers[index].access.each
                self._inbox.vanished(index, change.entity, state, in_set=in_set)
            else:
                self._inbox.changed(index, change.entity, state, missed=change.gap)

    def _note_in_set(self, inbox: SetInbox, member: int, change: Change) -> None:
        """Take a change of a set's member; where versions were missed, what is retained of it."""
        versions = [
            Capture(change.version, change.position.stamp_ns, change.captured_ns, change.null)
        ]
        if inbox.misses(member, change.version):
            view = self._bound.set_views()[member]
            versions = captured_versions(session_of((view,)), (view,))[0]
        inbox.captured(member, versions)


class OwnWatch(Watching):
    """The only watch of an actor, followed by the actor's thread itself while it is idle.

    No other thread has to be woken first.  What comes during an update waits in the watch's feed.
    """

    def __init__(self, bound: BoundActor, inbox: Inbox | SetInbox) -> None:
        super().__init__(bound, inbox)
        self._threads = []
        (self._group,) = _by_context(bound.watched()).values()
        self._watch: Watch | None = None
        self._again_ns = 0
        self._refused = 0

    def __exit__(self, *_: object) -> None:
        self._end()

    def _end(self) -> None:
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.close()

    def take(self, wait_s: float) -> Trigger | None:
        """Return the next run that is due, following the watch for at most `wait_s`; else None."""
        until_ns = monotonic_ns() + round(wait_s * 1e9)
        while True:
            due_ns = self._inbox.due_ns()
            wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
            self._follow_for(max(0, wake_ns - monotonic_ns()) / 1e9)
            trigger = self._inbox.take(0.0)
            if trigger is not None or monotonic_ns() >= until_ns:
                return trigger

    def _follow_for(self, wait_s: float) -> None:
        """Wait so long for a change, and note all that have arrived by then."""
        try:
            if self._watch is None:
                left_s = (self._again_ns - monotonic_ns()) / 1e9
                if left_s > 0:
                    time.sleep(min(left_s, wait_s))
                    return
                self._watch = _watch_of(self._group)
            change = self._watch.next(timeout_s=wait_s)
            for _ in range(AT_ONCE_MAX):
                if change is None:
                    return
                self._refused = 0
                self._note_in_all(self._group, change)
                change = self._watch.next_here()
            if change is not None:
                self._note_in_all(self._group, change)
        except LinkError as error:
            self._end()
            self._again_ns = monotonic_ns() + round(
                _broke_s(self._group, error, self._refused) * 1e9
            )
            self._refused += 1
