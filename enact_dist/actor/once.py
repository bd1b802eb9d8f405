"""An actor that acts at most once for each version: `once = True`.

::

    take        one lock: the version is new → its outcome is "taken", committed
    update      no lock is held; `lock.newer` says when to end
    outcome     one lock: the result, together with all that the update wrote

Rules that a change must keep:

1. `update` runs only after a commit, known to stand, that names its version as taken; no other
   process takes that version afterwards.  So it runs at most once per version, whatever dies.
2. An actor that finds a version taken by an ended session records it as interrupted and runs the
   next one; the interrupted version never runs again.
3. While the session that took a version lives, all other actors wait.
4. An outcome only ever replaces the ``taken`` outcome that it belongs to.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.access.lock import Lock
from enact_dist.access.trigger import Newer
from enact_dist.actor.inbox import Inbox
from enact_dist.actor.running.doing import Doing, place_of
from enact_dist.actor.triggers import BackOff
from enact_dist.errors import (
    ChangedError,
    CommitUnknownError,
    EnactError,
    LeaseLostError,
    LinkError,
    LockTimeoutError,
)
from enact_dist.link.clock import wall_ns
from enact_dist.outcome import Outcome, Seen, is_new
from enact_dist.terms import Entities, Entity, LockRequestOne, View, Write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.access.watch import Change
    from enact_dist.actor.binding import BoundActor
    from enact_dist.actor.lock import OnceLock

REFUSALS: Final = (
    LockTimeoutError,
    LeaseLostError,
    ChangedError,
    CommitUnknownError,
    LinkError,
)
"""Errors of an attempt that are not the actor's fault."""
OUTCOME_S: Final = 5.0
"""How long a stopped actor still tries to write an outcome."""
KNOWN_MAX: Final = 1024
"""How many entities' newest versions are remembered; beyond that, deleted ones are dropped."""
REMAINS: Final = "its outcome will read interrupted, and it is not run again"
"""The result of a motion that is cut off."""

log = logging.getLogger("enact.actor")

_ended: set[str] = set()
"""The runs of this process that have ended; its session may go on with the next run."""


class TakenError(LockTimeoutError):
    """Another process with a live session acts on this version or on an earlier one."""


class Acted(NamedTuple):
    """The result of one attempt.

    Attributes:
        states: The states of the trigger data that it has seen, as `PendingTriggers.used`.
    """

    states: dict[tuple[int, Entity], tuple[int, int]]
    ran: bool = False
    error: Exception | None = None


class OnceInbox(Inbox):
    """An inbox that also notifies the running update of newer versions."""

    meanwhile = True

    def __init__(self, *, per_entity: bool) -> None:
        super().__init__(per_entity=per_entity)
        self._newest: dict[Entity, tuple[int, bool]] = {}
        self._running: tuple[Entity, int, Newer] | None = None

    def note(self, index: int, change: Change) -> None:
        """Take note of a change, as `Inbox`."""
        super().note(index, change)
        entity, committed_ns = change.entity, change.position.stamp_ns
        with self._filled:
            if committed_ns > self._newest.get(entity, (0, False))[0]:
                if len(self._newest) >= KNOWN_MAX:
                    self._newest = {one: at for one, at in self._newest.items() if not at[1]}
                self._newest[entity] = committed_ns, change.null
                self._tell()

    def begin(self, entity: Entity, committed_ns: int, newer: Newer) -> None:
        """Set `newer` as soon as there is a version of `entity` after this one."""
        with self._filled:
            self._running = entity, committed_ns, newer
            self._tell()

    def end(self) -> None:
        """Stop notifying the update."""
        with self._filled:
            self._running = None

    def _tell(self) -> None:
        if self._running is None:
            return
        entity, committed_ns, newer = self._running
        newest_ns, null = self._newest.get(entity, (0, False))
        if newest_ns > committed_ns:
            newer.set("cancelled" if null else "preempted")


class Once:
    """Takes, runs and closes versions for one actor.

    Args:
        bound: The actor.
        name: Its name.
        doing: What it does, for other threads.
        stop: Set when it is to stop.
        inbox: Where its changes go; None without a watch, as in tests on a manual clock.

    Attributes:
        interrupted: Versions that were found taken by a session that is gone.
        last_interrupted: The newest of them.
    """

    def __init__(
        self,
        bound: BoundActor,
        name: str,
        doing: Doing,
        *,
        stop: threading.Event | None = None,
        inbox: OnceInbox | None = None,
    ) -> None:
        self._bound, self._name, self._doing = bound, name, doing
        self._stop = stop or threading.Event()
        self._inbox = inbox
        self._run = secrets.token_hex(4)
        self._begun: dict[Entity, Outcome] = {}
        self._waits_for: Outcome | None = None
        self._back_off = BackOff(spread=0.0)
        self.interrupted = 0
        self.last_interrupted = ""

    def attempt(
        self,
        entity: Entity,
        *,
        wait_s: float | None = None,
        granted: Callable[[], object] = lambda: None,
    ) -> Acted:
        """Act on the newest version of an entity's datum unless an actor already has.

        Args:
            entity: The triggering entity.
            wait_s: How long to wait for a lock; None: as long as the actor says.
            granted: Called when the version is taken, before `update`.

        Raises:
            TakenError: Another process acts on it.
            LockTimeoutError, LeaseLostError, ChangedError, LinkError: It was not taken, and
                `update` did not run.
            CommitUnknownError: `update` did not run; the next attempt finds whether it was taken.
        """
        while True:
            lock = self._bound.once_lock(entity, wait_s=wait_s, stop=self._stop)
            outcome = self._request(lock)
            with self._taking(lock):
                states = lock.granted_states(self._bound.declaration.triggers[0])
                seen = {(0, found): state for found, state in states.items()}
                last = lock.get(outcome)
                open_ = last if last is not None and self._is_open(entity, last) else None
                taken = None
                if open_ is None:
                    taken = self._taken(lock, last)
                    if taken is not None:
                        lock.keep()
                        lock[outcome] = taken
            if open_ is None:
                self._waits_for = None
                break
            self._close(outcome, open_)
        if taken is None:
            return Acted(seen)
        granted()
        return Acted(seen, ran=True, error=self._act(entity, lock, outcome, taken))

    def end(self) -> None:
        """Note that this run acts on nothing any more."""
        _ended.add(self._run)

    @contextlib.contextmanager
    def _taking(self, lock: OnceLock) -> Iterator[None]:
        try:
            with lock:
                yield
        except BaseException:
            lock.end()
            raise

    def sweep(self) -> bool:
        """Close the versions that earlier runs of this actor left as taken.

        Returns:
            Whether none is left because all sessions of such runs have ended.

        Raises:
            LinkError: A shard does not answer.
        """
        left = False
        declared = self._bound.declaration.outcome
        assert declared is not None
        context = self._bound.contexts[declared.world.name]
        only = self._bound.only if isinstance(declared.entity, Entities) else None
        for info in context.list_slots(str(only or declared.entity), (declared.aspect.name,)):
            view = View(context, info.entity, declared.aspect)
            last = context.view(view).get(view)
            if last is not None and last.state == "taken":
                try:
                    self._close(Write(context, info.entity, declared.aspect), last)
                except TakenError:
                    left = True
        return not left

    def _request(self, lock: OnceLock) -> Write[Outcome]:
        declared = self._bound.declaration.outcome
        assert declared is not None
        return lock.own(declared)

    def _is_open(self, entity: Entity, last: Outcome) -> bool:
        """Whether a claim stands whose update may have run: not one of ours that never began."""
        if last.state != "taken":
            return False
        return last.run != self._run or self._begun.get(entity) == last

    def _taken(self, lock: OnceLock, last: Outcome | None) -> Outcome | None:
        """Return a claim on the version that the lock shows; None if there is none."""
        trigger = self._bound.declaration.triggers[0]
        assert isinstance(trigger, LockRequestOne)
        if lock.is_null(trigger):
            return None
        ((version, committed_ns),) = lock.granted_states(trigger).values()
        plan = Seen(version, committed_ns)
        unsure = last is not None and last.state == "taken"  # ours: its commit was not answered
        if not unsure and not is_new(plan, last):
            return None
        client = self._session().client.core
        actor = f"{self._name}, process {client.pid} on {client.host}"
        return Outcome(
            "taken", *plan, actor=actor, session=client.session, run=self._run, taken_ns=wall_ns()
        )

    def _session(self) -> Any:
        return next(iter(self._bound.contexts.values())).session

    def _close(self, outcome: Write[Outcome], found: Outcome) -> None:
        """Record a version as interrupted if the process that claimed it has ended.

        Raises:
            TakenError: Its session is still alive.
            LinkError: A shard that may know the session does not answer.
        """
        mine = found.run == self._run or found.run in _ended
        if not mine and self._lives(found.session):
            if found != self._waits_for:
                self._waits_for = found
                log.warning(
                    "%s: waits: version %d for %r was taken by %s, which still runs and has not"
                    " written an outcome yet",
                    self._name, found.version, outcome, found.actor,
                )  # fmt: skip
            raise TakenError(f"{outcome!r}: version {found.version} is taken by {found.actor}")
        text = f"taken by {found.actor}, which ended before an outcome was written"
        with Lock(outcome, wait_s=self._bound.actor.wait_s) as closing:
            if closing.get(outcome) != found:
                return  # another thread has closed it
            closing[outcome] = replace(found, state="interrupted", text=text)
        self.interrupted += 1
        self.last_interrupted = f"version {found.version} for {outcome!r}"
        log.error(
            "%s: interrupted: %s was %s; how far it came is unknown, and it will not run again."
            " Write the datum again to run it",
            self._name, self.last_interrupted, text,
        )  # fmt: skip

    def _lives(self, session: str) -> bool:
        infos = self._bound.cell.actors()
        return any(info.session == session and not info.silent for info in infos)

    def _act(
        self, entity: Entity, lock: OnceLock, outcome: Write[Outcome], taken: Outcome
    ) -> Exception | None:
        """Run `update` for the version that was taken, write its outcome, return its error."""
        newer, error = Newer(self._stop), None
        self._begun[entity] = taken
        lock.begin(outcome, taken, newer)
        if self._inbox is not None:
            self._inbox.begin(entity, taken.committed_ns, newer)
        try:
            with self._doing.inside("update", about=f" for {entity}", remains=REMAINS):
                self._bound.actor.update(lock)
            ended = replace(taken, state=newer.ended())
        except Exception as raised:  # noqa: BLE001 (an update can raise anything)
            error = raised
            text = f"{type(raised).__name__} at {place_of(raised)}: {raised}"
            ended = replace(taken, state="failed", text=text[:2000])
        finally:
            if self._inbox is not None:
                self._inbox.end()
        # What a failed update wrote is not published, as with any other.
        written = [] if error is not None else list(lock.written())
        try:
            stands = self._write(outcome, taken, ended, written)
        except EnactError as refused:
            if not written:
                raise
            # It can never be written: too much, of a wrong type, without permission or room.
            error = refused
            text = f"{type(refused).__name__} of what it wrote: {refused}"[:2000]
            stands = self._write(outcome, taken, replace(taken, state="failed", text=text), [])
        if stands:
            del self._begun[entity]
        lock.end()
        return error

    def _write(
        self, outcome: Write[Outcome], taken: Outcome, ended: Outcome, written: list[Any]
    ) -> bool:
        """Write an outcome with its data, trying again until it stands; return whether it does."""
        requests = dict.fromkeys([outcome, *(request for request, _, _ in written)])
        refused, give_up_s = 0, float("inf")
        while True:
            if stopping := self._stop.is_set():
                give_up_s = min(give_up_s, time.monotonic() + OUTCOME_S)
            wait_s = max(0.0, min(self._bound.actor.wait_s, give_up_s - time.monotonic()))
            try:
                with Lock(*requests, wait_s=wait_s) as lock:
                    found = lock.get(outcome)
                    if found == taken:
                        lock[outcome] = ended
                        for request, value, stamp_ns in written:
                            if value is None:
                                del lock[request]
                            else:
                                lock.put(request, value, stamp_ns=stamp_ns)
            except REFUSALS as error:
                if time.monotonic() >= give_up_s:
                    log.error(  # noqa: TRY400 (the error is the shard's, and named)
                        "%s: could not write the outcome of version %d for %r, which will read"
                        " interrupted; it was: %s %s: %s",
                        self._name, ended.version, outcome, ended.state, ended.text, error,
                    )  # fmt: skip
                    return False
                log.warning("%s: outcome %s not written yet: %s", self._name, ended.state, error)
                pause_s = min(self._back_off.wait_s(refused, 0.0), give_up_s - time.monotonic())
                refused += 1
                if stopping:
                    time.sleep(max(0.0, pause_s))
                elif self._stop.wait(pause_s):
                    refused = 0  # at once, then as often as after a first refusal
            else:
                if found not in (taken, ended):
                    log.error(
                        "%s: %r now reads %s, so the outcome %s of version %d is not written",
                        self._name, outcome, found, ended.state, ended.version,
                    )  # fmt: skip
                return True
