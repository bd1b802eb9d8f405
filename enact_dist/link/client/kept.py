"""Locks under a grant that this session keeps: marks its use, and looks whether it lives.

::

    begin    take, mark, look at the cell, begin_kept       leave    mark back, look again, put back

Of a shard without memory in common it keeps grants, too, and a thread listens there for recalls as
long as it does.  That thread waits for the shard alone, never for a lock.

Rules a change must keep
  * The order of these steps; see `core.client.kept`.
  * The time from which a hold limit counts is taken before the mark: a recall comes after the mark.
  * A lock begins only under a mark that `repair` has not given back meanwhile; both hold the mutex.
  * A far grant is taken, and its lock begun, under the mutex in one go.
"""

from __future__ import annotations

import logging
import threading
from typing import TYPE_CHECKING, Final, NamedTuple

from enact_dist.core.client.client import RecallListener
from enact_dist.core.client.lock import WAIT_SLICE_NS
from enact_dist.core.protocol.messages import FAR, PROVE, DatumRead, Item, Release
from enact_dist.errors import EnactError
from enact_dist.link.client.calls import CALL_S
from enact_dist.link.memory.use_marks import retains

if TYPE_CHECKING:
    import weakref
    from collections.abc import Callable

    from enact_dist.core.client.client import Client
    from enact_dist.core.client.kept import KeptGrant
    from enact_dist.core.client.lock import MultiLock
    from enact_dist.link.carrier import Carrier
    from enact_dist.link.client.pauses import Pauses
    from enact_dist.link.memory.payload_client import SharedPayloads

LISTEN_S: Final = WAIT_SLICE_NS / 1e9 + CALL_S
"""How long a question for recalls waits for its answer."""
QUIET_S: Final = 0.1
"""Pause after a question that came back early without word of a recall, or could not be asked."""

_log = logging.getLogger("enact.link")


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
        self._calls: tuple[Carrier, Pauses, weakref.ref[object]] | None = None
        self._listeners: dict[str, threading.Thread] = {}

    def listens(self, carrier: Carrier, pauses: Pauses, session: weakref.ref[object]) -> None:
        """Keep grants also where no memory is shared, as long as `session` is referred to."""
        if not carrier.inside and retains():
            self._calls = carrier, pauses, session

    def keeps(self, shard: str) -> bool:
        """Whether this session may keep grants of a shard."""
        if self._payloads.sees(shard):
            return self._payloads.keeps(shard)
        return self._calls is not None

    def begin(self, lane: int, asked: WantedLock) -> MultiLock | None:
        """Begin a lock under a grant that is kept; None if it has to be asked for."""
        if asked.interrupt is not None and asked.interrupt.is_set():
            return None
        with self._mutex:
            grant = self._core.kept.take(asked.keep)
            lock = self._begin_far(lane, asked, grant) if grant is not None and grant.far else None
        if grant is None or grant.far:
            self.give_back()
            return lock
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

    def _begin_far(self, lane: int, asked: WantedLock, grant: KeptGrant) -> MultiLock | None:
        now_ns = self._now_ns()
        lock = self._core.begin_kept(lane, grant, now_ns=now_ns, hold_ns=asked.hold_ns)
        if lock is not None:
            asked.begun.append(lock)
            self._counters["grants_used_again"] = self._counters.get("grants_used_again", 0) + 1
        else:
            self._core.kept.give_back(grant)
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
        if not grant.far and (page is None or not page.lives(grant.place, grant.token.number)):
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
            if self._payloads.sees(part.shard):
                self._payloads.prove(part.shard)
            else:
                self._start_listening(part.shard)
        elif keeping.said == FAR:  # its answer may have been late: the thread may have ended
            self._start_listening(part.shard)
        elif page is not None and grant is not None:
            if page.lives(grant.place, number):
                self._core.kept.put_back(grant)
            else:
                lock.releases.append((part.shard, Release(grant.origin)))
        if self._core.kept.given_back:
            self.give_back()

    # ---------------------------------------------------------------- without common memory

    def give_back(self) -> None:
        """Send the releases of far grants; word of a lost one comes again."""
        if not self._core.kept.given_back or self._calls is None:
            return
        with self._mutex:
            given, self._core.kept.given_back = self._core.kept.given_back, []
        try:
            self._calls[0].request_all(given, timeout_s=CALL_S)
        except EnactError as error:
            _log.info("grants were not given back by message: %s", error)

    def _start_listening(self, shard: str) -> None:
        """Let a thread listen for recalls of a shard, unless one does."""
        with self._mutex:
            found = self._listeners.get(shard)
            if self._calls is None or (found is not None and found.is_alive()):
                return
            self._listeners[shard] = found = threading.Thread(
                target=self._listen, args=(shard, *self._calls), name="enact-recalls", daemon=True
            )
            found.start()

    def _listen(
        self, shard: str, carrier: Carrier, pauses: Pauses, session: weakref.ref[object]
    ) -> None:
        """Ask a shard for recalls while this session keeps grants there."""
        listener = RecallListener(self._core, shard)
        while not listener.over and session() is not None and not pauses.over:
            with self._mutex:
                greets, answer = self._core.needs_hello(shard), None
                question = listener.ask(self._now_ns())
            try:
                if not greets:  # the keep-alive thread greets, and learns what the shard has
                    answer = carrier.request(shard, question, timeout_s=LISTEN_S)
            except EnactError as error:
                _log.info("no word of recalls from shard %s: %s", shard, error)
            with self._mutex:
                pauses_first = listener.hear(question, answer, self._now_ns())
            self.give_back()
            if pauses_first:
                pauses.rest(QUIET_S)

    def join(self) -> None:
        """Wait for the threads that listen; the pauses and calls of the session have ended."""
        for thread in list(self._listeners.values()):
            thread.join(CALL_S)

    # ---------------------------------------------------------------- repair

    def repair(self) -> None:
        """Give back the marks that no lock has: an interrupt has cut off its end.

        Without this their grants could not be revoked for as long as the session lives.
        """
        self.give_back()
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
