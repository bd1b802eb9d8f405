"""Views over several shards: one cut, whatever the clocks, restarts and undecided commits."""

from __future__ import annotations

import pytest
from client_bench import ANSWER, NOTHING, CellBench, ClientBench
from shard_bench import MS, TTL_NS, S, datum, item, lock_id, slot

from enact_dist.core.client.cut import ROUNDS_MAX, Cut
from enact_dist.core.client.lock import MultiLock
from enact_dist.core.client.own_commits import SLOTS_MAX
from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.messages import (
    Commit,
    Finish,
    Outcome,
    PlacementMap,
    ShardEntry,
    TakeView,
    Viewed,
    WriteItem,
)
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import Called
from enact_dist.terms import Access

R, W, V = Access.READ, Access.WRITE, Access.VIEW
LOCK = lock_id("ann")
LATER_NS = 100 * S
EPOCHS = {"a": 5, "b": 6, "c": 7}


def cut_over(*shards: str, floor_ns: int = 0, observer: bool = False) -> Cut:
    """Return a cut that asks each of these shards one thing."""
    items = {shard: (item(V, f"on_{shard}"),) for shard in shards}
    return Cut(items, floor_ns=floor_ns, observer=observer)


def answer(
    cut: Cut, shard: str, from_ns: int, until_ns: int, *, epoch: int = 0, counts_ns: int = LATER_NS
) -> Viewed:
    """Let a shard answer that its data were current in an interval."""
    epoch = epoch or EPOCHS[shard]
    request = TakeView(LOCK, epoch, 1, 1, cut.items[shard], 0, cut.at_ns)
    viewed = Viewed(LOCK, epoch, until_ns, (), from_ns, until_ns)
    cut.take(shard, request, viewed, until_ns=counts_ns)
    return viewed


def settled(cut: Cut, *, now_ns: int = 0) -> dict[str, Viewed] | None:
    """Ask for the outcome of a round in which all have answered."""
    return cut.settled(EPOCHS.__getitem__, now_ns=now_ns)


class TestCut:
    def test_intervals_that_meet_are_a_cut(self):
        """One round trip, the usual case."""
        cut = cut_over("a", "b")
        answers = {"a": answer(cut, "a", 10, 50), "b": answer(cut, "b", 40, 60)}

        assert not cut.left
        assert settled(cut) == answers

    def test_only_who_lags_is_asked_again_at_the_largest_lower_end(self):
        """The others' answers hold at that stamp."""
        cut = cut_over("a", "b", "c")
        first = [answer(cut, "a", 10, 50), answer(cut, "c", 20, 90), answer(cut, "b", 60, 80)]
        assert settled(cut) is None
        assert (list(cut.left), cut.at_ns) == (["a"], 60)

        again = answer(cut, "a", 55, 60)

        assert settled(cut) == {"a": again, "b": first[2], "c": first[1]}

    def test_answer_of_an_earlier_round_is_too_late(self):
        """It says nothing of the stamp that is asked for now."""
        cut = cut_over("a", "b")
        old = TakeView(LOCK, 5, 1, 1, cut.items["a"], 0, 0)
        answer(cut, "a", 10, 50)
        answer(cut, "b", 60, 80)
        settled(cut)

        cut.take("a", old, Viewed(LOCK, 5, 50, (), 10, 50), until_ns=LATER_NS)

        assert list(cut.left) == ["a"]

    def test_one_shard_alone_needs_no_second_round(self):
        """It shows each commit whole, whatever stands in the way."""
        cut = cut_over("a")
        viewed = answer(cut, "a", 60, 50)

        assert settled(cut, now_ns=2 * LATER_NS) == {"a": viewed}

    def test_one_shard_as_of_a_stamp_may_mix_past_and_present(self):
        """Where it has forgotten a past it shows the present, beside the past of other slots."""
        cut = cut_over("a", floor_ns=90)
        answer(cut, "a", 10, 80)
        assert settled(cut) is None
        answer(cut, "a", 120, 90)

        assert settled(cut) is None
        assert cut.at_ns == 120

        again = answer(cut, "a", 120, 120)
        assert settled(cut) == {"a": again}

    def test_own_commits_are_waited_for(self):
        """A session sees what it has committed itself, at one shard too."""
        cut = cut_over("a", floor_ns=70)
        cut.not_before(90)
        answer(cut, "a", 10, 80)

        assert settled(cut) is None
        assert cut.at_ns == 90

    def test_answer_of_an_epoch_that_is_over_does_not_count(self):
        """Its shard may give smaller stamps now than it has promised."""
        cut = cut_over("a", "b")
        answer(cut, "a", 10, 50, epoch=4)
        answer(cut, "b", 20, 60)

        assert settled(cut) is None
        assert list(cut.left) == ["a"]

    def test_answer_does_not_count_longer_than_its_shard_would_wait_for_us(self):
        """From then on a restarted shard may have granted locks without our knowing."""
        cut = cut_over("a", "b")
        answer(cut, "a", 10, 50, counts_ns=LATER_NS)
        answer(cut, "b", 20, 60, counts_ns=2 * LATER_NS)

        assert settled(cut, now_ns=LATER_NS) is None
        assert (list(cut.left), cut.at_ns) == (["a"], 20)

    def test_observer_gets_the_first_answers_once_all_have_answered_again(self):
        """Nobody had restarted when the last of them came."""
        cut = cut_over("a", "b", observer=True)
        first = {"a": answer(cut, "a", 10, 50), "b": answer(cut, "b", 40, 60)}
        assert settled(cut) is None
        assert (list(cut.left), cut.at_ns) == (["a", "b"], 40)

        answer(cut, "a", 10, 40)
        answer(cut, "b", 70, 40)

        assert settled(cut) == first

    def test_observer_starts_over_when_a_shard_has_restarted(self):
        """The first answers are of no moment any more."""
        cut = cut_over("a", "b", observer=True)
        answer(cut, "a", 10, 50, epoch=5)
        answer(cut, "b", 40, 60)
        settled(cut)

        answer(cut, "a", 10, 40, epoch=8)
        answer(cut, "b", 40, 40)

        assert cut.settled({"a": 8, "b": 6}.__getitem__, now_ns=0) is None
        assert list(cut.left) == ["a", "b"]

    def test_rounds_are_counted(self):
        """Whoever never gets a cut is told, and takes locks."""
        cut = cut_over("a", "b")
        for number in range(ROUNDS_MAX):
            for shard in tuple(cut.left):
                answer(cut, shard, 100 * number + (10 if shard == "b" else 0), 100 * number)
            if "a" not in cut.left:
                assert settled(cut) is None

        assert cut.rounds == ROUNDS_MAX + 1


# ---------------------------------------------------------------- with shards


@pytest.fixture
def cell() -> CellBench:
    return CellBench("a", "b")


def tell_decisions(cell: CellBench) -> None:
    """Deliver what the shards have to say to each other."""
    for bench in cell.shards.values():
        calls, bench.calls = bench.calls, []
        for shard, request in calls:
            said = cell.shards[shard].ask(request)
            if said is not None:
                bench.event(Called(shard, request, said))


def write_both(cell: CellBench, client: ClientBench, text: str) -> None:
    """Commit one value on both shards; the participant is not told yet."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    lock = client.locked(item(W, x), item(W, y))
    client.finish(lock, (slot(x), text), (slot(y), text))
    assert lock.phase is Phase.COMMITTED


def shown(lock: MultiLock) -> list[str | None]:
    """Return the values that a lock shows."""
    data = [reading.state.datum for reading in lock.states]
    return [None if datum is None else bytes(datum.body).decode() for datum in data]


def test_view_is_not_older_than_what_the_same_lock_reads(cell):
    """A commit that a read shows is shown by the views beside it, though not told there yet."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    write_both(cell, cell.client("ann"), "new")
    assert [type(request) for _, request in cell.shards["a"].calls] == [Finish]

    reader = cell.client("bob")
    lock = reader.begin(item(R, x), item(V, y))
    for _ in range(3):
        reader.step(lock)
    assert lock.phase is Phase.VIEWING
    tell_decisions(cell)
    reader.drive(lock)

    assert (lock.phase, shown(lock)) == (Phase.HELD, ["new", "new"])


def test_view_beside_a_deleted_pattern_is_not_older_either(cell):
    """What a pattern shows no more counts as shown."""
    x, y = cell.entity_on("a", "tray/"), cell.entity_on("b")
    writer = cell.client("ann")
    write = writer.locked(item(W, x))
    writer.finish(write, (slot(x), "old"))
    write = writer.locked(item(W, x), item(W, y, "note"))
    writer.finish(write, (slot(x), None), (slot(y, "note"), "new"))

    reader = cell.client("bob")
    lock = reader.begin(item(Access.READ_EACH, "tray/*"), item(V, y, "note"))
    for _ in range(4):
        reader.step(lock)
    assert lock.phase is Phase.VIEWING
    tell_decisions(cell)
    reader.drive(lock)

    assert (lock.phase, shown(lock)) == (Phase.HELD, ["new"])


def test_own_commit_is_shown_though_an_earlier_one_was_told_later(cell):
    """Two threads of a process commit; the answer to the first one is late."""
    client = cell.client("ann")
    names = [(cell.entity_on("a", prefix), cell.entity_on("b", prefix)) for prefix in "ef"]
    first, second = (
        client.locked(item(W, x), item(W, y), lane=lane) for lane, (x, y) in enumerate(names)
    )
    client.lose = lambda _shard, request: (
        ANSWER
        if getattr(request, "lock", None) == first.lock and isinstance(request, Commit | Outcome)
        else NOTHING
    )
    writes = {
        shard_of(one, cell.placement): [WriteItem(slot(one), datum("first"))] for one in names[0]
    }
    first.finish(writes, give_up_ns=cell.now_ns + 10 * S)
    while not first.sent_commit:
        client.step(first)
    client.finish(second, *((slot(one), "second") for one in names[1]))
    client.lose = lambda _shard, _request: NOTHING
    client.drive(first)
    assert (first.phase, second.phase) == (Phase.COMMITTED, Phase.COMMITTED)
    assert first.position < second.position

    view = client.begin(item(V, names[1][1]), lane=2)
    for _ in range(3):
        client.step(view)
    assert view.phase is Phase.VIEWING
    tell_decisions(cell)
    client.drive(view)

    assert (view.phase, shown(view)) == (Phase.HELD, ["second"])


@pytest.mark.parametrize("seen", ["nothing else", "another slot", "a pattern of others"])
def test_own_commit_is_shown_whatever_else_of_its_shard_was_seen_before(cell, seen):
    """A shard that shows other slots as of now may still have our commit before it."""
    y, other = cell.entity_on("b"), cell.entity_on("b", "tray/")
    client = cell.client("ann")
    write_both(cell, client, "new")
    cell.wait(MS)
    if seen != "nothing else":
        before = (
            item(V, other) if seen == "another slot" else item(Access.VIEW_EACH, "tray/*", "note")
        )
        assert client.locked(before).phase is Phase.HELD

    alone, beside = (
        client.begin(item(V, y), lane=1),
        client.begin(item(W, other), item(V, y), lane=2),
    )
    for _ in range(4):
        for lock in (alone, beside):
            client.step(lock)
    assert [lock.phase for lock in (alone, beside)] == [Phase.VIEWING, Phase.VIEWING]
    tell_decisions(cell)

    assert shown(client.drive(alone)) == ["new"]
    assert shown(client.drive(beside))[-1] == "new"


def test_what_was_shown_once_rides_with_locks_again(cell):
    """As soon as a shard has shown our commit, views of it need no round trip of their own."""
    y, other = cell.entity_on("b"), cell.entity_on("b", "tray/")
    client = cell.client("ann")
    write_both(cell, client, "new")
    untold = client.core.plan((item(W, other), item(V, y)))
    assert [shard for shard, _ in untold.views] == ["b"]
    assert not client.core.plan((item(W, other), item(V, other, "note"))).views
    tell_decisions(cell)
    cell.wait(MS)

    assert shown(client.locked(item(V, y))) == ["new"]

    assert not client.core.plan((item(W, other), item(V, y))).views
    assert client.core.unsettled_ns("b") == 0


def test_commits_on_many_slots_are_forgotten_by_their_stamps(cell):
    """Who writes ever new slots over shards keeps a bounded memory of them, and misses none."""
    client = cell.client("ann").core
    for number in range(2 * SLOTS_MAX):
        client.unsettled.committed("b", (slot(f"e{number}"),), number + 1)

    assert len(client.unsettled) <= SLOTS_MAX + 1
    assert client.plan((item(V, "e0"),)).floor_ns >= 1
    client.reached("b", 2 * SLOTS_MAX)
    assert client.unsettled_ns("b") == 0


def test_view_that_outlived_a_restart_does_not_show_half_a_commit(cell):
    """The clock of a shard was ahead, and was set right while the shard restarted."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    cell.shards["a"].wall_ns += 3600 * S
    viewer = cell.client("ann")
    viewer.lose = lambda shard, request: (
        ANSWER if shard == "b" and isinstance(request, TakeView) else NOTHING
    )
    lock = viewer.begin(item(V, x), item(V, y), wait_s=30.0)
    viewer.step(lock)
    assert list(lock.cut.left) == ["b"]

    cell.shards["a"].restart()
    cell.shards["a"].wall_ns -= 3600 * S
    cell.wait(TTL_NS + 100 * MS)
    writer = cell.client("bob")
    for shard in cell.shards:
        writer.call(shard, writer.core.hello(shard))
    write_both(cell, writer, "new")
    tell_decisions(cell)
    viewer.lose = lambda _shard, _request: NOTHING
    viewer.drive(lock)

    assert (lock.phase, shown(lock)) == (Phase.HELD, ["new", "new"])


def test_lock_stays_where_it_was_placed(cell):
    """A map that the client learns meanwhile moves neither its writes nor what it expects."""
    x, y = cell.entity_on("a"), cell.entity_on("b")
    client = cell.client("ann")
    lock = client.locked(item(W, x), item(W, y))

    client.core.learn_placement(PlacementMap(2, (ShardEntry("elsewhere", ()),), ()))

    assert (lock.shard_of(slot(x)), lock.shard_of(slot(y))) == ("a", "b")
