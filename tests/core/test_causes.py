"""Each version knows its cause: who committed it, when, and which data went in."""

from __future__ import annotations

import pytest
from client_bench import CellBench
from shard_bench import MS, S, ShardBench, datum, item, lock_id, pages_of, slot

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol import pages
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Cause,
    Commit,
    DatumRead,
    Explain,
    FindEffects,
    Finish,
    KeepVersions,
    ListHistory,
    Refused,
    SlotVersion,
    WriteItem,
)
from enact_dist.core.protocol.pages import PAGE_BYTES_MAX
from enact_dist.core.protocol.parts import READS_MAX
from enact_dist.core.protocol.records import READ_BYTES
from enact_dist.core.shard.on_history import bytes_of
from enact_dist.terms import Access
from enact_dist.wire.frames import encode_frame

W, R, V = Access.WRITE, Access.READ, Access.VIEW
READ = DatumRead(slot("view/1", "frame"), 3, 77)


def committed(bench, *writes, reads=(), seq=1, held_ns=0, left_out=0):
    """Commit texts to slots under one lock, and return the lock and its commit."""
    lock = lock_id("ann", 0, seq)
    items = [item(W, one.entity, one.aspect) for one, _ in writes]
    grant = bench.granted(lock, *items)
    bench.wait(held_ns, keep=("ann",))
    written = tuple(WriteItem(one, datum(text)) for one, text in writes)
    request = Commit(lock, grant.token, written, 0, reads=tuple(reads), reads_left_out=left_out)
    return lock, bench.ask(request)


def entries(bench, *versions):
    """Return what is told of versions."""
    return bench.ask(Explain(tuple(versions))).entries


def test_commit_leaves_its_cause_on_each_version():
    """Lock, actor, host, process, stamp, how long it held, what it read and all that it wrote."""
    bench = ShardBench()
    bench.hello("ann")
    other = slot("other", "frame")
    lock, answer = committed(
        bench, (slot(), "1"), (other, "2"), reads=[READ], held_ns=300 * MS, left_out=2
    )

    cause = bench.shard.state.slots[slot()].cause
    assert cause == Cause(
        lock,
        "commit",
        "ann",
        "host",
        1,
        answer.position.stamp_ns,
        300 * MS,
        (READ,),
        2,
        (SlotVersion(slot(), 1), SlotVersion(other, 1)),
    )
    assert bench.shard.state.slots[other].cause is cause


@pytest.mark.parametrize("aspect", ["count", "note"])
def test_cause_survives_a_restart_with_its_version(aspect):
    """It is durable when its version is."""
    bench = ShardBench()
    bench.hello("ann")
    committed(bench, (slot(aspect=aspect), "1"), reads=[READ])
    before = bench.shard.state.slots[slot(aspect=aspect)]

    bench.restart()

    assert bench.shard.state.slots[slot(aspect=aspect)] == before


def test_cause_of_a_volatile_version_goes_with_it():
    """What is lost was caused by nobody that is known."""
    bench = ShardBench()
    bench.hello("ann")
    committed(bench, (slot(aspect="frame"), "1"), reads=[READ])

    bench.restart()

    (entry,) = entries(bench, SlotVersion(slot(aspect="frame"), 0))
    assert (entry.state.null_reason, entry.cause) == ("LOST", None)


def test_commit_over_two_shards_is_one_lock_everywhere():
    """Each shard keeps what was read anywhere, and what was written at it; the stamps agree."""
    cell = CellBench("s0", "s1")
    ann = cell.client("ann")
    near, far = cell.entity_on("s0"), cell.entity_on("s1")
    lock = ann.drive(ann.begin(item(W, near), item(W, far)))
    writes = {s: [WriteItem(slot(e), datum("1"))] for s, e in (("s0", near), ("s1", far))}
    lock.finish(writes, give_up_ns=cell.now_ns + S, reads=[READ], reads_left_out=1)
    ann.drive(lock)
    carry_calls(cell)

    assert lock.phase is Phase.COMMITTED
    causes = {
        name: cell.shards[name].shard.state.slots[slot(entity)].cause
        for name, entity in (("s0", near), ("s1", far))
    }
    for name, entity in (("s0", near), ("s1", far)):
        cause = causes[name]
        assert cause.lock == lock.lock
        assert cause.stamp_ns == lock.position.stamp_ns
        assert (cause.reads, cause.reads_left_out) == ((READ,), 1)
        assert cause.writes == (SlotVersion(slot(entity), 1),)


def carry_calls(cell):
    """Let the shards tell each other what they have decided."""
    for bench in cell.shards.values():
        calls, bench.calls[:] = list(bench.calls), []
        for other, request in calls:
            cell.shards[other].ask(request)


@pytest.mark.parametrize("aspect", ["count", "frame"])
def test_cause_of_what_is_prepared_outlasts_a_restart_of_its_shard(aspect):
    """It is told with the stamp of the decision, by whoever it was prepared for."""
    cell = CellBench("s0", "s1")
    ann = cell.client("ann")
    near, far = cell.entity_on("s0"), cell.entity_on("s1")
    lock = ann.drive(ann.begin(item(W, near), item(W, far, aspect)))
    there = slot(far, aspect)
    writes = {"s0": [WriteItem(slot(near), datum("1"))], "s1": [WriteItem(there, datum("1"))]}
    lock.finish(writes, give_up_ns=cell.now_ns + S, reads=[READ])
    ann.drive(lock)
    cell.shards["s1"].restart()
    ((_, finish),) = cell.shards["s0"].calls
    assert isinstance(finish, Finish)

    cell.shards["s1"].ask(finish)

    content = cell.shards["s1"].shard.state.slots[there]
    assert content.stamp_ns == content.cause.stamp_ns == lock.position.stamp_ns
    assert (content.cause.actor, content.cause.reads) == ("ann", (READ,))
    assert content.cause.writes == (SlotVersion(there, content.version),)


def test_longer_lineage_than_a_client_tells_is_refused():
    """A shard keeps what it is told as long as the version: that must be bounded."""
    bench = ShardBench()
    bench.hello("ann")

    _, answer = committed(bench, (slot(), "1"), reads=[READ] * (READS_MAX + 1))

    assert isinstance(answer, Refused)
    assert bench.value() is None


def test_replaced_version_is_explained_as_long_as_it_is_known():
    """With the stamp until which it was current; a version that never was is left out."""
    bench = ShardBench()
    bench.hello("ann")
    first, _ = committed(bench, (slot(), "1"), seq=1)
    second, answer = committed(bench, (slot(), "2"), seq=2)

    found = entries(bench, *(SlotVersion(slot(), version) for version in (1, 0, 7)))

    assert [(entry.state.version, entry.cause.lock) for entry in found] == [
        (1, first),
        (2, second),
    ]
    assert [entry.until_ns for entry in found] == [answer.position.stamp_ns, 0]


def test_never_written_slot_has_nothing_to_explain():
    """Nobody caused what is not there."""
    assert entries(ShardBench(), SlotVersion(slot(), 0)) == ()


def test_effects_are_found_by_slot_and_stamp():
    """A datum with the same version and another stamp is another one."""
    bench = ShardBench()
    bench.hello("ann")
    lock, _ = committed(bench, (slot(), "1"), (slot("other"), "2"), reads=[READ])
    committed(bench, (slot("third"), "3"), seq=2, reads=[READ._replace(stamp_ns=78)])

    found = bench.ask(FindEffects((READ,))).entries

    assert {entry.state.slot for entry in found} == {slot(), slot("other")}
    assert {entry.cause.lock for entry in found} == {lock}


def test_effects_of_what_was_replaced_since_are_found():
    """As far as the history goes."""
    bench = ShardBench()
    bench.hello("ann")
    committed(bench, (slot(), "1"), reads=[READ])
    committed(bench, (slot(), "2"), seq=2)

    (entry,) = bench.ask(FindEffects((READ,))).entries

    assert entry.state.version == 1


def test_effects_come_in_pages_that_lose_none(monkeypatch):
    """A page has room for three; the next one goes on where it ends."""
    bench = ShardBench()
    bench.hello("ann")
    for seq in range(1, 8):
        committed(bench, (slot(f"e{seq}"), "1"), seq=seq, reads=[READ])
    whole = bench.ask(FindEffects((READ,)))
    monkeypatch.setattr(pages, "PAGE_BYTES_MAX", 3 * bytes_of(whole.entries[0]))

    listed = pages_of(bench, FindEffects((READ,)))

    assert [len(page.entries) for page in listed] == [3, 3, 1]
    assert sum((page.entries for page in listed), ()) == whole.entries


@pytest.mark.parametrize("kind", [Explain, FindEffects])
def test_question_about_too_much_is_refused(kind):
    """One request keeps the shard from the others only for so long."""
    one = SlotVersion(slot(), 1) if kind is Explain else READ

    assert isinstance(ShardBench().ask(kind((one,) * 4097)), Refused)


def test_lineage_counts_in_the_cap_of_history(monkeypatch):
    """Versions that name much of what was read go as early as large ones."""
    bench = ShardBench()
    bench.hello("ann")
    history = bench.shard.state.slots.history
    monkeypatch.setattr(history, "_bytes_max", 3 * 100 * READ_BYTES + 100)
    for seq in range(1, 8):
        committed(bench, (slot(), "1"), seq=seq, reads=[READ] * 100)

    assert history.count == 3
    assert history.dropped == 3
    assert history.bytes == 3 * (100 * READ_BYTES + 1)


def test_answers_of_long_names_fit_into_frames():
    """What the shard could not send, its client would ask for again and again."""
    bench = ShardBench()
    bench.hello("ann")
    entities = [f"e{number:03}/".ljust(200, "e") for number in range(400)]
    reads = [DatumRead(slot(entity, "f" * 200, "w" * 200), 1, 1) for entity in entities]
    for seq in range(1, 81):
        committed(bench, (slot(f"{seq:03}".ljust(200, "e")), "1"), seq=seq, reads=reads)

    listed = pages_of(bench, ListHistory((), (), ()))

    assert max(len(encode_frame(page)[0]) for page in listed) < PAGE_BYTES_MAX * 5 // 4
    assert len(listed) == 3
    assert sum(len(page.entries) for page in listed) == 80


def test_each_version_is_explained_as_it_is_listed():
    """Retained, kept beyond that, replaced within the last two seconds, the newest."""
    bench = ShardBench()
    bench.hello("ann")
    bench.register(AspectEntry("mask", "int", "durable", 4))
    where = slot(aspect="mask")
    for seq in range(1, 12):
        committed(bench, (where, str(seq)), seq=seq)
        if seq in (2, 3, 11):
            bench.ask(KeepVersions("ann", "label", (SlotVersion(where, seq),)))

    listed = bench.ask(ListHistory((), (), ("mask",))).entries
    explained = [entries(bench, SlotVersion(where, version)) for version in range(14)]

    assert [entry.state.version for entry in listed] == [2, 3, 8, 9, 10, 11]
    assert [one for some in explained[1:] for one in some] == list(listed)
    assert explained[0] == listed[-1:]
