"""Where shards expect each other: what they pass on, what they ask, and when it is an alarm."""

import pytest
from shard_bench import ShardBench

from enact_dist.core.protocol.messages import ListPlaces, PlacementMap, Places, Refused, ShardEntry
from enact_dist.core.protocol.records import Call, Compare, Served, ShardReturned
from enact_dist.core.shard.owners import shard_identity
from enact_dist.core.shard.places import PLACE_CHARACTERS_MAX, PLACES_MAX

OURS = (ShardEntry("s0", ("zero",)), ShardEntry("far", ("one",)))


@pytest.fixture
def bench():
    """A shard s0 that expects the shard far at `one`."""
    return ShardBench(placement=PlacementMap(1, OURS, ()))


def say(bench, shard, *places):
    """Let the shard far say where it expects a shard; return what is done about it."""
    message = ListPlaces("far", (ShardEntry(shard, places),))
    now = {"now_ns": bench.now_ns, "wall_ns": bench.wall_ns}
    effects = bench.shard.handle(message, identity=shard_identity("far"), **now)
    return [effect for effect in effects if isinstance(effect, Call | Compare)]


def test_shard_that_comes_into_reach_hears_our_places(bench):
    """It may expect a shard elsewhere, and nobody else would say so."""
    bench.event(ShardReturned("far"))

    assert bench.calls_about_places == [("far", ListPlaces("s0", OURS))]


def test_what_everybody_expects_asks_nobody(bench):
    """A cell as its file says costs one message for each start."""
    assert say(bench, "far", "one") == []


def test_new_place_is_asked_and_passed_on_once(bench):
    """Shards that talk to another one know it then; the second time it is asked, not passed on."""
    compare = Compare("far", ("one", "two"))
    passed = ListPlaces("s0", (*OURS, ShardEntry("far", ("two",))))

    assert say(bench, "far", "two") == [compare, Call("far", passed)]
    assert say(bench, "far", "one") == [compare]
    assert bench.ask(ListPlaces()) == Places(passed.shards)


def test_places_of_others_are_bounded(bench):
    """Neither many, nor long ones, nor those of a shard that the cell has not, stay."""
    assert say(bench, "stray", "two") == []
    assert say(bench, "far", "x" * (PLACE_CHARACTERS_MAX + 1)) == []
    for number in range(3 * PLACES_MAX):
        say(bench, "far", f"at{number}")
    heard = bench.ask(ListPlaces()).shards[len(OURS) :]
    assert [len(entry.endpoints) for entry in heard] == [PLACES_MAX]
    assert say(bench, "far", "last")[1:] == []


def test_only_a_shard_speaks_for_itself(bench):
    """A client may ask; it names no shard."""
    assert isinstance(bench.ask_as("ann@h:1", ListPlaces()), Places)
    refused = bench.ask_as("ann@h:1", ListPlaces("far", OURS))
    assert isinstance(refused, Refused)
    assert refused.code == "permission"


def test_two_daemons_are_an_alarm_once_and_until_one_is_gone(bench):
    """Asked again and again meanwhile, the log has it once; another pair is another alarm."""
    for starts in ((1, 2), (1, 2), (1, 3), (3,), (3,)):
        bench.event(Served("far", starts, f"2 daemons {starts}" if len(starts) > 1 else ""))
    assert [(story.event, story.grave) for story in bench.stories] == [
        ("shard.namesakes", True),
        ("shard.namesakes", True),
        ("shard.alone", False),
    ]
    assert bench.shard.counters["namesakes_found"] == 2
    assert bench.shard.state.doubled == {}


@pytest.mark.parametrize(("starts", "count"), [((1,), "one daemon"), ((), "no daemon")])
def test_end_of_an_alarm_says_no_more_than_was_heard(bench, starts, count):
    """A daemon that does not answer may be there all the same."""
    bench.event(Served("far", (1, 2), "2 daemons"))
    bench.event(Served("far", starts, ""))

    text = bench.stories[-1].text
    assert text == f"{count} answers for shard far now; another one may be stopped or cut off"
