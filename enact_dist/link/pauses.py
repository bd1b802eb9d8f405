"""Pauses of a session: they end early once it is closed, or a shard has come back."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import weakref


class Pauses:
    """Where the threads of one session wait before they ask again.  Thread-safe.

    Attributes:
        returns: How often a shard has come back.
    """

    def __init__(self) -> None:
        self.returns = 0
        self._over = False
        self._changed = threading.Condition(threading.Lock())

    def rest(self, pause_s: float, returns: int | None = None) -> bool:
        """Wait, but not once more shards than `returns` have come back; say whether it is over.

        `returns` None stands for those that have come back so far.
        """
        with self._changed:
            before = self.returns if returns is None else returns
            self._changed.wait_for(lambda: self._over or self.returns != before, max(0.0, pause_s))
            return self._over

    def shard_returned(self) -> None:
        """Let everybody who waits ask again at once."""
        with self._changed:
            self.returns += 1
            self._changed.notify_all()

    def end(self) -> None:
        """Let nobody wait any more."""
        with self._changed:
            self._over = True
            self._changed.notify_all()


class Renewed(Protocol):
    """What has to give signs of life."""

    def next_renewal_s(self) -> float:
        """Return how long no sign of life is due."""

    def renew(self) -> None:
        """Send those that are due; raises nothing."""


def keep_renewing(found: weakref.ref[Renewed], pauses: Pauses) -> None:
    """Renew a session until it is closed, or nobody uses it any more."""
    returns = 0
    while (session := found()) is not None:
        pause_s = session.next_renewal_s()
        del session  # its last user may go while this waits
        if pauses.rest(pause_s, returns):
            return
        returns = pauses.returns
        session = found()
        if session is not None:
            session.renew()
        del session
