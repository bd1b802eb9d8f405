"""Sets of one capture stamp: which run, which are given up, who was missing; nothing unnamed."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from enact_dist import Entity
from enact_dist.actor_sets import PendingSets
from enact_dist.together import Captured

NAMES = ("left", "middle", "right")
LEFT, MIDDLE, RIGHT = range(3)


class Feed:
    """Three members whose data come one by one, in an order that the test says."""

    def __init__(self, open_max=4):
        self.sets = PendingSets(NAMES, entity=Entity("left"), open_max=open_max)
        self.versions = [0] * len(NAMES)
        self.commits = 0

    def next(self, member, stamp_ns, *, null=False):
        self.commits += 1
        self.versions[member] += 1
        return Captured(self.versions[member], self.commits, stamp_ns, null)

    def come(self, stamp_ns, *members):
        for member in members or range(len(NAMES)):
            self.sets.captured(member, [self.next(member, stamp_ns)])

    def runs(self):
        runs = []
        while (trigger := self.sets.take(0)) is not None:
            runs.append(trigger.captured_ns)
        return runs

    def told(self):
        return [(one.stamp_ns, one.missing) for one in self.sets.told]


def test_each_complete_set_runs_once_in_order():
    """However the data of several sets are mixed on their way."""
    feed = Feed()
    feed.come(10, LEFT)
    feed.come(20, LEFT)
    feed.come(10, RIGHT)
    assert feed.runs() == []
    feed.come(10, MIDDLE)
    feed.come(20, RIGHT, MIDDLE)

    assert feed.runs() == [10, 20]
    assert (feed.sets.incomplete, feed.sets.skipped, feed.sets.late) == (0, 0, 0)


def test_set_is_incomplete_once_each_missing_member_has_moved_on():
    """Not before: a slow member may still bring it."""
    feed = Feed()
    feed.come(10, LEFT)
    feed.come(20, LEFT, MIDDLE)
    assert feed.sets.incomplete == 0
    feed.come(20, RIGHT)

    assert feed.runs() == [20]
    assert feed.told() == [(10, ("middle", "right"))]
    assert str(feed.sets.told[0]) == "set of stamp 10: without middle, right"


def test_oldest_set_is_given_up_when_a_member_stays_away():
    """A dead camera is reported, not waited for."""
    feed = Feed(open_max=2)
    for stamp_ns in (10, 20, 30, 40):
        feed.come(stamp_ns, LEFT, MIDDLE)

    assert feed.runs() == []
    assert feed.told() == [(10, ("right",)), (20, ("right",))]
    feed.come(10, RIGHT)
    assert (feed.sets.late, feed.sets.incomplete) == (1, 2)
    feed.come(30, RIGHT)
    assert feed.runs() == [30]


def test_complete_sets_that_nobody_takes_are_skipped_and_counted():
    """The newest `open_max` wait for a slow actor."""
    feed = Feed(open_max=2)
    for stamp_ns in (10, 20, 30, 40):
        feed.come(stamp_ns)

    assert (feed.sets.skipped, feed.runs()) == (2, [30, 40])


def test_data_that_fit_no_set_are_counted_by_kind():
    """Without a stamp, for a set that is over, a second time for one that is open."""
    feed = Feed()
    feed.come(0, LEFT)
    feed.come(10)
    feed.come(10, LEFT)
    feed.come(20, LEFT)
    feed.come(20, LEFT)
    feed.sets.captured(LEFT, [feed.next(LEFT, 0, null=True)])

    assert (feed.sets.unstamped, feed.sets.late, feed.sets.skipped) == (1, 1, 1)
    assert (feed.runs(), feed.sets.incomplete) == ([10], 0)


def test_repeated_versions_are_no_news():
    """A watch that is opened again tells what is known; retained versions are asked twice."""
    feed = Feed()
    history = [feed.next(LEFT, stamp_ns) for stamp_ns in (10, 20)]
    feed.sets.captured(LEFT, history)
    feed.sets.captured(LEFT, history)
    feed.come(10, MIDDLE, RIGHT)
    feed.sets.captured(LEFT, history[:1])

    assert feed.runs() == [10]
    assert (feed.sets.late, feed.sets.skipped) == (0, 0)


def test_versions_that_were_not_seen_are_asked_for():
    """Lost notices, and a shard whose versions start again; the next one or the same are none."""
    feed = Feed()
    assert not feed.sets.misses(LEFT, 1)
    feed.come(10, LEFT)

    assert [feed.sets.misses(LEFT, version) for version in (1, 2, 3)] == [False, False, True]
    feed.come(20, LEFT)
    assert feed.sets.misses(LEFT, 1)


def test_versions_that_start_again_after_a_restart_count_as_new():
    """Their commit stamps go on."""
    feed = Feed()
    feed.come(10)
    feed.versions = [0, 0, 0]
    feed.come(20)

    assert feed.runs() == [10, 20]


def test_start_runs_the_newest_complete_set_only():
    """What was incomplete before, or older, is not this actor's business; what is open still is."""
    feed = Feed()
    stamps = {LEFT: (10, 20, 40, 50), MIDDLE: (20, 30, 40), RIGHT: (20, 40)}
    feed.sets.start([[feed.next(member, ns) for ns in each] for member, each in stamps.items()])
    assert feed.runs() == [40]
    feed.come(50, MIDDLE, RIGHT)

    assert feed.runs() == [50]
    assert (feed.sets.incomplete, feed.sets.late, feed.sets.skipped) == (0, 0, 0)


def test_refused_set_stays_the_next_one_until_it_is_due():
    """Order is kept over a shard's absence."""
    feed = Feed()
    feed.come(10)
    feed.come(20)
    trigger = feed.sets.take(0)
    feed.sets.postpone(trigger, 1_000)

    assert (feed.sets.take(999), feed.sets.due_ns()) == (None, 1_000)
    again = feed.sets.take(1_000)
    assert (again.captured_ns, again.refused) == (10, 1)
    assert feed.runs() == [20]
    assert feed.sets.due_ns() is None


def test_memory_is_bounded_by_the_open_sets():
    """Ten thousand sets leave no more behind than a few."""
    feed = Feed(open_max=3)
    for stamp_ns in range(1, 10_002):
        feed.come(stamp_ns, *((LEFT, MIDDLE) if stamp_ns % 10 == 0 else ()))
        feed.runs()

    sets = feed.sets
    assert sets.incomplete == 1_000
    assert len(sets._open) + len(sets._over) + len(sets._ready) <= 3 + 12 + 3
    feed.sets.captured(RIGHT, [feed.next(RIGHT, 5)])
    assert sets.late == 1


@pytest.mark.parametrize("seed", range(20))
def test_every_set_runs_or_is_named_whatever_the_order(seed):
    """Each member brings its stamps in order and drops some; the sum is always right."""
    import random

    draw = random.Random(seed)
    feed = Feed(open_max=256)
    queues = {m: [ns for ns in range(1, 101) if draw.random() < 0.9] + [101] for m in range(3)}
    whole = set.intersection(*map(set, queues.values()))
    touched = set.union(*map(set, queues.values()))
    runs = []
    while any(queues.values()):
        member = draw.choice([m for m, left in queues.items() if left])
        feed.come(queues[member].pop(0), member)
        runs += feed.runs()

    assert runs == sorted(whole)
    assert feed.sets.incomplete == len(touched - whole)
    assert (feed.sets.late, feed.sets.skipped) == (0, 0)


def test_set_that_is_over_is_never_opened_again_by_data_out_of_order():
    """A second datum of a set that ran is late, however many older sets were closed after it."""
    feed = Feed(open_max=1)
    feed.come(50)
    feed.come(1, LEFT)
    feed.come(2, LEFT)
    feed.come(3, LEFT)
    feed.sets.captured(LEFT, [feed.next(LEFT, 5), feed.next(LEFT, 6)])
    feed.come(50, LEFT)
    feed.come(60)

    assert [stamp_ns for stamp_ns, _ in feed.told()] == [1, 2, 3, 5, 6]
    assert feed.sets.late == 1


@pytest.mark.parametrize("open_max", [1, 2, 16])
def test_every_set_runs_or_is_told_at_most_once_in_any_order(open_max):
    """Stamps that come mixed, in bunches and with holes: no set twice, none both run and told."""
    for seed in range(300):
        draw = random.Random(seed)
        feed, ran, told = Feed(open_max), Counter(), Counter()
        queues = [[s for s in range(1, 60) if draw.random() < 0.85] for _ in NAMES]
        for queue in queues:
            for _ in range(15):
                one = draw.randrange(len(queue))
                other = min(len(queue) - 1, one + draw.randint(0, 5))
                queue[one], queue[other] = queue[other], queue[one]
        while any(queues):
            member = draw.choice([m for m, queue in enumerate(queues) if queue])
            bunch, queues[member] = queues[member][:3], queues[member][3:]
            before = feed.sets.incomplete
            feed.sets.captured(member, [feed.next(member, stamp_ns) for stamp_ns in bunch])
            told.update(s for s, _ in feed.told()[-(feed.sets.incomplete - before) or 99 :])
            ran.update(feed.runs())

        assert max((ran + told).values()) == 1, seed
