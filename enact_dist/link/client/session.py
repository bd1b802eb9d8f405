"""One session of this process with a cell: its calls, the shards' catalogues, keep-alives.

Threads: any thread may call; one keep-alive thread per cell renews the session and reconciles.
`_mutex` guards the pure core and is never held during a call.  With the shard in this process there
is no such thread: the shard is asked when its answer is needed.

The transport's liveliness token, which native threads renew, also extends the lease: a Python
thread alone would starve while a library holds the interpreter lock.
"""

from __future__ import annotations

import itertools
import logging
import os
import random
import threading
import weakref
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.backoff import (
    CALLED_NS_MAX,
    CALLED_NS_MIN,
    RETRY_NS_MAX,
    RETRY_NS_MIN,
    Backoff,
)
from enact_dist.core.protocol.messages import (
    REPORT_BYTES_MAX,
    Alive,
    Answer,
    AspectEntry,
    EpochChanged,
    Goodbye,
    Ping,
    Refused,
    Register,
    Welcome,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.errors import EnactError, MisuseError
from enact_dist.link.carrier import FORKED_REMEDY
from enact_dist.link.client.calls import CALL_S, Calls, attempt_timeout_s
from enact_dist.link.client.catalogue import CATALOGUES, FurtherShards, KnownCatalogue
from enact_dist.link.client.kept import KeptUses
from enact_dist.link.client.lanes import Lanes
from enact_dist.link.client.pauses import Pauses, Renewal, keep_renewing, weakly
from enact_dist.link.clock import boottime_ns
from enact_dist.link.memory.names import FIRST_STAGED
from enact_dist.link.memory.payload_client import SharedPayloads
from enact_dist.link.refusals import error_of, unreachable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from enact_dist.core.client.client import Client
    from enact_dist.core.protocol.messages import Request, Survey, WorldEntry
    from enact_dist.errors import ShardUnreachableError
    from enact_dist.link.carrier import Begun, Carrier, NoticeFeed
    from enact_dist.link.client.duplicate_daemons import Doubts

FINISH_S: Final = 10.0
"""Default time for repeating a call before its shard counts as unreachable."""
# Tuples: a union would be rebuilt for each call.
_GREETINGS: Final = (Welcome, Alive)
LEARNT: Final = frozenset((*CATALOGUES, Alive))
"""The answers from which a session learns something about a shard."""

CALLS_S_MAX: Final = 1e8
"""Three years; longer times count as infinite."""

_log = logging.getLogger("enact.link")

_alive: weakref.WeakSet[SessionClient] = weakref.WeakSet()


def _after_fork() -> None:
    for client in list(_alive):
        client.forked = True
        client.payloads.leave_pages()


os.register_at_fork(after_in_child=_after_fork)


class SessionClient:
    """Calls, catalogue and life of one session of this process with one cell.

    Attributes:
        request_timeout_s: How long a call is repeated by default.
        catalogue: What is known of the shards' catalogues.
    """

    def __init__(
        self,
        carrier: Carrier,
        client: Client,
        *,
        now_ns: Callable[[], int] = boottime_ns,
        keep_alive: bool = True,
        doubts: Doubts | None = None,
    ) -> None:
        self.carrier = carrier
        self.core = client
        self.forked = False
        self.closed = False
        self.request_timeout_s = FINISH_S
        self.notice_numbers: dict[str, tuple[int, int]] = {}
        self.counters: dict[str, int] = {}
        self.staged_numbers = itertools.count(FIRST_STAGED)
        self._now_ns = now_ns
        self._mutex = threading.RLock()
        self.pauses = Pauses()
        self.renewal = Renewal(client, carrier, self._mutex, self.pauses, now_ns)
        self._lanes = Lanes()
        self.catalogue = KnownCatalogue()
        self.payloads = SharedPayloads(
            client.session, weakly(self._staged), weakly(self.count), inside=carrier.inside
        )
        self._kept = KeptUses(client, self.payloads, self._mutex, now_ns, self.counters)
        self._further = FurtherShards(carrier, client.placement, now_ns, weakly(self.count), doubts)
        self._renewer: threading.Thread | None = None
        if keep_alive:
            self._kept.listens(carrier, self.pauses, weakref.ref(self))
            self._renewer = threading.Thread(
                target=keep_renewing,
                args=(weakref.ref(self), self.pauses),
                name="enact-keep-alive",
                daemon=True,
            )
        _alive.add(self)

    # ---------------------------------------------------------------- start and end

    def start(self, welcome: Welcome) -> None:
        """Take the first welcome and start the keep-alive thread."""
        self._take(welcome.shard, self.core.hello(welcome.shard), welcome)
        if self._renewer is not None:
            self._renewer.start()
            self.carrier.on_reconnect(weakly(self._shard_returned))

    def close(self) -> None:
        """Say goodbye to every shard and end; idempotent."""
        if self.closed or self.forked:
            return
        self.closed = True
        self.pauses.end()
        if self._renewer is not None and self._renewer.is_alive():
            self._renewer.join()
        goodbyes = [(shard, Goodbye(self.core.session)) for shard in self.core.shards_in_use()]
        try:
            self.carrier.request_all(goodbyes, timeout_s=CALL_S / 2)
        except EnactError as error:
            _log.info("session %s ends without goodbye: %s", self.core.session[:8], error)
        finally:
            self.payloads.close()
            self.carrier.close()
            self._kept.join()
            _alive.discard(self)

    def check_usable(self) -> None:
        """Raise `MisuseError` if this client is closed or belongs to the parent process."""
        if self.forked:
            raise MisuseError(
                "this cell was opened before a fork and belongs to the parent process;"
                f" {FORKED_REMEDY}"
            )
        if self.closed:
            raise MisuseError("this cell is closed; connect again")

    # ---------------------------------------------------------------- calls

    def call(self, shard: str, request: Request, *, timeout_s: float | None = None) -> Answer:
        """Make one idempotent call, repeating it until it is answered.

        Raises:
            ShardUnreachableError: No answer within `timeout_s` (None: `request_timeout_s`).
        """
        return self.call_all([(shard, request)], timeout_s=timeout_s)[0]

    def call_all(
        self, calls: Sequence[tuple[str, Request]], *, timeout_s: float | None = None
    ) -> list[Answer]:
        """Make idempotent calls at once, repeating each until it is answered.

        Raises:
            ShardUnreachableError: One got no answer within `timeout_s`.
        """
        answers = self.call_each(calls, timeout_s=timeout_s)
        for (shard, _), answer in zip(calls, answers, strict=True):
            if answer is None:
                waited_s = self.request_timeout_s if timeout_s is None else timeout_s
                raise self.unreachable(shard, waited_s)
        return [answer for answer in answers if answer is not None]

    def call_each(
        self, calls: Sequence[tuple[str, Request]], *, timeout_s: float | None = None
    ) -> list[Answer | None]:
        """Make idempotent calls at once, repeating each until it is answered or time is up.

        Listings are complete; each of their pages gets the full time.
        """
        self.check_usable()
        made = Calls(calls)
        deadline_ns = self._deadline_ns(timeout_s)
        near = Backoff(RETRY_NS_MIN, RETRY_NS_MAX, random.random)
        far = Backoff(CALLED_NS_MIN, CALLED_NS_MAX, random.random)
        while left := made.left:
            sent = [made.asked[index] for index in left]
            epochs, returns = [self.core.epoch(shard) for shard, _ in sent], self.pauses.returns
            turned = False
            for index, answer, epoch in zip(left, self._send(sent), epochs, strict=True):
                if answer is not None:
                    self._take(*made.asked[index], answer, epoch)
                    turned |= made.take(index, answer)
            left_ns = deadline_ns - self._now_ns()
            if turned:
                deadline_ns = self._deadline_ns(timeout_s)
            elif made.left and left_ns <= 0:
                break
            elif made.left:
                away = all(self.carrier.away(made.asked[index][0]) for index in made.left)
                pause_ns = (far if away else near).pause_ns()
                self.pauses.rest(min(pause_ns, left_ns) / 1e9, returns)
        return made.answers

    def _deadline_ns(self, timeout_s: float | None) -> int:
        """Return the deadline of calls with this time limit (None: `request_timeout_s`)."""
        wait_s = self.request_timeout_s if timeout_s is None else timeout_s
        return self._now_ns() + int(min(wait_s, CALLS_S_MAX) * 1e9)

    def ask_each(
        self,
        shards: Iterable[str],
        request_of: Callable[[str, int, int], Request],
        *,
        timeout_s: float | None = None,
    ) -> dict[str, Answer | None]:
        """Make one call to each shard that needs a known session; greet where needed.

        Args:
            shards: The shards to call.
            request_of: Makes the call for a shard's name, epoch and message counter; called again
                if the shard has restarted.
            timeout_s: Time limit; afterwards a missing answer is None.  A refused greeting counts
                as the shard's answer.
        """
        answers: dict[str, Answer | None] = dict.fromkeys(shards)
        deadline_ns = self._deadline_ns(timeout_s)
        while True:
            left = [shard for shard, answer in answers.items() if answer is None]
            left_s = max(0.0, (deadline_ns - self._now_ns()) / 1e9)
            hellos = [(s, self.core.hello(s)) for s in left if self.core.needs_hello(s)]
            greeted = self.call_each(hellos, timeout_s=left_s)
            for (shard, _), answer in zip(hellos, greeted, strict=True):
                if isinstance(answer, Refused):
                    answers[shard] = answer
                    left.remove(shard)
            with self._mutex:
                next_count, now_ns = self.core.sendings.next, self._now_ns()
                calls = [(s, request_of(s, self.core.epoch(s), next_count(now_ns))) for s in left]
            found = self.call_each(calls, timeout_s=left_s)
            told = zip(left, found, strict=True)
            answers.update(
                (s, answer) for s, answer in told if not isinstance(answer, EpochChanged)
            )
            if None not in answers.values() or self._now_ns() >= deadline_ns:
                return answers

    def unreachable(self, shard: str, waited_s: float) -> ShardUnreachableError:
        """Return the error for a shard without an answer to a question that needs no disk."""
        runs = self.carrier.request(shard, Ping(), timeout_s=CALL_S / 4) is not None
        return unreachable(shard, waited_s, self.carrier, runs=runs)

    def call_once(
        self, calls: Sequence[tuple[str, Request]], *, timeout_s: float = CALL_S
    ) -> list[Answer | None]:
        """Make calls at once, each only once; None: no answer.

        Listings are complete; `timeout_s` holds for each of their pages.
        """
        self.check_usable()
        made = Calls(calls)
        left = made.left
        while left:
            asked = [made.asked[index] for index in left]
            found = self.carrier.request_all(asked, timeout_s=timeout_s)
            some = [
                (index, answer)
                for index, answer in zip(left, found, strict=True)
                if answer is not None
            ]
            for index, answer in some:
                self._take(*made.asked[index], answer)
            left = [index for index, answer in some if made.take(index, answer)]
        return made.answers

    def begin(self, shard: str, request: Request, *, timeout_s: float) -> Begun:
        """Send one request of a transfer; the caller awaits its answer later.

        Raises:
            MisuseError: This client is closed.
        """
        self.check_usable()
        return self.carrier.begin(shard, request, timeout_s=timeout_s)

    def rest(self, pause_s: float) -> None:
        """Wait a little before a retry; end early when a shard comes back."""
        self.pauses.rest(pause_s)

    def _staged(self, shard: str, request: Request) -> Answer | None:
        return self.call_once([(shard, request)])[0]

    def _send(self, calls: Sequence[tuple[str, Request]]) -> list[Answer | None]:
        if self._further.doubted:
            self._further.check(calls)
        if len(calls) == 1:
            shard, request = calls[0]
            return [self.carrier.request(shard, request, timeout_s=attempt_timeout_s(request))]
        longest_s = max((attempt_timeout_s(request) for _, request in calls), default=CALL_S)
        return self.carrier.request_all(calls, timeout_s=longest_s)

    def _take(self, shard: str, request: Request, answer: Answer, sent_in: int = 0) -> None:
        """Update the session from an answer to a request sent in that epoch of the shard."""
        with self._mutex:
            self._learn(shard, answer, sent_in)
            self.core.answered(shard, request, answer, self._now_ns())
        self._further.follow(self.core.placement)  # outside the mutex

    def _learn(self, shard: str, answer: Answer, sent_in: int = 0) -> None:
        if isinstance(answer, CATALOGUES):
            self.catalogue.learn(shard, answer, sent_in=sent_in)
            self.core.knows_types(shard, self.catalogue.successions(shard))
        if isinstance(answer, _GREETINGS):
            if isinstance(answer, Welcome):
                self.payloads.learn(answer)
            self.notice_numbers[shard] = (answer.epoch, answer.notice_number)

    def unsettled_ns(self, shard: str) -> int:
        """Return the timestamp of our latest commit that a shard may not show yet (0: none)."""
        with self._mutex:
            return self.core.unsettled_ns(shard)

    def reached(self, shard: str, stamp_ns: int) -> None:
        """Note that a shard shows everything up to a timestamp."""
        with self._mutex:
            self.core.reached(shard, stamp_ns)

    # ---------------------------------------------------------------- catalogue

    def shards(self) -> tuple[str, ...]:
        """Return the names of all shards of the cell."""
        return tuple(shard.name for shard in self.core.placement.shards)

    def shard_of(self, entity: str) -> str:
        """Return the shard that stores an entity of that name."""
        return shard_of(entity, self.core.placement)

    def greet(self, shards: Iterable[str] | None = None, *, timeout_s: float | None = None) -> None:
        """Say hello to shards (None: to all) again, which refreshes the catalogue."""
        wanted = self.shards() if shards is None else shards
        hellos = [(shard, self.core.hello(shard)) for shard in wanted]
        for answer in self.call_all(hellos, timeout_s=timeout_s):
            if isinstance(answer, Refused):
                raise error_of(answer)

    def worlds(self) -> dict[str, WorldEntry]:
        """Return the world contexts that every greeted shard knows."""
        return self.catalogue.worlds()

    def worlds_at(self, name: str) -> dict[str, WorldEntry]:
        """Return the greeted shards that know a world context, each with its entry."""
        return self.catalogue.worlds_at(name)

    def aspect_entries(self) -> dict[str, AspectEntry]:
        """Return the registered aspects of all greeted shards by name."""
        return self.catalogue.aspects()

    def knows(self, aspects: Sequence[AspectEntry]) -> bool:
        """Whether every shard of the cell is known to have these aspects: the usual case."""
        return self.catalogue.settled(aspects, self.core.placement)

    def lacking(
        self, aspects: Sequence[AspectEntry], needed: Callable[[], Iterable[str]]
    ) -> list[str]:
        """Return those of the needed shards that may lack some of these aspects."""
        missing = [shard for shard in self.shards() if self.catalogue.lacks(shard, (), aspects)]
        if not missing:
            return []
        wanted = set(needed())
        return [shard for shard in missing if shard in wanted]

    def register(
        self,
        *,
        worlds: Iterable[str] = (),
        aspects: Iterable[AspectEntry] = (),
        needed: Callable[[], Iterable[str]] | None = None,
        timeout_s: float | None = None,
    ) -> None:
        """Ensure that shards know these world contexts and aspects.

        Args:
            worlds: Names of world contexts, created if missing.
            aspects: Entries of aspects.
            needed: Returns the shards that matter; None: all.  Called only if some shard lacks
                something, so an absent shard stops only calls that need it.
            timeout_s: How long a shard may take to answer.

        Raises:
            DatumTypeError: An aspect is registered with another type or durability.
            ShardUnreachableError: A shard does not answer.
            MisuseError: This session only observes.
        """
        worlds, aspects = tuple(worlds), tuple(aspects)
        if self.core.observer and (worlds or aspects):
            raise MisuseError(
                "this session only observes: it cannot lock or create world contexts and"
                " aspects; connect without observer=True"
            )
        self.catalogue.wants(aspects)
        missing = [shard for shard in self.shards() if self.catalogue.lacks(shard, worlds, aspects)]
        if missing and needed is not None:
            wanted = set(needed())
            missing = [shard for shard in missing if shard in wanted]
        if missing:
            request = Register(self.core.session, worlds, aspects)
            epochs = {shard: self.core.epoch(shard) for shard in missing}
            found = self.ask_each(missing, lambda *_: request, timeout_s=timeout_s)
            for shard, answer in found.items():
                if answer is None:
                    raise self.unreachable(shard, timeout_s or self.request_timeout_s)
                if isinstance(answer, Refused):
                    raise error_of(answer)
            restarted = [shard for shard in missing if self.core.epoch(shard) != epochs[shard]]
            if restarted:  # the answer may be from before the restart and is then ignored
                self.greet(restarted, timeout_s=timeout_s)

    def subscribe(self, interest: Survey | None = None) -> NoticeFeed:
        """Open a feed of the notices of all shards that `interest` lists (None: of all slots)."""
        self.check_usable()
        return self.carrier.subscribe(interest)

    # ---------------------------------------------------------------- keep-alive

    def next_renewal_s(self) -> float:
        """Return how long until the next keep-alive is due."""
        return self.renewal.pause_s()

    def renew(self) -> None:
        """Send the keep-alives that are due; failures are only logged."""
        try:
            self.renew_once()
            if any(self.core.needs_hello(shard) for shard in self.core.shards_in_use()):
                # A shard restarted: the sooner it hears that we noticed, the sooner it grants.
                self.renew_once()
        except Exception as error:  # noqa: BLE001 - a bad answer must not end the renewal
            self.count("keep_alives_failed")
            _log.warning("keep-alive of session %s: %s", self.core.session[:8], error)

    def _shard_returned(self, _: str) -> None:
        """Let all waiting threads retry at once."""
        with self._mutex:
            self.core.ask_again()
        self.pauses.shard_returned()

    def renew_once(self) -> None:
        """Send one keep-alive to every shard in use that is within reach; process the answers.

        A shard that is known to be away is asked less and less often.
        """
        due = self.renewal.due()
        with self._mutex:
            now_ns = self._now_ns()
            calls = [(shard, self.core.keep_alive(shard, now_ns)) for shard, _ in due]
        answers = self.carrier.request_all(calls, timeout_s=max(0.1, self.core.ttl_ns / 4e9))
        for (shard, request), (_, was_away), answer in zip(calls, due, answers, strict=True):
            if answer is not None:
                self._take(shard, request, answer)
                if was_away:
                    self._shard_returned(shard)
            else:
                self.count("keep_alives_unanswered")
        self._kept.repair()

    def set_report(self, report: bytes) -> None:
        """Set what the next keep-alives carry: an actor's statistics; MisuseError if too long."""
        if (size := len(report)) > REPORT_BYTES_MAX:
            raise MisuseError(f"a report of {size} bytes; at most {REPORT_BYTES_MAX} are kept")
        if self.forked or self.closed:
            return
        with self._mutex:
            self.core.report = report
        if self._renewer is None:
            self.renew_once()

    def count(self, name: str, amount: int = 1) -> None:
        """Add to one of the counters that `Cell.statistics` returns."""
        with self._mutex:
            self.counters[name] = self.counters.get(name, 0) + amount
