"""Several actors in one process: each in a thread of its own, started, ended and restarted alone.

A process costs some 30 MB and a session one percent of that, so a camera and the worker behind it
may share one: `process = "camera-3"` in the table of each in `cell.toml`.  What they share is the
interpreter, its environment, and the memory of what they import.  Each has its own

  * session: its locks, its lease, its report, its name in `enact actor ls` and `enact why`.  An
    actor whose lease is lost, or that ends, costs no other actor a lock;
  * end: an actor that fails, is done or is restarted (`enact actor restart`) leaves the others
    running.  It is restarted as `enact up` restarts a process: after a growing pause, but not
    once it is done or cannot run as configured;
  * drain: how long its update may still take after a signal.

A thread cannot be ended from outside.  Where an update does not return within its drain, the other
actors are drained, and the process ends.  A crash of the interpreter ends all of them.  Whatever
started the process (`enact up`, systemd, docker) starts it again with all its actors.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

from enact_dist.actor.running.doing import Doing, place_of_thread
from enact_dist.operate.supervise import NEVER_AGAIN, RestartPauses

LOOK_S: Final = 0.1
"""How often a wait looks."""
DRAIN_S: Final = 8.0
"""How long an update may still take after the first signal; `docker stop` kills after 10 s."""
SAY_S: Final = 1.5
"""How long writing the last line may block if the log has no reader."""
CUT_OFF: Final = 1
"""Exit status of a process that has cut something off."""
DONE: Final = 0
ANEW: Final = 75
"""Exit status of an actor that ends in order to restart: its supervisor starts it again."""

log = logging.getLogger("enact.actor")


class StopWithPulse(threading.Event):
    """The stop of an actor as its pulse: each look calls `alive`, in the thread that looks.

    An actor that is idle, waits for a lock or was refused looks every 0.1 s.  One inside `update`
    does not look: an update that hangs, or takes longer than the watchdog allows, is silent.

    Args:
        alive: Called with each sign of life; must not block.
    """

    def __init__(self, alive: Callable[[], None]) -> None:
        super().__init__()
        self._alive = alive

    def is_set(self) -> bool:
        """Return whether to stop."""
        self._alive()
        return super().is_set()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, or for `timeout` seconds; return whether to stop."""
        end_s = float("inf") if timeout is None else time.monotonic() + timeout
        while True:
            self._alive()
            left_s = end_s - time.monotonic()
            if super().wait(max(0.0, min(left_s, LOOK_S))) or left_s <= LOOK_S:
                return super().is_set()


class Life:
    """One life of an actor, and its end: its current update may finish and commit within `drain_s`.

    If the update does not return by then, or at a second request, the life logs what the actor was
    doing and ends the process; the actor's lock ends with it.  Any thread may call it.

    Args:
        name: Name of the actor.
        drain_s: How long its update may still take once it is asked to end, seconds.
        alive: Called by the actor's thread each time it looks whether to stop; must not block.
        ready: Called when the actor serves.
        leave: Called with an exit status where the actor does not end in time; waits for no thread.

    Attributes:
        stop: Set once the actor is asked to end.
        ready: Call it when the actor serves.
    """

    def __init__(
        self,
        name: str,
        drain_s: float,
        *,
        alive: Callable[[], None],
        ready: Callable[[], None],
        leave: Callable[[int], object] = os._exit,
    ) -> None:
        self.stop = StopWithPulse(alive)
        self.ready = ready
        self._name, self._drain_s, self._leave = name, drain_s, leave
        self._mutex = threading.Lock()
        self._doing: Doing | None = None
        self._why = ""
        self._over = threading.Event()

    def begin(self, doing: Doing) -> None:
        """Note that the actor is about to run; `doing` shows what it is doing."""
        with self._mutex:
            self._doing, why = doing, self._why
        if why:
            self._drain(doing, why)

    def end(self, why: str) -> None:
        """Ask the actor to end after its update, within its drain."""
        self.stop.set()
        with self._mutex:
            self._why, doing = why, self._doing
        if doing is not None:
            self._drain(doing, why)

    def stop_now(self, _why: str) -> None:
        """Cut the actor off now."""
        if self._doing is not None:
            self._cut_off(self._doing, "received a second signal")

    def over(self) -> None:
        """Note that the actor has ended by itself."""
        self._over.set()

    def _drain(self, doing: Doing, why: str) -> None:
        if doing.call is not None:
            log.info(
                "%s received: actor %s finishes its current call and ends, within %g s; a second"
                " signal ends it at once",
                why, self._name, self._drain_s,
            )  # fmt: skip
        threading.Thread(target=self._wait, args=(doing, why), name="drain", daemon=True).start()

    def _wait(self, doing: Doing, why: str) -> None:
        if not self._over.wait(self._drain_s):
            self._cut_off(doing, f"did not end within {self._drain_s:g} s of {why}")

    def _cut_off(self, doing: Doing, why: str) -> None:
        if self._over.is_set():
            return
        say = threading.Thread(target=self._say, args=(doing, why), daemon=True)
        say.start()
        say.join(SAY_S)
        self._over.set()  # set once, if leaving waits for other actors of the process
        self._leave(CUT_OFF)

    def _say(self, doing: Doing, why: str) -> None:
        log.critical("cut off: actor %s %s: %s", self._name, why, doing.cut_off())
        sys.stdout.flush()
        sys.stderr.flush()


class Leaving:
    """Lets no thread that actors have started keep the process after their end.

    The interpreter waits for all that are no daemon threads: forever for one that spins.  Threads
    that ran before this was made do not count.

    Args:
        leave: Ends the process with a status; waits for no thread.
    """

    def __init__(self, *, leave: Callable[[int], object] = os._exit) -> None:
        self._before, self._leave = set(threading.enumerate()), leave

    def within(self, drain_s: float, status: int) -> None:
        """End the process with a status where such threads still run in so many seconds."""
        end_s = time.monotonic() + drain_s
        new = [one for one in threading.enumerate() if one not in self._before and not one.daemon]

        def wait() -> None:
            for one in new:
                one.join(max(0.0, end_s - time.monotonic()))
            if left := [one for one in new if one.is_alive()]:
                say = threading.Thread(target=self._say, args=(left, drain_s), daemon=True)
                say.start()
                say.join(SAY_S)
                self._leave(status)

        if new:
            threading.Thread(target=wait, name="drain", daemon=True).start()

    def _say(self, left: Sequence[threading.Thread], drain_s: float) -> None:
        places = (f"{one.name} at {place_of_thread(one.ident or 0)}" for one in left)
        log.critical(
            "cut off: the process did not end within %g s of its actors, as threads of theirs still"
            " run: %s; end them in `stop`, or make them daemon threads",
            drain_s, ", ".join(places),
        )  # fmt: skip
        sys.stderr.flush()


class ActorGroup:
    """Runs the actors of one process until all have ended.  One thread calls `run`.

    Args:
        name: Name of the process.
        drains_s: How long each actor's update may still take after a signal, by the actor's name.
        live: Runs an actor of this name once, in the calling thread, and returns the exit status
            that it would have as a process of its own; raises nothing.
        alive: Called by the thread of `run`, each time after all actors have shown that they live.
        ready: Called when each actor has been ready, or has ended, for the first time.
        leave: Ends the process with a status, without waiting for any thread.
    """

    def __init__(
        self,
        name: str,
        drains_s: Mapping[str, float],
        live: Callable[[str, Life], int],
        *,
        alive: Callable[[], None],
        ready: Callable[[], None],
        leave: Callable[[int], object] = os._exit,
    ) -> None:
        self._name, self._drains_s, self._live = name, drains_s, live
        self._alive, self._ready, self._leave = alive, ready, leave
        self._changed = threading.Condition()
        self._ending = threading.Event()
        self._why = ""
        self._lives: dict[str, Life] = {}
        self._kept = set(drains_s)
        self._unready = set(drains_s)
        self._serving: set[str] = set()
        self._pulsed: set[str] = set()
        self._cut: set[str] = set()
        self._unfit = False

    def run(self) -> int:
        """Run all actors; return the exit status of the process.

        It is 0 when all are done or were asked to end, 2 when one cannot run as it is configured
        and no other is left, 1 when one was cut off.
        """
        for name in self._drains_s:
            threading.Thread(target=self._keep, args=(name,), name=name, daemon=True).start()
        with self._changed:
            while self._kept:
                self._changed.wait(LOOK_S)
                if self._serving <= self._pulsed:
                    self._pulsed.clear()
                    self._alive()
        if self._cut:
            return CUT_OFF
        return NEVER_AGAIN if self._unfit and not self._ending.is_set() else DONE

    def end(self, why: str) -> None:
        """Ask all actors to end."""
        with self._changed:
            self._why = why
            self._ending.set()
            lives = list(self._lives.values())
        for life in lives:
            life.end(why)

    def stop_now(self, why: str) -> None:
        """Cut off all actors that still run."""
        with self._changed:
            lives = list(self._lives.values())
        for life in lives:  # each may block on a log without a reader
            threading.Thread(target=life.stop_now, args=(why,), daemon=True).start()

    def _keep(self, name: str) -> None:
        """Run an actor, and run it again, in its thread."""
        pauses = RestartPauses()
        try:
            while (life := self._begun(name)) is not None:
                pauses.started()
                status = self._live(name, life)
                self._over(name, life)
                if self._ending.is_set() or not self._again(name, status, pauses):
                    return
        finally:
            with self._changed:
                self._kept.discard(name)
                self._changed.notify_all()
            self._leave_if_cut()

    def _begun(self, name: str) -> Life | None:
        """Return a life for an actor; None where the process ends."""
        life = Life(
            name,
            self._drains_s[name],
            alive=partial(self._pulsed.add, name),
            ready=partial(self._serves, name),
            leave=partial(self._cut_off, name),
        )
        with self._changed:
            if self._ending.is_set():
                return None
            self._lives[name] = life
        return life

    def _over(self, name: str, life: Life) -> None:
        life.over()
        with self._changed:
            self._lives.pop(name, None)
            self._serving.discard(name)
        self._heard_of(name)

    def _again(self, name: str, status: int, pauses: RestartPauses) -> bool:
        """Log the end of an actor; if it is to be restarted, wait and return True."""
        if status == DONE:
            log.info("actor %s is done; it is not started again", name)
            return False
        if status == NEVER_AGAIN:
            self._unfit = True
            log.error("actor %s cannot run like this and is not started again", name)
            return False
        pause_s = pauses.ended()
        if status != ANEW:
            log.warning("actor %s failed; started again in %.1f s", name, pause_s)
        return not self._ending.wait(pause_s)

    def _serves(self, name: str) -> None:
        self._pulsed.add(name)
        with self._changed:
            self._serving.add(name)
        self._heard_of(name)

    def _heard_of(self, name: str) -> None:
        """Report the process as ready once each actor has been ready or has ended."""
        with self._changed:
            last = self._unready == {name}
            self._unready.discard(name)
        if last:
            self._ready()

    def _cut_off(self, name: str, _status: int) -> None:
        with self._changed:
            self._cut.add(name)
            first = not self._ending.is_set()
        if first:
            log.critical(
                "process %s ends, since actor %s does not and a thread cannot be ended alone",
                self._name, name,
            )  # fmt: skip
            self.end(f"the request to end process {self._name}")
        self._leave_if_cut()

    def _leave_if_cut(self) -> None:
        """End the process once only actors that were cut off are left in it."""
        with self._changed:
            leaves = bool(self._kept) and self._kept <= self._cut
        if leaves:
            self._leave(CUT_OFF)
