"""The judge bites where no wrong edit gets: each rule, given evidence that breaks it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from enact_dist.core.client.plan import Phase
from enact_dist.core.protocol.datum import Datum, LockId, Token
from enact_dist.core.protocol.messages import AspectEntry, Refused, Register
from enact_dist.core.protocol.records import Persist, Persisted, PreparedEnded, PreparedRecord, Tick
from enact_dist.terms import Durability
from enact_dist.verify.simulation.faults import NONE
from enact_dist.verify.simulation.hosts.world import S, SimulationError
from enact_dist.verify.simulation.judges.growth import NEWER, NEWER_ENCODING, OLDER
from enact_dist.verify.simulation.judges.history import conflict
from enact_dist.verify.simulation.scenario import Scenario

STRANGER = LockId("stranger", 0, 1)


@pytest.fixture(scope="module")
def ended():
    """A run of one shard that has ended well."""
    scenario = next(
        s for s in (Scenario(seed, faults=NONE) for seed in range(9)) if s.cell.shards == 1
    )
    assert scenario.run().violation == ""
    return scenario


@pytest.fixture
def scene(ended):
    """The scenario with its one shard and the judge's picture of it."""
    host, model = ended.shards["s0"], ended.model
    return ended, host, model, model.pictures["s0"]


def a_slot(picture, aspect):
    return next(slot for slot in picture.chains if slot.aspect == aspect)


def test_i2_version_that_skips_is_seen(scene):
    """Each version is one more than the one before."""
    _, _, model, picture = scene
    slot = a_slot(picture, "count")
    now = picture.now(slot)

    with pytest.raises(SimulationError, match="I2 versions are a chain"):
        model._put_all(STRANGER, {slot: (now.version + 2, now.stamp_ns + 1)}, picture, {})


def test_i4_committed_version_that_is_gone_is_seen(scene):
    """A start without a durable slot that was committed."""
    _, host, model, picture = scene
    slot = a_slot(picture, "count")
    left = host.disk.left(len(host.disk.log))
    left = replace(left, epoch=picture.epoch + 1, slots=[r for r in left.slots if r.slot != slot])

    with pytest.raises(SimulationError, match="I4 committed versions never regress"):
        model.booted(host, left, crashed_at_ns=0)


def test_i5_visible_commit_of_a_released_lock_is_seen(scene):
    """Who was told that nothing is written must never see it written."""
    scenario, _, model, picture = scene
    entry = next(e for e in scenario.history.entries.values() if e.told is Phase.RELEASED)

    with pytest.raises(SimulationError, match="I5 told not committed, then visible"):
        model._put_all(entry.id, {}, picture, {})


def test_i9_abort_of_what_is_applied_is_seen(scene):
    """A lock is committed or aborted, not both."""
    _, _, model, picture = scene
    lock = next(iter(picture.applied))

    with pytest.raises(SimulationError, match="I9 applied and aborted"):
        model._check_persist(Persist(0, (PreparedEnded(lock),), Durability.OS), picture)


def test_i10_and_i17_lock_that_lost_its_tenure_is_seen(scene):
    """What is prepared or in flight keeps its locks."""
    _, host, model, picture = scene
    record = PreparedRecord(STRANGER, Token(1, 1), (), (), (), 0, "s1", Token(1, 1))
    for table, rule in ((picture.prepared, "I10"), (picture.in_flight, "I17")):
        table[STRANGER] = record
        with pytest.raises(SimulationError, match=rule):
            model._locks.judge(host, Tick(), picture)
        del table[STRANGER]


def test_i12_request_without_an_answer_is_seen(scene):
    """At the end nobody waits for anything."""
    scenario, host, _, _ = scene
    host._replies[0] = print

    with pytest.raises(SimulationError, match="I12 nothing is left"):
        scenario._check_quiet()
    del host._replies[0]


def test_i13_grant_past_an_earlier_waiter_is_seen():
    """Somebody waits who came earlier and conflicts, and a later one is granted."""
    scenario = Scenario(7, faults=NONE)
    judge = scenario.model._locks
    looked = []

    def later_grant(host, message, picture):
        tenures = host.shard.state.tenures.by_lock
        waiting = [t for t in tenures.values() if t.token is None and t.lock in picture.arrivals]
        for holder in (t for t in tenures.values() if t.token is not None and not t.bound):
            for waiter in waiting:
                if conflict(holder.items, waiter.items) and holder.lock in picture.granted:
                    # As if the holder had come after the waiter, and been granted just now.
                    picture.arrivals[waiter.lock], picture.newest_token = 0, None
                    picture.granted_ever.pop(holder.lock)
                    del picture.granted[holder.lock]
                    looked.append(holder.lock)
        original(host, message, picture)

    original = judge.judge
    judge.judge = later_grant
    assert scenario.run().rule == "I13 no lock is overtaken"
    assert looked


def test_i14_outcome_of_a_lane_that_never_asked_is_seen(scene):
    """The outcome table has no entries but those of lanes."""
    _, host, model, picture = scene
    session = next(iter(host.shard.state.sessions))
    session.lane(77)

    with pytest.raises(SimulationError, match="I14 one outcome per lane"):
        model._locks.judge(host, Tick(), picture)
    del session.lanes[77]


def test_i16_second_execution_is_seen(scene):
    """A lock is applied once."""
    _, _, model, picture = scene

    with pytest.raises(SimulationError, match="I16 one execution per lock"):
        model._put_all(next(iter(picture.applied)), {}, picture, {})


def test_i19_os_slot_with_a_state_that_never_was_is_seen(scene):
    """Class `os` may fall back to an older state, not to one that was never committed."""
    _, host, model, picture = scene
    slot = a_slot(picture, "note")
    left = host.disk.left(len(host.disk.log))
    slots = [replace(r, version=10**6) if r.slot == slot else r for r in left.slots]

    with pytest.raises(SimulationError, match="I19 only declared losses"):
        model.booted(host, replace(left, epoch=picture.epoch + 1, slots=slots), crashed_at_ns=0)


def test_lost_promise_is_seen(scene):
    """A power cut takes nothing that was promised to another shard."""
    _, _, model, picture = scene
    record = PreparedRecord(STRANGER, Token(1, 1), (), (), (), 0, "s1", Token(1, 1))
    picture.prepared[STRANGER] = record

    with pytest.raises(SimulationError, match="a promise survives"):
        model._check_promises([Persist(1, (record,), Durability.DURABLE)], picture)
    del picture.prepared[STRANGER]


def test_dropped_field_and_refused_newer_writer_are_seen(scene):
    """No older datum replaces a newer one, and a refusal of the newer type is an error."""
    scenario, host, model, picture = scene
    slot = a_slot(picture, "count")
    entry = next(iter(scenario.history.entries.values()))
    older, newer = Datum(b"text", b"1", 1), Datum(NEWER_ENCODING, b"1", 1)
    grown = AspectEntry("count", NEWER, "durable", 6, older=(OLDER,))
    asked = Register("a", (), (grown._replace(older=()),))
    picture.grown["count"] = grown

    with pytest.raises(SimulationError, match="a new field is not dropped"):
        model.growth.committed(entry, slot, newer, older, picture)
    with pytest.raises(SimulationError, match="a writer of the newer type is let in"):
        model.growth._check_refused(host, asked, Refused("datum_type", ""), picture)
    with pytest.raises(SimulationError, match="a newer type stays"):
        model.growth.booted(host, picture)
    picture.grown.clear()


def test_stalled_dispatcher_handles_afterwards_what_came_while_its_disk_went_on():
    """A stall stops the dispatcher alone: the disk writes on, its report waits."""
    scenario = Scenario(7, faults=NONE)
    host = scenario.shards["s0"]
    seen = []

    def stall(host):
        if host.stall(S):
            scenario.world.after(S // 2, look)

    def look():
        kept = host.disk.written == len(host.disk.log)
        seen.append(kept and any(isinstance(message, Persisted) for message, _ in host._inbox))

    host.on_persist = stall
    assert scenario.run().violation == ""
    assert any(seen)
    assert not host._inbox
