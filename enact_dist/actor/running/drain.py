"""The end of an actor process whose actor does not end: after `drain_s`, or at a second signal.

After the first signal the current update may finish and commit.  If it does not return within the
drain, the process cuts it off, logs what it was doing, and ends; its lock ends with it.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.actor.running.doing import Doing

DRAIN_S: Final = 8.0
"""How long an update may still take after the first signal; `docker stop` kills after 10 s."""
SAY_S: Final = 1.5
"""How long writing the last line may block if the log has no reader."""
CUT_OFF: Final = 1
"""Exit status of a process that has cut something off."""

log = logging.getLogger("enact.actor")


class Drain:
    """What signals mean to a process that runs one actor; called by the thread of the signals.

    Args:
        name: Name of the actor.
        doing: What the actor does.
        drain_s: How long it may still take.
        leave: Ends the process with a status, without waiting for any thread.
    """

    def __init__(
        self, name: str, doing: Doing, drain_s: float, leave: Callable[[int], object] = os._exit
    ) -> None:
        self._name, self._doing, self._drain_s, self._leave = name, doing, drain_s, leave
        self._over = threading.Event()

    def begin(self, signal: str) -> None:
        """Begin the drain at the first signal."""
        if self._doing.call is not None:
            log.info(
                "%s received: actor %s finishes its current call and ends, within %g s; a second"
                " signal ends it at once",
                signal, self._name, self._drain_s,
            )  # fmt: skip
        why = f"did not end within {self._drain_s:g} s of {signal}"
        threading.Thread(target=self._wait, args=(why,), name="drain", daemon=True).start()

    def hurry(self, _signal: str) -> None:
        """End the process at once at the second request to end."""
        self._cut_off("received a second signal")

    def over(self) -> None:
        """Note that the actor has ended by itself."""
        self._over.set()

    def _wait(self, why: str) -> None:
        if not self._over.wait(self._drain_s):
            self._cut_off(why)

    def _cut_off(self, why: str) -> None:
        if self._over.is_set():
            return
        say = threading.Thread(target=self._say, args=(why,), daemon=True)
        say.start()
        say.join(SAY_S)
        self._over.set()  # set once, if leaving waits for other actors of the process
        self._leave(CUT_OFF)

    def _say(self, why: str) -> None:
        log.critical("cut off: actor %s %s: %s", self._name, why, self._doing.cut_off())
        sys.stdout.flush()
        sys.stderr.flush()
