"""Actors as the threads of one process, as in the paper: for work that needs no second host."""

from __future__ import annotations

import logging
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from enact_dist import ActorThread
from enact_dist.errors import EnactError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from enact_dist import Actor, Cell, Entity


@contextmanager
def running(actors: Sequence[Actor], cell: Cell) -> Iterator[list[Exception]]:
    """Run actors in threads for the length of a block; yield what went wrong in them."""
    failures = list[Exception]()

    def failed(_: Entity | None, error: Exception) -> None:
        if not isinstance(error, EnactError):  # those the framework tries again by itself
            failures.append(error)

    threads = [ActorThread(actor, cell, on_error=failed) for actor in actors]
    # A failure ends the run with one line of its own; its traceback in the log says no more.
    log = logging.getLogger("enact.actor")
    with ExitStack() as last_first:
        last_first.callback(setattr, log, "disabled", log.disabled)
        log.disabled = True
        for thread in threads:
            last_first.callback(thread.join)
            thread.start()
        for thread in threads:
            last_first.callback(thread.stop)
        yield failures
