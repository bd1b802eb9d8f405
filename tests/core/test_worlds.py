"""Forks share what their source had as of a stamp."""

from __future__ import annotations

import pytest
from shard_bench import ASPECTS, MS, S, ShardBench, item, lock_id, slot
from world_parts import LOCKS, V, W, content, drop, fork, of, write

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    AspectEntry,
    Commit,
    DatumRead,
    Explain,
    Finish,
    Forgotten,
    Fork,
    Forked,
    Hello,
    Item,
    Prepare,
    Prepared,
    Refused,
    Register,
    SlotVersion,
    TakeView,
    Viewed,
    WorldEntry,
    WriteItem,
)
from enact_dist.core.protocol.parts import CAUSE_FORK
from enact_dist.core.protocol.records import NOTHING, SlotRecord, WorldRecord
from enact_dist.core.shard.on_world import CHANGES_MAX, FORK_WAIT_NS
from enact_dist.terms import NullReason

SESSIONS = ("ann",)


# ---------------------------------------------------------------- what a fork is


def test_fork_has_the_data_of_its_source_as_of_the_stamp(bench):
    """What came later is not in it; nothing is copied."""
    write(bench, "1")
    at_ns = write(bench, "old", slot("other", "frame"))
    shared = content(bench, slot()).datum
    write(bench, "2")
    write(bench, "new", slot("later"))

    assert fork(bench, at_ns=at_ns) == Forked("what_if", 2, bench.shard.state.stamp())

    assert content(bench, of("what_if")).datum is shared
    assert bench.value(of("what_if", "other", "frame")) == "old"
    assert not bench.shard.state.slots.exists(of("what_if", "later"))


def test_writes_on_a_fork_and_on_its_source_do_not_touch_each_other(bench):
    """Both go on from what they share."""
    write(bench, "1")
    fork(bench)
    write(bench, "theirs")
    write(bench, "ours", of("what_if"))

    assert (bench.value(), bench.value(of("what_if"))) == ("theirs", "ours")


def test_each_slot_of_a_fork_comes_from_a_version_of_its_source(bench):
    """Lineage goes on through it."""
    stamp_ns = write(bench, "1")
    at_ns = bench.shard.state.stamp()
    fork(bench, at_ns=at_ns)

    (entry,) = bench.ask(Explain((SlotVersion(of("what_if"), 0),))).entries

    assert (entry.cause.kind, entry.cause.actor, entry.cause.stamp_ns) == (
        CAUSE_FORK,
        "ann",
        at_ns,
    )
    assert entry.cause.reads == (DatumRead(slot(), 1, stamp_ns),)
    assert entry.cause.writes == (SlotVersion(of("what_if"), 1),)


def test_deleted_slot_of_the_source_is_null_in_the_fork(bench):
    """And its lineage says who deleted it."""
    write(bench, "1")
    stamp_ns = write(bench, None)
    fork(bench)

    found = content(bench, of("what_if"))
    assert (found.datum, found.null_reason) == (None, NullReason.DELETED)
    assert found.cause.reads == (DatumRead(slot(), 2, stamp_ns),)


def test_fork_was_there_from_the_stamp_on_that_it_was_forked_as_of(bench):
    """On each of its shards: so a view shows all of it or nothing."""
    write(bench, "1")
    write(bench, "2", slot("other"))
    at_ns = bench.shard.state.stamp()
    write(bench, "3")
    fork(bench, at_ns=at_ns)

    def seen(view_ns):
        items = tuple(Item(V, "what_if", entity, "count") for entity in ("piece", "other"))
        lock = lock_id("ann", 2, next(LOCKS))
        answer = bench.ask(TakeView(lock, 1, 1, bench.next_count("ann"), items, 0, view_ns))
        assert isinstance(answer, Viewed)
        return [state.datum and bytes(state.datum.body) for state in answer.states]

    assert seen(at_ns) == seen(0) == [b"1", b"2"]
    assert bench.shard.state.slots.as_of(of("what_if"), at_ns - 1) is NOTHING


def test_fork_of_a_fork_has_what_that_had(bench):
    """A fork is a world context like any other."""
    write(bench, "1")
    fork(bench)
    write(bench, "2", of("what_if"))
    fork(bench, "and_then", "what_if")
    write(bench, "3", of("what_if"))

    assert bench.value(of("and_then")) == "2"
    assert content(bench, of("and_then")).cause.reads[0].slot == of("what_if")


def test_forks_are_named_in_the_catalogue(bench):
    """A client finds out on which shards a fork is there, and of what."""
    at_ns = bench.shard.state.stamp()
    fork(bench, at_ns=at_ns)
    entry = WorldEntry("what_if", "online", at_ns)

    assert bench.ask(Hello("bob", 0, S, "bob", "h", 2, False)).forks == (entry,)
    registered = bench.ask(Register("ann", (), ()))
    assert (registered.worlds, registered.forks) == (("online", "training", "what_if"), (entry,))


def test_fork_is_published_to_whoever_watches_that_name(bench):
    """In notices of bounded size."""
    writes = tuple((slot(f"e{number}"), "1") for number in range(CHANGES_MAX + 1))
    grant = bench.granted(lock_id(), *(Item(W, *to) for to, _ in writes))
    bench.commit(lock_id(), grant.token, *writes)
    bench.notices.clear()
    fork(bench)

    assert [len(notice.changes) for notice in bench.notices] == [CHANGES_MAX, 1]
    assert {change.slot.context for n in bench.notices for change in n.changes} == {"what_if"}
    numbers = [notice.number for notice in bench.notices]
    assert numbers == list(range(numbers[0], numbers[0] + 2))


# ---------------------------------------------------------------- when a fork is made


def test_fork_waits_for_undecided_commits_of_its_source(bench):
    """A commit that the disk works on may still become part of it."""
    bench.disk_is_done = False
    lock = lock_id()
    grant = bench.granted(lock, item(W))
    bench.commit(lock, grant.token, (slot(), "1"))
    handle = bench.send(Fork("ann", "what_if", "online", bench.shard.state.stamp()))
    assert handle not in bench.answers
    assert len(bench.pending) == 1

    bench.disk_is_done = True
    bench.finish_disk()

    assert isinstance(bench.answers[handle], Forked)
    assert bench.value(of("what_if")) == "1"


def test_fork_does_not_wait_for_commits_elsewhere_or_later(bench):
    """Only what may become part of it stands in its way."""
    before_ns = bench.shard.state.stamp()
    bench.wait(MS)
    bench.disk_is_done = False
    lock = lock_id()
    grant = bench.granted(lock, item(W), Item(W, *of("training")))
    bench.commit(lock, grant.token, (of("training"), "1"))
    bench.disk_is_done = True

    for name, source, at_ns in (("a", "online", None), ("b", "training", before_ns)):
        bench.pending, others = [], bench.pending
        assert isinstance(fork(bench, name, source, at_ns), Forked)
        bench.pending = others


def test_fork_before_which_a_commit_stays_undecided_is_refused_and_may_be_asked_again():
    """It waits for the word of another shard, but not for ever."""
    bench = ShardBench()
    bench.hello("ann")
    lock = lock_id()
    grant = bench.granted(lock, item(W), alone=False)
    write = (WriteItem(slot(), content(bench, slot()).datum),)
    promise = Prepare(lock, grant.token, write, 0, (), "far", Token(1, 1))
    assert isinstance(bench.ask(promise), Prepared)
    message = Fork("ann", "what_if", "online", bench.shard.state.stamp())
    handle = bench.send(message)
    bench.wait(FORK_WAIT_NS - 10 * MS, keep=("ann",))
    assert handle not in bench.answers

    bench.wait(20 * MS)

    answer = bench.answers[handle]
    assert isinstance(answer, Refused)
    assert answer.code == "overload"
    bench.ask(Finish(lock, Position(bench.shard.state.stamp(), "far")))
    assert isinstance(bench.ask(message), Forked)


def test_fork_as_of_a_forgotten_stamp_says_since_when_its_source_is_known(bench):
    """It never gets the present in place of the past."""
    bench.ask(Register("ann", (), (AspectEntry("count", "int", "", 1),)))
    first_ns = write(bench, "1")
    write(bench, "2")
    bench.wait(10 * S, keep=("ann",))
    newest_ns = write(bench, "3")
    bench.wait(10 * S, keep=("ann",))

    answer = fork(bench, at_ns=first_ns)

    assert answer == Forgotten(slot(), newest_ns)
    assert isinstance(fork(bench, at_ns=newest_ns), Forked)


def test_fork_is_refused_by_name(bench):
    """Source unknown, name taken or not to be read, or a time that is still to come."""
    at_ns = bench.shard.state.stamp()
    unknown = bench.ask(Fork("ann", "what_if", "onlin", at_ns))
    taken = bench.ask(Fork("ann", "training", "online", at_ns))
    wrong = bench.ask(Fork("ann", "what/if", "online", at_ns))
    future = bench.ask(Fork("ann", "what_if", "online", bench.wall_ns + 5 * S))

    assert [answer.code for answer in (unknown, taken, wrong, future)] == [
        "unknown_world",
        "value",
        "value",
        "clock_skew",
    ]
    assert "'onlin'" in unknown.text
    assert "training" in taken.text
    assert "5.0 s ahead" in future.text
    assert tuple(bench.shard.state.catalogue.worlds) == ("online", "training")


def test_name_of_another_fork_is_refused(bench):
    """Its source and its stamp are told."""
    at_ns = write(bench, "1")
    fork(bench, at_ns=at_ns)

    answer = fork(bench, at_ns=at_ns + 1)

    assert isinstance(answer, Refused)
    assert f"fork of 'online' as of stamp {at_ns}" in answer.text


def test_fork_is_used_from_when_it_survives(bench):
    """What a crash may take back is shown to nobody, and its name is not given away."""
    write(bench, "1")
    bench.disk_is_done = False
    handle = bench.send(Fork("ann", "what_if", "online", bench.shard.state.stamp()))

    assert handle not in bench.answers
    assert "what_if" not in bench.shard.state.catalogue.worlds
    assert bench.ask(Register("ann", ("what_if",), ())).code == "overload"
    assert drop(bench).code == drop(bench, "online").code == "overload"

    bench.finish_disk()
    assert isinstance(bench.answers[handle], Forked)
    assert "what_if" in bench.shard.state.catalogue.worlds


def test_commit_on_a_fork_goes_on_from_its_stamp():
    """Its clock does, too, where it was asked as of a stamp a little ahead."""
    bench = ShardBench()
    bench.hello("ann")
    ahead_ns = bench.wall_ns + S // 2
    assert isinstance(fork(bench, at_ns=ahead_ns), Forked)
    lock = lock_id()
    grant = bench.granted(lock, Item(W, *of("what_if")))

    answer = bench.ask(Commit(lock, grant.token, (WriteItem(of("what_if"), None),), 0))

    assert answer.position.stamp_ns > ahead_ns
    assert ASPECTS[0].name == "count"


@pytest.mark.parametrize("at_ns", [0, -1])
def test_fork_as_of_no_stamp_is_refused(bench, at_ns):
    """It would show the present under a stamp before all others, and wait for no commit."""
    write(bench, "1")

    answer = fork(bench, at_ns=at_ns)

    assert isinstance(answer, Refused)
    assert "which is none" in answer.text
    assert "what_if" not in bench.shard.state.catalogue.worlds


# ---------------------------------------------------------------- over restarts


def test_fork_survives_a_restart_of_its_shard(bench):
    """Stored data with their lineage, of volatile slots that they were there."""
    write(bench, "1")
    write(bench, "2", slot("other", "note"))
    write(bench, "3", slot("third", "frame"))
    at_ns = bench.shard.state.stamp()
    fork(bench, at_ns=at_ns)
    before = {e: content(bench, of("what_if", *e)) for e in (("piece",), ("other", "note"))}

    bench.restart()

    assert bench.shard.state.catalogue.worlds["what_if"] == WorldEntry("what_if", "online", at_ns)
    assert {e: content(bench, of("what_if", *e)) for e in before} == before
    assert content(bench, of("what_if", "third", "frame")).null_reason is NullReason.LOST
    bench.hello("ann", known_epoch=bench.shard.epoch)
    assert isinstance(fork(bench, at_ns=at_ns), Forked)


def test_nothing_is_committed_before_a_fork_after_a_restart(bench):
    """Other shards fork as of the same stamp, though this one has no slot to remember it by."""
    at_ns = bench.wall_ns + S // 2
    assert isinstance(fork(bench, source="training", at_ns=at_ns), Forked)

    bench.restart()
    bench.hello("ann", known_epoch=bench.shard.epoch)

    assert write(bench, "5") > at_ns


def test_stored_bytes_are_named_and_not_written_again(bench):
    """The record of a slot says of which version its bytes are."""
    write(bench, "1")
    write(bench, "2")
    write(bench, "3", slot("frame", "frame"))
    before = len(bench.log)
    fork(bench)

    records = bench.log[before:]
    assert [type(record) for record in records] == [WorldRecord, SlotRecord, SlotRecord]
    stored, volatile = records[1:]
    assert stored.same_as == SlotVersion(slot(), 2)
    assert volatile.volatile
    assert volatile.datum is None


def test_fork_that_a_crash_took_may_be_asked_again(bench):
    """Nothing of it is left, and nobody was told of it."""
    write(bench, "1")
    at_ns = bench.shard.state.stamp()
    bench.disk_is_done = False
    bench.send(Fork("ann", "what_if", "online", at_ns))
    bench.restart()
    bench.disk_is_done = True
    bench.hello("ann", known_epoch=bench.shard.epoch)
    assert "what_if" not in bench.shard.state.catalogue.worlds

    assert isinstance(fork(bench, at_ns=at_ns), Forked)
