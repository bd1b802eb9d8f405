"""A shard that lacks a named payload is sent the bytes; what it said before says nothing then."""

from __future__ import annotations

from client_bench import CellBench
from shard_bench import S, item, slot

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Datum
from enact_dist.core.protocol.messages import Refused, WriteItem
from enact_dist.terms import Access

MISSING = Refused("no_payload", "send the bytes")


def test_late_refusal_of_a_named_payload_ends_nothing():
    """Two copies named it, each was refused; the second refusal comes after the bytes went."""
    ann = CellBench("s0").client("ann")
    lock = ann.locked(item(Access.WRITE))
    named = WriteItem(slot(), Datum(b"t", b"bytes", 5, file="payload"))
    lock.finish({"s0": [named]}, give_up_ns=ann.cell.now_ns + 10 * S)
    ((_, first),), _ = lock.next_calls(ann.cell.now_ns)
    lock.answered("s0", first, MISSING, ann.cell.now_ns)
    ((_, second),), _ = lock.next_calls(ann.cell.now_ns)
    lock.answered("s0", first, MISSING, ann.cell.now_ns)

    assert (first.writes[0].datum.file, second.writes[0].datum.file) == ("payload", "")
    assert lock.phase is Phase.COMMITTING
    lock.answered("s0", second, ann.cell.shards["s0"].ask(second), ann.cell.now_ns)
    assert lock.phase is Phase.COMMITTED


def test_bytes_that_are_refused_as_missing_end_the_lock():
    """A shard that asks for bytes it was sent is no shard to ask for ever."""
    ann = CellBench("s0").client("ann")
    lock = ann.locked(item(Access.WRITE))
    plain = WriteItem(slot(), Datum(b"t", b"bytes", 5))
    lock.finish({"s0": [plain]}, give_up_ns=ann.cell.now_ns + 10 * S)
    ((_, sent),), _ = lock.next_calls(ann.cell.now_ns)
    lock.answered("s0", sent, MISSING, ann.cell.now_ns)

    assert lock.phase is Phase.REFUSED
