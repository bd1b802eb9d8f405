"""What tests of the history share: writing, looking at the past, listing and keeping."""

from __future__ import annotations

from shard_bench import ShardBench, item, lock_id, slot

from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Commit,
    Item,
    KeepVersions,
    Kept,
    ListHistory,
    Register,
    SlotVersion,
    TakeView,
    Versions,
    Viewed,
    WriteItem,
)
from enact_dist.terms import Access

W, V, VE = Access.WRITE, Access.VIEW, Access.VIEW_EACH
SEC = 1_000_000_000


def retain(bench: ShardBench, aspect: str, versions: int, age_ns: int = 0, size: int = 0) -> None:
    """Let an aspect retain so much."""
    bench.ask(Register("ann", (), (AspectEntry(aspect, "int", "", versions, age_ns, size),)))


def write(
    bench: ShardBench, value: str | None, aspect: str = "count", entity: str = "piece"
) -> int:
    """Set a slot (None: to null) and return the stamp of its commit."""
    seq = next(bench._handles)
    lock, to = lock_id("ann", 3, seq), slot(entity, aspect)
    grant = bench.granted(lock, Item(W, *to))
    return bench.commit(lock, grant.token, (to, value)).position.stamp_ns


def capture(bench: ShardBench, captured_ns: int) -> None:
    """Write a datum that was captured at a stamp."""
    lock = lock_id("ann", 3, next(bench._handles))
    grant = bench.granted(lock, item(W, "cam", "frame"))
    write_item = WriteItem(slot("cam", "frame"), Datum(b"t", b"x", 1, captured_ns))
    bench.ask(Commit(lock, grant.token, (write_item,), 0))


def as_of(bench: ShardBench, at_ns: int, *items: Item) -> object:
    """Return the answer to a strict view as of a stamp."""
    lock, count = lock_id("ann", 4, next(bench._handles)), bench.next_count("ann")
    items = items or (item(V),)
    return bench.ask(TakeView(lock, bench.shard.epoch, 1, count, items, 0, at_ns, strict=True))


def shown(bench: ShardBench, at_ns: int, *items: Item) -> list[str]:
    """Return the data (or why there are none) that a strict view shows, in order."""
    answer = as_of(bench, at_ns, *items)
    assert isinstance(answer, Viewed), answer
    assert answer.from_ns <= at_ns == answer.until_ns
    return [bytes(s.datum.body).decode() if s.datum else s.null_reason for s in answer.states]


def listed(bench: ShardBench, aspect: str = "count", **options: int) -> list[int]:
    """Return the versions that are listed of an aspect."""
    answer = bench.ask(ListHistory((), (), (aspect,), **options))
    assert isinstance(answer, Versions)
    return [entry.state.version for entry in answer.entries]


def keep(bench: ShardBench, label: str, *versions: int, aspect: str = "count") -> Kept:
    """Keep versions of the slot of all these tests."""
    asked = tuple(SlotVersion(slot(aspect=aspect), version) for version in versions)
    answer = bench.ask(KeepVersions("ann", label, asked))
    assert isinstance(answer, Kept), answer
    return answer
