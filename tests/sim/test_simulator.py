"""The simulator itself: one seed is one run, and its judge sees what it should see."""

from __future__ import annotations

from functools import partial
from random import Random

import pytest

from enact_dist.core.protocol.messages import Item, PlacementMap, ShardEntry
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import Persist, SessionRecord
from enact_dist.terms import Access, Durability
from enact_dist.verify.simulation.faults import NONE, drawn
from enact_dist.verify.simulation.hosts.disk import Disk
from enact_dist.verify.simulation.hosts.world import DriftingClock, Host, S, SimulatedWorld
from enact_dist.verify.simulation.judges.history import conflict
from enact_dist.verify.simulation.scenario import Scenario
from enact_dist.verify.simulation.schedule import Schedule
from enact_dist.verify.simulation.work.workload import ENTITIES

R, W, RE, WE, V = (
    Access.READ,
    Access.WRITE,
    Access.READ_EACH,
    Access.WRITE_EACH,
    Access.VIEW,
)


def test_same_seed_gives_the_same_run():
    """A failure can be repeated: the seed decides everything."""
    one, other = Scenario(5), Scenario(5)
    first, second = one.run(), other.run()

    assert first == second
    assert list(one.history.entries) == list(other.history.entries)
    assert [entry.ended_ns for entry in one.history.entries.values()] == [
        entry.ended_ns for entry in other.history.entries.values()
    ]


def test_wire_changes_nothing():
    """Messages mean the same after they have been bytes."""
    direct, encoded = Scenario(6, through_wire=False).run(), Scenario(6).run()

    assert direct == encoded


def test_run_without_faults_loses_nothing():
    """Faults are options: without them nothing is lost, fenced or unknown."""
    tally = Scenario(3, faults=NONE).run().tally

    assert tally["commits"] > 30
    for name in ("lost", "crashes", "pauses", "shard: leases_expired", "told: unknown"):
        assert tally[name] == 0


@pytest.mark.parametrize("ppm", [-10_000, 0, 10_000])
def test_clock_turns_durations_into_true_time(ppm):
    """A clock that is fast or slow agrees with itself."""
    clock = DriftingClock(5, ppm)
    true_ns = clock.true_duration(S)

    assert clock.at(true_ns) - clock.at(0) in range(S, S + 3)


def test_paused_host_handles_afterwards_what_arrived_meanwhile():
    """A pause loses nothing and keeps the order."""
    world = SimulatedWorld(Schedule(0))
    host = Host(world, "h", drift_ppm=0, wall_offset_ns=0)
    seen: list[int] = []
    host.pause(S)
    for number in (1, 2):
        host.receive(lambda number=number: seen.append(number))
    world.run_until(S // 2)
    assert seen == []

    world.run_until(2 * S)

    assert seen == [1, 2]


def test_restarted_host_forgets_what_it_had_planned():
    """A new life knows nothing of the old one's timers."""
    world = SimulatedWorld(Schedule(0))
    host = Host(world, "h", drift_ppm=0, wall_offset_ns=0)
    seen: list[int] = []
    host.later(S, lambda: seen.append(1))
    host.end_life()
    host.up = True
    world.run_until(2 * S)

    assert seen == []


@pytest.mark.parametrize("seed", range(20))
def test_crash_keeps_a_prefix_and_what_was_reported(seed):
    """A disk loses no durable record that it reported, and nothing in the middle."""
    world = SimulatedWorld(Schedule(seed))
    host = Host(world, "h", drift_ppm=0, wall_offset_ns=0)
    disk, done = Disk(world, NONE, "h"), []
    for number in range(1, 9):
        durability = Durability.DURABLE if number % 3 == 0 else Durability.OS
        persist = Persist(number, (SessionRecord(str(number), 1),), durability)
        submit = partial(disk.submit, host, persist, done.append)
        world.after(number * S // 1000, submit)
    luck = Random(seed)
    world.run_until(luck.randrange(12 * S // 1000))
    disk.crash(power_cut=True, luck=luck)

    kept = [persist.ticket for persist in disk.log]
    assert kept == list(range(1, len(kept) + 1))
    assert all(ticket in kept for ticket in done if ticket % 3 == 0)


@pytest.mark.parametrize(
    ("one", "other", "clash"),
    [
        ((R, "a"), (R, "a"), False),
        ((R, "a"), (W, "a"), True),
        ((W, "a"), (W, "b"), False),
        ((V, "a"), (W, "a"), False),
        ((RE, "t/*"), (W, "t/1"), True),
        ((RE, "t/*"), (W, "a"), False),
        ((WE, "t/*"), (RE, "**"), True),
    ],
)
def test_judge_knows_which_locks_conflict(one, other, clash):
    """The judge's own idea of a conflict is the paper's, with readers shared."""
    first, second = ((Item(access, "online", entity, "count"),) for access, entity in (one, other))

    assert conflict(first, second) is conflict(second, first) is clash


@pytest.mark.parametrize("count", [1, 2, 3])
def test_entities_lie_on_every_shard(count):
    """Locks over all shards of a cell occur: entities by twos lie apart, all of them everywhere."""
    shards = tuple(ShardEntry(f"s{index}", ()) for index in range(count))
    homes = [shard_of(entity, PlacementMap(1, shards, ())) for entity in ENTITIES]

    assert set(homes) == {shard.name for shard in shards}
    assert len(set(homes[:2])) == min(count, 2)


def test_drawn_faults_differ_between_seeds():
    """Seeds cover quiet and wild cells."""
    options = {drawn(Random(seed), shards=1) for seed in range(50)}

    assert NONE in options
    assert len(options) > 40
