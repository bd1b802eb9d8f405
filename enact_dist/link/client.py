"""The client's working half: drives `core.Client` over a carrier, keeps the session alive.

Threads: the caller's own thread makes its lock's calls; one keep-alive thread per cell renews the
session and reconciles.  `_mutex` guards the pure core and is never held during a call.

The lease itself also rides on the transport's liveliness token, which native threads renew: a
Python thread alone would starve for as long as a library holds the interpreter lock.
"""

from __future__ import annotations

import os
import threading
import weakref
from typing import TYPE_CHECKING, Final

from enact_dist.core.messages import (
    Acquire,
    Alive,
    Answer,
    AspectEntry,
    Commit,
    Fetch,
    Goodbye,
    Hello,
    KeepAlive,
    Refused,
    Register,
    Registered,
    Welcome,
)
from enact_dist.core.multilock import MultiLock, Phase
from enact_dist.errors import MisuseError
from enact_dist.link.clock import boottime_ns
from enact_dist.link.refusals import error_of, not_committed, not_granted, unreachable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from enact_dist.core.client import Client
    from enact_dist.core.messages import Item, Request, SlotVersion, WriteItem
    from enact_dist.link.carrier import Carrier, NoticeFeed

CALL_S: Final = 1.0
"""How long one call may stay unanswered before it counts as unknown and is made again."""
BYTES_PER_S_MIN: Final = 10e6
"""A call that carries data gets this much more time per byte."""
FINISH_S: Final = 10.0
"""How long a commit may stay without an answer before `CommitUnknownError`."""

_alive: weakref.WeakSet[CellClient] = weakref.WeakSet()


def _after_fork() -> None:
    for client in list(_alive):
        client.forked = True


os.register_at_fork(after_in_child=_after_fork)


class CellClient:
    """One session of this process with one cell."""

    def __init__(
        self,
        carrier: Carrier,
        client: Client,
        *,
        now_ns: Callable[[], int] = boottime_ns,
        keep_alive: bool = True,
    ) -> None:
        self.carrier = carrier
        self.core = client
        self.forked = False
        self.closed = False
        self.notice_numbers: dict[str, tuple[int, int]] = {}
        self.counters: dict[str, int] = {}
        self._now_ns = now_ns
        self._mutex = threading.RLock()
        self._stopping = threading.Event()
        self._lanes_free: list[int] = []
        self._lanes_made = 0
        self._aspects: dict[str, dict[str, AspectEntry]] = {}
        self._registered: dict[str, AspectEntry] = {}
        self._worlds: dict[str, tuple[str, ...]] = {}
        self._renewer: threading.Thread | None = None
        if keep_alive:
            self._renewer = threading.Thread(
                target=self._renew, name="enact-keep-alive", daemon=True
            )
        _alive.add(self)

    # ---------------------------------------------------------------- start and end

    def start(self, welcome: Welcome) -> None:
        """Take the first welcome and begin to keep the session alive."""
        hello = self.core.hello(welcome.shard)
        self._take(welcome.shard, hello, welcome)
        self.carrier.add_endpoints(welcome.placement.shards)
        if self._renewer is not None:
            self._renewer.start()

    def close(self) -> None:
        """Say goodbye to every shard and end; twice is harmless."""
        if self.closed or self.forked:
            return
        self.closed = True
        self._stopping.set()
        if self._renewer is not None and self._renewer.is_alive():
            self._renewer.join()
        goodbyes = [(shard, Goodbye(self.core.session)) for shard in self.core.shards_in_use()]
        self.carrier.request_all(goodbyes, timeout_s=CALL_S / 2)
        self.carrier.close()
        _alive.discard(self)

    def check_usable(self) -> None:
        """Raise `MisuseError` if this client is closed or belongs to the parent process."""
        if self.forked:
            raise MisuseError(
                "this cell was connected before a fork and belongs to the parent process;"
                " connect anew in the child, or start it with the 'spawn' method"
            )
        if self.closed:
            raise MisuseError("this cell is closed; connect again")

    # ---------------------------------------------------------------- calls

    def call(self, shard: str, request: Request, *, timeout_s: float = FINISH_S) -> Answer:
        """Make one idempotent call, again until it is answered.

        Raises:
            ShardUnreachableError: No answer within `timeout_s`.
        """
        return self.call_all([(shard, request)], timeout_s=timeout_s)[0]

    def call_all(
        self, calls: Sequence[tuple[str, Request]], *, timeout_s: float = FINISH_S
    ) -> list[Answer]:
        """Make idempotent calls at once, each again until it is answered.

        Raises:
            ShardUnreachableError: One stays without an answer for `timeout_s`.
        """
        self.check_usable()
        answers: dict[int, Answer] = {}
        deadline_ns = self._now_ns() + int(timeout_s * 1e9)
        pause_s = 0.02
        while True:
            left = [index for index in range(len(calls)) if index not in answers]
            sent = [calls[index] for index in left]
            for index, answer in zip(left, self._send(sent), strict=True):
                if answer is not None:
                    self._take(*calls[index], answer)
                    answers[index] = answer
            if len(answers) == len(calls):
                return [answers[index] for index in range(len(calls))]
            if self._now_ns() >= deadline_ns:
                missing = next(index for index in left if index not in answers)
                raise unreachable(calls[missing][0], timeout_s, self.carrier.endpoint_of)
            self._stopping.wait(pause_s)
            pause_s = min(2 * pause_s, 0.3)

    def call_once(
        self, calls: Sequence[tuple[str, Request]], *, timeout_s: float = CALL_S
    ) -> list[Answer | None]:
        """Make calls at once, none of them twice; None stands for no answer."""
        self.check_usable()
        answers = self.carrier.request_all(calls, timeout_s=timeout_s)
        for (shard, request), answer in zip(calls, answers, strict=True):
            if answer is not None:
                self._take(shard, request, answer)
        return answers

    def _send(self, calls: Sequence[tuple[str, Request]]) -> list[Answer | None]:
        if len(calls) == 1:
            shard, request = calls[0]
            return [self.carrier.request(shard, request, timeout_s=_patience_s(request))]
        patience_s = max((_patience_s(request) for _, request in calls), default=CALL_S)
        return self.carrier.request_all(calls, timeout_s=patience_s)

    def _take(self, shard: str, request: Request, answer: Answer) -> None:
        """Let the session learn from an answer."""
        with self._mutex:
            self._learn(shard, answer)
            self.core.answered(shard, request, answer, self._now_ns())

    def _learn(self, shard: str, answer: Answer) -> None:
        if isinstance(answer, Welcome):
            known = self.core.placement
            self._worlds[shard] = answer.worlds
            self._aspects[shard] = {entry.name: entry for entry in answer.aspects}
            self.notice_numbers[shard] = (answer.epoch, answer.notice_number)
            if known.version != answer.placement.version:
                self.carrier.add_endpoints(answer.placement.shards)
        elif isinstance(answer, Registered):
            self._worlds[shard] = answer.worlds
            self._aspects[shard] = {entry.name: entry for entry in answer.aspects}
        elif isinstance(answer, Alive):
            self.notice_numbers[shard] = (answer.epoch, answer.notice_number)

    # ---------------------------------------------------------------- catalogue

    def shards(self) -> tuple[str, ...]:
        """Return the names of all shards of the cell."""
        return tuple(shard.name for shard in self.core.placement.shards)

    def greet(self, *, timeout_s: float = FINISH_S) -> None:
        """Say hello to every shard (again), which refreshes the catalogue."""
        self.call_all(
            [(shard, self.core.hello(shard)) for shard in self.shards()], timeout_s=timeout_s
        )

    def worlds(self) -> tuple[str, ...]:
        """Return the world contexts that every greeted shard knows."""
        known = [set(worlds) for worlds in self._worlds.values()]
        return tuple(sorted(set.intersection(*known))) if known else ()

    def aspect_entries(self) -> dict[str, AspectEntry]:
        """Return the registered aspects of all greeted shards by name."""
        merged: dict[str, AspectEntry] = {}
        for aspects in self._aspects.values():
            merged.update(aspects)
        return merged

    def register(self, *, worlds: Iterable[str] = (), aspects: Iterable[AspectEntry] = ()) -> None:
        """Make sure that every shard knows these world contexts and aspects.

        Raises:
            DatumTypeError: An aspect is registered with another type or durability.
            ShardUnreachableError: A shard does not answer.
        """
        worlds, aspects = tuple(worlds), tuple(aspects)
        self._registered.update((entry.name, entry) for entry in aspects)
        missing = [
            shard
            for shard in self.shards()
            if not all(_agrees(self._aspects.get(shard, {}).get(e.name), e) for e in aspects)
            or not set(worlds) <= set(self._worlds.get(shard, ()))
        ]
        if missing:
            request = Register(self.core.session, worlds, aspects)
            for answer in self.call_all([(shard, request) for shard in missing]):
                if isinstance(answer, Refused):
                    raise error_of(answer)

    # ---------------------------------------------------------------- locks

    def acquire(
        self, items: Iterable[Item], *, wait_s: float, hold_s: float, check_plan: Callable[[], None]
    ) -> MultiLock:
        """Acquire a lock; it rests in HELD when this returns.

        Args:
            items: What to lock and view.
            wait_s: How long to wait for the grant.
            hold_s: Hold limit after the last grant.
            check_plan: Called with each plan before anything is asked; may raise.

        Raises:
            LockTimeoutError: Not granted in time; nothing is held.
            ShardUnreachableError: A shard stayed without an answer.
            EnactError: The shard refused the request.
        """
        self.check_usable()
        items = tuple(items)
        lane = self._take_lane()
        started_ns = now_ns = self._now_ns()
        wait_ns = int(wait_s * 1e9)
        try:
            while True:
                with self._mutex:
                    plan = self.core.plan(items)
                    check_plan()
                    left_ns = started_ns + wait_ns - now_ns
                    lock = self.core.begin(
                        lane, plan, now_ns=now_ns, wait_ns=left_ns, hold_ns=int(hold_s * 1e9)
                    )
                self._drive(lock)
                now_ns = self._now_ns()
                restart = lock.phase in (Phase.LOST, Phase.MISPLACED)
                if lock.refusal is not None and lock.refusal.code == "unknown_aspect":
                    # A shard that keeps nothing restarted since: its catalogue is empty again.
                    self.greet()
                    self.register(aspects=self._registered.values())
                    restart = True
                if not restart or now_ns >= started_ns + wait_ns:
                    break
            if lock.phase is not Phase.HELD:
                raise not_granted(lock, (now_ns - started_ns) / 1e9, self.carrier.endpoint_of)
        except BaseException:
            self._lanes_free.append(lane)
            raise
        return lock

    def _take_lane(self) -> int:
        with self._mutex:
            if self._lanes_free:
                return self._lanes_free.pop()
            self._lanes_made += 1
            return self._lanes_made - 1

    def _drive(self, lock: MultiLock) -> None:
        """Make the lock's calls until it rests."""
        try:
            while True:
                with self._mutex:
                    calls, wait_until_ns = lock.next_calls(self._now_ns())
                    if not calls and not lock.phase.busy:
                        return
                if not calls:
                    self._stopping.wait(max(0.001, (wait_until_ns - self._now_ns()) / 1e9))
                    continue
                answers = self._send(calls)
                with self._mutex:
                    for (shard, request), answer in zip(calls, answers, strict=True):
                        if answer is not None:
                            self._learn(shard, answer)
                        lock.answered(shard, request, answer, self._now_ns())
        except BaseException:
            lock.release()
            raise
        finally:
            farewells = lock.take_farewells()
            if farewells:
                self.carrier.request_all(farewells, timeout_s=CALL_S)

    def finish(
        self,
        lock: MultiLock,
        writes: Mapping[str, Sequence[WriteItem]],
        expects: Sequence[SlotVersion] = (),
    ) -> None:
        """Publish `writes` and give the lock back.

        Raises:
            ChangedError: An expected slot has moved on; nothing was written.
            LeaseLostError: The lock was lost; nothing was written.
            CommitUnknownError: The commit was sent and never answered.
            ShardUnreachableError: A shard does not answer; nothing was written.
        """
        try:
            with self._mutex:
                if lock.phase is Phase.HELD:
                    size = sum(w.datum.size for ws in writes.values() for w in ws if w.datum)
                    finish_s = FINISH_S + size / BYTES_PER_S_MIN
                    give_up_ns = self._now_ns() + int(finish_s * 1e9)
                    lock.finish(writes, give_up_ns=give_up_ns, expects=expects)
            self._drive(lock)
            if lock.phase is not Phase.COMMITTED:
                raise not_committed(lock, FINISH_S, self.carrier.endpoint_of)
        finally:
            self._lanes_free.append(lock.lock.lane)

    def release(self, lock: MultiLock) -> None:
        """Give the lock back without writing; never raises for a lock already lost."""
        try:
            with self._mutex:
                lock.release()
            self._drive(lock)
        finally:
            self._lanes_free.append(lock.lock.lane)

    def valid(self, lock: MultiLock) -> bool:
        """Whether the client may still believe in the lock, without asking anybody."""
        with self._mutex:
            return lock.valid(self._now_ns())

    def check(self, lock: MultiLock) -> None:
        """Make sure that the lock is held, asking its shards where belief has run out.

        Raises:
            LeaseLostError: It is lost.
            ShardUnreachableError: A shard does not answer, so nobody can say.
        """
        self.check_usable()
        if self.valid(lock):
            return
        if lock.phase is Phase.HELD:
            with self._mutex:
                now_ns = self._now_ns()
                shards = [part.shard for part in lock.parts]
                calls = [(shard, self.core.keep_alive(shard, now_ns)) for shard in shards]
            self.call_all(calls)
        if lock.phase is not Phase.HELD:
            raise not_committed(lock, FINISH_S, self.carrier.endpoint_of)

    def fetch_call(self, request: Fetch, shard: str) -> Answer | None:
        """Ask once for a part of a datum."""
        return self.carrier.request(shard, request, timeout_s=CALL_S)

    def subscribe(self) -> NoticeFeed:
        """Open a feed of the notices of all shards."""
        self.check_usable()
        return self.carrier.subscribe()

    # ---------------------------------------------------------------- keep-alive

    def _renew(self) -> None:
        while not self._stopping.wait(self.core.ttl_ns / 4e9):
            self.renew_once()

    def renew_once(self) -> None:
        """Send one keep-alive to every shard in use and take the answers."""
        with self._mutex:
            now_ns = self._now_ns()
            calls = [
                (shard, self.core.keep_alive(shard, now_ns)) for shard in self.core.shards_in_use()
            ]
        answers = self.carrier.request_all(calls, timeout_s=max(0.1, self.core.ttl_ns / 4e9))
        for (shard, request), answer in zip(calls, answers, strict=True):
            if answer is not None:
                self._take(shard, request, answer)
            else:
                self.counters["keep_alives_unanswered"] = (
                    self.counters.get("keep_alives_unanswered", 0) + 1
                )

    def set_report(self, report: bytes) -> None:
        """Let the next keep-alives carry this actor's statistics (msgpack)."""
        with self._mutex:
            self.core.report = report


def _patience_s(request: Request) -> float:
    """Return how long to wait for the answer to one call."""
    if isinstance(request, Acquire):
        return request.wait_ns / 1e9 + CALL_S
    if isinstance(request, Commit):
        size = sum(write.datum.size for write in request.writes if write.datum is not None)
        return CALL_S + size / BYTES_PER_S_MIN
    if isinstance(request, Hello | KeepAlive):
        return CALL_S / 2
    return CALL_S


def _agrees(known: AspectEntry | None, wanted: AspectEntry) -> bool:
    return (
        known is not None
        and known.fingerprint == wanted.fingerprint
        and wanted.durability in ("", known.durability)
    )
