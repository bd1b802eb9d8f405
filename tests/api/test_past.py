"""A world context as it was: one cut, exactly at its stamp, or an error that says what is known."""

import time
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from counted import COUNT, delete, put, value_of
from polling import until

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Position,
    Read,
    Retention,
    Together,
    View,
    ViewEach,
    Write,
)
from enact_dist.core.protocol.messages import TakeView
from enact_dist.errors import (
    ClockSkewError,
    ForgottenError,
    MisuseError,
    NullDatumError,
    UnknownWorldError,
)

pytestmark = pytest.mark.carrier("local", "drawn")

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
FLEETING = Aspect("fleeting", int, Durability.VOLATILE, retention=3)
ARM, LEG = Entity("arm"), Entity("leg")
LEFT, RIGHT = Entity("left/arm"), Entity("right/arm")


def each_of(world, pattern="**", aspect=COUNT):
    request = ViewEach(world, Entities(pattern), aspect)
    return dict(world.view(request)[request])


# ---------------------------------------------------------------- what it shows


def test_context_as_of_a_commit_shows_that_commit_and_none_after(online):
    """Each position gives back what was true right after it."""
    positions = [put(online, ARM, number) for number in range(8)]

    shown = [value_of(online.at(position), ARM) for position in positions]

    assert shown == list(range(8))
    assert value_of(online, ARM) == 7


def test_stamp_just_before_a_commit_shows_the_one_before(online):
    """A stamp is exact to the nanosecond."""
    put(online, ARM, 1)
    second = put(online, ARM, 2)

    before = online.at(Position(second.stamp_ns - 1, second.shard))

    assert value_of(before, ARM) == 1


def test_pattern_of_the_past_has_what_was_deleted_since_and_not_what_came(online):
    """The set of entities is that of then."""
    put(online, ARM, 1)
    then = put(online, LEG, 2)
    delete(online, ARM)
    put(online, Entity("head"), 3)

    past = online.at(then)

    assert each_of(past) == {ARM: 1, LEG: 2}
    assert past.entities() == (ARM, LEG)
    assert [(info.entity, info.version) for info in past.list_slots("a*")] == [(ARM, 1)]
    assert each_of(online) == {LEG: 2, Entity("head"): 3}


def test_what_was_deleted_or_not_yet_set_is_null_with_its_reason(online):
    """A null of the past is known to be one."""
    first = put(online, LEG, 1)
    put(online, ARM, 1)
    gone = delete(online, ARM)
    put(online, ARM, 2)

    with pytest.raises(NullDatumError, match=r"never set"):
        value_of(online.at(first), ARM)
    with pytest.raises(NullDatumError, match=r"deleted"):
        value_of(online.at(gone), ARM)


def test_large_data_of_the_past_are_those_of_then(online):
    """They are fetched by version, and do not push the newest out of what this process knows."""
    clouds = [np.full(50_000, number, np.float64) for number in range(3)]
    positions = [put(online, ARM, cloud, CLOUD) for cloud in clouds]
    assert value_of(online, ARM, CLOUD)[0] == 2.0

    for position, cloud in zip(positions, clouds, strict=True):
        assert np.array_equal(value_of(online.at(position), ARM, CLOUD), cloud)

    assert value_of(online, ARM, CLOUD)[0] == 2.0


def test_moments_are_written_as_dates_and_seconds_too(online):
    """A reading of a clock lies between two commits as it does in time."""
    first = put(online, ARM, 1)
    until(lambda: time.time_ns() // 1000 > first.stamp_ns // 1000)  # a date has whole microseconds
    moment_s, moment = time.time(), datetime.now(UTC)
    put(online, ARM, 2)

    for when in (moment_s, moment, moment.astimezone(timezone(timedelta(hours=5)))):
        assert value_of(online.at(when), ARM) == 1


def test_past_is_seen_inside_a_lock(online):
    """No lock can stand in its way, so nothing is held and waited for."""
    then = put(online, ARM, 1)
    arm = Write(online, ARM, COUNT)

    with Lock(arm) as lock:
        lock[arm] = value_of(online.at(then), ARM) + 10

    assert value_of(online, ARM) == 11


def test_raw_datum_of_the_past_needs_no_type(online):
    """As that of the present."""
    then = put(online, ARM, 1)
    put(online, ARM, 2)

    assert online.at(then).get_untyped(ARM, "count") == 1


# ---------------------------------------------------------------- what it refuses


def test_what_has_left_its_retention_names_the_oldest_known_moment(online, loose):
    """Never the latest value; what is named is known."""
    positions = [put(online, ARM, number, FLEETING) for number in range(4)]
    loose.end()
    positions += [put(online, ARM, number, FLEETING) for number in range(4, 6)]

    with pytest.raises(
        ForgottenError, match=r"older than its retention, .*; everything requested is known from"
    ) as error:
        value_of(online.at(positions[0]), ARM, FLEETING)

    oldest = Position(error.value.oldest_ns, "")
    assert value_of(online.at(oldest), ARM, FLEETING) == 3
    with pytest.raises(ForgottenError):
        each_of(online.at(positions[0]), aspect=FLEETING)
    with pytest.raises(ForgottenError):
        value_of(online.at(Position(oldest.stamp_ns - 1, "")), ARM, FLEETING)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda: time.time() + 30.0, r"lies [\d.]+ s in the future"),
        (lambda: datetime.now(UTC) + timedelta(days=1), r"s in the future"),
        (lambda: datetime.now(UTC).replace(tzinfo=None), r"has no time zone"),
        (lambda: -5.0, r"lies before 1970"),
        (lambda: float("nan"), r"is no moment"),
        (lambda: True, r"is no moment"),
        (lambda: "yesterday", r"is no moment"),
        (lambda: None, r"at\(…\) takes a moment, or stamp_ns"),
    ],
)
def test_what_is_no_moment_of_the_past_is_refused(online, wrong, told):
    """At once, by what is wrong with it."""
    with pytest.raises(MisuseError, match=told):
        online.at(wrong())


def test_position_in_the_future_of_a_shard_is_refused_by_it(online):
    """Nobody can have been given one."""
    put(online, ARM, 1)
    ahead = Position(time.time_ns() + 60_000_000_000, "local")

    with pytest.raises(ClockSkewError, match=r"ahead of the clock of shard"):
        value_of(online.at(ahead), ARM)


def test_past_is_read_only(online):
    """Each refusal says what to do instead."""
    past = online.at(put(online, ARM, 1))

    with pytest.raises(MisuseError, match=r"what was cannot be locked; view it with"):
        Lock(Read(past, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"what was cannot be locked"):
        Lock(Write(past, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"what was cannot be locked"):
        Lock(View(past, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"what was cannot be locked"):
        past.view(Read(past, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"init on .*set it in"):
        past.init(ARM, COUNT, 2)
    with pytest.raises(MisuseError, match=r"watch on .*watch cell.world"):
        past.watch("**")
    assert value_of(online, ARM) == 1


def test_one_view_shows_one_moment(online):
    """Mixed moments would be no cut."""
    first, second = put(online, ARM, 1), put(online, ARM, 2)
    one, other = online.at(first), online.at(second)

    with pytest.raises(MisuseError, match=r"one view shows one moment"):
        online.view(View(one, ARM, COUNT), View(online, LEG, COUNT))
    with pytest.raises(MisuseError, match=r"does not name PastContext"):
        one.view(View(other, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"does not name PastContext"):
        one.view(View(online, ARM, COUNT))
    with pytest.raises(MisuseError, match=r"see an older one with"):
        online.view(Together([View(one, ARM, COUNT), View(one, LEG, COUNT)]))


def test_several_contexts_are_seen_as_of_one_moment(cell, online):
    """The moment makes the cut, not the context."""
    training = cell.world("training")
    put(training, ARM, 10)
    then = put(online, ARM, 1)
    put(training, ARM, 20)
    one, other = View(online.at(then), ARM, COUNT), View(training.at(then), ARM, COUNT)

    snapshot = one.world.view(one, other)

    assert (snapshot[one], snapshot[other]) == (1, 10)


def test_past_of_a_dropped_context_is_gone(cell, online):
    """With its history."""
    what_if = online.fork("what_if")
    past = what_if.at(put(what_if, ARM, 1))

    cell.drop_world("what_if")

    for use in (lambda: value_of(past, ARM), past.list_slots):
        with pytest.raises(UnknownWorldError, match=r"what_if"):
            use()


# ---------------------------------------------------------------- by capture stamp


def test_data_are_shown_by_when_they_were_captured(online):
    """Exactly, or the nearest; of two as near the later one."""
    for second in (10, 20, 30):
        put(online, ARM, second, stamp_ns=second * 10**9)
    put(online, LEG, 7, stamp_ns=21 * 10**9)

    exact = online.at(stamp_ns=20 * 10**9)
    nearest = online.at(stamp_ns=21 * 10**9, nearest=True)
    middle = online.at(stamp_ns=25 * 10**9, nearest=True)

    assert value_of(exact, ARM) == 20
    assert each_of(nearest) == {ARM: 20, LEG: 7}
    assert value_of(middle, ARM) == 30
    assert each_of(exact) == {ARM: 20}
    assert [(info.entity, info.version) for info in exact.list_slots()] == [(ARM, 2)]
    with pytest.raises(NullDatumError, match=r"outside retention"):
        value_of(online.at(stamp_ns=11), ARM)
    assert (exact.at_ns, exact.stamp_ns) == (0, 20 * 10**9)


@pytest.mark.parametrize(
    "wrong",
    [{}, {"nearest": True}, {"stamp_ns": 0}, {"stamp_ns": 1.5}, {"stamp_ns": True}],
)
def test_capture_stamp_that_is_none_is_refused(online, wrong):
    """`nearest` says nothing without one."""
    with pytest.raises(MisuseError, match=r"at\(…\) takes a moment, or stamp_ns"):
        online.at(**wrong)
    with pytest.raises(MisuseError, match=r"at\(…\) takes a moment"):
        online.at(time.time(), stamp_ns=5)


# ---------------------------------------------------------------- over two shards


def test_past_over_shards_is_one_cut_after_a_restart(two_stored):
    """A shard that has restarted answers as of then, or says what it has forgotten."""
    online = two_stored.cell.world("online")
    both = [Write(online, LEFT, COUNT), Write(online, RIGHT, COUNT)]
    positions = []
    for number in range(5):
        with Lock(*both) as lock:
            for request in both:
                lock[request] = number
        positions.append(lock.position)
    two_stored.cell.wait(positions[-1])

    two_stored.stop("right")
    two_stored.start("right")
    shown = [each_of(online.at(position)) for position in positions]

    assert shown == [{LEFT: number, RIGHT: number} for number in range(5)]


def test_making_a_past_context_asks_nobody_and_a_view_asks_each_shard_once(two_shards, monkeypatch):
    """Travelling costs a view: one round trip, to both shards at once."""
    cell, online = two_shards.cell, two_shards.cell.world("online")
    put(online, LEFT, 1)
    then = put(online, RIGHT, 2)
    each_of(online.at(then))  # the aspect is known, the session greeted
    asked = []
    carrier = cell._client.carrier
    inner = carrier.request_all

    def request_all(requests, **options):
        asked.append([type(request) for _, request in requests])
        return inner(requests, **options)

    monkeypatch.setattr(carrier, "request_all", request_all)
    past = online.at(then)
    assert asked == []

    assert each_of(past) == {LEFT: 1, RIGHT: 2}

    assert [kinds for kinds in asked if TakeView in kinds] == [[TakeView, TakeView]]
    assert all(kinds == [TakeView, TakeView] for kinds in asked if kinds[:1] != [_keep_alive()])


def _keep_alive():
    from enact_dist.core.protocol.messages import KeepAlive

    return KeepAlive


def test_retention_of_one_version_leaves_no_past(online, loose):
    """Whoever wants none pays for none."""
    bare = Aspect("bare", int, Durability.VOLATILE, retention=Retention(versions=1))
    first = put(online, ARM, 1, bare)
    loose.end()
    put(online, ARM, 2, bare)
    put(online, ARM, 3, bare)
    loose.end()
    put(online, ARM, 4, bare)

    with pytest.raises(ForgottenError):
        value_of(online.at(first), ARM, bare)
