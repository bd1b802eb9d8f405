"""Views of the past over several shards: one cut, exactly at the stamp that was asked for."""

from __future__ import annotations

import pytest
from client_bench import NOTHING, REQUEST, CellBench, ClientBench
from shard_bench import MS, S, item, lock_id, slot

from enact_dist.core.client.cut import Cut
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import Finish, Forgotten, TakeView, Viewed
from enact_dist.core.protocol.records import Called
from enact_dist.terms import Access

W, V = Access.WRITE, Access.VIEW
LOCK = lock_id("ann")
EPOCHS = {"a": 5, "b": 6}
THEN_NS = 50
LATER_NS = 100 * S


def cut_at(*shards: str, observer: bool = False) -> Cut:
    items = {shard: (item(V, f"on_{shard}"),) for shard in shards}
    return Cut(items, floor_ns=70, observer=observer, past_ns=THEN_NS)


def answer(cut: Cut, shard: str, until_ns: int, *, epoch: int = 0) -> Viewed:
    """Let a shard answer with data that were current up to a stamp."""
    epoch = epoch or EPOCHS[shard]
    request = TakeView(LOCK, epoch, 1, 1, cut.items[shard], 0, cut.at_ns, cut.strict)
    viewed = Viewed(LOCK, epoch, until_ns, (), 10, until_ns)
    cut.take(shard, request, viewed, until_ns=LATER_NS)
    return viewed


def settled(cut: Cut) -> dict[str, Viewed] | None:
    return cut.settled(EPOCHS.__getitem__, now_ns=0)


class TestCut:
    def test_every_shard_is_asked_as_of_then_from_the_first_round_on(self):
        """The session's own commits do not move it, nor does anything that is shown."""
        cut = cut_at("a", "b")
        assert (cut.at_ns, cut.strict, list(cut.left)) == (THEN_NS, True, ["a", "b"])

        answers = {"a": answer(cut, "a", THEN_NS), "b": answer(cut, "b", THEN_NS)}

        assert settled(cut) == answers

    def test_undecided_commit_is_waited_for_at_the_same_stamp(self):
        """As often as it takes; one shard alone is no exception."""
        cut = cut_at("a")
        for _ in range(20):
            answer(cut, "a", THEN_NS - 1)
            assert settled(cut) is None
            assert (cut.at_ns, list(cut.left)) == (THEN_NS, ["a"])

        last = answer(cut, "a", THEN_NS)

        assert settled(cut) == {"a": last}

    def test_restarted_shard_is_asked_again_as_of_then(self):
        """What it has promised in the epoch before it may not keep."""
        cut = cut_at("a", "b")
        answer(cut, "a", THEN_NS, epoch=4)
        answer(cut, "b", THEN_NS)

        assert settled(cut) is None
        assert (cut.at_ns, list(cut.left)) == (THEN_NS, ["a"])

    def test_observer_asks_all_a_second_time_as_of_then(self):
        """No shard waits for it when it restarts."""
        cut = cut_at("a", "b", observer=True)
        first = {shard: answer(cut, shard, THEN_NS) for shard in ("a", "b")}
        assert settled(cut) is None
        assert (cut.at_ns, list(cut.left)) == (THEN_NS, ["a", "b"])

        for shard in ("a", "b"):
            answer(cut, shard, THEN_NS)

        assert settled(cut) == first


# ---------------------------------------------------------------- a client and its shards


@pytest.fixture
def cell() -> CellBench:
    return CellBench("a", "b")


def write_both(cell: CellBench, client: ClientBench, text: str) -> int:
    """Commit one value on both shards and return its stamp; the participant is not told yet."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    lock = client.locked(item(W, x), item(W, y))
    client.finish(lock, (slot(x), text), (slot(y), text))
    assert lock.position is not None
    return lock.position.stamp_ns


def tell_decisions(cell: CellBench) -> None:
    """Deliver what the shards have to say to each other."""
    for bench in cell.shards.values():
        calls, bench.calls = bench.calls, []
        for shard, request in calls:
            said = cell.shards[shard].ask(request)
            if said is not None:
                bench.event(Called(shard, request, said))


def seen_at(cell: CellBench, client: ClientBench, past_ns: int, **options: float) -> MultiLock:
    """See both shards as of a stamp."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    return client.drive(client.begin(item(V, x), item(V, y), past_ns=past_ns, **options))


def shown(lock: MultiLock) -> list[str | None]:
    data = [reading.state.datum for reading in lock.states]
    return [None if datum is None else bytes(datum.body).decode() for datum in data]


def test_past_is_seen_in_one_round_trip(cell):
    """Each commit as of its own stamp, none as of the stamp before the first."""
    client = cell.client("ann")
    stamps = []
    for number in range(4):
        stamps.append(write_both(cell, client, f"v{number}"))
        tell_decisions(cell)

    for number, stamp_ns in enumerate(stamps):
        since = len(client.sent)
        lock = seen_at(cell, client, stamp_ns)
        assert (lock.phase, shown(lock)) == (Phase.HELD, [f"v{number}"] * 2)
        assert client.kinds_sent(since=since) == ["TakeView", "TakeView"]
        client.finish(lock)
    assert shown(seen_at(cell, client, stamps[0] - 1)) == [None, None]


def test_commit_that_a_shard_was_not_told_of_yet_is_waited_for(cell):
    """Asked as of its stamp, the participant shows nothing before it knows."""
    client = cell.client("ann")
    stamp_ns = write_both(cell, client, "new")
    assert [type(request) for _, request in cell.shards["a"].calls] == [Finish]
    lock = client.begin(
        item(V, cell.entity_on("a")), item(V, cell.entity_on("b")), past_ns=stamp_ns
    )
    client.step(lock)
    assert lock.phase is Phase.VIEWING

    tell_decisions(cell)
    client.drive(lock)

    assert (lock.phase, shown(lock)) == (Phase.HELD, ["new", "new"])


def test_commit_that_stays_undecided_leaves_the_past_unseen(cell):
    """Neither with it nor without it: nobody can say yet; and no read lock is taken for it."""
    client = cell.client("ann")
    stamp_ns = write_both(cell, client, "new")
    since = len(client.sent)

    lock = seen_at(cell, client, stamp_ns, wait_s=1.0)

    assert lock.phase is not Phase.HELD
    assert not lock.states
    assert set(client.kinds_sent(since=since)) <= {"TakeView", "Release"}


def test_forgotten_state_ends_the_view_by_name(cell):
    """What other shards still know is given back."""
    client = cell.client("ann")
    first_ns = write_both(cell, client, "v0")
    tell_decisions(cell)
    for number in range(1, 20):
        cell.wait(MS)
        write_both(cell, client, f"v{number}")
        tell_decisions(cell)
    cell.wait(3 * S)
    client.keep_alive()
    write_both(cell, client, "last")
    tell_decisions(cell)

    lock = seen_at(cell, client, first_ns)

    assert lock.phase is Phase.REFUSED
    assert isinstance(lock.refusal, Forgotten)
    assert lock.refusal.oldest_ns > first_ns
    assert not lock.states
    assert shown(seen_at(cell, client, lock.refusal.oldest_ns)) != [None, None]


def test_restart_in_the_midst_gives_no_mixed_answer(cell):
    """The clock of a shard was ahead, and is right after its restart: it commits before then."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    cell.shards["a"].wall_ns += S // 2
    viewer, writer = cell.client("ann"), cell.client("bob")
    write_both(cell, writer, "old")
    tell_decisions(cell)
    then_ns = cell.shards["a"].wall_ns + S // 4
    viewer.lose = lambda shard, request: (
        REQUEST if shard == "b" and isinstance(request, TakeView) else NOTHING
    )
    lock = viewer.begin(item(V, x), item(V, y), wait_s=30.0, past_ns=then_ns)
    viewer.step(lock)
    assert list(lock.cut.left) == ["b"]

    cell.shards["a"].restart()
    cell.shards["a"].wall_ns -= S // 2
    for client in (viewer, writer, viewer, writer):
        client.keep_alive()  # learns of the restart, then acknowledges it: the grace is over
    assert write_both(cell, writer, "new") < then_ns
    tell_decisions(cell)
    viewer.lose = lambda _shard, _request: NOTHING
    viewer.drive(lock)

    assert (lock.phase, shown(lock)) == (Phase.HELD, ["new", "new"])
