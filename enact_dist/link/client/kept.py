"""Locks under a grant that this session keeps: marks its use, and looks whether it lives.

The order of these steps is the rule: see `core.client.kept`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from enact_dist.core.protocol.messages import PROVE, Release

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from enact_dist.core.client.client import Client
    from enact_dist.core.client.kept import Keeping
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.core.protocol.messages import Item
    from enact_dist.link.memory.payload_client import SharedPayloads


class WantedLock(NamedTuple):
    """What a thread asks for: the arguments of `CellClient.acquire`."""

    items: tuple[Item, ...]
    give_up_ns: int
    hold_ns: int
    past_ns: int
    keep: tuple[Item, ...]
    interrupt: threading.Event | None
    begun: list[MultiLock]


class KeptUses:
    """The use of the kept grants of one session.  Thread-safe.

    Args:
        core: The session.
        payloads: Where its pages are.
        mutex: Guards the session.
        now_ns: The session's clock.
    """

    def __init__(
        self,
        core: Client,
        payloads: SharedPayloads,
        mutex: threading.RLock,
        now_ns: Callable[[], int],
    ) -> None:
        self._core, self._payloads = core, payloads
        self._mutex, self._now_ns = mutex, now_ns

    def begin(self, lane: int, asked: WantedLock) -> MultiLock | None:
        """Begin a lock under a grant that is kept; None if it has to be asked for."""
        if asked.interrupt is not None and asked.interrupt.is_set():
            return None
        grant = self._core.kept.take(asked.keep)
        if grant is None:
            return None
        page = self._payloads.page(grant.shard, grant.token.epoch)
        if page is None:
            return None
        lock, number = None, grant.token.number
        page.mark(number)
        try:
            if page.lives(grant.place, number):
                with self._mutex:
                    now_ns, hold_ns = self._now_ns(), asked.hold_ns
                    lock = self._core.begin_kept(lane, grant, now_ns=now_ns, hold_ns=hold_ns)
                    if lock is not None:
                        asked.begun.append(lock)
        finally:
            if lock is None:
                page.unmark(number)
        return lock

    def finish(self, lock: MultiLock) -> bool:
        """End a lock that has written nothing without a message.

        Returns:
            False if its shard has to be asked: it did not begin under a kept grant, another lock
            waits for it, it may have ended, or its lease may be over.
        """
        grant = lock.keeping.grant if lock.keeping is not None else None
        if grant is None:
            return False
        page = self._payloads.page(grant.shard, grant.token.epoch)
        if page is None or not page.lives(grant.place, grant.token.number):
            return False
        with self._mutex:
            return lock.finish_kept(self._now_ns())

    def leave(self, lock: MultiLock, keeping: Keeping) -> None:
        """Give the mark of a block back, and keep its grant if that still lives."""
        part, grant = lock.parts[0], keeping.take_grant()
        page = self._payloads.page(part.shard, part.token.epoch) if part.token else None
        if part.token is None or page is None:
            if keeping.said == PROVE:
                self._payloads.prove(part.shard)
            return
        number = part.token.number
        if keeping.begun_ns:
            keeping.begun_ns = 0
            page.unmark(number)
        if grant is not None and page.lives(grant.place, number):
            self._core.kept.put_back(grant)
        elif grant is not None:
            lock.farewells.append((part.shard, Release(grant.origin)))
