"""The client half of one lock: acquire over shards in order, hold, finish, give up.

::

    ACQUIRING ──> VIEWING ──> HELD ──> VALIDATING ──> COMMITTING ──> COMMITTED
                                       (preparing)
        │            │          │           │              │
        └────────────┴──────────┴───────────┴──────────────┴──> LOST · CHANGED · TIMED_OUT ·
                                  UNREACHABLE · REFUSED · MISPLACED · UNKNOWN · RELEASED

Rules a change must keep
  * Shards are acquired in one global order (by name), waiting at one at a time: waits-for edges
    over shards only go up, so there is no deadlock.
  * Reads and expectations on other shards are validated, writes prepared, after `finish` and
    before the commit: everything was then held at the moment of `finish`.
  * Until the commit is sent, giving up means abort: releasing the primary causes it.
  * No answer means unknown.  A commit without an answer is asked about (`Outcome`), never guessed.
  * A `Stale` or lost lock never comes back under its seq.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import repeat, starmap
from typing import TYPE_CHECKING, Final

from enact_dist.core.client.backoff import RETRY_NS_MAX, RETRY_NS_MIN
from enact_dist.core.client.cut import ROUNDS_MAX, Cut
from enact_dist.core.client.finishing import Finishing, by_shard, tokens_of
from enact_dist.core.client.kept import Keeping
from enact_dist.core.client.plan import OF_SESSIONS, Part, Phase, Plan, Reading, first_asking
from enact_dist.core.protocol.messages import (
    NO_PAYLOAD,
    OUTCOME_COMMITTED,
    OVERLOAD,
    Answer,
    Changed,
    Commit,
    Committed,
    EpochChanged,
    Fenced,
    Forgotten,
    Granted,
    Outcome,
    OutcomeIs,
    Prepare,
    Prepared,
    Refused,
    Release,
    Stale,
    TakeView,
    Valid,
    Validate,
    Viewed,
    Waiting,
    WrongShard,
)
from enact_dist.core.protocol.placement import shard_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from enact_dist.core.client.plan import AwaitedNews
    from enact_dist.core.client.session import ClientSession
    from enact_dist.core.protocol.datum import LockId, Position, Slot
    from enact_dist.core.protocol.messages import DatumRead, Holder, Request, SlotVersion, WriteItem

WAIT_SLICE_NS: Final = 900_000_000
"""How long one call of a waiting lock is parked; below the shard's own limit of 1 s."""
_TO_ANY_REQUEST: Final = frozenset((Refused, Forgotten, WrongShard, EpochChanged))
_DECIDERS: Final = (Commit, Outcome)

FREE_CALLS: Final = 3
"""Calls after each step that are made even once time is up: a lock with `wait_s=0` asks each shard
once, and again after a restart."""


@dataclass(slots=True, eq=False)
class MultiLock:
    """One lock of one thread.  Driven by `next_calls` and `answered`; time comes in as argument."""

    client: ClientSession[MultiLock]
    lock: LockId
    plan: Plan
    give_up_ns: int
    hold_ns: int
    phase: Phase = Phase.ACQUIRING
    cause: str = ""
    refusal: Refused | Forgotten | None = None
    moved: SlotVersion | None = None
    silent_shard: str = ""
    blockers: tuple[Holder, ...] = ()
    taken_from: Part | None = None
    position: Position | None = None
    versions: tuple[SlotVersion, ...] = ()
    states: list[Reading] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    slice_ns: int = WAIT_SLICE_NS
    lane_free: bool = False
    releases: list[tuple[str, Request]] = field(default_factory=list)
    cut: Cut | None = None
    unnamed: bool = False  # its bytes travel: the shard has lost the payloads that it named
    keeping: Keeping | None = None  # if its grant may stay with the session
    news: AwaitedNews | None = None  # what it waits for before it enters the queue
    waited_ns: int = 0  # in the queue of the last shard
    finishing: Finishing | None = None
    _free_calls: int = FREE_CALLS
    _retry_at_ns: int = 0
    _retry_ns: int = RETRY_NS_MIN

    def __post_init__(self) -> None:
        self.parts = list(starmap(Part, self.plan.locks))
        if self.plan.views:
            self.cut = Cut.of(self.plan, observer=self.client.observer)
        if not self.parts:
            self._advance()

    # ---------------------------------------------------------------- what to send

    def next_calls(self, now_ns: int) -> tuple[list[tuple[str, Request]], int]:
        """Return the calls to make now; without any, the time until which to wait.

        Every returned call must be followed by one `answered`.
        """
        if not self.phase.busy:
            return [], 0
        if now_ns >= self.give_up_ns and not self._free_calls:
            self._gives_up()
            return [], 0
        if now_ns < self._retry_at_ns:
            return [], min(self._retry_at_ns, self.give_up_ns)
        calls = [self._acquire(now_ns)] if self.phase is Phase.ACQUIRING else self._calls(now_ns)
        if not self.client.greeted.issuperset(dict(calls)):
            strangers = [shard for shard in dict(calls) if self.client.needs_hello(shard)]
            return [(shard, self.client.hello(shard)) for shard in strangers], 0
        return calls, 0

    def _calls(self, now_ns: int) -> list[tuple[str, Request]]:
        if self.cut is not None and self.phase is Phase.VIEWING:
            return self.cut.calls(self.lock, self.client, self.plan.placement.version, now_ns)
        finishing = self.finishing
        assert finishing is not None
        if self.phase is Phase.VALIDATING:
            return finishing.votes_to_ask(self.client.seen_stamp_ns, keep=self.keeping is not None)
        if finishing.ask_outcome:
            return [(finishing.primary, Outcome(self.lock))]
        finishing.sent = True
        commit = finishing.commit(self.client.seen_stamp_ns, self.keeping, now_ns)
        return [(finishing.primary, commit)]

    def _acquire(self, now_ns: int) -> tuple[str, Request]:
        parts = self.parts
        part = parts[0] if len(parts) == 1 else first_asking(parts)
        assert part is not None
        left_ns = max(0, self.give_up_ns - now_ns)
        # The hold limit counts from the last grant; earlier ones must outlast the waiting too.
        hold_ns = self.hold_ns if part is parts[-1] else self.hold_ns + left_ns
        wait_ns, news = min(self.slice_ns, left_ns), self.news.seen if self.news is not None else ()
        return part.shard, self.client.acquire(
            self.lock, self.plan, part, news, now_ns=now_ns, wait_ns=wait_ns, hold_ns=hold_ns
        )

    def take_releases(self) -> list[tuple[str, Request]]:
        """Return releases to send once; their answers do not matter, and lost ones are repaired."""
        releases, self.releases = self.releases, []
        return releases

    # ---------------------------------------------------------------- what came back

    def answered(self, shard: str, request: Request, answer: Answer | None, now_ns: int) -> None:
        """Take the answer to one call (None: unknown)."""
        if answer is None or (isinstance(answer, Refused) and self._undecided(request, answer)):
            self._silent(shard, request, now_ns)
            return
        kind = type(answer)
        if kind in OF_SESSIONS and self.client.answered(shard, request, answer, now_ns):
            return  # it was about the session, not about this lock
        if kind is Granted and self.client.unsettled.by_slot:
            self.client.unsettled.shown(shard, answer.states)  # type: ignore[union-attr]
        if self.silent_shard == shard:
            self.silent_shard = ""
        self._retry_ns = RETRY_NS_MIN
        if kind in _TO_ANY_REQUEST:
            self._on_refusal(shard, request, answer)  # type: ignore[arg-type]  # one of these
        elif getattr(answer, "lock", None) != self.lock:
            return
        elif self.phase is Phase.ACQUIRING:
            self._on_acquiring(shard, answer, now_ns)
        elif self.phase is Phase.COMMITTING:
            if isinstance(request, _DECIDERS):
                self._on_committing(answer, now_ns)
        elif isinstance(answer, Viewed) and isinstance(request, TakeView):
            self._on_viewed(shard, request, answer, now_ns)
        elif self.phase is Phase.VALIDATING and isinstance(request, Validate | Prepare):
            self._on_vote(shard, answer)

    def _on_refusal(
        self, shard: str, request: Request, answer: Refused | Forgotten | WrongShard | EpochChanged
    ) -> None:
        if isinstance(answer, Forgotten) and isinstance(self.refusal, Forgotten):
            self.refusal = max(answer, self.refusal, key=lambda each: each.oldest_ns)
        elif isinstance(answer, Refused | Forgotten):
            code = answer.code if isinstance(answer, Refused) else ""
            if code == NO_PAYLOAD and self.finishing and self.finishing.unname(request):
                self.unnamed = True
                return  # asked again, with the bytes
            self._end(Phase.REFUSED)
            self.refusal = answer
        elif isinstance(answer, WrongShard):
            self.client.learn_placement(answer.placement)
            self._end(Phase.MISPLACED)
        else:
            self._epoch_changed(shard, request)

    def _undecided(self, request: Request, answer: Refused) -> bool:
        """Whether a refusal leaves open what became of a commit: an earlier copy may stand."""
        if self.phase is not Phase.COMMITTING or not self.sent_commit:
            return False
        return not isinstance(request, Commit) or answer.code == OVERLOAD

    def _silent(self, shard: str, request: Request, now_ns: int) -> None:
        self.silent_shard = shard
        self._free_calls = 0
        if isinstance(request, _DECIDERS) and self.finishing is not None:
            self.finishing.silent()
        self._pause(now_ns)

    def _pause(self, now_ns: int) -> None:
        self._retry_at_ns = now_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, RETRY_NS_MAX)

    def ask_again(self) -> None:
        """Make the next call without a further pause."""
        self._retry_at_ns, self._retry_ns = 0, RETRY_NS_MIN

    def _epoch_changed(self, shard: str, request: Request) -> None:
        """The shard restarted or forgot the session; `client` has dropped our grants there."""
        self._free_calls = max(0, self._free_calls - 1)
        finishing = self.finishing
        if isinstance(request, _DECIDERS) and finishing is not None:
            finishing.ask_outcome = True
        elif isinstance(request, Validate | Prepare) and finishing and shard in finishing.left:
            self.lose(f"shard {shard} restarted or forgot this session")
        # Otherwise: a first acquire or view is simply asked again after the new Hello; a lost
        # grant has already ended this lock through `lose_at`.

    def _on_acquiring(self, shard: str, answer: Answer, now_ns: int) -> None:
        parts, client = self.parts, self.client
        part = parts[0] if parts[0].token is None else first_asking(parts)
        if part is None or part.shard != shard:
            return
        if isinstance(answer, Granted):
            epoch = answer.epoch
            if epoch != client.peers[shard].epoch:
                return  # a grant of an epoch that is over
            part.granted(answer, client.sendings, ttl_ns=client.ttl_ns)
            self.waited_ns = answer.waited_ns
            client.saw_stamp(answer.stamp_ns)
            self.states += map(Reading, repeat(shard), repeat(epoch), answer.states)
            if self.cut is not None:
                self.cut.not_before(answer.from_ns)
            if part is parts[-1] and not self.plan.views:
                self.phase = Phase.HELD
            else:
                self._advance()
        elif isinstance(answer, Waiting):
            self.blockers = answer.blockers
            self._free_calls = 0
            later_ns = self.news.give_up_ns(answer, now_ns) if self.news is not None else None
            if later_ns is not None:
                self.give_up_ns = later_ns
            elif now_ns >= self.give_up_ns:
                self._gives_up()
        elif isinstance(answer, Stale):
            self.lose("its place in the queue was lost")

    def _on_viewed(self, shard: str, request: TakeView, answer: Viewed, now_ns: int) -> None:
        cut = self.cut
        if self.phase is not Phase.VIEWING or cut is None:
            return
        believe = self.client.sendings.believe_until_ns
        cut.take(shard, request, answer, until_ns=believe(request.count, self.client.ttl_ns))
        self.client.saw_stamp(answer.stamp_ns)
        if cut.left:
            return
        answers = cut.settled(self.client.epoch, now_ns=now_ns)
        if answers is not None:
            for one, viewed in answers.items():
                self.states += [Reading(one, viewed.epoch, state) for state in viewed.states]
                self.client.unsettled.shown(one, viewed.states, until_ns=viewed.until_ns)
            self._advance()
        elif cut.rounds > ROUNDS_MAX:
            self.lose("its views over several shards were never of one moment")

    def _advance(self) -> None:
        """Go on when everything of this phase has arrived."""
        self._free_calls = FREE_CALLS
        if self.phase is Phase.ACQUIRING and first_asking(self.parts) is None:
            self.phase = Phase.VIEWING
        if self.phase is Phase.VIEWING and (self.cut is None or not self.cut.left):
            self.phase = Phase.HELD

    # ---------------------------------------------------------------- holding

    def valid(self, now_ns: int) -> bool:
        """Whether the client may still believe that it holds every lock."""
        return self.phase is Phase.HELD and all(
            now_ns < min(part.until_ns, part.hold_until_ns) for part in self.parts
        )

    @property
    def sent_commit(self) -> bool:
        """Whether the commit that decides has been sent: only its shard knows then."""
        return self.finishing is not None and self.finishing.sent

    @property
    def no_cut(self) -> bool:
        """Whether it ended because its views were never of one moment."""
        return self.phase is Phase.LOST and self.cut is not None and self.cut.rounds > ROUNDS_MAX

    def lose_at(self, shard: str, cause: str) -> None:
        """A shard has dropped the grant there; what it has prepared it keeps (and says so)."""
        if self.finishing is None or shard == self.finishing.primary:
            self.lose(cause)

    def lose(self, cause: str, *, asked_of: Part | None = None) -> None:
        """A shard has ended this lock; give the rest back.

        Args:
            cause: The reason, as far as known here.
            asked_of: The part whose shard knows more (`ask_cause`).
        """
        if self.phase is Phase.COMMITTING or not (self.phase.busy or self.phase is Phase.HELD):
            return
        self.cause = cause
        self.taken_from = asked_of
        self._end(Phase.LOST)

    def ask_cause(self) -> tuple[str, Request] | None:
        """Return the call that tells why a lock was lost, once; for messages to people."""
        part, self.taken_from = self.taken_from, None
        if part is None or part.token is None:
            return None
        return part.shard, Validate(self.lock, part.token)

    def told_cause(self, answer: Answer | None) -> None:
        """Take the answer to `ask_cause`."""
        if isinstance(answer, Fenced) and answer.lock == self.lock:
            self.cause = answer.cause

    def _gives_up(self) -> None:
        """The deadline has passed: rest in what that means in this phase."""
        if self.phase is Phase.COMMITTING:
            if self.finishing is not None and self.finishing.pending:
                primary = self.finishing.primary
                self.cause = f"shard {primary} still works on it: its disk has not kept it yet"
            self._end(Phase.UNKNOWN if self.sent_commit else Phase.UNREACHABLE)
        elif self.phase is Phase.VALIDATING or self.silent_shard:
            self._end(Phase.UNREACHABLE)
        else:
            self._end(Phase.TIMED_OUT)

    def _end(self, phase: Phase) -> None:
        """Rest in `phase`; whatever may still be held or awaited is given back."""
        self.phase = phase
        keeping, sent = self.keeping, self.finishing is not None
        if keeping is not None and keeping.ends(phase, self.parts[0], sent=sent):
            self.client.ended(self)
            return
        if self.finishing is not None:
            if phase is not Phase.COMMITTED:
                self.finishing.note_who_knows()
            self.finishing.writes = {}  # they may be large, and the program may keep the lock
        if phase not in (Phase.COMMITTED, Phase.UNKNOWN):
            touched = dict.fromkeys([*(part.shard for part in self.parts), *dict(self.plan.views)])
            self.releases += [(shard, Release(self.lock)) for shard in touched]
        self.client.ended(self)

    # ---------------------------------------------------------------- the end

    def release(self) -> None:
        """Give everything back without writing."""
        if self.phase.busy or self.phase is Phase.HELD:
            self._end(Phase.RELEASED)

    def finish(
        self,
        writes: Mapping[str, Sequence[WriteItem]],
        *,
        give_up_ns: int,
        expects: Sequence[SlotVersion] = (),
        reads: Sequence[DatumRead] = (),
        reads_left_out: int = 0,
    ) -> None:
        """Publish `writes` (by shard) if every lock is still held.

        `expects` are versions that were viewed and must still be the newest; `reads` are kept as
        the lineage of what is written: at most `READS_MAX`, of further ones their number.
        Ends in COMMITTED, LOST, CHANGED, REFUSED, UNREACHABLE (nothing written) or UNKNOWN.
        """
        if self.phase is not Phase.HELD:
            return
        self.give_up_ns, self._free_calls, self._retry_at_ns = give_up_ns, 0, 0
        expected = by_shard(expects, self.plan.placement) if expects else {}
        viewed = {shard: self._epoch_viewed(shard) for shard in expected} if expected else {}
        written = {shard: tuple(items) for shard, items in writes.items() if items}
        tokens, reads = tokens_of(self.parts, viewed), tuple(reads)
        self.finishing = Finishing(self.lock, tokens, written, expected, reads, reads_left_out)
        self.phase = Phase.VALIDATING
        self._after_votes()

    def finish_kept(self, now_ns: int) -> bool:
        """End without writes and without a message; False if the shard has to be asked."""
        local = self.keeping is not None and self.keeping.begun_ns > 0 and self.valid(now_ns)
        if local:
            self._end(Phase.COMMITTED)
        return local

    def shard_of(self, slot: Slot) -> str:
        """Return the shard where this lock has a slot, even if the placement changes meanwhile."""
        return shard_of(slot.entity, self.plan.placement)

    def _epoch_viewed(self, shard: str) -> int:
        return next((r.epoch for r in self.states if r.shard == shard), self.client.epoch(shard))

    def _after_votes(self) -> None:
        finishing = self.finishing
        if finishing is None or finishing.left:
            return
        if finishing.primary:
            finishing.recorded = self.client.peers[finishing.primary].recorded
            self.phase = Phase.COMMITTING
        else:
            if not self.parts and any(r.state.large or r.state.same for r in self.states):
                # The shards keep large data of a lock of views alone.
                self.releases += [(shard, Release(self.lock)) for shard, _ in self.plan.views]
            self._end(Phase.COMMITTED)

    def _on_vote(self, shard: str, answer: Answer) -> None:
        assert self.finishing is not None
        if shard not in self.finishing.left:
            return
        if isinstance(answer, Valid | Prepared):
            del self.finishing.left[shard]
            if isinstance(answer, Prepared):
                self.finishing.prepared[shard] = answer
                self.client.saw_stamp(answer.stamp_ns)
            elif self.keeping is not None:
                self.keeping.told(answer.kept, self)
            self._after_votes()
        elif isinstance(answer, Fenced):
            self.lose(answer.cause)
        elif isinstance(answer, Changed):
            self._changed(answer)

    def _changed(self, answer: Changed) -> None:
        self.moved = self.finishing.moved(answer) if self.finishing is not None else None
        how = f"has moved on to version {answer.version} since it was viewed"
        self.cause = f"{answer.slot} {how if self.moved else 'is about to be written'}"
        self._end(Phase.CHANGED)

    def _on_committing(self, answer: Answer, now_ns: int) -> None:
        if isinstance(answer, Committed):
            if self.keeping is not None:
                self.keeping.told(answer.kept, self)
            self._committed(answer.position, answer.versions)
        elif isinstance(answer, Fenced):
            self.cause = answer.cause
            self._end(Phase.LOST)
        elif isinstance(answer, Changed):
            self._changed(answer)
        elif isinstance(answer, OutcomeIs):
            self._on_outcome(answer, now_ns)

    def _on_outcome(self, answer: OutcomeIs, now_ns: int) -> None:
        finishing = self.finishing
        assert finishing is not None
        if self.keeping is not None:
            self.keeping.grant = None
        if answer.kind == OUTCOME_COMMITTED:
            self._committed(answer.position, answer.versions)
            return
        phase, self.cause = finishing.not_committed(answer, self.cause)
        if phase is not None:
            self._end(phase)
        elif finishing.pending:
            self._pause(now_ns)

    def _committed(self, position: Position, versions: tuple[SlotVersion, ...]) -> None:
        assert self.finishing is not None
        self.position, self.versions = position, versions
        self.client.saw_stamp(position.stamp_ns)
        if self.keeping is not None and self.keeping.grant is not None:
            writes = self.finishing.writes[self.finishing.primary]
            self.keeping.grant.committed(writes, versions, position.stamp_ns)
        if prepared := self.finishing.prepared:
            self.versions += tuple([v for vote in prepared.values() for v in vote.versions])
            self.client.committed(prepared, position.stamp_ns)
        self._end(Phase.COMMITTED)
