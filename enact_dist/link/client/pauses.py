"""Pauses of a session, which end early once it is closed or a shard has come back.

A session in use sends keep-alives more often than an idle one; the first lock after a while wakes
the keep-alive thread.
"""

from __future__ import annotations

import random
import threading
import weakref
from typing import TYPE_CHECKING, Any, Final, Protocol

from enact_dist.core.client.backoff import SignsOfLife

if TYPE_CHECKING:
    from collections.abc import Callable

    from enact_dist.core.client.client import Client
    from enact_dist.link.carrier import Carrier


USED_AGAIN_NS: Final = 50_000_000
"""How long one note that a session is used holds: less than the shortest TTL."""


class Pauses:
    """Where the threads of one session pause before a retry.  Thread-safe.

    Attributes:
        returns: How often a shard has come back.
    """

    def __init__(self) -> None:
        self.returns = 0
        self._used = False
        self._over = False
        self._changed = threading.Condition(threading.Lock())

    def rest(self, pause_s: float, returns: int | None = None) -> bool:
        """Pause, but only until shards have come back more than `returns` times; return `over`.

        `returns` None: the present count.
        """
        with self._changed:
            before = self.returns if returns is None else returns
            self._changed.wait_for(lambda: self._over or self.returns != before, max(0.0, pause_s))
            return self._over

    def shard_returned(self) -> None:
        """Let all pausing threads retry at once."""
        with self._changed:
            self.returns += 1
            self._changed.notify_all()

    def rest_of_renewal(self, pause_s: float, returns: int) -> bool:
        """Pause as `rest`, but only until the session is used; return whether it was."""
        with self._changed:
            over = self._changed.wait_for(
                lambda: self._over or self.returns != returns or self._used, max(0.0, pause_s)
            )
            used, self._used = self._used, False
            return over and used and not self._over and self.returns == returns

    def end_long_pause(self) -> None:
        """End a long pause of the keep-alive thread, because the session is used."""
        with self._changed:
            self._used = True
            self._changed.notify_all()

    @property
    def over(self) -> bool:
        """Whether all pauses have ended."""
        return self._over

    def end(self) -> None:
        """End all pauses, for ever."""
        with self._changed:
            self._over = True
            self._changed.notify_all()


def weakly(method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls a bound method while its object lives, else returns None."""
    found = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        bound = found()
        return bound(*arguments) if bound is not None else None

    return call


class Renewed(Protocol):
    """An object that sends keep-alives."""

    def next_renewal_s(self) -> float:
        """Return how long until the next keep-alive is due."""

    def renew(self) -> None:
        """Send the keep-alives that are due; raises nothing."""


def keep_renewing(found: weakref.ref[Renewed], pauses: Pauses) -> None:
    """Renew a session until it is closed, or nothing refers to it any more."""
    returns = 0
    while (session := found()) is not None:
        pause_s = session.next_renewal_s()
        del session  # its last user may drop it during this wait
        used = pauses.rest_of_renewal(pause_s, returns)
        if pauses.over:
            return
        returns = pauses.returns
        session = None if used else found()
        if session is not None:
            session.renew()
        del session


class Renewal:
    """When one session sends keep-alives, and to which shards.  Thread-safe.

    Attributes:
        used_until_ns: Until then the last note of a use counts for further ones.
    """

    def __init__(
        self,
        core: Client,
        carrier: Carrier,
        mutex: threading.RLock,
        pauses: Pauses,
        now_ns: Callable[[], int],
    ) -> None:
        self._core, self._carrier, self._mutex = core, carrier, mutex
        self._pauses, self._now_ns = pauses, now_ns
        self._signs = SignsOfLife(random.random)
        self._rests_long = False
        self.used_until_ns = 0

    def pause_s(self) -> float:
        """Return how long until the next keep-alive is due."""
        core, away = self._core, self._carrier.away
        with self._mutex:
            now_ns = self._now_ns()
            if core.works():
                self._signs.used(now_ns, core.ttl_ns)
            self._rests_long = not self._signs.is_used(now_ns)
            return self._signs.pause_ns(core.shards_in_use(), away, core.ttl_ns, now_ns) / 1e9

    def due(self) -> list[tuple[str, bool]]:
        """Return the shards to renew with now, each with whether it was away."""
        shards, away = self._core.shards_in_use(), self._carrier.away
        with self._mutex:
            due = self._signs.due(shards, away, self._now_ns())
            return [(shard, shard in self._signs.gone) for shard in due]

    def used(self) -> None:
        """Note that a lock begins, or that a thread waits for news from the shards."""
        now_ns = self._now_ns()
        with self._mutex:
            self.used_until_ns = now_ns + USED_AGAIN_NS
            self._signs.used(now_ns, self._core.ttl_ns)
            rested_long, self._rests_long = self._rests_long, False
        if rested_long:
            self._pauses.end_long_pause()
