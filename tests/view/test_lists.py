"""What pages list: moments, slots, numbers, and texts that cannot become markup."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from view_samples import BEGIN_NS, SECOND_NS, slot

from enact_dist.operate.cell_rows import ActorRates
from enact_dist.view import markup
from enact_dist.view.activity import RunTimes, table
from enact_dist.view.catalogue import ROWS_MAX, ListedState, SlotCatalogue
from enact_dist.view.timeline import Player, Timeline


def at(*seconds):
    return [BEGIN_NS + round(each * SECOND_NS) for each in seconds]


# ---------------------------------------------------------------- moments

MOVING, STILL = slot("robot", "pose"), slot("camera", "calibration")
LINE = Timeline.of(
    {
        MOVING: list(zip((7, 8, 9), at(10, 11, 13), strict=True)),
        slot("hull"): list(zip((1, 2), at(9, 12), strict=True)),
        STILL: [(1, at(-3600)[0])],
    }
)


def test_a_timeline_begins_with_the_first_datum_that_changed():
    """A calibration of an hour ago does not stretch the slider."""
    assert (LINE.oldest_ns, LINE.newest_ns, LINE.span_s) == (*at(9, 13), 4.0)
    assert LINE.whole_ns == at(10)[0]  # before that, the pose has left its retention


def test_steps_go_from_commit_to_commit():
    """From between two commits to the next one; at an end they stay."""
    assert LINE.step(at(13)[0], -1) == at(12)[0]
    assert LINE.step(at(11.5)[0], -1) == at(11)[0]
    assert LINE.step(at(11.5)[0], 1) == at(12)[0]
    assert LINE.step(at(13)[0], 1) == at(13)[0]
    assert LINE.step(at(9)[0], -1) == at(9)[0]


def test_a_moment_is_seconds_after_the_left_end():
    """Beyond the right end is the right end; a timeline without commits has moment 0."""
    assert LINE.at(1.5) == at(10.5)[0]
    assert LINE.at(99.0) == at(13)[0]
    assert LINE.seconds(at(10.5)[0]) == 1.5
    assert Timeline().at(1.0) == 0


def test_a_cause_before_the_left_end_can_be_shown():
    """The timeline grows to it, and steps stop there."""
    longer = LINE.including(at(2))
    assert (longer.oldest_ns, longer.step(at(2)[0], -1)) == (at(2)[0], at(2)[0])


def test_playing_goes_on_at_its_speed_and_stops_at_the_end():
    """Two seconds at half speed are one second; to follow is to be live again."""
    player = Player()
    player.look_back(LINE, at(10)[0])
    player.playing, player.speed = True, 0.5
    player.advance(2.0)
    assert (player.at_ns, player.playing) == (at(11)[0], True)
    player.advance(60.0)
    assert (player.at_ns, player.playing) == (at(13)[0], False)
    player.follow()
    assert player.live


# ---------------------------------------------------------------- slots


def filled(*slots):
    catalogue = SlotCatalogue()
    for number, each in enumerate(slots, 1):
        state = ListedState(1, BEGIN_NS + number, null=False)
        catalogue.note(each, state, gap=0, now_s=0.0)
    return catalogue


def test_the_tree_has_branches_and_data():
    """A name may be both, and numbers are sorted as numbers."""
    catalogue = filled(slot("camera/10/left"), slot("camera/2"), slot("camera/10"), slot("hull"))
    root = catalogue.listing("online")
    assert (root.branches, root.slots) == ((("camera", 3),), (slot("hull"),))
    below = catalogue.listing("online", "camera/")
    assert below.branches == (("10", 1),)
    assert below.slots == (slot("camera/2"), slot("camera/10"))
    assert catalogue.listing("truth") == ((), (), 0)


@pytest.mark.parametrize(
    ("wanted", "aspects"),
    [("HULL", ["hull"]), ("all/*/x", ["hull", "size"]), ("x/size", ["size"])],
)
def test_a_filter_takes_a_part_of_a_name_or_a_pattern(wanted, aspects):
    """In either case of letters, of entity or aspect, over all branches."""
    catalogue = filled(slot("all/1/x", "hull"), slot("all/2/y", "other"), slot("all/1/x", "size"))
    found = catalogue.listing("online", "camera/", wanted).slots
    assert sorted(found) == [slot("all/1/x", aspect) for aspect in aspects]


def test_long_lists_are_cut_and_counted():
    """The rows that stay are the first by number."""
    catalogue = filled(*(slot(f"part/{number}") for number in range(100)))
    listing = catalogue.listing("online", "part/")
    assert (len(listing.slots), listing.left_out) == (ROWS_MAX, 100 - ROWS_MAX)
    assert listing.slots[9] == slot("part/9")


def test_null_slots_are_not_listed_until_they_are_set_again():
    """Neither in the tree nor as an example of their aspect."""
    catalogue = filled(slot("a"))
    catalogue.note(slot("a"), ListedState(2, BEGIN_NS + 5, null=True), gap=0, now_s=1.0)
    assert catalogue.slots("online") == []
    assert catalogue.first_of_aspects() == []
    catalogue.note(slot("a"), ListedState(3, BEGIN_NS + 6, null=False), gap=0, now_s=1.0)
    assert catalogue.slots("online") == catalogue.first_of_aspects() == [slot("a")]


def test_a_rate_is_that_of_the_commits():
    """One commit gives none; one each tenth of a second gives 10 Hz."""
    catalogue = filled(slot("a"))
    assert catalogue.rate_hz(slot("a"), 0.0) is None
    for number in range(1, 12):
        state = ListedState(number + 1, BEGIN_NS + number * SECOND_NS // 10, null=False)
        catalogue.note(slot("a"), state, gap=0, now_s=number / 10)
    assert catalogue.rate_hz(slot("a"), 1.1) == pytest.approx(10.0)


# ---------------------------------------------------------------- markup


def test_texts_of_the_cell_are_no_markup():
    """Neither a value nor an actor's error runs in the browser of an operator."""
    evil = "<img src=x onerror=alert(1)>"
    for content in (
        markup.table(("a",), [(evil,)], empty=""),
        markup.table(("a",), [], empty=evil),
        markup.whole_value({evil: evil}),
        markup.big_plot([(1, {evil: 1.0}), (2, {evil: 2.0})]),
    ):
        assert "<img" not in content


def test_each_actor_has_a_strip_of_its_own_run_times():
    """One that says nothing, or that has gone, has none; its name stays a text."""
    times = RunTimes()
    for p50_ms in (2.0, 4.0):
        planner = ActorRates("<b>plan", "pc", 7, "running", 10.0, p50_ms, 2 * p50_ms)
        twin = ActorRates("<b>plan", "pc", 8, "connected")
        times.add([planner, twin])
    rows = table(SimpleNamespace(actors=[planner, twin]), "a", times).split("<tr>")
    assert "<th" in rows[1]
    assert rows[1].index(">actor<") < rows[1].index(">run time<") < rows[1].index(">state<")
    drawn = next(row for row in rows[2:] if ">7<" in row)
    silent = next(row for row in rows[2:] if ">8<" in row)
    assert (drawn.count("<polyline"), silent.count("<svg")) == (2, 0)
    assert "&lt;b&gt;plan" in drawn
    times.add([twin])
    assert not times.strip("<b>plan", "pc", "7")


def test_strips_are_made_of_those_actors_alone_that_are_shown(monkeypatch):
    """The strips of a thousand took 2 s at a load of 20; those of 60 take 0.1 s."""
    made, times = [], RunTimes()
    monkeypatch.setattr(markup, "plot", lambda samples: made.append(samples) or "")
    actors = [ActorRates(f"a{n}", "pc", n, "running", 10.0, 2.0, 4.0) for n in range(500)]
    times.add(actors)
    assert "and 440 more" in table(SimpleNamespace(actors=actors), "a", times)
    assert len(made) == markup.ROWS_SHOWN_MAX


@pytest.mark.parametrize(
    ("value", "numbers"),
    [
        (1.5, {"": 1.5}),
        (True, {"": 1.0}),
        ("text", {}),
        ({"x": 1, "note": "a", "in": {"y": [2, 3]}}, {"x": 1.0, "in.y[0]": 2.0, "in.y[1]": 3.0}),
        (np.array([1.0, 2.0]), {"[0]": 1.0, "[1]": 2.0}),
        (np.array([1.5], np.longdouble), {"[0]": 1.5}),
        (np.array(1.5, np.longdouble), {"": 1.5}),
        (np.array([1.5], np.clongdouble), {}),
        (np.zeros((100, 3)), {}),
    ],
)
def test_numbers_of_a_datum_by_their_place(value, numbers):
    """Flags count as numbers; text, complex numbers and large arrays give none."""
    assert markup.numbers_in(value) == numbers


def test_a_plot_has_a_line_for_each_number_within_its_picture():
    """What is infinite leaves a gap in its line; one sample alone is no plot."""
    samples = [(BEGIN_NS + i, {"a": float(i), "b": math.inf if i == 1 else -1.0}) for i in range(3)]
    picture = markup.plot(samples, wide_px=100, high_px=20)
    assert picture.count("<polyline") == 2
    assert 'points="0.0,13.0 50.0,7.0 100.0,1.0"' in picture
    assert markup.plot(samples[:1]) == ""


def test_a_long_value_is_one_short_line():
    """It is cut with one sign more; an array is named by its shape."""
    text = markup.short_value({"x": list(range(100))})
    assert len(text) == markup.VALUE_SHOWN_MAX + 1
    assert markup.short_value(np.zeros((480, 640))).startswith("array 480 x 640")
