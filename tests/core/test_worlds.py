"""Forks share what their source had as of a stamp, and dropped contexts never come back by halves."""

from __future__ import annotations

from itertools import count

import pytest
from shard_bench import ASPECTS, MS, S, ShardBench, item, lock_id, slot

from enact_dist.core.datum import Position, Token
from enact_dist.core.message_parts import CAUSE_FORK
from enact_dist.core.messages import (
    AspectEntry,
    Commit,
    DatumRead,
    Dropped,
    DropWorld,
    EpochChanged,
    Explain,
    Finish,
    Forgotten,
    Fork,
    Forked,
    Goodbye,
    Hello,
    Item,
    KeepVersions,
    Prepare,
    Prepared,
    Refused,
    Register,
    Registered,
    SlotVersion,
    TakeView,
    Viewed,
    WorldEntry,
    WriteItem,
)
from enact_dist.core.records import KeptRecord, SlotRecord, WorldDropped, WorldRecord
from enact_dist.core.slots import NOTHING
from enact_dist.core.worlds import CHANGES_MAX, FORK_WAIT_NS
from enact_dist.terms import Access, NullReason

W, V = Access.WRITE, Access.VIEW
LOCKS = count(1)


@pytest.fixture
def bench():
    """Return a shard with one session."""
    made = ShardBench()
    made.hello("ann")
    return made


def write(bench, value, to=None):
    """Set a slot (None: to null) and return the stamp of the commit."""
    to = to or slot()
    lock = lock_id("ann", 1, next(LOCKS))
    grant = bench.granted(lock, Item(W, *to))
    return bench.commit(lock, grant.token, (to, value)).position.stamp_ns


def fork(bench, world="what_if", source="online", at_ns=None):
    """Fork a world context, as of now where nothing else is said."""
    at_ns = bench.shard.state.stamp() if at_ns is None else at_ns
    return bench.ask(Fork("ann", world, source, at_ns))


def drop(bench, world="what_if"):
    """Drop a world context."""
    return bench.ask(DropWorld("ann", world))


def of(world, entity="piece", aspect="count"):
    """Return a slot of a world context."""
    return slot(entity, aspect, world)


def content(bench, where):
    """Return the newest state of a slot."""
    return bench.shard.state.slots[where]


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


# ---------------------------------------------------------------- drop


def test_dropped_context_is_gone_with_all_its_slots(bench):
    """From the catalogue, from memory and from the disk; the source stays."""
    write(bench, "1")
    fork(bench)
    write(bench, "2", of("what_if"))
    count_before = bench.shard.state.slots.count

    assert drop(bench) == Dropped("what_if", 1)

    assert "what_if" not in bench.shard.state.catalogue.worlds
    assert bench.shard.state.slots.count == count_before - 1
    assert bench.shard.state.slots.bytes == 1
    assert not bench.shard.state.slots.exists(of("what_if"))
    assert bench.value() == "1"
    assert bench.ask(Explain((SlotVersion(of("what_if"), 1),))).entries == ()
    bench.restart()
    assert "what_if" not in bench.shard.state.catalogue.worlds
    assert not bench.shard.state.slots.exists(of("what_if"))


def test_who_watches_a_dropped_context_is_told_that_all_is_null(bench):
    """Each slot once, with one version more, in notices of bounded size."""
    names = [f"e{number}" for number in range(CHANGES_MAX + 1)]
    bench.ask(Register("ann", ("plan",), ()))
    slots = [of("plan", name) for name in names]
    grant = bench.granted(lock_id(), *(Item(W, *to) for to in slots))
    bench.commit(lock_id(), grant.token, *((to, "1") for to in slots))
    write(bench, None, slots[0])
    bench.notices.clear()

    drop(bench, "plan")

    changes = [change for notice in bench.notices for change in notice.changes]
    assert len(changes) == CHANGES_MAX
    assert {(change.slot, change.version, change.null) for change in changes} == {
        (to, 2, True) for to in slots[1:]
    }
    assert max(len(notice.changes) for notice in bench.notices) <= CHANGES_MAX


@pytest.mark.parametrize("restarted", [False, True], ids=["at once", "after a restart"])
def test_versions_of_a_context_that_is_made_again_start_above_the_old_ones(bench, restarted):
    """No version is ever used twice, not even that of the null that watchers were told of."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "1", of("plan", "other"))
    for value in "123":
        write(bench, value, of("plan"))
    drop(bench, "plan")
    if restarted:
        bench.restart()
        bench.hello("ann", known_epoch=bench.shard.epoch)
    bench.ask(Register("ann", ("plan",), ()))

    write(bench, "again", of("plan", "other"))

    assert content(bench, of("plan", "other")).version == 5
    drop(bench, "plan")
    fork(bench, "plan", "online")
    write(bench, "new", of("plan"))
    assert content(bench, of("plan")).version == 7


def test_history_of_a_dropped_context_is_gone_when_it_is_made_again(bench):
    """A view as of then finds nothing of the old one."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "old", of("plan"))
    old_ns = write(bench, "older", of("plan"))
    drop(bench, "plan")
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "new", of("plan"))

    assert [c.version for c, _ in bench.shard.state.slots.versions(of("plan"))] == [4]
    assert isinstance(fork(bench, "late", "plan", old_ns), Forked)
    assert not bench.shard.state.slots.exists(of("late"))


@pytest.mark.parametrize("access", [W, V], ids=["write", "view"])
def test_context_is_not_dropped_while_a_lock_names_it(bench, access):
    """The refusal says who; what is held is written as ever."""
    bench.ask(Register("ann", ("plan",), ()))
    lock = lock_id()
    grant = bench.granted(lock, Item(access, *of("plan")), item(W))

    answer = drop(bench, "plan")

    assert isinstance(answer, Refused)
    assert answer.code == "held"
    assert "ann@host pid 1 holds piece/count" in answer.text
    bench.commit(lock, grant.token, (slot(), "1"))
    assert drop(bench, "plan") == Dropped("plan", 0)


def test_context_is_not_dropped_while_a_lock_in_it_is_awaited_or_prepared(bench):
    """A prepared write may have to be applied yet, after a restart too."""
    bench.hello("bob")
    bench.ask(Register("ann", ("plan",), ()))
    lock = lock_id()
    grant = bench.granted(lock, Item(W, *of("plan")), item(W), alone=False)
    bench.acquire(lock_id("bob"), Item(W, *of("plan", "other")), item(W))
    prepare = Prepare(lock, grant.token, (WriteItem(of("plan"), None),), 0, (), "far", Token(1, 1))
    bench.ask(prepare)
    assert drop(bench, "plan").code == "held"

    bench.restart()

    assert drop(bench, "plan").code == "held"
    bench.ask(Finish(lock, Position(bench.shard.state.stamp(), "far")))
    assert drop(bench, "plan") == Dropped("plan", 1)


def test_context_that_the_cell_is_configured_with_is_not_dropped(bench):
    """It would be there again after the next start."""
    answer = drop(bench, "online")

    assert isinstance(answer, Refused)
    assert "cell.toml" in answer.text


def test_nothing_new_begins_in_a_context_that_is_going(bench):
    """A commit would come after its end on the disk."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "1", of("plan"))
    bench.disk_is_done = False
    handle = bench.send(DropWorld("ann", "plan"))

    assert bench.acquire(lock_id("ann", 5, 1), Item(W, *of("plan"))).code == "unknown_world"
    assert bench.ask(Register("ann", ("plan",), ())).code == "overload"
    assert fork(bench, "what_if", "plan").code == "unknown_world"
    assert bench.value(of("plan")) == "1"
    bench.disk_is_done = True
    bench.finish_disk()
    assert bench.answers[handle] == Dropped("plan", 1)
    assert isinstance(bench.ask(Register("ann", ("plan",), ())), Registered)


def test_view_that_waited_while_its_context_was_dropped_is_refused(bench):
    """It shows no nulls for what was there as of its stamp."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "1", of("plan"))
    lock = lock_id()
    grant = bench.granted(lock, item(W), alone=False)
    bench.ask(Prepare(lock, grant.token, (WriteItem(slot(), None),), 0, (), "far", Token(1, 1)))
    items = (Item(V, "plan", "piece", "count"), item(V))
    at_ns = bench.shard.state.stamp()
    view = TakeView(lock_id("ann", 2, 1), 1, 1, bench.next_count("ann"), items, 0, at_ns, True)
    handle = bench.send(view)
    assert drop(bench, "plan") == Dropped("plan", 1)
    assert handle not in bench.answers

    bench.ask(Finish(lock, Position(at_ns, "far")))

    assert bench.answers[handle].code == "unknown_world"


def test_drop_that_a_crash_took_leaves_everything(bench):
    """Nobody was told that it is gone."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "1", of("plan"))
    bench.disk_is_done = False
    bench.send(DropWorld("ann", "plan"))
    bench.restart()

    assert "plan" in bench.shard.state.catalogue.worlds
    assert bench.value(of("plan")) == "1"


def test_record_of_a_drop_says_from_where_versions_go_on(bench):
    """The store keeps it when all else of the context is gone."""
    bench.ask(Register("ann", ("plan",), ()))
    write(bench, "1", of("plan", "frame", "frame"))
    drop(bench, "plan")

    assert bench.log[-1] == WorldDropped("plan", 2)


# ---------------------------------------------------------------- copies


def test_request_asked_again_is_answered_the_same(bench):
    """Whoever lost the answer gets it."""
    at_ns = write(bench, "1")
    assert fork(bench, at_ns=at_ns) == fork(bench, at_ns=at_ns)
    assert drop(bench) == Dropped("what_if", 1)
    assert drop(bench) == Dropped("what_if", 0)


def test_copy_of_a_fork_under_way_is_answered_with_it(bench):
    """The store is asked once."""
    bench.disk_is_done = False
    message = Fork("ann", "what_if", "online", bench.shard.state.stamp(), 1, 1)
    handles = [bench.send(message), bench.send(message)]
    assert len(bench.pending) == 1
    bench.finish_disk()

    assert bench.answers[handles[0]] == bench.answers[handles[1]]


def test_late_copy_makes_no_context_that_was_dropped_since(bench):
    """Nor does it drop one that was made since; it gets the answer of then."""
    at_ns = bench.shard.state.stamp()
    forked = bench.ask(first := Fork("ann", "what_if", "online", at_ns, 1, 1))
    bench.hello("bob")
    bench.ask(DropWorld("bob", "what_if", 1, 1))

    assert bench.ask(first) == forked
    assert "what_if" not in bench.shard.state.catalogue.worlds

    bench.ask(dropping := DropWorld("ann", "what_if", 1, 2))
    bench.ask(Fork("bob", "what_if", "online", at_ns, 1, 2))
    assert bench.ask(dropping) == Dropped("what_if", 0)
    assert bench.ask(first).code == "overload"
    assert "what_if" in bench.shard.state.catalogue.worlds


def test_copy_from_before_a_restart_does_nothing(bench):
    """The shard knows no more what it has answered then."""
    bench.ask(message := Fork("ann", "what_if", "online", bench.shard.state.stamp(), 1, 1))
    drop(bench)
    bench.restart()

    assert bench.ask(message) == EpochChanged(bench.shard.epoch)
    assert "what_if" not in bench.shard.state.catalogue.worlds


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


def test_late_copy_makes_no_context_when_its_session_was_away(bench):
    """A session that is opened again in the same epoch has asked for what it has asked for."""
    at_ns = write(bench, "1")
    late = Fork("ann", "what_if", "online", at_ns, 1, bench.next_count("ann"))
    bench.ask(late)
    assert isinstance(bench.ask(DropWorld("ann", "what_if", 1, bench.next_count("ann"))), Dropped)
    bench.ask(Goodbye("ann"))
    bench.hello("ann")

    assert isinstance(bench.ask(late), Refused)
    assert "what_if" not in bench.shard.state.catalogue.worlds


@pytest.mark.parametrize("at_ns", [0, -1])
def test_fork_as_of_no_stamp_is_refused(bench, at_ns):
    """It would show the present under a stamp before all others, and wait for no commit."""
    write(bench, "1")

    answer = fork(bench, at_ns=at_ns)

    assert isinstance(answer, Refused)
    assert "which is none" in answer.text
    assert "what_if" not in bench.shard.state.catalogue.worlds


def test_dropped_context_leaves_no_label_on_the_disk(bench):
    """Nobody could let go of it: it is listed nowhere.  What it keeps of others stays."""
    write(bench, "1")
    fork(bench)
    there, here = SlotVersion(of("what_if"), 1), SlotVersion(slot(), 1)
    bench.ask(KeepVersions("ann", "trial", (there,)))
    bench.ask(KeepVersions("ann", "both", (there, here)))

    drop(bench)

    assert bench.recovered(2).kept == [KeptRecord("both", (here,))]
    bench.restart()
    assert list(bench.shard.state.slots.history.labels) == ["both"]
