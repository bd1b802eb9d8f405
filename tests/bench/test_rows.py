"""Samples, goals and rows: how figures are summed up and judged."""

from dataclasses import replace

import pytest

from enact_dist.bench.floors import ECHO, FDATASYNC, QUERY
from enact_dist.bench.rows import Case, Goal, Timings, at_most, row_of, sample_of, times
from enact_dist.bench.run import Run
from enact_dist.bench.timing import COUNT_MIN, timed

FLOOR, OTHER, MINE = ("floor", "query"), ("floor", "disk"), ("update", "mine")


def figures(**medians_us):
    return {
        {"floor": FLOOR, "disk": OTHER, "mine": MINE}[name]: Timings(median_us, 2 * median_us, 9)
        for name, median_us in medians_us.items()
    }


def case(goal=None, floor=FLOOR):
    return Case(*MINE, lambda _seconds_s: (), floor, goal)


def test_sample_is_median_and_99th_percentile():
    """The order of the times does not matter."""
    assert sample_of([float(n) for n in range(200, 0, -1)]) == Timings(100.5, 199.0, 200)


def test_sample_of_nothing_is_refused():
    """A figure that nobody measured is never zero."""
    with pytest.raises(ValueError, match="nothing was measured"):
        sample_of([])


@pytest.mark.parametrize(("mine_us", "met"), [(229.0, True), (231.0, False)])
def test_goal_in_floors_follows_the_floor_of_the_run(mine_us, met):
    """2.3 raw queries are 230 µs where one takes 100."""
    goal = times(2.3, FLOOR, "≤ 2.3 x query")

    row = row_of(case(goal), figures(floor=100.0, mine=mine_us))

    assert (row.met, row.ratio) == (met, pytest.approx(mine_us / 100.0))


@pytest.mark.parametrize(("mine_us", "met"), [(560.0, True), (561.0, False)])
def test_goal_may_allow_for_the_disk(mine_us, met):
    """2.6 queries and 1.5 times the disk."""
    goal = times(2.6, FLOOR, "…", plus=(1.5, OTHER))

    assert row_of(case(goal), figures(floor=100.0, disk=200.0, mine=mine_us)).met is met


def test_floors_of_a_goal_are_measured_with_its_row():
    """Not only what the row is divided by: a bench that runs alone judges its rows."""
    variants = []

    class Machine:
        def case(self, variant):
            variants.append(variant)
            return Case("floor", variant, lambda _seconds_s: [100.0])

    run = Run(Place(near=True), Machine(), seconds_s=1.0, told=lambda _text: None)
    goal = times(2.6, QUERY, "…", plus=(1.5, FDATASYNC))

    run.measure([Case(*MINE, lambda _seconds_s: [410.0], ECHO, goal)])

    assert {name for _, name in (QUERY, FDATASYNC, ECHO)} == set(variants)
    assert [row.met for row in run.rows() if row.goal] == [True]


def test_speed_is_told_of_what_moves_bytes():
    """10 MB in 5 ms are 2,000 MB/s; a row that moves none has none."""
    case = Case(*MINE, lambda _seconds_s: (), bytes=10_000_000)

    assert row_of(case, figures(mine=5_000.0)).as_json()["mb_s"] == 2_000.0
    assert "mb_s" not in row_of(replace(case, bytes=0), figures(mine=1.0)).as_json()


def test_row_is_seen_beside_another_that_does_not_judge_it():
    """The goal goes by the like-for-like row; the plain ratio is told all the same."""
    beside = replace(case(times(1.3, FLOOR, "≤ 1.3 x like")), beside=(OTHER, "plain"))

    row = row_of(beside, figures(floor=100.0, disk=50.0, mine=120.0))

    assert (row.met, row.as_json()["beside"]) == (True, "2.40 x plain")
    assert "beside" not in row_of(beside, figures(floor=100.0, mine=120.0)).as_json()


def test_goal_without_its_floor_is_not_judged():
    """What this run cannot tell is neither met nor missed."""
    goal = times(1.2, OTHER, "…")

    row = row_of(case(goal), figures(mine=1.0))

    assert (row.met, row.ratio, row.goal) == (None, None, "…")


@pytest.mark.parametrize(("p99_us", "met"), [(20.0, True), (19.0, False)])
def test_goal_may_bound_the_99th_percentile_too(p99_us, met):
    """A good median does not excuse a bad tail."""
    goal = at_most(12.0, "…", p99_us=p99_us)

    assert goal.met(Timings(10.0, 20.0, 9), {}) is met


def test_row_without_a_goal_has_none():
    """Nothing to keep to, nothing to judge."""
    row = row_of(case(), figures(floor=2.0, mine=1.0))

    assert (row.goal, row.met) == (None, None)
    assert "value" not in row.as_json()


def test_act_is_repeated_at_least_three_times():
    """An act longer than the measuring time still gives a median."""
    calls = []

    times_us = timed(lambda: calls.append("act"), 1e-9, before=lambda: calls.append("before"))

    assert len(times_us) >= COUNT_MIN
    assert calls[::2] == ["before"] * (len(calls) // 2)
    assert calls[1::2] == ["act"] * (len(calls) // 2)


def test_goal_is_a_value():
    """Two texts tell two goals apart."""
    assert Goal("a", len) != Goal("b", len)


class Place:
    """Where nothing is started."""

    def __init__(self, *, near):
        self.near = near


def ran(*rounds_us, near=True, name="update"):
    """Return the row of a case whose rounds took so long, beside a floor of 5 µs and a goal."""
    run = Run(Place(near=near), None, seconds_s=1.0, told=lambda _text: None)
    floor = Case(*QUERY, lambda _: ())
    case = Case(name, "v", lambda _: (), QUERY, times(4.0, QUERY, "≤ 4 x"))
    run.add(floor, [5.0] * 100)
    for times_us in rounds_us:
        run.add(case, times_us)
    return next(row for row in run.rows() if row.name == name)


def test_median_tail_and_spread_are_of_all_rounds():
    """No round is left out: not the one that met with other work, nor the best one."""
    row = ran([20.0] * 100, [10.0] * 100, [12.0] * 95 + [900.0] * 5)

    assert (row.median_us, row.p99_us, row.n) == (12.0, 900.0, 300)
    assert row.spread_us == (10.0, 20.0)
    assert row.as_json()["spread_us"] == (10.0, 20.0)
    assert ran([20.0] * 100).spread_us is None  # one round has no spread


@pytest.mark.parametrize(
    ("near", "floor"), [(True, ("zenoh query", 5.0, 2.0)), (False, ("", None, None))]
)
def test_figures_that_come_first_repeat_rows_of_the_table(near, floor):
    """Each with its floor, unless the cell is on another host; what was not measured is left out."""
    run = Run(Place(near=near), None, seconds_s=1.0, told=lambda _text: None)
    run.add(Case(*QUERY, lambda _: ()), [5.0] * 100)
    for variant in ("zenoh, volatile, 4 slots", "embedded, volatile", "zenoh, volatile"):
        for median_us in (8.0, 10.0, 12.0):
            run.add(Case("update", variant, lambda _: (), QUERY), [median_us] * 100)

    update, four = run.answer()

    assert (update.what, update.row.variant) == ("update", "zenoh, volatile")
    assert (four.what, four.row.variant) == ("4 slots", "zenoh, volatile, 4 slots")
    assert (update.floor, update.floor_us, update.row.ratio) == floor
    assert update.row.spread_us == (8.0, 12.0)
    assert update.as_json()["floor_us"] == floor[1]


@pytest.mark.parametrize(
    ("near", "name", "judged"),
    [(True, "update", True), (False, "update", None), (False, "core", True)],
)
def test_cell_on_another_host_is_not_judged_by_the_floors_of_this_one(near, name, judged):
    """Its disk and its network are others; what runs here is judged all the same."""
    row = ran([10.0] * 100, near=near, name=name)

    assert row.met is judged
    assert (row.ratio is None) == (judged is None)
    assert row.goal == "≤ 4 x"
