"""Rates of a cell are differences of two looks, by the clock of each shard."""

import pytest

from enact_dist import local
from enact_dist.access.snapshot import SlotInfo
from enact_dist.cli.top.tables import TABLES
from enact_dist.core.protocol.datum import Position, Slot
from enact_dist.core.protocol.messages import Survey
from enact_dist.errors import LinkError
from enact_dist.operate.cell_rates import LEASE_NAMES, CellLooks, Looks, pause_s
from enact_dist.terms import Entity
from enact_dist.world.listings import ActorInfo, LockInfo, ShardInfo
from enact_dist.world.look import Look, look_at

T0_S = 1_000.0


def shard(name="left", *, uptime_s, epoch=1, **counters):
    return ShardInfo(
        name, "tcp/h:1", True, epoch, True, uptime_s, sessions=3, counters=counters
    )  # fmt: skip


def away(name="left", problem=""):
    return ShardInfo(name, "tcp/h:1", reachable=False, problem=problem)


def actor(name="camera", session="s1", *, left_s=0.9, shards=("left",), namesakes=(), **report):
    row = {"name": name, "state": "running", **report}
    return ActorInfo(
        name, "host", 7, session, shards, left_s, 1, {"actors": [row]}, namesakes
    )  # fmt: skip


def slots(where="left", **versions):
    """Slots of online:camera/NAME/image, each 0.5 s old at `T0_S`."""
    return {
        Slot("online", f"camera/{name}", "image"): SlotInfo(
            Entity(f"camera/{name}"), "image", version, Position(int((T0_S - 0.5) * 1e9), where),
            1_000, "", where,
        )
        for name, version in versions.items()
    }  # fmt: skip


def test_rates_are_differences_over_the_time_of_the_shard():
    """The clock of the one who looks has no part in it: this look came 7 s late."""
    looks = Looks()
    first = looks.add(Look(T0_S, shards=(shard(uptime_s=10.0, commits=100, bytes_written=0),)))
    then = looks.add(
        Look(T0_S + 9.0, shards=(shard(uptime_s=12.0, commits=150, bytes_written=5_000),))
    )

    assert first.shards[0].commits_hz is None
    assert first.seconds == 0.0
    assert then.seconds == 9.0
    assert then.shards[0].commits_hz == pytest.approx(25.0)
    assert then.shards[0].written_bytes_s == pytest.approx(2_500.0)
    assert then.shards[0].lock_waits_hz == 0.0


def test_shard_that_restarted_counts_from_its_start():
    """Its counters began at 0, so the difference to those before would be below 0."""
    looks = Looks()
    looks.add(Look(T0_S, shards=(shard(uptime_s=900.0, commits=10_000),)))
    then = looks.add(Look(T0_S + 5, shards=(shard(uptime_s=2.0, epoch=2, commits=30),)))

    assert then.shards[0].commits_hz == pytest.approx(15.0)
    assert [(one.name, one.moved) for one in then.counters] == [("commits", 30)]
    assert then.events == ((T0_S + 5, "shard left has restarted"),)


def test_shard_that_is_away_is_named_until_it_is_back():
    """Its rows say so, since when and why; the others have their rates."""
    looks = Looks()
    both = (shard(uptime_s=1.0, commits=0), shard("right", uptime_s=1.0, commits=0))
    looks.add(Look(T0_S, shards=both))
    gone = (away(problem="no route"), shard("right", uptime_s=2.0, commits=7))
    looks.add(Look(T0_S + 1, shards=gone))
    still = looks.add(Look(T0_S + 3, shards=(away(), shard("right", uptime_s=4.0, commits=9))))
    back = looks.add(Look(T0_S + 6, shards=(shard(uptime_s=0.5, epoch=2, commits=1), both[1])))

    assert [one.name for one in still.away] == ["left"]
    assert (still.shards[0].state, still.shards[0].away_s) == ("AWAY", 2.0)
    assert still.shards[1].commits_hz == pytest.approx(1.0)
    assert back.away == ()
    assert back.shards[0].commits_hz == pytest.approx(2.0)
    assert [text for _, text in back.events] == [
        "shard left is away: no route",
        "shard left is back after 5.0 s, restarted",
    ]


def test_same_shard_after_a_cut_has_the_mean_rate_of_that_time():
    """It was only unreachable: what it did meanwhile is in its counters."""
    looks = Looks()
    looks.add(Look(T0_S, shards=(shard(uptime_s=10.0, commits=100),)))
    looks.add(Look(T0_S + 1, shards=(away(),)))
    back = looks.add(Look(T0_S + 4, shards=(shard(uptime_s=14.0, commits=180),)))

    assert back.shards[0].commits_hz == pytest.approx(20.0)
    assert back.events[-1][1] == "shard left is back after 3.0 s"


def test_counters_that_moved_are_told_with_what_to_do():
    """Since the first look; those with a remedy first, and no figure that may fall."""
    looks = Looks()
    at_first = {"commits": 5, "leases_expired": 2, "stalls": 1, "payload_bytes": 10}
    looks.add(Look(T0_S, shards=(shard(uptime_s=1.0, **at_first),)))
    moved = {"commits": 9, "leases_expired": 3, "stalls": 1, "payload_bytes": 99}
    looks.add(Look(T0_S + 1, shards=(shard(uptime_s=2.0, **moved),)))
    then = looks.add(Look(T0_S + 2, shards=(shard(uptime_s=3.0, **moved),)))

    assert [(one.name, one.moved, one.total, one.hz) for one in then.counters] == [
        ("leases_expired", 1, 3, 0.0),
        ("commits", 4, 9, 0.0),
    ]
    assert "enact actor ls" in then.counters[0].remedy


def test_leases_are_counted_by_what_is_left_of_them():
    """A silent session has none left."""
    actors = [actor(f"a{left_s}", f"s{left_s}", left_s=left_s) for left_s in (-3, 0.2, 0.7, 0.9, 5)]
    elsewhere = actor("b", "s", shards=("right",))
    look = Look(T0_S, shards=(shard(uptime_s=1.0),), actors=(*actors, elsewhere))

    assert Looks().add(look).shards[0].leases == dict(zip(LEASE_NAMES, (1, 1, 2, 1), strict=True))


def test_lock_waits_of_a_shard_are_those_of_its_slowest_actor():
    """A silent one reports nothing of now."""
    actors = (
        actor("a", "1", lock_wait_p50_ms=1.0, lock_wait_p99_ms=9.0),
        actor("b", "2", lock_wait_p50_ms=3.0, lock_wait_p99_ms=4.0),
        actor("c", "3", left_s=-1.0, lock_wait_p99_ms=99.0),
        actor("d", "4", shards=("right",), lock_wait_p99_ms=50.0),
    )
    (row,) = Looks().add(Look(T0_S, shards=(shard(uptime_s=1.0),), actors=actors)).shards

    assert (row.lock_wait_p50_ms, row.lock_wait_p99_ms) == (3.0, 9.0)


def test_actor_that_began_anew_is_counted():
    """A new session of its name is a restart; a second one beside it is none."""
    looks = Looks()
    looks.add(Look(T0_S, actors=(actor(session="one", updates=50),)))
    again = looks.add(Look(T0_S + 1, actors=(actor(session="two", updates=1),)))
    twins = (actor(session="two", namesakes=("three",)), actor(session="three", namesakes=("two",)))
    beside = looks.add(Look(T0_S + 2, actors=twins))
    old = (actor(session="two"), actor(session="one", left_s=-5.0))
    lingers = looks.add(Look(T0_S + 3, actors=old))

    assert [one.restarts for one in again.actors] == [1]
    assert {one.restarts for one in beside.actors} == {1}
    assert [(one.state, one.restarts) for one in lingers.actors] == [("running", 1), ("silent", 1)]
    assert lingers.events == ((T0_S + 1, "actor camera has restarted, process 7 on host"),)


def test_actor_row_has_what_it_reports_and_the_age_of_what_it_wrote():
    """Patterns and names of what it declares to write are looked up among the slots."""
    by_name = actor("a", "1", writes=["online:camera/1/image"], updates=3, missed=2, incomplete=1,
                    rate_hz=9.5, update_p50_ms=1.5, update_p99_ms=20.0)  # fmt: skip
    by_pattern = actor("b", "2", writes=("training:x/image", "online:camera/*/image"))
    nothing = actor("c", "3", writes=("online:camera/7/image",))
    no_report = ActorInfo("d", "host", 8, "4", ("left",), 0.5, 0, {"mine": 1})
    look = Look(T0_S, actors=(by_name, by_pattern, nothing, no_report), slots=slots(**{"1": 4}))

    a, b, c, d = Looks().add(look).actors

    assert (a.runs_hz, a.updates, a.missed, a.incomplete) == (9.5, 3, 2, 1)
    assert (a.update_p50_ms, a.update_p99_ms) == (1.5, 20.0)
    assert a.wrote_age_s == b.wrote_age_s == pytest.approx(0.5)
    assert c.wrote_age_s is None
    assert (d.name, d.state, d.runs_hz) == ("d", "connected", None)


def test_actor_is_away_with_all_its_shards():
    """One that a shard still knows is as that shard says, or has gone."""
    looks, infos = Looks(), [actor(rate_hz=10.0), actor("arm", "s2", shards=("left", "right"))]
    right = shard("right", uptime_s=1.0)
    looks.add(Look(T0_S, shards=(shard(uptime_s=1.0), right), actors=(*infos,)))
    gone = [looks.add(Look(T0_S + n, shards=(away(), right), actors=())) for n in (1, 2)]
    back = looks.add(Look(T0_S + 3, shards=(shard(uptime_s=4.0), right), actors=(infos[0],)))

    for rates in gone:
        assert [(one.name, one.state, one.runs_hz) for one in rates.actors] == [
            ("camera", "away", None)
        ]
    assert [(one.name, one.state) for one in back.actors] == [("camera", "running")]


def test_silent_actor_has_no_rate():
    """Its last report describes an earlier time."""
    (row,) = Looks().add(Look(T0_S, actors=(actor(left_s=-2.0, rate_hz=10.0),))).actors

    assert (row.state, row.runs_hz) == ("silent", None)


def test_slots_change_by_their_versions():
    """A slot that was not there before has no rate yet; one of a shard that is away has none."""
    looks = Looks()
    looks.add(Look(T0_S, shards=(shard(uptime_s=1.0),), slots=slots(a=10)))
    looks.add(Look(T0_S, shards=(shard(uptime_s=3.0),), slots=slots(a=30, b=5)))
    then = looks.add(Look(T0_S, shards=(shard(uptime_s=3.5),), slots=slots(a=30, b=7)))

    assert [(one.entity, one.hz, one.bytes_s) for one in then.data] == [
        ("camera/a", 0.0, 0.0),
        ("camera/b", 4.0, 4_000.0),
    ]


def test_look_without_slots_keeps_the_rates_of_the_last_one_with_them():
    """The next one that asks for them is compared with that, over all the time between."""
    looks = Looks()
    looks.add(Look(T0_S, shards=(shard(uptime_s=1.0),), slots=slots(a=10)))
    looks.add(Look(T0_S, shards=(shard(uptime_s=2.0),), slots=slots(a=12)))
    writer = actor(writes=["online:camera/a/image"])
    without = looks.add(Look(T0_S, shards=(shard(uptime_s=4.0),), actors=(writer,), slots=None))
    then = looks.add(Look(T0_S, shards=(shard(uptime_s=7.0),), slots=slots(a=32)))

    assert [(one.version, one.hz) for one in without.data] == [(12, 2.0)]
    assert without.actors[0].wrote_age_s == pytest.approx(0.5)
    assert [(one.version, one.hz) for one in then.data] == [(32, 4.0)]


def test_versions_before_a_restart_are_no_rate_of_the_time_since():
    """A shard goes on with its version numbers, but its uptime begins again."""
    looks = Looks()
    looks.add(Look(T0_S, shards=(shard(uptime_s=900.0),), slots=slots(a=10)))
    restarted = shard(uptime_s=0.5, epoch=2)
    first = looks.add(Look(T0_S + 100, shards=(restarted,), slots=slots(a=510)))
    second = shard(uptime_s=2.5, epoch=2)
    then = looks.add(Look(T0_S + 102, shards=(second,), slots=slots(a=530)))

    assert [one.hz for one in first.data] == [None]
    assert [one.hz for one in then.data] == [10.0]


def test_ages_of_data_are_those_at_the_look_that_showed_them():
    """Between two looks at slots a busy actor does not seem to stand still; titles say when."""
    looks, writer = Looks(), actor(writes=["online:camera/a/image"])
    here = (shard(uptime_s=1.0),)
    now = looks.add(Look(T0_S, shards=here, actors=(writer,), slots=slots(a=10)))
    later = looks.add(Look(T0_S + 30.0, shards=here, actors=(writer,), slots=None))
    actors, data = (one for one in TABLES if one.key in "ad")

    assert later.data_unix_s == T0_S
    assert later.actors[0].wrote_age_s == later.data[0].age_s == pytest.approx(0.5)
    assert (actors.as_of(now), data.as_of(now)) == ("", "")
    assert actors.as_of(later).startswith(", wrote as of ")
    assert data.as_of(later).startswith(", all as of ")


def test_slots_that_a_shard_does_not_list_stay_as_they_were():
    """One event names the shard; its next listing gives the rate over all the time between."""
    looks, writer = Looks(), actor(writes=["online:camera/a/image"])

    def look(after_s, listed, **unlisted):
        both = tuple(shard(name, uptime_s=1.0 + after_s) for name in ("left", "right"))
        return looks.add(
            Look(T0_S + after_s, shards=both, actors=(writer,), slots=listed, unlisted=unlisted)
        )

    look(0.0, slots(a=10) | slots("right", b=5))
    for after_s in (1.0, 2.0):
        cut = look(after_s, slots("right", b=5), left="no answer")
    back = look(4.0, slots(a=30) | slots("right", b=5))

    assert {(one.entity, one.version) for one in cut.data} == {("camera/a", 10), ("camera/b", 5)}
    assert cut.actors[0].wrote_age_s == pytest.approx(0.5)
    text = "shard left does not list its slots, so the last known are shown: no answer"
    assert cut.events == back.events == ((T0_S + 1.0, text),)
    assert [(one.entity, one.hz) for one in back.data] == [("camera/a", 5.0), ("camera/b", 0.0)]


def test_data_of_a_shard_that_is_away_stay_and_say_so():
    """Once it is back, the rate is that of the whole time between."""
    looks, right = Looks(), slots("right", b=5)
    there = looks.add(Look(T0_S, shards=(shard(uptime_s=1.0), shard("right", uptime_s=1.0)),
                           slots=slots(a=10) | right))  # fmt: skip
    gone = looks.add(Look(T0_S + 1, shards=(away(), shard("right", uptime_s=2.0)), slots=right))
    back = looks.add(Look(T0_S + 3, shards=(shard(uptime_s=4.0), shard("right", uptime_s=4.0)),
                          slots=slots(a=16) | right))  # fmt: skip

    def rows(rates):
        return [(one.entity, one.version, one.hz, one.away) for one in rates.data]

    assert [away for *_, away in rows(there)] == [False, False]
    assert rows(gone) == [("camera/a", 10, None, True), ("camera/b", 5, 0.0, False)]
    assert rows(back) == [("camera/a", 16, 2.0, False), ("camera/b", 5, 0.0, False)]


def test_look_names_a_shard_that_does_not_list_its_slots(monkeypatch):
    """It has answered all else, so it is not away."""
    with local(worlds=["online"]) as cell:
        client = type(cell.world("online").session.client)
        call = client.call_once

        def cut(self, calls, **options):
            if any(isinstance(request, Survey) for _, request in calls):
                raise LinkError("cut off")
            return call(self, calls, **options)

        monkeypatch.setattr(client, "call_once", cut)
        look = look_at(cell, Survey((), ("**",), ()))

    assert look.unlisted == {"local": "cut off"}
    assert look.shards[0].reachable
    assert look.slots == {}


def test_slots_of_a_large_cell_are_looked_at_less_often(monkeypatch):
    """All else is looked at each time."""
    asked = []

    def look_at_large(_, survey):
        asked.append(survey is not None)
        took_s = 5.0 if survey is not None else 0.0
        return Look(T0_S, slots={} if took_s else None, slots_took_s=took_s)

    monkeypatch.setattr("enact_dist.operate.cell_rates.look_at", look_at_large)
    looks = CellLooks(None)
    for _ in range(3):
        looks.take()
    looks.take(slots=True)

    assert asked == [True, False, False, True]


def test_looks_at_a_slow_cell_are_rare():
    """They take a tenth of the time at most."""
    assert pause_s(1.0, 0.01) == pytest.approx(0.99)
    assert pause_s(1.0, 0.5) == pytest.approx(4.5)
    assert pause_s(0.1, 0.0) == pytest.approx(0.1)


def test_locks_are_counted_at_their_shard():
    """Held ones and those that wait, apart."""
    held = LockInfo("left", 1, "a", "x", "h", 1, True, "write", 1.0, 0.5, 9.0, ("s",), ())
    waits = LockInfo("left", 2, "b", "y", "h", 2, False, "read", 1.0, 0.5, 9.0, ("s",), (1,))
    other = LockInfo("right", 1, "c", "z", "h", 3, True, "read", 1.0, 0.5, 9.0, ("s",), ())
    (row,) = (
        Looks().add(Look(T0_S, shards=(shard(uptime_s=1.0),), locks=(held, waits, other))).shards
    )

    assert (row.locks_held, row.locks_waiting) == (1, 1)
