"""Dropped contexts never come back, by halves or by late copies."""

from __future__ import annotations

import pytest
from shard_bench import item, lock_id, slot
from world_parts import V, W, content, drop, fork, of, write

from enact_dist.core.protocol.datum import Position, Token
from enact_dist.core.protocol.messages import (
    Dropped,
    DropWorld,
    EpochChanged,
    Explain,
    Finish,
    Fork,
    Forked,
    Goodbye,
    Item,
    KeepVersions,
    Prepare,
    Refused,
    Register,
    Registered,
    SlotVersion,
    TakeView,
    WriteItem,
)
from enact_dist.core.protocol.records import KeptRecord, WorldDropped
from enact_dist.core.shard.on_world import CHANGES_MAX

SESSIONS = ("ann",)


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
