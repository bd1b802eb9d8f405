"""A client process of the recovery figures: `recovery_client CELL ROLE`.

==========  ==============================================================================
stay        joins, takes a lock once, and keeps its session alive
ask         takes a lock over everything at each line ``ask``; says when it had it
hold        takes the same lock and keeps it
vanish      commits over both shards, and kills itself when all is prepared and nothing decided
==========  ==============================================================================
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

from enact_dist.access.lock import Lock
from enact_dist.core.protocol.messages import Answer, Commit, Request
from enact_dist.errors import LeaseLostError, ShardUnreachableError
from enact_dist.terms import Aspect, Entity, Write
from enact_dist.world.cell import Cell
from enact_dist.world.connecting import connect

NUMBER: Final = Aspect("number", int)
ENTITIES: Final = (Entity("left"), Entity("right"))
WAIT_S: Final = 60.0


class _Vanishing:
    """A carrier that ends its process where the deciding commit would leave it."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def request(
        self, shard: str, message: Request, *, timeout_s: float, interrupt: Any = None
    ) -> Answer | None:
        if isinstance(message, Commit):
            os.kill(os.getpid(), signal.SIGKILL)
        answer: Answer | None = self._inner.request(
            shard, message, timeout_s=timeout_s, interrupt=interrupt
        )
        return answer


def _say(word: str) -> None:
    print(word, f"{time.monotonic():.6f}", flush=True)


def _writes(cell: Cell) -> list[Write[int]]:
    world = cell.world("online")
    return [Write(world, entity, NUMBER) for entity in ENTITIES]


def _lock_once(writes: list[Write[int]], *, said: str = "") -> None:
    """Take a lock over all of it and release it; print when it was granted, if asked to.

    What is found lost at the end, or away at the beginning, is asked for again.
    """
    while True:
        with contextlib.suppress(LeaseLostError, ShardUnreachableError):
            with Lock(*writes, wait_s=WAIT_S):
                if said:
                    _say(said)
            return


def _stay(cell: Cell) -> None:
    _lock_once(_writes(cell))
    _say("staying")
    sys.stdin.read()


def _ask(cell: Cell) -> None:
    writes = _writes(cell)
    _lock_once(writes)
    _say("ready")
    for _ in sys.stdin:
        _say("asking")
        _lock_once(writes, said="granted")
        _say("done")


def _hold(cell: Cell) -> None:
    with Lock(*_writes(cell), wait_s=WAIT_S, hold_s=3600.0):
        _say("holding")
        sys.stdin.read()


def _vanish(cell: Cell) -> None:
    writes = _writes(cell)
    with Lock(*writes, wait_s=WAIT_S) as lock:
        for write in writes:
            lock[write] = 1
        cell._client.carrier = _Vanishing(cell._client.carrier)  # noqa: SLF001 (it has to end here)
        _say("vanishing")


_ROLES: Final[dict[str, Callable[[Cell], None]]] = {
    "stay": _stay,
    "ask": _ask,
    "hold": _hold,
    "vanish": _vanish,
}


def main(words: Sequence[str]) -> None:
    """Play one role until the parent ends this process."""
    file, role = words
    with connect(file, actor=role, timeout_s=60.0) as cell:
        _ROLES[role](cell)


if __name__ == "__main__":
    main(sys.argv[1:])
