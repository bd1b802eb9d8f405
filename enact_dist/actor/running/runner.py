"""Runs one actor in one thread: trigger → lock → update → commit → report.

What happens with an error:

========================================  =====================================================
error                                     the run
========================================  =====================================================
`LockTimeoutError` not granted            tried again for the same entity after a growing pause,
`LeaseLostError` granted, then lost       without end: nothing is wrong with the actor, and the
`ChangedError` expected view moved on     trigger must not be lost
`LinkError` shard away
`CommitUnknownError` may stand            the same: the new update reads what stands (`unknown`)
`PermissionDeniedError`                   ends the run
any other exception                       counted, logged (one like before as a count), kept as last
                                          error; run again when the entity changes
========================================  =====================================================

Before the first update, the shards of the actor's data have to accept its requests.  The run waits
for a shard that is away, and ends if a shard knows an aspect with another type.

After a refusal, a source waits for its next tick instead of trying again.  An actor that runs once
tries again after a refusal and ends after any other error.  `KeyboardInterrupt` and the like end
the run.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import random
import threading
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

from enact_dist.actor.actor import Actor, check_period, name_of
from enact_dist.actor.binding import BoundActor
from enact_dist.actor.inbox import Inbox, SetInbox, Watching
from enact_dist.actor.once import REFUSALS, Once, OnceInbox, TakenError
from enact_dist.actor.report import (
    ERROR_LENGTH_MAX,
    WRITES_MAX,
    ActorRecord,
    ActorStatistics,
    Repeated,
    ReportBoard,
    kind_of,
)
from enact_dist.actor.running.doing import Doing
from enact_dist.actor.running.load import shown_values
from enact_dist.actor.triggers import BackOff, FixedRate, is_news
from enact_dist.errors import (
    LeaseLostError,
    LinkError,
    LockTimeoutError,
    MisuseError,
    PermissionDeniedError,
)
from enact_dist.link.clock import monotonic_ns, wall_ns
from enact_dist.terms import Entity

if TYPE_CHECKING:
    from enact_dist.actor.lock import ActorLock
    from enact_dist.core.protocol.messages import DatumRead
    from enact_dist.world.cell import Cell

OnError = Callable[["Entity | None", Exception], None]
"""Called with the triggering entity and each error of a run, in the actor's thread."""

STOP_LOOK_S: Final = 0.1
"""How often an idle actor checks `stop`: no call waits for an `Event` and a `Condition` at once."""

STANDING_VARIABLE: Final = "ENACT_STANDING"
"""0 in the environment of an actor lets it watch its triggers even where its lock could wait."""
REPORT_EVERY_NS: Final = 1_000_000_000
SWEEP_NS: Final = 2_000_000_000
"""How often an actor with `once` looks for versions that an earlier process left as taken."""
LOOK_OUT_S: Final = 1.0
NOTHING: Final = "nothing of it was written"
"""The result of an update that is cut off: its lock ends with its process."""

log = logging.getLogger("enact.actor")


def run_actor(
    actor: Actor,
    cell: Cell,
    worlds: Mapping[str, str] | None = None,
    *,
    stop: threading.Event,
    name: str = "",
    wait_s: float | None = None,
    on_error: OnError | None = None,
) -> ActorStatistics:
    """Run an actor in this thread until `stop` is set, or until a once-actor is done.

    `stop` lets the update that is running finish and commit; an attempt that waits for its lock
    ends within 0.2 s.  The other arguments are those of `ActorThread`.

    Returns:
        What the actor did.

    Raises:
        MisuseError: The actor cannot be bound like this, or the cell was closed under it.
        DatumTypeError: A shard knows one of its aspects with another type.
        UnknownWorldError: The cell has no such world context.
    """
    return ActorRun(
        actor, cell, worlds, stop=stop, name=name, wait_s=wait_s, on_error=on_error
    ).run()


class ActorRun:
    """One run of one actor.  `statistics` may be asked from any thread.

    Attributes:
        name: Name in logs and reports.
        doing: Which method of the actor runs.
        words_in: The world context in which a process may listen for words to it.
    """

    def __init__(
        self,
        actor: Actor,
        cell: Cell,
        worlds: Mapping[str, str] | None = None,
        *,
        stop: threading.Event,
        name: str = "",
        wait_s: float | None = None,
        on_error: OnError | None = None,
    ) -> None:
        self._bound = BoundActor(actor, cell, worlds)
        self._actor = actor
        self._every_s = actor.every_s
        self._stop = stop
        self._wait_s = wait_s
        self._on_error = on_error
        sets = self._bound.pending_sets()
        views = self._bound.set_views()
        self._sets = SetInbox(sets, views) if sets is not None else None
        declaration = self._bound.declaration
        per_entity = declaration.per_entity
        each = [at for at, one in enumerate(declaration.triggers) if one.access.each]
        self._once: Once | None = None
        self._inbox = Inbox(per_entity=per_entity, each=each)
        self._back_off = BackOff()
        self._failures = Repeated()
        self.name = name or name_of(actor)
        self._record = ActorRecord(self.name, now_ns=monotonic_ns())
        self._board = ReportBoard.of(cell)
        self._ended = threading.Event()
        self.doing = Doing(type(actor).__name__)
        if declaration.outcome is not None:
            self._inbox = inbox = OnceInbox(per_entity=per_entity)
            self._once = Once(self._bound, self.name, self.doing, stop=stop, inbox=inbox)
        self._lost: set[Entity | None] = set()
        self._warned = False
        self.words_in = min(context.name for context in self._bound.contexts.values())
        self._listens, self._word = False, ""
        self._standing = self._in_vain = False
        self._reported_ns = 0
        if self._every_s is not None:
            check_period(self.name, self._every_s)
            if declaration.triggers:
                raise MisuseError(f"{self.name} has triggers and every_s; it can have only one")

    def statistics(self) -> ActorStatistics:
        """Return what the actor has done so far."""
        inbox = self._sets or self._inbox
        self._record.skipped = inbox.skipped
        more: dict[str, Any] = {
            "writes": self._bound.writes()[:WRITES_MAX],
            "args": shown_values(self._actor),
            "words_in": self.words_in if self._listens else "",
            "word": self._word,
        }
        if (call := self.doing.call) is not None and call.method == "update":
            lasted_s, lost = (monotonic_ns() - call.since_ns) / 1e9, call.lock_lost
            more |= {"updating_s": round(lasted_s, 3), "lock_lost": lost}
            more |= {"state": "stuck"} if lost else {}
        if self._once is not None:
            interrupted, last = self._once.interrupted, self._once.last_interrupted
            more |= {"interrupted": interrupted, "last_interrupted": last[:ERROR_LENGTH_MAX]}
        elif self._sets is not None:
            more |= self._sets.counts()
        return dataclasses.replace(self._record.snapshot(monotonic_ns()), **more)

    def answer(self, word: str = "") -> None:
        """Report that commands are received, and the result of the newest one."""
        self._listens, self._word = True, word[:ERROR_LENGTH_MAX]
        self._report(now=True)

    def run(self, *, on_ready: Callable[[], None] | None = None) -> ActorStatistics:
        """Run until stopped or done; see `run_actor`.

        Args:
            on_ready: Called once the shards of the actor's data have accepted what it requests and
                its `start` is over; an actor that is stopped before never is ready.
        """
        if not self._reaches(self._bound.register):
            self._record.state = "stopped"
            self._report(now=True)
            return self.statistics()
        with self.doing.inside("start"):
            self._actor.start()
        lookout = threading.Thread(target=self._look_out, name=f"{self.name} lookout", daemon=True)
        lookout.start()
        try:
            if on_ready is not None:
                on_ready()
            self._record.state = "running"
            self._report(now=True)
            if self._bound.declaration.triggers:
                if os.environ.get(STANDING_VARIABLE) != "0":
                    self._run_standing()
                self._run_triggered()
            elif self._every_s is not None:
                self._run_source(self._every_s)
            else:
                self._run_once()
        finally:
            if self._record.state == "running":
                self._record.state = "stopped"
            self._ended.set()
            if self._once is not None:
                self._once.end()
            lookout.join()
            self._report(now=True)
            self._tell_left()
            with self.doing.inside("stop"):
                self._actor.stop()
        return self.statistics()

    def _look_out(self) -> None:
        """Report on behalf of an update, or of a wait for news, that takes long."""
        while not self._ended.wait(LOOK_OUT_S):
            call = self.doing.call
            long_update = call is not None and monotonic_ns() - call.since_ns >= REPORT_EVERY_NS
            if long_update or self._standing:
                self._report()

    def _reaches(self, ask: Callable[[], object]) -> bool:
        """Call `ask`, again while its shards are away; False: stopped first."""
        refused = 0
        while not self._stop.is_set():
            try:
                ask()
            except LinkError as error:
                self._record.refused(error)
                if not refused:
                    log.warning("%s: not ready before its shards answer: %s", self.name, error)
                self._report()
                self._stop.wait(self._pause_s(refused))
                refused += 1
            else:
                return True
        return False

    def _run_standing(self) -> None:
        """Ask for each lock ahead: its shard grants it, data included, once a trigger has changed.

        Returns when the actor is stopped, or its triggers have to be watched.
        """
        refused = 0
        while not self._stop.is_set() and (slots := self._bound.trigger_slots()):
            entity = Entity(slots[0].entity)
            ending = self._attempt(entity, after=self._inbox.seen(slots))
            if isinstance(ending, REFUSALS) or self._in_vain:
                self._stop.wait(self._pause_s(refused))
                refused += 1
            else:
                refused = 0
            self._report()

    def _run_triggered(self) -> None:
        """Run for what changes; of sets first for the newest existing one, then as they come."""
        inbox, once = self._sets or self._inbox, self._once
        sweep_ns: float = 0 if once is not None else math.inf
        if self._sets is not None and not self._reaches(self._sets.start):
            return
        with Watching(self._bound, inbox) as changes:
            while not self._stop.is_set():
                if once is not None and monotonic_ns() >= sweep_ns:
                    sweep_ns = monotonic_ns() + SWEEP_NS if not self._swept(once) else math.inf
                trigger = changes.take(STOP_LOOK_S)
                if trigger is not None:
                    entity = trigger.entity if self._sets is None else None
                    ending = (
                        self._attempt_once(trigger.entity)
                        if once is not None
                        else self._attempt(entity, members=trigger.members)
                    )
                    if isinstance(ending, REFUSALS):
                        pause_s = self._pause_s(trigger.refused)
                        inbox.postpone(trigger, monotonic_ns() + round(pause_s * 1e9))
                self._report()

    def _swept(self, once: Once) -> bool:
        try:
            return once.sweep()
        except REFUSALS as error:
            log.warning("%s: what was taken before is not known yet: %s", self.name, error)
            return False

    def _run_source(self, every_s: float) -> None:
        rate = FixedRate(
            every_s, now_ns=monotonic_ns(), wall_ns=wall_ns(), in_phase=self._actor.in_phase
        )
        missed = 0
        while not self._stop.wait(max(0, rate.due_ns() - monotonic_ns()) / 1e9):
            if tick_ns := rate.tick(monotonic_ns(), wall_ns()):
                in_vain = isinstance(self._attempt(None, tick_ns=tick_ns), REFUSALS)
                self._record.missed(rate.missed - missed + in_vain)
                missed = rate.missed
            self._report()

    def _run_once(self) -> None:
        refused = 0
        while not self._stop.is_set():
            error = self._attempt(None)
            if not isinstance(error, REFUSALS):
                self._record.state = "done"
                return
            self._report()
            self._stop.wait(self._pause_s(refused))
            refused += 1

    def _attempt(
        self,
        entity: Entity | None,
        *,
        members: tuple[int, ...] = (),
        tick_ns: int = 0,
        after: tuple[DatumRead, ...] = (),
    ) -> Exception | None:
        """Run `update` once under its lock; return what ended it early."""
        asked_ns, granted_ns, stale = monotonic_ns(), 0, False
        missing: list[int] = []
        seen: dict[tuple[int, Entity], tuple[int, int]] = {}
        try:
            lock = self._bound.lock(
                entity,
                wait_s=self._wait_s,
                stop=self._stop,
                members=members,
                tick_ns=tick_ns,
                after=after,
                shown=self._sets.shown(members) if self._sets is not None and members else (),
            )
            self._standing = bool(after)
            with lock:
                self._standing = False
                granted_ns = monotonic_ns()
                if after:
                    asked_ns = granted_ns - round(lock.statistics().waited_s * 1e9)
                absent = lock.absent()
                missing = [] if self._sets is None or self._sets.sets.enough(absent) else absent
                seen = self._seen(lock)
                stale = bool(after) and not is_news(after, seen)
                if not missing and not stale:
                    self._warn_of_repetition(entity)
                    about = _about(entity)
                    with self.doing.inside("update", about=about, lock=lock, remains=NOTHING):
                        self._actor.update(lock)
        except PermissionDeniedError as error:
            self._record.failed(error)
            raise  # nothing changes by asking again
        except REFUSALS as error:
            if isinstance(error, LockTimeoutError) and self._stop.is_set():
                return error  # interrupted while it waited: nothing was refused
            self._refused(entity, error)
            if granted_ns and isinstance(error, LeaseLostError):
                self._lost.add(entity)
            ending: Exception | None = error
        except Exception as error:  # noqa: BLE001 (an update can raise anything)
            self._bound.check_usable()
            self._failed(entity, error)
            ending = error
        else:
            ended_ns = monotonic_ns()
            if missing and self._sets is not None:
                self._sets.gone(min(filter(None, members)), missing)
            elif not stale:
                took_ns = ended_ns - granted_ns
                self._record.updated(took_ns=took_ns, now_ns=ended_ns, wall_ns=wall_ns())
            ending = None
        self._standing, self._in_vain = False, not granted_ns or stale
        if isinstance(ending, LockTimeoutError) and after:
            self._record.waited(round(ending.waited_s * 1e9))
        elif granted_ns or not after:
            self._record.waited((granted_ns or monotonic_ns()) - asked_ns)
        if not isinstance(ending, REFUSALS):
            self._inbox.used(seen, standing=bool(after))
        if ending is not None and self._on_error is not None:
            self._on_error(entity, ending)
        return ending

    def _attempt_once(self, entity: Entity) -> Exception | None:
        """Act on the newest version once; return what kept it from being taken, to try again."""
        assert self._once is not None
        asked_ns = monotonic_ns()
        granted_ns: list[int] = []
        try:
            acted = self._once.attempt(
                entity, wait_s=self._wait_s, granted=lambda: granted_ns.append(monotonic_ns())
            )
        except TakenError as error:
            return error  # was logged when it was found
        except REFUSALS as error:
            if not (isinstance(error, LockTimeoutError) and self._stop.is_set()):
                self._refused(entity, error)
            return error
        if acted.error is not None:
            self._bound.check_usable()
            self._failed(entity, acted.error)
            if self._on_error is not None:
                self._on_error(entity, acted.error)
        elif acted.ran:
            now_ns = monotonic_ns()
            self._record.updated(took_ns=now_ns - granted_ns[0], now_ns=now_ns, wall_ns=wall_ns())
        self._record.waited((granted_ns[0] if granted_ns else monotonic_ns()) - asked_ns)
        self._inbox.used(acted.states)
        return None

    def _refused(self, entity: Entity | None, error: Exception) -> None:
        self._record.refused(error)
        recovers = isinstance(error, LeaseLostError) and error.restarted
        level = logging.DEBUG if recovers else logging.WARNING
        log.log(level, "%s%s: refused: %s", self.name, _about(entity), error)

    def _failed(self, entity: Entity | None, error: Exception) -> None:
        self._record.failed(error)
        self._tell(entity, error)

    def _warn_of_repetition(self, entity: Entity | None) -> None:
        """Warn once that an update runs again after it lost its lock, and how to prevent that."""
        if entity not in self._lost or self._every_s is not None:
            return
        self._lost.discard(entity)
        if not self._warned:
            self._warned = True
            log.warning(
                "%s%s: %s.update runs again, because it lost its lock (hold_s = %g). Its writes are"
                " discarded, but its effects outside the cell remain. If the actor moves something,"
                " set once = True (enact_dist/docs/actuators.md); otherwise consider a longer"
                " hold_s",
                self.name, _about(entity), type(self._actor).__name__, self._actor.hold_s,
            )  # fmt: skip

    def _tell(self, entity: Entity | None, error: Exception) -> None:
        """Log an error of an update: with its traceback, or as a count of equal errors."""
        text = f"{type(error).__name__}: {error}"
        count = self._failures.tell(kind_of(error), text, monotonic_ns())
        if count == 0:
            log.error("%s%s: update failed", self.name, _about(entity), exc_info=error)
        elif count is not None:
            log.error(
                "%s%s: update failed as before, %d times since the last line: %s",
                self.name, _about(entity), count, text,
            )  # fmt: skip

    def _tell_left(self) -> None:
        """Log the errors that have only been counted so far."""
        for count, newest in self._failures.left():
            log.error("%s: update failed as before %d more times: %s", self.name, count, newest)
        if self._sets is not None:
            self._sets.tell_left()

    def _seen(self, lock: ActorLock) -> dict[tuple[int, Entity], tuple[int, int]]:
        return {
            (index, entity): state
            for index, trigger in enumerate(self._bound.declaration.triggers)
            for entity, state in lock.granted_states(trigger).items()
        }

    def _pause_s(self, refused: int) -> float:
        return self._back_off.wait_s(refused, random.random())  # noqa: S311 (spreads retries)

    def _report(self, *, now: bool = False) -> None:
        """Post the statistics with the session's keep-alive, at most once a second."""
        now_ns = monotonic_ns()
        if now or now_ns - self._reported_ns >= REPORT_EVERY_NS:
            self._reported_ns = now_ns
            self._board.post(self._bound.cell, self.statistics())


def _about(entity: Entity | None) -> str:
    return "" if entity is None else f" for {entity}"
