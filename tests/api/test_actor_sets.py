"""Sets of one capture stamp: which run, which are given up, who was missing; nothing unnamed."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from enact_dist import Entity
from enact_dist.access.sets import Capture, PendingSets

NAMES = ("left", "middle", "right")
LEFT, MIDDLE, RIGHT = range(3)


class Feed:
    """Three members whose data come one by one, in an order that the test says."""

    def __init__(self, open_max=4, **options):
        self.sets = PendingSets(NAMES, entity=Entity("left"), open_max=open_max, **options)
        self.versions = [0] * len(NAMES)
        self.commits = 0

    def next(self, member, stamp_ns, *, null=False):
        self.commits += 1
        self.versions[member] += 1
        return Capture(self.versions[member], self.commits, stamp_ns, null)

    def come(self, stamp_ns, *members, now_ns=0):
        for member in members or range(len(NAMES)):
            self.sets.captured(member, [self.next(member, stamp_ns)], now_ns)

    def runs(self):
        return [captured_ns for captured_ns, _ in self.members()]

    def members(self, now_ns=0):
        runs = []
        while (trigger := self.sets.take(now_ns)) is not None:
            runs.append((trigger.captured_ns, trigger.members))
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


def test_only_the_newest_set_runs_where_older_ones_are_of_no_use():
    """An actor that was held up goes on with what is, and never goes back; all is counted."""
    feed = Feed(newest_only=True, least=2, least_after_ns=10**9)
    for stamp_ns in (10, 20, 30):
        feed.come(stamp_ns)
    assert (feed.sets.skipped, feed.runs()) == (2, [30])

    feed.come(40, LEFT, MIDDLE)
    feed.come(50)
    assert feed.runs() == [50]  # 40 has enough, and its last member has moved on
    assert feed.sets.skipped == 3

    trigger = feed.sets.take(0)
    assert trigger is None
    feed.come(60)
    trigger = feed.sets.take(0)
    feed.sets.postpone(trigger, 100)
    feed.come(70)
    assert feed.sets.take(99) is None
    assert feed.sets.take(100).captured_ns == 70
    assert feed.sets.skipped == 4


def test_set_older_than_one_that_ran_is_skipped():
    """It became old enough to run without a member only after the newer one was complete."""
    feed = Feed(newest_only=True, least=2, least_after_ns=100, within_ns=4)
    feed.come(20, LEFT, now_ns=0)
    feed.come(30, now_ns=0)
    assert feed.runs() == [30]
    feed.sets.captured(MIDDLE, [feed.next(MIDDLE, 20)], 0)

    assert feed.members(now_ns=200) == []
    assert feed.sets.skipped + feed.sets.late + feed.sets.incomplete >= 1


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


def test_stamps_that_are_near_make_a_set():
    """Each datum joins the nearest set that lacks it; the oldest stamp is that of the set."""
    feed = Feed(within_ns=20)
    feed.come(100, LEFT)
    feed.come(200, LEFT)
    feed.come(115, MIDDLE)
    feed.come(190, MIDDLE)
    feed.come(101, RIGHT)
    feed.come(195, RIGHT)

    assert feed.members() == [(100, (100, 115, 101)), (190, (200, 190, 195))]
    assert (feed.sets.incomplete, feed.sets.skipped, feed.sets.late) == (0, 0, 0)


def test_set_of_near_stamps_spreads_no_further_than_it_may():
    """Two that are near a third need not be near each other."""
    feed = Feed(within_ns=20)
    feed.come(100, LEFT)
    feed.come(120, MIDDLE)
    feed.come(121, RIGHT)  # 21 from the left one: another set

    assert feed.members() == []
    feed.come(300)

    assert feed.members() == [(300, (300, 300, 300))]
    assert feed.told() == [(100, ("right",)), (121, ("left", "middle"))]


def test_datum_of_a_set_of_near_stamps_that_is_over_is_late():
    """It belongs to that set, which has run or was given up, and to no later one."""
    feed = Feed(within_ns=20)
    feed.come(100, LEFT, MIDDLE)
    feed.come(300)
    feed.come(110, RIGHT)
    feed.come(300, LEFT)

    assert feed.members() == [(300, (300, 300, 300))]
    assert feed.told() == [(100, ("right",))]
    assert feed.sets.late == 2


def test_set_with_enough_data_runs_once_the_others_have_moved_on():
    """What is missing is named; nothing was given up."""
    feed = Feed(least=2, least_after_ns=10**9)
    feed.come(10, LEFT, RIGHT)
    assert feed.members() == []
    feed.come(20, MIDDLE)

    assert feed.members() == [(10, (10, 0, 10))]
    assert (feed.sets.partial, feed.sets.incomplete) == (1, 0)
    assert feed.sets.last_partial == "set of stamp 10: without middle"


def test_set_with_enough_data_runs_when_it_is_old_enough():
    """A camera that is dead shows no newer stamp; the clock is that of the actor."""
    feed = Feed(least=2, least_after_ns=100)
    feed.come(10, LEFT, now_ns=1_000)
    assert feed.sets.due_ns() is None  # one alone is not enough, however old
    feed.come(10, RIGHT, now_ns=1_050)

    assert feed.sets.due_ns() == 1_100
    assert feed.members(1_099) == []
    assert feed.members(1_100) == [(10, (10, 0, 10))]
    assert feed.sets.due_ns() is None
    feed.come(10, MIDDLE, now_ns=1_200)
    assert (feed.sets.late, feed.members(9_999)) == (1, [])


def test_set_with_too_few_data_is_given_up_all_the_same():
    """Beyond `open_max` the oldest ends: with enough it runs, with less it is incomplete."""
    feed = Feed(open_max=1, least=2, least_after_ns=10**9)
    feed.come(10, LEFT)
    feed.come(20, LEFT, RIGHT)
    feed.come(30, LEFT)

    assert feed.members() == [(20, (20, 0, 20))]
    assert feed.told() == [(10, ("middle", "right"))]


def test_start_takes_the_newest_set_that_has_enough_where_none_is_complete():
    """A camera that was dead before the actor started keeps it from nothing."""
    feed = Feed(least=2, within_ns=5)
    versions = [[], [], []]
    for stamp_ns in (10, 20):
        for member in (LEFT, RIGHT):
            versions[member].append(feed.next(member, stamp_ns + member))
    feed.sets.start(versions)

    assert feed.members() == [(20, (20, 0, 22))]
    assert feed.told() == []


def test_start_finds_the_newest_set_however_far_behind_a_member_is():
    """Of a member that died long ago the common stamp lies far back in the others' history."""
    feed = Feed()
    versions = [[feed.next(member, stamp_ns) for stamp_ns in range(1, 500)] for member in (0, 1)]
    versions.append([feed.next(RIGHT, 3)])
    feed.sets.start(versions)

    assert feed.runs() == [3]


def test_unstamped_data_are_named():
    """Whose writer has to give a stamp."""
    feed = Feed()
    feed.come(0, RIGHT)
    feed.come(0, LEFT)

    assert feed.sets.unstamped_from == ("left", "right")
    assert feed.sets.unstamped == 2


@pytest.mark.parametrize("seed", range(20))
def test_no_datum_of_near_stamps_is_lost_without_a_count(seed):
    """Whatever comes in whatever order: each datum runs, or is counted, once."""
    rng = random.Random(seed)
    feed = Feed(open_max=3, within_ns=30, least=rng.choice([2, 3]), least_after_ns=200)
    came, ran, now_ns = 0, 0, 0
    for tick in range(1, 200):
        for member in rng.sample(range(3), 3):
            now_ns += rng.randrange(40)
            if rng.random() < 0.8:
                came += 1
                feed.come(tick * 100 + rng.randrange(-14, 15), member, now_ns=now_ns)
        for captured_ns, members in feed.members(now_ns):
            present = [stamp_ns for stamp_ns in members if stamp_ns]
            assert captured_ns == min(present)
            assert max(present) - min(present) <= 30
            assert len(present) >= feed.sets._least
            ran += len(present)
    given_up = sum(3 - len(missing) for _, missing in feed.told())
    open_ = sum(one.count for one in feed.sets._open)

    if feed.sets.incomplete == len(feed.sets.told):  # the newest 16 are kept by name
        left = came - ran - given_up - open_ - feed.sets.late
        assert feed.sets.skipped <= left <= 3 * feed.sets.skipped  # data, or whole sets
    assert ran > 200


SECOND_NS = 1_000_000_000


def test_clock_of_the_sensors_that_was_set_back_ends_nothing():
    """A clock an hour ahead is corrected: sets go on; what was open by the old clock is named."""
    hour_ns = 3600 * SECOND_NS
    feed = Feed(newest_only=True)
    feed.come(hour_ns)
    feed.come(hour_ns + 1, LEFT)
    assert feed.runs() == [hour_ns]
    for number in range(1, 4):
        feed.come(number * SECOND_NS)
        assert feed.runs() == ([number * SECOND_NS] if number > 1 else [])
    assert (hour_ns + 1, ("middle", "right")) in feed.told()


def test_member_that_is_silent_does_not_hide_that_a_clock_was_set_back():
    """More than half of the members suffice; the silent one is missing, as before."""
    feed = Feed(least=2, least_after_ns=50)
    feed.come(3600 * SECOND_NS)
    assert feed.runs() == [3600 * SECOND_NS]
    for number in range(1, 4):
        feed.come(number * SECOND_NS, LEFT, MIDDLE)
    assert [stamp_ns for stamp_ns, _ in feed.members(50)][-1] == 3 * SECOND_NS


def test_one_member_whose_clock_is_set_back_is_late():
    """Two tell the time against one: their sets end without it, none of its own begins."""
    feed = Feed(least=1, least_after_ns=50)
    feed.come(3600 * SECOND_NS)
    feed.come(SECOND_NS, LEFT)
    feed.come(3601 * SECOND_NS, MIDDLE, RIGHT)
    feed.come(2 * SECOND_NS, LEFT)
    runs = [stamp_ns for stamp_ns, _ in feed.members(50)]
    assert [stamp_ns for stamp_ns in runs if stamp_ns >= 3600 * SECOND_NS] == [
        3600 * SECOND_NS,
        3601 * SECOND_NS,
    ]
