"""Locks under a grant that this session keeps: marks its use, and looks whether it lives.

::

    begin    take, mark, look at the cell, begin_kept       leave    mark back, look again, put back

Rules a change must keep
  * The order of these steps; see `core.client.kept`.
  * The time from which a hold limit counts is taken before the mark: a recall comes after the mark.
  * A lock begins only under a mark that `repair` has not given back meanwhile; both hold the mutex.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from enact_dist.core.protocol.messages import PROVE, DatumRead, Item, Release

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from enact_dist.core.client.client import Client
    from enact_dist.core.client.lock import MultiLock
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
    after: tuple[DatumRead, ...] = ()


class KeptUses:
    """What touches the pages of marks when locks of one session begin and end."""

    def __init__(
        self,
        core: Client,
        payloads: SharedPayloads,
        mutex: threading.RLock,
        now_ns: Callable[[], int],
        counters: dict[str, int],
    ) -> None:
        self._core, self._payloads, self._mutex = core, payloads, mutex
        self._now_ns, self._counters = now_ns, counters

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
        lock, number, now_ns, hold_ns = None, grant.token.number, self._now_ns(), asked.hold_ns
        try:
            page.mark(number)
            if page.lives(grant.place, number):
                with self._mutex:
                    if number in page.marked:
                        lock = self._core.begin_kept(lane, grant, now_ns=now_ns, hold_ns=hold_ns)
                    if lock is not None:
                        asked.begun.append(lock)
                        used = self._counters.get("grants_used_again", 0)
                        self._counters["grants_used_again"] = used + 1
        except OSError as error:
            self._payloads.keep_no_more(grant.shard, error)
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

    def leave(self, lock: MultiLock) -> None:
        """Give the mark of a block back, and keep its grant if that still lives."""
        keeping, part = lock.keeping, lock.parts[0]
        if keeping is None or part.token is None:
            return
        grant, number = keeping.take_grant(), part.token.number
        page = self._payloads.page(part.shard, part.token.epoch)
        try:
            if page is not None and keeping.begun_ns:
                page.unmark(number)
                keeping.begun_ns = 0
        finally:
            if page is not None and keeping.begun_ns:  # interrupted
                page.unmark(number)
        if keeping.said == PROVE:
            self._payloads.prove(part.shard)
        elif page is not None and grant is not None:
            if page.lives(grant.place, number):
                self._core.kept.put_back(grant)
            else:
                lock.releases.append((part.shard, Release(grant.origin)))

    def repair(self) -> None:
        """Give back the marks that no lock has: an interrupt has cut off its end.

        Without this their grants could not be revoked for as long as the session lives.
        """
        pages = self._payloads.pages()
        if not any(page.marked for _, page in pages):
            return
        with self._mutex:
            used = {
                (part.shard, part.token.number)
                for lock in self._core.live_locks()
                for part in lock.parts
                if part.token is not None
            }
            for shard, page in pages:
                for number in page.marked.copy():
                    if (shard, number) not in used:
                        page.unmark(number)
