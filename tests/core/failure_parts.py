"""What the tests of the failure table share: who asks, for what, and what is there before."""

from __future__ import annotations

from shard_bench import ShardBench, item, lock_id

from enact_dist.terms import Access

READ, WRITE = item(Access.READ), item(Access.WRITE)
ANN, BOB = lock_id("ann"), lock_id("bob")


def seeded(bench: ShardBench) -> None:
    """Two sessions, and the value 1 in the slot."""
    bench.hello("ann", "bob", "eve")
    bench.write("eve", 1, "1")
