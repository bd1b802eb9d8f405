"""Sets of stamps that are near, and sets that run without some of their data."""

import threading

import pytest

from enact_dist import ActorThread, testing
from enact_dist.access.lock import Lock
from enact_dist.access.together import Together
from enact_dist.actor.actor import Actor
from enact_dist.errors import MisuseError, NullDatumError
from enact_dist.terms import Aspect, Entity, View, World, Write

ONLINE = World("online")
SIDES = [Entity(f"camera/{side}") for side in ("left", "middle", "right")]
LEFT, MIDDLE, RIGHT = SIDES
DEPTH, SUM = Aspect("depth", int), Aspect("sum", int)
BENCH = Entity("bench")
PATIENCE_S = 60.0
MS = 1_000_000


def put(world, entity, stamp_ns, datum=1):
    request = Write(world, entity, DEPTH)
    with Lock(request) as lock:
        lock.put(request, datum, stamp_ns=stamp_ns)


def joining(**options):
    depths_ = Together([View(ONLINE, side, DEPTH) for side in SIDES], by="stamp", **options)

    class Joining(Actor):
        depths = depths_
        sum = Write(ONLINE, BENCH, SUM)
        triggers = (depths,)

        def __init__(self):
            self.seen = []
            self.ran = threading.Semaphore(0)

        def update(self, lock):
            names = [view.entity.name for view in lock.missing]
            self.seen.append((lock[self.depths], lock.stamp_ns(self.depths), names))
            lock[self.sum] = sum(depth or 0 for depth in lock[self.depths])
            self.ran.release()

    return Joining()


@pytest.fixture
def clock():
    return testing.ManualClock()


@pytest.fixture
def manual(clock):
    with testing.worlds("online", clock=clock) as cell:
        yield cell


def test_cameras_without_a_common_clock_make_sets(manual):
    """Each of its data is that of its own stamp; what the set triggers bears the oldest."""
    online, actor = manual.world("online"), joining(within_s=0.02)
    for tick in (100, 200):
        for number, side in enumerate(SIDES):
            put(online, side, (tick + 5 * number) * MS, tick + number)

    assert testing.run_once(actor, manual) == 1
    assert actor.seen == [((200, 201, 202), 200 * MS, [])]
    total = View(online, BENCH, SUM)
    with Lock(total) as lock:
        assert (lock[total], lock.stamp_ns(total)) == (603, 200 * MS)
    bound = Together([View(online, side, DEPTH) for side in SIDES], within_s=0.02)
    shown = online.view(bound)
    assert (shown[bound], shown.captured_ns) == ((200, 201, 202), 200 * MS)
    exact = Together([View(online, side, DEPTH) for side in SIDES])
    with pytest.raises(NullDatumError, match="no capture stamp is common"):
        online.view(exact)


def test_dead_camera_ends_no_sets_where_fewer_are_enough(manual, clock):
    """The set waits for it for a while, by the clock; it is null, and named."""
    online, actor = manual.world("online"), joining(least=2, least_after_s=0.5)
    for side in SIDES:
        put(online, side, 100 * MS, 1)
    assert testing.run_once(actor, manual) == 1
    for side in (LEFT, RIGHT):
        put(online, side, 200 * MS, 2)

    assert testing.run_once(actor, manual) == 0
    clock.advance(0.5)
    assert testing.run_once(actor, manual) == 1
    assert actor.seen == [((1, 1, 1), 100 * MS, []), ((2, None, 2), 200 * MS, ["camera/middle"])]
    bound = Together([View(online, side, DEPTH) for side in SIDES], least=2)
    shown = online.view(bound)
    assert (shown[bound], shown.captured_ns) == ((1, 1, 1), 100 * MS)


@pytest.mark.carrier("local", "socket", "zenoh")
def test_running_actor_goes_on_without_a_dead_camera(cell, online):
    """By its own clock, with nothing else to wake it; its report names what was missing."""
    actor = joining(least=2, least_after_s=0.05)
    with ActorThread(actor, cell, name="join") as thread:
        for side in SIDES:
            put(online, side, 100 * MS)
        assert actor.ran.acquire(timeout=PATIENCE_S)
        for side in (LEFT, RIGHT):
            put(online, side, 200 * MS)
        assert actor.ran.acquire(timeout=PATIENCE_S)
        report = thread.statistics()

    assert actor.seen[1] == ((1, None, 1), 200 * MS, ["camera/middle"])
    assert (report.partial, report.incomplete) == (1, 0)
    assert report.last_partial == "set of stamp 200000000: without online:camera/middle/depth"


def test_set_that_gets_no_stamps_is_told_of_once(cell, online, caplog):
    """By name, in the log and in the report, with what its writer has to do."""
    actor = joining()
    with ActorThread(actor, cell) as thread:
        for side in SIDES:
            put(online, side, 100 * MS)
        assert actor.ran.acquire(timeout=PATIENCE_S)
        for _ in range(2):
            put(online, LEFT, 0)
        for side in SIDES:
            put(online, side, 200 * MS)
        assert actor.ran.acquire(timeout=PATIENCE_S)
        report = thread.statistics()

    told = [line for line in caplog.messages if "comes without a capture stamp" in line]
    assert len(told) == 1
    assert told[0].startswith("online:camera/left/depth comes without a capture stamp, so no set")
    assert (report.unstamped, report.unstamped_from) == (2, "online:camera/left/depth")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"within_s": -1}, "within_s is -1"),
        ({"within_s": float("nan")}, "within_s is nan"),
        ({"within_s": "1"}, "within_s is '1'"),
        ({"least": 0}, "between 1 and 3"),
        ({"least": 4}, "between 1 and 3"),
        ({"least": True}, "between 1 and 3"),
        ({"least_after_s": float("inf")}, "least_after_s is inf"),
    ],
)
def test_set_that_cannot_be_is_refused(options, reason):
    """The message names the argument and its value."""
    with pytest.raises(ValueError, match=reason):
        joining(**options)


def test_only_a_set_misses_data(online):
    """`lock.missing` is of an update that a set triggers."""
    with Lock(View(online, LEFT, DEPTH)) as lock, pytest.raises(MisuseError, match="Together"):
        lock.missing  # noqa: B018
