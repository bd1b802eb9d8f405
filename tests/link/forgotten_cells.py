"""What tests of forgotten aspects look at in the folders of a stopped cell."""

import os
import signal
import time

from rebalance_cells import POSE, placement
from store_writer import persist

from enact_dist import Aspect, Lock, Write
from enact_dist.core.protocol.messages import AspectEntry
from enact_dist.core.protocol.placement import shard_of
from enact_dist.core.protocol.records import AspectRecord
from enact_dist.link.offline.forgetting import forget
from enact_dist.link.store.store import open_store, read_store

TWO_NAMES = ("left", "right")
TWO = placement(*TWO_NAMES)
NEW_POSE = Aspect("pose", str, POSE.durability, retention=POSE.retention)
NOW_NS = time.time_ns()
GONE = (False, 0, 0)


def of_aspect(folder, name="pose"):
    """Return how much there is of an aspect in a folder: registered, states, kept versions."""
    with read_store(folder) as found:
        states = [one for one in (*found.slots, *found.history) if one.slot.aspect == name]
        kept = [v for record in found.kept for v in record.versions if v.slot.aspect == name]
        return name in {entry.name for entry in found.aspects}, len(states), len(kept)


def rest_of(folder, name="pose"):
    """Return everything else that a folder has."""
    with read_store(folder) as found:
        states = [one for one in (*found.slots, *found.history) if one.slot.aspect != name]
        kept = {
            record.label: {v for v in record.versions if v.slot.aspect != name}
            for record in found.kept
        }
        return (
            {
                (s.slot, s.version): (s.stamp_ns, s.datum and bytes(s.datum.body), s.cause)
                for s in states
            },
            {label: versions for label, versions in kept.items() if versions},
            {entry for entry in found.aspects if entry.name != name},
            set(found.worlds),
            set(found.outcomes),
        )


def put(cells, entity, aspect, datum, where=TWO):
    """Write one datum; return its version."""
    world = cells[shard_of(entity.name, where)].world("online")
    with Lock(write := Write(world, entity, aspect)) as lock:
        lock[write] = datum
    return world.history(entity, aspect)[-1].version


class Killer:
    """Ends its process like kill -9 before the n-th act; counts them."""

    def __init__(self, at):
        self.at, self.acts = at, []

    def found(self, forgotten):
        """Do nothing."""

    def act(self, name):
        """Die, if it is time."""
        self.acts.append(name)
        if len(self.acts) == self.at:
            os.kill(os.getpid(), signal.SIGKILL)


def killed_at(cell, number, *, now_ns=NOW_NS):
    """Forget in a child process that is killed at an act; return whether it was."""
    child = os.fork()
    if not child:
        try:
            forget(cell.folders, ["pose"], now_ns=now_ns, progress=Killer(number))
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def two_stores(tmp_path, **records):
    """Make two folders with these records each; return them."""
    folders = {name: tmp_path / name for name in ("left", "right")}
    for name, folder in folders.items():
        store, _ = open_store(folder, unix_s=1)
        known = AspectRecord(AspectEntry("aspect", "int", "durable", 0))
        store.write([persist(known, *records.get(name, ()))])
        store.close()
    return folders
