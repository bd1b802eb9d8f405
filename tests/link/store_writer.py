"""Records to store, what a store holds, and a writer process that can be killed.

As a program: ``python store_writer.py FOLDER`` forks a writer for each seed read from its input;
``python store_writer.py URL SHARD`` writes to a database.  A writer opens the store, prints ``ready PID``, then writes through a store thread as fast as it
goes and prints one line ``GROUP VERSION`` per kept batch; when it was killed, ``ended`` follows.
Each `Persist` sets all slots of a group, one of them large, and the group's outcome to one version.
"""

import os
import random
import sys
import threading
import zlib
from pathlib import Path

from enact_dist.core.protocol.datum import Datum, LockId, Position, Slot
from enact_dist.core.protocol.messages import SlotVersion
from enact_dist.core.protocol.records import OutcomeRecord, Persist, SlotRecord
from enact_dist.link.store.store import open_store, read_store
from enact_dist.link.store.thread import StoreThread
from enact_dist.terms import Durability

GROUPS = 3
SMALL_SLOTS = 4
LARGE_BYTES = 70_000
IN_FLIGHT = 8
KILLED_LEASE_S = 0.3
"""Of a shard in a database whose writers are killed; the next one waits for its end."""


def body_of(name, version, size):
    """Return the bytes that slot `name` has at `version`."""
    return random.Random(zlib.crc32(f"{name} {version}".encode())).randbytes(size)


def slot_record(name, version, *, size=200):
    """Return the state of slot `name` at `version`."""
    datum = Datum(b"encoding", body_of(name, version, size), size, version)
    return SlotRecord(Slot("online", name, "aspect"), version, version * 10, datum, "")


def outcome_record(lane, version, names=("a",)):
    """Return what lane `lane` committed at `version`."""
    versions = tuple(SlotVersion(Slot("online", name, "aspect"), version) for name in names)
    return OutcomeRecord(LockId("session", lane, version), Position(version * 10, "s0"), versions)


def persist(*records, ticket=1, durability=Durability.DURABLE):
    """Return a `Persist` of `records`."""
    return Persist(ticket, records, durability)


def group_names(group):
    """Return the names of a group's slots; the first one is large."""
    return [f"group{group}/{number}" for number in range(SMALL_SLOTS + 1)]


def group_persist(group, version, *, durability):
    """Return what sets all slots of a group to `version`."""
    large, *small = group_names(group)
    records = [slot_record(large, version, size=LARGE_BYTES)]
    records += [slot_record(name, version) for name in small]
    records.append(outcome_record(group, version, [large, *small]))
    return persist(*records, ticket=version * GROUPS + group, durability=durability)


def group_versions(recovered):
    """Return the version of each group, having checked that none is half there."""
    found = {record.slot.entity: record for record in recovered.slots}
    outcomes = {outcome.lock.lane: outcome.lock.seq for outcome in recovered.outcomes}
    versions = []
    for group in range(GROUPS):
        names = group_names(group)
        if names[0] not in found:
            assert not any(name in found for name in names)
            versions.append(0)
            continue
        version = found[names[0]].version
        for name in names:
            datum = found[name].datum
            assert found[name].version == version, f"group {group} is half there"
            assert bytes(datum.body) == body_of(name, version, datum.size)
        assert outcomes[group] == version
        versions.append(version)
    return versions


def contents(recovered):
    """Return what was recovered, the epoch aside, in a form that can be compared."""
    return (
        {record.slot: flat(record) for record in recovered.slots},
        {(outcome.lock.session, outcome.lock.lane): outcome for outcome in recovered.outcomes},
        sorted(record.name for record in recovered.worlds),
        sorted(recovered.aspects),
        sorted((record.session, record.ttl_ns) for record in recovered.sessions),
    )


def flat(record):
    """Return a slot's record with its body as bytes."""
    datum = record.datum
    shown = datum and (datum.encoding, bytes(datum.body), datum.size, datum.stamp_ns)
    return (record.version, record.stamp_ns, shown, record.null_reason, record.volatile)


def reopened(folder, *, unix_s=1):
    """Return what a folder holds when it is opened again."""
    store, recovered = open_store(folder, unix_s=unix_s)
    store.close()
    return recovered


def versions(folder):
    """Return the newest version of each slot of a folder."""
    with read_store(folder) as stored:
        return {record.slot.entity: record.version for record in stored.slots}


def fill(folder, version, *, unix_s=1):
    """Write one version of two slots, one of them large, and close; return the epoch."""
    store, found = open_store(folder, unix_s=unix_s)
    store.write([persist(slot_record("a", version, size=LARGE_BYTES), slot_record("b", version))])
    store.close()
    return found.epoch


def write_until_killed(opened, seed):
    """Write and report until this process ends."""
    rng = random.Random(seed)
    store, recovered = opened()[:2]
    versions = group_versions(recovered)
    free = threading.Semaphore(IN_FLIGHT)

    def report(tickets):
        lines = [f"{ticket % GROUPS} {ticket // GROUPS}\n" for ticket in tickets]
        os.write(1, "".join(lines).encode())
        free.release(len(tickets))

    thread = StoreThread(store, report, lambda failure: os._exit(f"{failure}" != ""))
    os.write(1, f"ready {os.getpid()}\n".encode())
    while True:
        free.acquire()
        group = rng.randrange(GROUPS)
        versions[group] += 1
        durability = rng.choice([Durability.DURABLE, Durability.OS])
        thread.submit(group_persist(group, versions[group], durability=durability))


def write_again_and_again(opened):
    """Fork a writer for each seed of the input and wait for its end."""
    for seed in sys.stdin:
        writer = os.fork()
        if not writer:
            write_until_killed(opened, int(seed))
        os.waitpid(writer, 0)
        os.write(1, b"ended\n")


def opener(place, *shard):
    """Return what opens the store of a folder, or of a shard in a database."""
    if not shard:
        return lambda: open_store(Path(place), unix_s=1)
    sys.path.append(str(Path(__file__).parents[1] / "postgres"))
    from shard_stores import address_of, take

    return lambda: take(address_of(place, *shard, lease_s=KILLED_LEASE_S), patient=True)


if __name__ == "__main__":
    write_again_and_again(opener(*sys.argv[1:]))
