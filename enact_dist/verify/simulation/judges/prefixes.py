"""I15: whatever prefix of its log a crash leaves, a shard can start from it and is right.

The run goes on with one prefix only.  Here each one that the crash might leave is tried, in a shard
that then never speaks to anybody.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from enact_dist.core.shard.shard import Shard
from enact_dist.terms import Durability
from enact_dist.verify.simulation.judges.history import conflict

if TYPE_CHECKING:
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.records import Recovered
    from enact_dist.verify.simulation.hosts.shard_host import ShardNode
    from enact_dist.verify.simulation.judges.picture import ShardPicture


def judge_prefixes(
    host: ShardNode, picture: ShardPicture, durabilities: dict[str, Durability], *, power_cut: bool
) -> None:
    """Start a shard from every prefix that this crash may leave, and look at it."""
    for count in host.disk.keepable(power_cut=power_cut):
        left = replace(host.disk.left(count), epoch=host.disk.epoch + 1)
        shard = Shard(host.settings, left, now_ns=0, wall_ns=host.wall_ns)
        if host.asserts:
            shard.assert_invariants()
        host.world.tally["log prefixes replayed"] += 1
        _judge_slots(host, shard, left, picture, durabilities, power_cut=power_cut)
        _judge_outcomes(host, left, durabilities)
        _judge_prepared(host, shard, left)


def _judge_slots(
    host: ShardNode,
    shard: Shard,
    left: Recovered,
    picture: ShardPicture,
    durabilities: dict[str, Durability],
    *,
    power_cut: bool,
) -> None:
    found = {record.slot: record for record in left.slots if not record.volatile}
    for slot, record in found.items():
        content = shard.state.slots[slot]
        if (content.version, content.stamp_ns) != (record.version, record.stamp_ns):
            host.world.violation("I15 recovery is exact", slot, content, record)
    dropped = {r.name for r in left.dropped if r.version_base > picture.bases.get(r.name, 0)}
    for slot in picture.chains:
        if slot.context in dropped:
            continue  # the shard has not told of it yet
        durability = durabilities[slot.aspect]
        kept = durability is Durability.DURABLE or (durability is Durability.OS and not power_cut)
        version = found[slot].version if slot in found else 0
        if kept and version < picture.now(slot).version:
            host.world.violation("I15 no prefix loses", slot, version, picture.now(slot))


def _judge_outcomes(host: ShardNode, left: Recovered, durabilities: dict[str, Durability]) -> None:
    """An outcome that is kept has all that it tells of, unless its context was dropped since."""
    found: dict[Slot, int] = {record.slot: record.version for record in left.slots}
    gone = {record.name: record.version_base for record in left.dropped}

    def dropped(slot: Slot, version: int) -> bool:
        # A restart between commit and drop has let the versions of volatile slots start again.
        volatile = durabilities[slot.aspect] is Durability.VOLATILE
        return slot.context in gone and (volatile or version <= gone[slot.context])

    for outcome in left.outcomes:
        missing = [
            slot
            for slot, version in outcome.versions
            if slot not in found and not dropped(slot, version)
        ]
        kept = {record.slot for record in left.slots if not record.volatile}
        early = [s for s, version in outcome.versions if s in kept and found[s] < version]
        if missing or early:
            host.world.violation("I15 an outcome has its writes", outcome, missing, early)


def _judge_prepared(host: ShardNode, shard: Shard, left: Recovered) -> None:
    """What is prepared holds its locks again, and nothing else does."""
    held = shard.state.tenures.by_lock
    for record in left.prepared:
        tenure = held.get(record.lock)
        if tenure is None or tenure.token != record.token or not tenure.claim.granted:
            host.world.violation("I10 prepared locks are held again", record.lock)
        for other in left.prepared:
            if other is not record and conflict(record.items, other.items):
                host.world.violation("I1 no conflicting grants", record.lock, other.lock)
    if len(held) != len(left.prepared):
        host.world.violation("I15 no lock outlives its epoch unprepared", list(held))
