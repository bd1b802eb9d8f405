"""A shard that has forgotten an aspect: nobody is shown a past that it cannot know."""

from __future__ import annotations

import pytest
from shard_bench import ASPECTS, WALL_NS, S, ShardBench, item, lock_id, slot
from world_parts import LOCKS, V, content, fork, of, write

from enact_dist.core.protocol.messages import Forgotten, Forked, Register, TakeView, Viewed
from enact_dist.core.protocol.records import AspectForgotten, BasesMoved
from enact_dist.terms import Access

AT_NS = WALL_NS + 100 * S
"""When the aspect was forgotten; the wall clock is set back, and is before it."""
EACH = Access.VIEW_EACH
COUNT, NOTE, _ = ASPECTS


def bench_after(*records):
    """Return a shard that had three versions before it found these records in its store."""
    bench = ShardBench()
    bench.hello("ann")
    for value in "123":
        write(bench, value)
    write(bench, "n", slot(aspect="note"))
    bench.log += records
    bench.restart()
    bench.hello("ann", known_epoch=bench.shard.epoch)
    return bench


@pytest.fixture
def bench():
    """Return a shard with one session that has forgotten an aspect, which nobody made again."""
    return bench_after(AspectForgotten(COUNT.name, 3, AT_NS))


def asked(bench, at_ns, *items):
    """Return what a view as of a stamp is answered."""
    lock, count = lock_id("ann", 2, next(LOCKS)), bench.next_count("ann")
    return bench.ask(TakeView(lock, bench.shard.epoch, 1, count, items, 0, at_ns, strict=True))


def made_again(bench):
    """Register the aspect again and write it once; return the stamp."""
    bench.ask(Register("ann", (), (COUNT,)))
    return write(bench, "4")


def test_no_commit_is_stamped_before_what_was_forgotten(bench):
    """Though the clock was set back since: what it made would count as forgotten."""
    stamp_ns = made_again(bench)
    assert bench.wall_ns < AT_NS < stamp_ns
    assert content(bench, slot()).version == 4
    assert isinstance(asked(bench, stamp_ns, item(V)), Viewed)


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("access", [V, EACH])
@pytest.mark.parametrize("entity", ["piece", "other"])
def test_a_view_of_before_is_forgotten(bench, access, entity, again):
    """Of a slot and of a pattern, whether there is anything now or not."""
    if again:
        made_again(bench)
    answer = asked(bench, AT_NS - 1, item(access, entity))
    assert answer == Forgotten(slot(entity), AT_NS)
    assert isinstance(asked(bench, AT_NS, item(access, entity)), Viewed)
    assert isinstance(asked(bench, AT_NS - 1, item(access, entity, "note")), Viewed)


@pytest.mark.parametrize("again", [False, True])
def test_a_fork_of_before_is_refused(bench, again):
    """It would lack the aspect without a word; from then on it has what was then."""
    if again:
        made_again(bench)
    answer = fork(bench, at_ns=AT_NS - 1)
    assert (type(answer), answer.oldest_ns) == (Forgotten, AT_NS)
    assert "what_if" not in bench.shard.state.catalogue.worlds

    assert isinstance(fork(bench, at_ns=AT_NS), Forked)
    assert bench.value(of("what_if", aspect="note")) == "n"
    assert bench.value(of("what_if")) is None


def test_an_entity_from_elsewhere_is_known_since_it_was_forgotten_there():
    """What it was before is told, of no other one, and its versions go on."""
    own_ns = WALL_NS + 1
    moved = AspectForgotten(COUNT.name, 30, AT_NS, (("piece", 0, own_ns),))
    bench = bench_after(BasesMoved(moved))
    first = content(bench, slot())
    assert (first.version, bench.value()) == (3, "3")

    (state,) = asked(bench, first.stamp_ns, item(V)).states
    assert (state.version, bytes(state.datum.body)) == (3, b"3")
    assert asked(bench, own_ns - 1, item(V)) == Forgotten(slot(), own_ns)
    for access, entity in ((V, "other"), (EACH, "piece"), (EACH, "*")):
        answer = asked(bench, first.stamp_ns, item(access, entity))
        assert answer == Forgotten(slot(entity), AT_NS)
    write(bench, "4")
    write(bench, "1", slot("other"))
    assert [content(bench, slot(entity)).version for entity in ("piece", "other")] == [4, 31]
