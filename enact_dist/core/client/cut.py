"""One consistent cut over the views of several shards, without synchronised clocks.

Each shard says from when to when (on the clock of commit stamps) its data were current.  If all
intervals have a stamp T in common, the answers are of one cut.  If not, T is the largest lower
end, and the shards whose interval ended before it are asked again as of T.  That settles it unless
a shard does not remember so far back, or an undecided commit stays in its way; then T moves on,
`ROUNDS_MAX` times at most.  A client that gets no cut takes read locks instead.

A request about the past names T: the client asks every shard as of T from the first round on, and T
never moves.  A shard reports what it has forgotten, and waits for commits up to T to be decided.

Rule a change must keep: a shard that restarts may give stamps below those that it has answered
with (its clock is not on its disk), so an answer counts only while no lock can have been granted in
a later epoch.  For a session that locks this holds until it has acknowledged that epoch or a TTL
has passed: the grace waits for it.  The grace does not wait for an observer, which asks all shards
a second time; the first answers count if no shard has restarted until then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from enact_dist.core.protocol.messages import Item, Request, TakeView, Viewed

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from enact_dist.core.client.plan import Plan
    from enact_dist.core.client.session import ClientSession
    from enact_dist.core.protocol.datum import LockId

ROUNDS_MAX: Final = 8
"""How often shards are asked before the views are given up."""


class _Answer(NamedTuple):
    viewed: Viewed
    until_ns: int


class Cut:
    """The views of one lock, until they are of one cut.

    Attributes:
        at_ns: The stamp as of which shards are asked (0: now).
        left: The shards that have not answered in this round.

    Args:
        items: What to view at which shard.
        floor_ns: The cut must not lie before this stamp (the session's own commits).
        observer: No shard waits for this session when it restarts.
        past_ns: The cut must lie exactly here (0: wherever it can be had).
    """

    __slots__ = (
        "_answers",
        "_floor_ns",
        "_observer",
        "_past_ns",
        "_settled",
        "at_ns",
        "items",
        "left",
        "rounds",
    )

    def __init__(
        self,
        items: Mapping[str, tuple[Item, ...]],
        *,
        floor_ns: int,
        observer: bool = False,
        past_ns: int = 0,
    ) -> None:
        self.items = dict(items)
        self.left = dict.fromkeys(self.items)
        self.at_ns = past_ns
        self.rounds = 1
        self._floor_ns = floor_ns
        self._past_ns = past_ns
        self._observer = observer and len(self.items) > 1
        self._answers: dict[str, _Answer] = {}
        self._settled: dict[str, Viewed] = {}

    @classmethod
    def of(cls, plan: Plan, *, observer: bool) -> Cut:
        """Return the cut that the views of a plan ask for."""
        items = dict(plan.views)
        return cls(items, floor_ns=plan.floor_ns, observer=observer, past_ns=plan.past_ns)

    def not_before(self, stamp_ns: int) -> None:
        """Let the cut show whatever was committed up to a stamp; before it is taken."""
        self._floor_ns = max(self._floor_ns, stamp_ns)

    @property
    def strict(self) -> bool:
        """Whether it lies where it was asked for: what shards forgot they must not make up for."""
        return bool(self._past_ns)

    def calls(
        self, lock: LockId, client: ClientSession[Any], map_version: int, now_ns: int
    ) -> list[tuple[str, Request]]:
        """Return the requests of this round that have no answer yet."""
        calls: list[tuple[str, Request]] = []
        for shard, items in self.items.items():
            if shard in self.left:
                count, epoch = client.sendings.next(now_ns), client.epoch(shard)
                seen_ns, at_ns, strict = client.seen_stamp_ns, self.at_ns, self.strict
                request = TakeView(lock, epoch, map_version, count, items, seen_ns, at_ns, strict)
                calls.append((shard, request))
        return calls

    def take(self, shard: str, request: TakeView, answer: Viewed, *, until_ns: int) -> None:
        """Take an answer of this round; others are too late.

        Args:
            shard: The answering shard.
            request: The request.
            answer: The answer.
            until_ns: When, by this host's clock, that shard's grace period for us ends.
        """
        if shard in self.left and request.at_ns == self.at_ns:
            del self.left[shard]
            self._answers[shard] = _Answer(answer, until_ns)

    def settled(self, epoch: Callable[[str], int], *, now_ns: int) -> dict[str, Viewed] | None:
        """Return the answers if they are of one cut, else begin the next round."""
        assert not self.left
        if self._settled and self._confirmed():
            return self._settled
        answers = {shard: answer.viewed for shard, answer in self._answers.items()}
        at_ns = max((viewed.from_ns for viewed in answers.values()), default=0)
        if len(answers) == 1 and not self.at_ns:
            at_ns = 0  # one shard shows every commit whole as of now, whatever its stamp
        at_ns = self._past_ns or max(at_ns, self._floor_ns)
        lagging = [
            shard
            for shard, (viewed, until_ns) in self._answers.items()
            if viewed.until_ns < at_ns
            or viewed.epoch != epoch(shard)
            or (until_ns <= now_ns and len(answers) > 1)
        ]
        if not lagging and not self._observer:
            return answers
        self._settled = {} if lagging else answers
        self.at_ns = at_ns
        self.left = dict.fromkeys(lagging or self.items)
        self.rounds += 1
        return None

    def _confirmed(self) -> bool:
        """Whether no shard had restarted when all first answers were there."""
        return all(
            self._answers[shard].viewed.epoch == viewed.epoch
            for shard, viewed in self._settled.items()
        )
