"""Requests that the wire can carry and no honest client makes: refused by name, nothing breaks."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any, get_args, get_origin

import pytest
from shard_bench import MS, ShardBench, datum, item, lock_id, slot

from enact_dist.core.datum import Datum, Position, Token
from enact_dist.core.messages import (
    AspectEntry,
    Commit,
    Committed,
    Fenced,
    Finish,
    Finished,
    Granted,
    Item,
    ListHistory,
    Prepare,
    Prepared,
    Refused,
    Register,
    Release,
    Request,
    Survey,
    TakeView,
    Validate,
    WriteItem,
)
from enact_dist.core.records import Tick
from enact_dist.terms import Access
from enact_dist.wire.message_parts import annotated, without_none

W = Access.WRITE
ANN = lock_id("ann")
FAR_TOKEN = Token(7, 7)
WRITES = (WriteItem(slot(), datum("new")),)


@pytest.fixture
def bench() -> ShardBench:
    bench = ShardBench()
    bench.hello("ann", "bob")
    return bench


def refused(answer: object, match: str) -> None:
    """Assert that a request was refused for this reason."""
    assert isinstance(answer, Refused), answer
    assert match in answer.text


def free(bench: ShardBench) -> bool:
    """Whether the slot of all these tests can be locked by somebody else at once."""
    return isinstance(bench.acquire(lock_id("bob", 3), item(W)), Granted)


@pytest.mark.parametrize("access", [-1, 0, 7, 99])
def test_access_that_does_not_exist_is_refused(bench, access):
    """For a lock and for a view; the shard goes on."""
    wrong = Item(access, "online", "piece", "count")
    refused(bench.acquire(ANN, wrong), "access")
    refused(bench.ask(TakeView(ANN, 1, 1, 5, (wrong,), 0)), "access")

    assert free(bench)


@pytest.mark.parametrize("pattern", ["*a" * 9, "/".join(["**"] * 5), "a**b", "", "a//b", "a\0*"])
def test_pattern_that_no_client_makes_is_refused(bench, pattern):
    """Of a lock, of a view and of each listing: too many stars could stop everybody else."""
    bench.write("bob", 1, "new", to=slot("a" * 150))
    for access in (Access.READ_EACH, Access.WRITE_EACH):
        refused(bench.acquire(ANN, item(access, pattern)), "pattern")
    view = (item(Access.VIEW_EACH, pattern),)
    refused(bench.ask(TakeView(ANN, 1, 1, 5, view, 0)), "pattern")
    refused(bench.ask(Survey((), ("piece", pattern), ())), "pattern")
    refused(bench.ask(ListHistory((), (pattern,), ())), "pattern")

    assert free(bench)


@pytest.mark.parametrize("parties", [("nosuch",), ("s0",), ("far", "s0"), ("",)])
def test_commit_with_participants_that_cannot_be_told_is_refused(bench, parties):
    """An unknown shard, and this one itself; else the decision would be kept for ever."""
    grant = bench.granted(ANN, item(W))

    refused(bench.ask(Commit(ANN, grant.token, WRITES, 0, (), parties)), "far")

    assert not bench.shard.state.decisions.by_lock
    assert free(bench)


def test_participant_named_twice_counts_once(bench):
    """It is told once, and once it has finished the decision is over."""
    grant = bench.granted(ANN, item(W))
    answer = bench.ask(Commit(ANN, grant.token, WRITES, 0, (), ("far", "far")))

    assert isinstance(answer, Committed)
    assert [shard for shard, _ in bench.calls] == ["far"]


@pytest.mark.parametrize("primary", ["nosuch", "s0", ""])
def test_prepare_for_a_primary_that_cannot_be_asked_is_refused(bench, primary):
    """Nothing would ever end it."""
    grant = bench.granted(ANN, item(W))

    refused(bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), primary, FAR_TOKEN)), "far")

    bench.ask(Release(ANN))
    assert free(bench)


def test_prepared_lock_does_not_commit_by_itself(bench):
    """Only its primary decides; and it stays prepared."""
    grant = bench.granted(ANN, item(W))
    assert isinstance(
        bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", FAR_TOKEN)), Prepared
    )

    refused(bench.ask(Commit(ANN, grant.token, WRITES, 0)), "another way")

    assert not free(bench)


def test_finish_by_another_than_the_primary_is_refused(bench):
    """A misdirected message decides nothing."""
    grant = bench.granted(ANN, item(W))
    bench.ask(Prepare(ANN, grant.token, WRITES, 0, (), "far", FAR_TOKEN))

    refused(bench.ask(Finish(ANN, Position(bench.wall_ns, "nosuch"))), "far")

    assert bench.ask(Finish(ANN, Position(bench.wall_ns, "far"))) == Finished(ANN)


@pytest.mark.parametrize(
    ("name", "durability"), [("speed", "bogus"), ("", "os"), ("a/b", "os"), ("**", "")]
)
def test_aspect_that_nobody_could_use_is_refused(bench, name, durability):
    """A durability that does not exist would only be found by the first commit."""
    before = dict(bench.shard.state.catalogue.aspects)

    answer = bench.ask(Register("ann", (), (AspectEntry(name, "int", durability),)))

    assert isinstance(answer, Refused)
    assert bench.shard.state.catalogue.aspects == before


@pytest.mark.parametrize("entity", ["", "a//b", "tray/*", "\0"])
def test_entity_that_nobody_could_read_is_not_made(bench, entity):
    """Every client whose pattern covers it would stumble over its name."""
    lock = bench.granted(ANN, item(W, entity))

    answer = bench.commit(ANN, lock.token, (slot(entity), "new"))

    assert isinstance(answer, Refused)
    assert not bench.shard.state.slots.exists(slot(entity))


def test_validations_of_unknown_lanes_leave_nothing(bench):
    """The exactly-once table has a row per lane that locked here, not per question."""
    for lane in range(1, 50):
        assert isinstance(bench.ask(Validate(lock_id("ann", lane), Token(1, 99))), Fenced)

    assert not bench.shard.state.sessions.by_id["ann"].lanes


# ---------------------------------------------------------------- anything at all

BIG = (1 << 63) - 1
TEXTS: dict[str, tuple[Any, ...]] = {
    "access": (*(access.value for access in Access), 0, 99),
    "epoch": (1, 1, 1, 0, 2, BIG),
    "map_version": (1, 1, 1, 0),
    "lane": (0, 0, 1, -1, BIG),
    "seq": (1, 2, 3, 4, 0, -1, BIG),
    "number": (1, 2, 3, 4, 5, 0, -1),
    "version": (0, 1, 2),
    "session": ("ann", "bob", "zed", ""),
    "context": ("online", "training", "nowhere", ""),
    "entity": ("piece", "bench", "a/**", "*", "a**b", "", "/", "[", "\0"),
    "aspect": ("count", "note", "frame", "wrong", ""),
    "name": ("count", "wrong", "s0", ""),
    "shard": ("s0", "far", "nosuch", ""),
    "durability": ("", "durable", "os", "volatile", "bogus"),
}
"""What a field may hold, by its name; the others get numbers and texts at the edges."""
SAME_AS = {
    "pattern": "entity",
    "patterns": "entity",
    "contexts": "context",
    "aspects": "aspect",
    "worlds": "name",
    "primary": "shard",
    "asker": "shard",
    "participants": "shard",
}


def anything(random: Random, name: str, kind: Any) -> Any:
    """Return a value that the wire would take for a field."""
    inner = without_none(kind)
    if inner is not kind and random.random() < 0.2:
        return None
    if inner is Datum:
        return datum("any")
    if get_origin(inner) is tuple:
        one = get_args(inner)[0]
        return tuple(anything(random, name, one) for _ in range(random.choice((0, 1, 1, 2))))
    found = TEXTS.get(SAME_AS.get(name, name))
    if found is not None and inner in (int, str):
        return random.choice(found)
    if inner is int:
        return random.choice((0, 1, -1, 5, 1_000_000_000, BIG, -BIG, 1_800_000_000_000_000_000))
    if inner in (str, bytes, bool):
        return random.choice({str: ("", "x"), bytes: (b"", b"x"), bool: (True, False)}[inner])
    return inner(*(anything(random, part, of) for part, of in annotated(inner)))


def any_request(random: Random, grants: dict[Any, Token]) -> Any:
    """Return a request of any kind, often under a lock that is held."""
    kind = random.choice((*get_args(Request), Commit, Prepare, Validate))
    request = kind(*(anything(random, name, of) for name, of in annotated(kind)))
    names = {name for name, _ in annotated(kind)}
    if "lock" in names and grants and random.random() < 0.7:
        lock, token = random.choice(list(grants.items()))
        changes: dict[str, Any] = {"lock": lock}
        if "token" in names:
            changes["token"] = token
        if "writes" in names and random.random() < 0.8:
            changes["writes"] = WRITES
        if random.random() < 0.6:
            usual = {"participants": (), "primary": "far", "expects": ()}
            changes |= {name: value for name, value in usual.items() if name in names}
            if "seen_stamp_ns" in names:
                changes["seen_stamp_ns"] = 0
        request = replace(request, **changes)
    return request


@pytest.mark.parametrize("part", range(4))
def test_no_request_whatever_breaks_the_shard(part):
    """400 short lives of a shard, with honest locks between."""
    kinds_answered: dict[str, int] = {}
    for seed in range(100 * part, 100 * part + 100):
        random = Random(seed)
        bench = ShardBench()
        bench.hello("ann", "bob")
        grants: dict[Any, Token] = {}
        for _ in range(50):
            bench.disk_is_done = random.random() < 0.7
            if random.random() < 0.1:
                bench.now_ns += 100 * MS
                bench.event(Tick())
                continue
            request = any_request(random, grants)
            if random.random() < 0.25:
                lock = lock_id(random.choice(("ann", "bob")), 0, random.randint(1, 5))
                access, entity = random.choice(list(Access)), random.choice(("piece", "*"))
                request = bench.acquire_request(lock, item(access, entity))
            bench.ask(request)
            grants |= {a.lock: a.token for a in bench.answers.values() if isinstance(a, Granted)}
        for answer in bench.answers.values():
            name = type(answer).__name__
            kinds_answered[name] = kinds_answered.get(name, 0) + 1
    wanted = {"Granted", "Refused", "Fenced", "Committed", "Prepared", "Viewed", "Valid"}
    assert wanted <= kinds_answered.keys(), "it never got anywhere"
