"""One consistent cut over the views of several shards, without synchronised clocks.

Each shard says from when to when (on the clock of commit stamps) its data were current.  If all
intervals have a stamp T in common, the answers are of one cut.  If not, T is the largest lower
end, and the shards whose interval ended before it are asked again as of T.  That settles it unless
a shard does not remember so far back, or an undecided commit stays in its way; then T moves on,
`ROUNDS_MAX` times at most.  Whoever gets no cut takes read locks instead.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from enact_dist.core.messages import Item, TakeView, Viewed

ROUNDS_MAX: Final = 8
"""How often shards are asked before the views are given up."""


class Cut:
    """The views of one lock, until they are of one cut.

    Attributes:
        at_ns: The stamp as of which shards are asked (0: now).
        left: The shards that have not answered in this round.

    Args:
        items: What to view at which shard.
        floor_ns: The cut must not lie before this stamp (the session's own commits).
    """

    __slots__ = ("_answers", "_floor_ns", "at_ns", "items", "left", "rounds")

    def __init__(self, items: Mapping[str, tuple[Item, ...]], *, floor_ns: int) -> None:
        self.items = dict(items)
        self.left = dict.fromkeys(self.items)
        self.at_ns = 0
        self.rounds = 1
        self._floor_ns = floor_ns
        self._answers: dict[str, Viewed] = {}

    def take(self, shard: str, request: TakeView, answer: Viewed) -> None:
        """Take an answer of this round; others are too late."""
        if shard in self.left and request.at_ns == self.at_ns:
            del self.left[shard]
            self._answers[shard] = answer

    def settled(self, epoch: Callable[[str], int]) -> dict[str, Viewed] | None:
        """Return the answers if they are of one cut, else begin the next round.

        An answer of an epoch that is over does not count: the clock of a restarted shard may have
        gone back behind what was promised.
        """
        assert not self.left
        answers = self._answers
        at_ns = max((answer.from_ns for answer in answers.values()), default=0)
        if len(answers) == 1:
            at_ns = 0  # one shard shows every commit whole, whatever its stamp
        at_ns = max(at_ns, self._floor_ns)
        lagging = [
            shard
            for shard, answer in answers.items()
            if answer.until_ns < at_ns or answer.epoch != epoch(shard)
        ]
        if not lagging:
            return answers
        self.at_ns = at_ns
        self.left = dict.fromkeys(lagging)
        self.rounds += 1
        return None
