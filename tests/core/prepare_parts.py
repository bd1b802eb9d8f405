"""What tests of commits over shards share: one shard as a participant, or as the primary."""

from __future__ import annotations

from shard_bench import S, ShardBench, datum, item, lock_id, slot

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    Commit,
    Committed,
    Granted,
    Prepare,
    Prepared,
    Resolve,
    Resolved,
    WriteItem,
)
from enact_dist.core.protocol.records import (
    Called,
)
from enact_dist.terms import Access

R, W, V = Access.READ, Access.WRITE, Access.VIEW
ANN = lock_id("ann")
FAR_TOKEN = Token(7, 7)
STAMP_NS = 1_800_000_000 * S + 5


def prepare_of(grant: Granted, *, aspect: str = "count", **options: object) -> Prepare:
    """Return the request to prepare one write under a grant."""
    write = WriteItem(slot(aspect=aspect), datum("new"))
    expects = options.get("expects", ())
    return Prepare(grant.lock, grant.token, (write,), 0, expects, "far", FAR_TOKEN)


def prepared(bench: ShardBench, *, aspect: str = "count") -> Granted:
    """Get a lock and prepare its write."""
    grant = bench.granted(ANN, item(W, aspect=aspect))
    assert isinstance(bench.ask(prepare_of(grant, aspect=aspect)), Prepared)
    return grant


def decided(bench: ShardBench) -> Committed:
    """Commit at this shard, as the primary, with one participant."""
    grant = bench.granted(ANN, item(W))
    write = WriteItem(slot(), datum("new"))
    answer = bench.ask(Commit(ANN, grant.token, (write,), STAMP_NS, (), ("far",)))
    assert isinstance(answer, Committed)
    return answer


def called(bench: ShardBench, kind: str) -> None:
    """Tell the participant what its primary has answered."""
    request = Resolve(ANN, FAR_TOKEN, "s0")
    bench.event(Called("far", request, Resolved(ANN, kind, Position(STAMP_NS, "far"))))
