"""Listings come in pages: whole, in order, each short enough, each with as little work."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shard_bench import ShardBench, item, lock_id, pages_of, slot

from enact_dist.core.client.client import Client
from enact_dist.core.protocol import pages
from enact_dist.core.protocol.messages import (
    START,
    AspectEntry,
    Cursor,
    EpochChanged,
    FindEffects,
    KeepVersions,
    ListAudit,
    ListHistory,
    ListLocks,
    ListSessions,
    PlacementMap,
    Register,
    SlotVersion,
    Survey,
    Surveyed,
    Welcome,
)
from enact_dist.core.protocol.records import AuditRecord
from enact_dist.core.shard import inspection, on_history
from enact_dist.terms import Access
from enact_dist.wire.frames import encode_frame

ENTITIES = [f"tray/{number:02}" for number in range(7)]


@pytest.fixture
def bench():
    """Slots of two aspects, one of them with three versions each, sessions and locks."""
    bench = ShardBench()
    bench.hello("ann")
    bench.ask(Register("ann", (), (AspectEntry("mask", "int", "durable", 3),)))
    seq = 0
    for aspect, body in (("mask", "1"), ("mask", "2"), ("mask", "3"), ("note", "1")):
        for entity in ENTITIES:
            seq += 1
            lock = lock_id("ann", 0, seq)
            grant = bench.granted(lock, item(Access.WRITE, entity, aspect))
            bench.commit(lock, grant.token, (slot(entity, aspect), body))
    for number in range(5):
        bench.hello(f"waiter{number}")
        bench.acquire(lock_id(f"waiter{number}"), item(Access.WRITE, "piece", "count"))
    for number in range(5):
        bench.shard.state.audit.keep(AuditRecord(number + 1, f"act {number}", "broken"))
    return bench


LISTINGS = [
    (Survey((), (), ()), "states", 14),
    (Survey((), (), (), retained=True), "states", 28),
    (Survey(("online",), ("tray/*",), ("note",)), "states", 7),
    (ListHistory((), (), ("mask",)), "entries", 21),
    (ListHistory((), (), (), count_max=2), "entries", 21),
    (ListLocks(), "holders", 5),
    (ListSessions(), "sessions", 6),
    (ListAudit(""), "entries", 5),
]


@pytest.mark.parametrize(("request_", "field", "count"), LISTINGS)
@pytest.mark.parametrize("bytes_max", [1, 300, 1_000])
def test_pages_of_a_listing_are_the_listing(bench, monkeypatch, request_, field, count, bytes_max):
    """Whatever fits on one: nothing twice, nothing left out, the same order."""
    whole = bench.ask(request_)
    assert (len(getattr(whole, field)), whole.more) == (count, START)
    monkeypatch.setattr(pages, "PAGE_BYTES_MAX", bytes_max)

    listed = pages_of(bench, request_)

    assert sum((getattr(page, field) for page in listed), ()) == getattr(whole, field)
    assert len(listed) > 1 or bytes_max > 1
    assert all(getattr(page, field) for page in listed)


@pytest.mark.parametrize(
    ("request_", "field", "count"), [*LISTINGS, (FindEffects(()), "entries", 0)]
)
def test_page_ends_after_some_work_though_nothing_was_found(
    bench, monkeypatch, request_, field, count
):
    """What looks at everything lets others have their turn, page by page."""
    whole = getattr(bench.ask(request_), field)
    monkeypatch.setattr(pages, "WORK_MAX", 1)

    listed = pages_of(bench, request_)

    assert sum((getattr(page, field) for page in listed), ()) == whole
    assert len(listed) >= max(2, count // 4)


def test_page_with_many_patterns_ends_after_fewer_slots(bench, monkeypatch):
    """Each pattern is tried against each slot: 64 of them are the work of eight slots more."""
    monkeypatch.setattr(pages, "WORK_MAX", 20)
    few, many = ("none/*",), tuple(f"none/{number}/*" for number in range(64))

    asked = [sum(1 for _ in pages_of(bench, Survey((), some, ()))) for some in (few, many)]

    assert asked == [1, 5]


def test_cursor_of_an_earlier_epoch_is_refused(bench):
    """A restart may have ordered the slots anew: whoever lists begins again."""
    bench.restart()

    answer = bench.ask(Survey((), (), (), after=Cursor(1, ("online", "mask"), 3)))

    assert answer == EpochChanged(2)


@given(
    st.sampled_from([request for request, _, _ in LISTINGS]),
    st.lists(st.text(max_size=3), max_size=3).map(tuple),
    st.integers(-5, 1 << 62),
    st.integers(-5, 1 << 62),
)
def test_no_cursor_breaks_the_shard(request_, names, number, version):
    """It comes from outside, though only honest clients send back what they got."""
    bench = ShardBench()
    bench.hello("ann")

    answer = bench.ask(type(request_)(**_fields(request_), after=Cursor(1, names, number, version)))

    assert encode_frame(answer)


def _fields(request_):
    names = [name for name in request_.__slots__ if name != "after"]
    return {name: getattr(request_, name) for name in names}


def test_page_goes_on_in_what_has_changed_meanwhile(bench, monkeypatch):
    """What stays comes once, though a context goes and slots come between two pages."""
    monkeypatch.setattr(pages, "PAGE_BYTES_MAX", 500)
    first = bench.ask(Survey((), (), ()))
    grant = bench.granted(lock_id("ann", 0, 99), item(Access.WRITE, "late", "note"))
    bench.commit(lock_id("ann", 0, 99), grant.token, (slot("late", "note"), "1"))

    listed = [first, *pages_of(bench, Survey((), (), (), after=first.more))]

    assert all(isinstance(page, Surveyed) for page in listed)
    slots = [state.slot for page in listed for state in page.states]
    assert len(slots) == len(set(slots)) == 15


def test_slot_with_many_versions_is_not_listed_anew_for_each_page(monkeypatch):
    """A page makes the entries that it shows and no others, wherever in the slot it begins."""
    bench = ShardBench()
    bench.hello("ann")
    bench.ask(Register("ann", (), (AspectEntry("many", "int", "durable", 400),)))
    for seq in range(1, 301):
        bench.write("ann", seq, str(seq), to=slot(aspect="many"))
    made = []
    real = on_history.state_of
    monkeypatch.setattr(on_history, "state_of", lambda *a, **k: made.append(1) or real(*a, **k))
    monkeypatch.setattr(inspection, "state_of", on_history.state_of)
    monkeypatch.setattr(pages, "WORK_MAX", 50)

    for first, field in (
        (ListHistory((), (), ()), "entries"),
        (ListHistory((), (), (), 0, 200), "entries"),
        (Survey((), (), (), retained=True), "states"),
    ):
        made.clear()
        found, request, count = [], first, 0
        while count == 0 or request.after != START:
            answer = bench.ask(request)
            found += [getattr(one, "state", one).version for one in getattr(answer, field)]
            request, count = replace(request, after=answer.more), count + 1
        wanted = getattr(first, "count_max", 0) or 300
        assert found == list(range(301 - wanted, 301))
        assert count > 3
        assert len(made) <= wanted + 2 * count


@pytest.mark.parametrize(
    "request_", [ListHistory((), (), ("mask",)), Survey((), (), ("mask",), retained=True)]
)
def test_page_of_a_slot_with_very_many_versions_has_many_of_them(monkeypatch, request_):
    """To find where a page goes on may take most of its time; one version a page has no end."""
    monkeypatch.setattr(pages, "WORK_MAX", 20)
    bench = ShardBench()
    bench.hello("ann")
    bench.ask(Register("ann", (), (AspectEntry("mask", "int", "durable", 400),)))
    for seq in range(1, 401):
        grant = bench.granted(lock_id("ann", 0, seq), item(Access.WRITE, "cup", "mask"))
        bench.commit(lock_id("ann", 0, seq), grant.token, (slot("cup", "mask"), str(seq)))

    listed = pages_of(bench, request_)

    field = "states" if isinstance(request_, Survey) else "entries"
    assert sum(len(getattr(page, field)) for page in listed) == 400
    assert len(listed) <= 40


def test_what_a_label_keeps_comes_in_pages(bench, monkeypatch):
    """By slot and version, whatever the order of keeping; a further page changes nothing."""
    monkeypatch.setattr(pages, "WORK_MAX", 3)
    versions = [SlotVersion(slot(entity, "mask"), one) for one in (3, 1, 2) for entity in ENTITIES]
    keep = KeepVersions("ann", "all", tuple(versions), 1, 1)
    answer = first = bench.ask(keep)
    written, found = len(bench.log), [answer.versions]
    while answer.more != START:
        answer = bench.ask(replace(keep, after=answer.more))
        found.append(answer.versions)

    assert [len(page) for page in found] == 7 * [3]
    assert [one for page in found for one in page] == sorted(versions)
    assert len(bench.log) == written
    assert bench.ask(keep) == first
    stale = answer.more._replace(epoch=9)
    assert bench.ask(replace(keep, after=stale)) == EpochChanged(1)


def test_pages_of_a_label_go_on_behind_what_was_let_go_of(bench, monkeypatch):
    """What stays comes exactly once."""
    monkeypatch.setattr(pages, "WORK_MAX", 3)
    versions = [SlotVersion(slot(entity, "mask"), 3) for entity in ENTITIES]
    keep = KeepVersions("ann", "all", tuple(versions), 1, 1)
    answer = bench.ask(keep)
    bench.ask(KeepVersions("ann", "all", (), 1, 2))
    bench.ask(KeepVersions("ann", "all", tuple(versions[2:6]), 1, 3))

    assert bench.ask(replace(keep, after=answer.more)).versions == tuple(versions[3:6])


def test_session_that_a_shard_has_forgotten_greets_it_before_it_keeps_again():
    """The refusal is of this epoch, not of an earlier one: without a greeting it came for ever."""
    client = Client("ann", ttl_ns=10**9)
    welcome = Welcome("s0", 1, True, 10**9, 1, 0, PlacementMap(1, (), ()), (), ())
    client.answered("s0", client.hello("s0"), welcome, 0)
    assert not client.needs_hello("s0")

    client.answered("s0", KeepVersions("ann", "all", (), 1, 1), EpochChanged(1), 0)

    assert client.needs_hello("s0")
