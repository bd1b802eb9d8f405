"""How a lock ends with its writes: validate, prepare, then the one commit that decides.

::

    reads elsewhere:  Validate ──┐
    writes elsewhere: Prepare  ──┴── all positive ──> Commit at the primary = decided
    one shard alone:  ──────────────────────────────> Commit

The primary is the lowest shard that is written to.  Each part is sent again until it is answered;
every answer can be had again.  After the commit was sent, only the primary knows the outcome.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from enact_dist.core.client.plan import Part, Phase
from enact_dist.core.protocol.datum import LockId, Token
from enact_dist.core.protocol.messages import (
    OUTCOME_EXPIRED,
    OUTCOME_PENDING,
    Changed,
    Commit,
    DatumRead,
    OutcomeIs,
    PlacementMap,
    Prepare,
    Prepared,
    Request,
    SlotVersion,
    Validate,
    WriteItem,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.state.clock import is_kept
from enact_dist.errors import SHARD_RESTARTED

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.core.client.kept import Keeping


@dataclass(slots=True)
class Finishing:
    """What to publish, by shard, and the messages still to send.

    Attributes:
        tokens: The grants; number 0 where something is expected but nothing held.
        primary: The shard whose commit decides; empty where nothing is written.
        left: Shards that have not validated or prepared yet.
        reads: The lineage of the writes, which every shard that is written to keeps beside them.
        reads_left_out: How many data more than these were read.
        prepared: What the other writing shards have answered.
        pending: Whether the last word about the commit was that its shard still works on it.
        recorded: The aspects whose commits the primary still knows after a restart.
        known_in: Once it has ended: the epoch of the primary that alone can know whether the commit
            that was sent took effect; 0: later ones can, too.
    """

    lock: LockId
    tokens: Mapping[str, Token]
    writes: Mapping[str, tuple[WriteItem, ...]]
    expects: Mapping[str, tuple[SlotVersion, ...]]
    reads: tuple[DatumRead, ...] = ()
    reads_left_out: int = 0
    primary: str = ""
    left: dict[str, None] = field(default_factory=dict)
    prepared: dict[str, Prepared] = field(default_factory=dict)
    ask_outcome: bool = False
    sent: bool = False
    pending: bool = False
    recorded: frozenset[str] = frozenset()
    known_in: int = 0

    def __post_init__(self) -> None:
        self.primary = min(self.writes, default="")
        self.left = dict.fromkeys(self.tokens)
        self.left.pop(self.primary, None)

    def moved(self, answer: Changed) -> SlotVersion | None:
        """Return what stands where a lock expected another version; None: nothing does as yet."""
        found = SlotVersion(answer.slot, answer.version)
        return None if any(found in each for each in self.expects.values()) else found

    def votes_to_ask(self, seen_stamp_ns: int, *, keep: bool = False) -> list[tuple[str, Request]]:
        """Return the requests to the shards that have not agreed yet."""
        calls: list[tuple[str, Request]] = []
        for shard in self.left:
            token, expects = self.tokens[shard], self.expects.get(shard, ())
            if shard in self.writes:
                request: Request = Prepare(
                    self.lock,
                    token,
                    self.writes[shard],
                    seen_stamp_ns,
                    expects,
                    self.primary,
                    self.tokens[self.primary],
                    self.reads,
                    self.reads_left_out,
                )
            else:
                request = Validate(self.lock, token, expects, keep)
            calls.append((shard, request))
        return calls

    def commit(self, seen_stamp_ns: int, keeping: Keeping | None, now_ns: int) -> Commit:
        """Return the commit that decides, stamped after everything that was prepared."""
        for answer in self.prepared.values():
            seen_stamp_ns = max(seen_stamp_ns, answer.stamp_ns)
        return Commit(
            self.lock,
            self.tokens[self.primary],
            self.writes[self.primary],
            seen_stamp_ns,
            self.expects.get(self.primary, ()),
            tuple(sorted(self.prepared)) if self.prepared else (),
            self.reads,
            self.reads_left_out,
            keeping is not None,
            keeping.used_ns(now_ns) if keeping is not None else 0,
        )

    def silent(self) -> None:
        """The primary did not answer: ask for the outcome before anything is sent again."""
        self.ask_outcome, self.pending = True, False

    def _known_in(self) -> int:
        epoch = self.token.epoch
        aspects = {slot.aspect for slot, _ in self.writes[self.primary]}
        kept = is_kept(epoch) and (self.prepared or not self.recorded.isdisjoint(aspects))
        return 0 if kept else epoch

    def note_who_knows(self) -> None:
        """Note in which epochs the outcome of a commit without an answer can be known."""
        if self.sent:
            self.known_in = self._known_in()

    def not_committed(self, answer: OutcomeIs, cause: str) -> tuple[Phase | None, str]:
        """Return what an outcome that is no commit means, None if the lock goes on, and why.

        Args:
            answer: The outcome, as the primary knows it.
            cause: What is known so far.
        """
        self.pending = answer.kind == OUTCOME_PENDING
        if answer.kind == OUTCOME_EXPIRED:
            return Phase.UNKNOWN, "its shard has no record of this session any more"
        if not self.pending and answer.epoch != self.token.epoch:
            # Even if the shard refused this copy: an earlier one may have come before the restart.
            if self._known_in() or not is_kept(answer.epoch):
                return (
                    Phase.UNKNOWN,
                    f"{SHARD_RESTARTED}, which lost its record of the commit, if there was one",
                )
            return Phase.LOST, f"{SHARD_RESTARTED} before the commit arrived"
        self.ask_outcome = self.pending  # else it never arrived: send it (again)
        return None, cause

    def unname(self, refused: Request) -> bool:
        """Let the bytes travel with the messages from now on.

        Returns:
            Whether the refused message had named bytes that are here.  Its refusal may come late,
            when a copy with the bytes is on its way or was applied, and then does not count.
        """
        self.writes = {
            shard: tuple(
                write._replace(datum=replace(write.datum, file=""))
                if write.datum is not None and _is_named(write)
                else write
                for write in writes
            )
            for shard, writes in self.writes.items()
        }
        return isinstance(refused, Commit | Prepare) and any(map(_is_named, refused.writes))

    @property
    def token(self) -> Token:
        """The grant that the commit is compared with."""
        return self.tokens[self.primary]


def by_shard(
    versions: Iterable[SlotVersion], placement: PlacementMap
) -> dict[str, tuple[SlotVersion, ...]]:
    """Split versions by the shard that has their slots."""
    found: dict[str, list[SlotVersion]] = {}
    for version in versions:
        found.setdefault(shard_of(version.slot.entity, placement), []).append(version)
    return {shard: tuple(some) for shard, some in found.items()}


def _is_named(write: WriteItem) -> bool:
    """Whether a write names a payload whose bytes are here, too."""
    datum = write.datum
    return datum is not None and bool(datum.file) and len(datum.body) == datum.size


def tokens_of(parts: Iterable[Part], epochs: Mapping[str, int]) -> dict[str, Token]:
    """Return the tokens of a lock, and `epochs` as tokens where it only expects something."""
    tokens: dict[str, Token] = {}
    for shard, epoch in epochs.items():
        tokens[shard] = Token(epoch, 0)
    for part in parts:
        if part.token is not None:
            tokens[part.shard] = part.token
    return tokens
