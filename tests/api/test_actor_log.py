"""An actor's log of what repeats: the first at once, then counts, and nothing left unsaid."""

import itertools
import logging
import threading

import pytest

from enact_dist.access.sets import Capture, PendingSets
from enact_dist.actor import report
from enact_dist.actor.actor import Actor
from enact_dist.actor.inbox import SetInbox
from enact_dist.actor.report import KINDS_MAX, PAUSE_NS_MAX, PAUSE_NS_MIN, Repeated, kind_of
from enact_dist.actor.running.runner import run_actor
from enact_dist.errors import SHARD_RESTARTED, LeaseLostError
from enact_dist.terms import Aspect, Entity, World, Write
from enact_dist.world.connecting import local


def test_first_is_told_at_once_and_the_others_as_counts():
    """The pauses grow while there is something to count; what counts is told in the end."""
    repeated, told, counted = Repeated(), [], 0
    step_ns = PAUSE_NS_MIN // 5
    for now_ns in range(0, 3 * PAUSE_NS_MAX, step_ns):
        count = repeated.tell("dead", str(now_ns), now_ns)
        if count is not None:
            told.append(now_ns)
            counted += count or 1
    left = repeated.left()

    pauses_ns = [later - one for one, later in itertools.pairwise(told)]
    assert told[0] == 0
    assert pauses_ns[:3] == [PAUSE_NS_MIN, 2 * PAUSE_NS_MIN, 4 * PAUSE_NS_MIN]
    assert max(pauses_ns) == PAUSE_NS_MAX
    assert counted + sum(count for count, _ in left) == 3 * PAUSE_NS_MAX // step_ns
    assert left[0][1] == str(now_ns)
    assert repeated.left() == []


def test_what_comes_seldom_is_told_each_time():
    """A pause is no reason to keep an error of tomorrow back."""
    repeated = Repeated()

    counts = [repeated.tell("seldom", "", k * 2 * PAUSE_NS_MIN) for k in range(5)]

    assert counts == [0, 1, 1, 1, 1]


def test_very_many_kinds_are_counted_together():
    """What never says the same twice must not flood either; quiet kinds make room."""
    repeated = Repeated()
    first = [repeated.tell(k, str(k), 0) for k in range(10 * KINDS_MAX)]

    assert first.count(0) == KINDS_MAX + 1
    assert repeated.left() == [(9 * KINDS_MAX - 1, str(10 * KINDS_MAX - 1))]
    assert repeated.tell("new", "", 2 * PAUSE_NS_MIN) == 0


def error_of(act):
    with pytest.raises(Exception) as caught:
        act()
    return caught.value


def test_errors_differ_by_class_text_and_place():
    """A number in the text makes no other error."""

    def fail(error):
        raise error

    alike = [error_of(lambda k=k: fail(ValueError(f"{k} of 9"))) for k in (1, 22)]
    other = error_of(lambda: fail(ValueError("none of 9")))
    elsewhere = error_of(lambda: int("none"))

    assert kind_of(alike[0]) == kind_of(alike[1])
    assert len({kind_of(error) for error in (alike[0], other, elsewhere)}) == 3


class Failing(Actor):
    """Fails `often` times with one error, then once with another, and is stopped."""

    count = Write(World("online"), Entity("bench"), Aspect("count", int))
    every_s = 0.001

    def __init__(self, often, stop):
        self.often, self.stop_event = often, stop

    def update(self, _lock):
        self.often -= 1
        if self.often >= 0:
            raise ValueError(f"no light, {self.often} tries left")
        self.stop_event.set()
        raise KeyError("no lamp")


def test_update_that_always_fails_is_one_traceback_and_a_count(caplog, monkeypatch):
    """Another error has its own traceback; every failure is in a line."""
    monkeypatch.setattr(report, "PAUSE_NS_MIN", 3_600_000_000_000)
    stop = threading.Event()
    with local(worlds=["online"]) as cell, caplog.at_level(logging.WARNING, "enact.actor"):
        found = run_actor(Failing(7, stop), cell, stop=stop)

    assert found.failures == 8
    assert [bool(line.exc_info) for line in caplog.records] == [True, True, False]
    assert caplog.messages[2] == (
        "Failing: update failed as before 6 more times: ValueError: no light, 0 tries left"
    )


def test_dead_camera_is_one_line_and_a_count(caplog):
    """Sets without another datum are a kind of their own."""
    sets = PendingSets(["a", "b", "c"], entity=Entity("a"), open_max=1)
    inbox = SetInbox(sets)
    with caplog.at_level(logging.WARNING, "enact.actor"):
        for stamp_ns in range(1, 21):
            inbox.captured(0, [Capture(stamp_ns, stamp_ns, stamp_ns, null=False)])
            inbox.captured(1, [Capture(stamp_ns, stamp_ns, stamp_ns, null=False)])
        inbox.captured(0, [Capture(21, 21, 21, null=False)])
        inbox.captured(0, [Capture(22, 22, 22, null=False)])
        inbox.tell_left()

    assert sets.incomplete == 21
    assert [line.split(" of")[0] for line in caplog.messages] == [
        "incomplete set",
        "incomplete set",
        "19 more incomplete sets, the newest a set",
    ]


@pytest.mark.parametrize(
    ("cause", "lines"), [(f"{SHARD_RESTARTED} before the commit arrived", 0), ("lease expired", 1)]
)
def test_a_shard_that_was_started_again_is_no_line_of_an_actor(caplog, cause, lines):
    """The update runs again by itself; what is counted and shown by actor ls is all there is."""

    class Unlucky(Actor):
        count = Write(World("online"), Entity("unlucky"), Aspect("count", int))
        tries = 0

        def update(self, lock):
            self.tries += 1
            if self.tries == 1:
                raise LeaseLostError("lost", cause=cause)
            lock[self.count] = self.tries

    caplog.set_level(logging.INFO, logger="enact.actor")
    with local(worlds=["online"]) as cell:
        statistics = run_actor(Unlucky(), cell, stop=threading.Event())

    assert (statistics.updates, statistics.refused) == (1, 1)
    assert len([line for line in caplog.messages if "refused" in line]) == lines
