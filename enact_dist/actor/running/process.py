"""Several actors at once: as threads of one process, or each as a process of its own.

Threads share one cell (the mode of the paper, and the only one on `local()`).  Processes are
spawned, never forked: a forked child would share its parent's session without the parent's threads.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Self

from enact_dist.actor.running.runner import ActorRun, OnError
from enact_dist.errors import MisuseError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from enact_dist.actor.actor import Actor
    from enact_dist.actor.report import ActorStatistics
    from enact_dist.world.cell import Cell


class ActorThread:
    """An actor that runs in a thread of this process; a context manager that stops it.

    ::

        with ActorThread(Fusion(), cell), ActorThread(Feedback(), cell):
            ...                                    # both run until the block ends

    Several threads may share a cell.

    Args:
        actor: The actor; a fresh instance, run once.
        cell: Where its world contexts are.
        worlds: Role → name of a world context; None binds each role to the context of its name.
        name: Name in logs and reports; by default the class's, with that of its `only_entity`.
        wait_s: How long an attempt waits for its lock; None: as long as the actor says.
        on_error: Called in the actor's thread with each error, besides the log.

    Raises:
        MisuseError: The actor cannot be bound like this.
        UnknownWorldError: The cell has no such world context.
    """

    def __init__(
        self,
        actor: Actor,
        cell: Cell,
        worlds: Mapping[str, str] | None = None,
        *,
        name: str = "",
        wait_s: float | None = None,
        on_error: OnError | None = None,
    ) -> None:
        self._stop = threading.Event()
        self._run = ActorRun(
            actor, cell, worlds, stop=self._stop, name=name, wait_s=wait_s, on_error=on_error
        )
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name=self._run.name, daemon=True)

    def start(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def statistics(self) -> ActorStatistics:
        """Return what the actor has done so far."""
        return self._run.statistics()

    def stop(self) -> None:
        """Ask the actor to stop after its current update.  Does not wait."""
        self._stop.set()

    def join(self, timeout_s: float | None = None) -> ActorStatistics:
        """Wait until the actor has stopped, or is done, and return what it did.

        Raises:
            MisuseError: It still runs after `timeout_s`.
            BaseException: What ended the run, if it did not end by itself.
        """
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise MisuseError(
                f"actor {self._run.name} still runs after {timeout_s} s; call stop() first, or"
                " wait longer than its update and wait_s take"
            )
        if self._error is not None:
            raise self._error
        return self._run.statistics()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.join()

    def _work(self) -> None:
        try:
            self._run.run()
        except BaseException as error:  # noqa: BLE001 (raised again by join)
            self._error = error
