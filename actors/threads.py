"""Actors as the threads of one process, as in the paper: for work that needs no second host."""

from __future__ import annotations

import logging
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

from enact_dist import run_actor
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from enact_dist import Actor, Cell, Entity


@contextmanager
def running(actors: Sequence[Actor], cell: Cell) -> Iterator[list[Exception]]:
    """Run actors in threads for the length of a block; yield what went wrong in them."""
    stop, failures = threading.Event(), list[Exception]()

    def failed(_: Entity | None, error: Exception) -> None:
        if not isinstance(error, EnactError):  # those the framework tries again by itself
            failures.append(error)

    threads = [
        threading.Thread(
            target=run_actor,
            args=(actor, cell),
            kwargs={"stop": stop, "on_error": failed},
            name=type(actor).__name__,
        )
        for actor in actors
    ]
    # A failure ends the run with one line of its own; its traceback in the log says no more.
    log = logging.getLogger("enact.actor")
    heard, log.disabled = log.disabled, True
    for thread in threads:
        thread.start()
    try:
        yield failures
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        log.disabled = heard
