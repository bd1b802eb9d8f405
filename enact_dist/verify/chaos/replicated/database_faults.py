"""What is done to the servers of a cell's database, by a thread of its own, one after the other.

==========================  ===================================================================
kill database               SIGKILL of the primary's first process, which is started again
stop database               SIGSTOP of all processes of one of the servers for a while
lose database standby       the standby is killed, and comes back; now and then the primary goes
                            on with one copy meanwhile
switch over                 the standby is promoted while the old primary lives on, cut off from
                            all, or cannot hear, or is not heard; later that is copied anew
cancel wait for standby     a commit that waits for the standby is cancelled, which PostgreSQL
                            reports as a success with a warning
terminate wait for standby  the connection of such a commit is ended
fill disk of database       the data or the log of a server find no space for a while
==========================  ===================================================================

Each one ends with a primary and a standby that confirms each commit.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from enact_dist.errors import LinkError

if TYPE_CHECKING:
    from collections.abc import Callable
    from random import Random

    from enact_dist.verify.chaos.replicated.cuts import SharedCuts
    from enact_dist.verify.chaos.replicated.nodes import DatabasePair

TARGET: Final = "database"
KILL, STOP, LOSE_STANDBY = "kill database", "stop database", "lose database standby"
SWITCH, FILL = "switch over", "fill disk of database"
CANCEL, TERMINATE = "cancel wait for standby", "terminate wait for standby"
DECK: Final = {KILL: 1, STOP: 1, LOSE_STANDBY: 1, SWITCH: 2, CANCEL: 1, TERMINATE: 1, FILL: 2}
WAITS_S: Final = 3.0
"""How long a commit is waited for that can be cancelled."""


class DatabaseFaults:
    """Carries out faults of a database.

    Args:
        pair: Its servers.
        others: All other hosts.
        cuts: Of the run.

    Attributes:
        names: Its hosts.
    """

    def __init__(self, pair: DatabasePair, others: tuple[str, ...], cuts: SharedCuts) -> None:
        self._pair, self._others, self._cuts = pair, others, cuts
        self.names = (pair.primary.name, pair.standby.name)
        # A server dies with the thread that started it.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="database-faults")
        self._acts: dict[str, Callable[[Random], str | None]] = {
            KILL: self._kill,
            STOP: self._stop,
            LOSE_STANDBY: self._lose_standby,
            SWITCH: self._switch,
            CANCEL: lambda draw: self._end_wait(draw, "pg_cancel_backend"),
            TERMINATE: lambda draw: self._end_wait(draw, "pg_terminate_backend"),
            FILL: self._fill,
        }

    def start(self) -> None:
        """Make the servers.

        Raises:
            LinkError: They do not start.
        """
        self._thread.submit(self._pair.start).result()

    def begin(self, kind: str, draw: Random) -> Future[str]:
        """Begin a fault; the result is its kind, once the database is whole again."""
        return self._thread.submit(self._carry_out, kind, draw)

    def _carry_out(self, kind: str, draw: Random) -> str:
        missed = self._acts[kind](draw)
        self._pair.make_whole()
        return f"{kind}: {missed}" if missed else kind

    def close(self) -> None:
        """End the servers."""
        self._pair.end()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._pair.end()  # one that was just being started

    # ---------------------------------------------------------------- faults

    def _kill(self, draw: Random) -> None:
        self._pair.primary.kill()
        time.sleep(draw.choice((0.0, 0.5, 2.0, 5.0)))

    def _stop(self, draw: Random) -> None:
        node = draw.choice((self._pair.primary, self._pair.primary, self._pair.standby))
        node.pause()
        try:
            time.sleep(draw.choice((0.5, 2.0, 4.0)))
        finally:
            node.go_on()

    def _lose_standby(self, draw: Random) -> None:
        self._pair.standby.kill()
        time.sleep(draw.choice((0.2, 1.0)))
        if draw.random() < 0.5:
            with suppress(LinkError):
                self._pair.one_copy()
        time.sleep(draw.choice((0.5, 3.0)))

    def _switch(self, draw: Random) -> None:
        pair = self._pair
        old, new = pair.primary, pair.standby
        sends, hears = draw.choice(((True, True), (True, True), (True, False), (False, True)))
        ways = [(old.name, other) for other in (*self._others, new.name) if sends]
        ways += [(other, old.name) for other in (*self._others, new.name) if hears]
        self._cuts.cut(ways)
        try:
            time.sleep(draw.choice((0.0, 0.5, 2.0)))
            pair.swap()
            time.sleep(draw.choice((0.5, 2.0, 5.0)))
        finally:
            old.kill()
            self._cuts.heal(ways)

    def _end_wait(self, draw: Random, how: str) -> str:
        pair = self._pair
        pair.standby.pause()
        try:
            waiting = pair.waiting(WAITS_S)
            for pid in waiting if draw.random() < 0.5 else waiting[:1]:
                pair.primary.ask(f"SELECT {how}({pid})")
            time.sleep(draw.choice((0.1, 1.0)))
        finally:
            pair.standby.go_on()
        return "" if waiting else "no commit waited"

    def _fill(self, draw: Random) -> None:
        pair, part = self._pair, draw.choice(("data", "log"))
        node = draw.choice((pair.primary, pair.primary, pair.standby))
        free = node.fill(part)
        try:
            end_s = time.monotonic() + draw.choice((1.0, 3.0))
            while time.monotonic() < end_s:
                with suppress(LinkError):  # as wanted
                    pair.primary.ask("SELECT pg_switch_wal()")
                time.sleep(0.1)
        finally:
            free()
