"""This project in a harness that times other systems on the same workloads.

    ENACT_PEERS=/folder/of/the/harness python tests/bench/peer_enact.py W1 W6 --quick

The harness (`harness.py` with `Peer`, `Client`, `Item` and `main`) is no part of this repository;
it is imported from the folder that ENACT_PEERS names.  Results go to PEER_RESULTS, the daemon's
files to PEER_RUN; both are folders below the working folder unless given.

  (default)        enact: the fastest carrier, volatile data
  --carrier zenoh  enact-zenoh: the same over Zenoh
  --durable        enact-durable: every commit is forced to the disk before its answer
"""

import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

HARNESS = os.environ.get("ENACT_PEERS")
if not HARNESS:
    sys.exit("peer_enact: name the folder of the harness in ENACT_PEERS")
for variable, folder in (("PEER_RESULTS", "results"), ("PEER_RUN", "run")):
    os.environ.setdefault(variable, str(Path.cwd() / folder))
sys.path.insert(0, HARNESS)

import harness  # noqa: E402
import numpy as np  # noqa: E402

from enact_dist import (  # noqa: E402
    Aspect,
    Durability,
    Entity,
    Lock,
    Read,
    Write,
    connect,
)
from enact_dist.verify.daemons import CellProcesses  # noqa: E402

WAIT_S = 60.0
JOIN_S = 30.0


def entity(name):
    """Return the entity of an item: numbered ones have a pattern in common."""
    return Entity(f"{name.rstrip('0123456789') or 'n'}/{name}")


class Client(harness.Client):
    """One client process."""

    def __init__(self, cfg):
        super().__init__(cfg)
        os.environ["ENACT_CARRIER"] = cfg["carrier"]
        durability = Durability(cfg["durability"])
        self.number = Aspect(f"{durability.value}_number", int, durability)
        self.array = Aspect(f"{durability.value}_array", np.ndarray, durability)
        self.cell = connect(cfg["file"], actor="peer", timeout_s=JOIN_S)
        self.world = self.cell.world("online")
        self.watch = None

    def close(self):
        if self.watch is not None:
            self.watch.close()
        self.cell.close()

    # ---------------------------------------------------------------- numbers

    def put_int(self, key, v):
        write = Write(self.world, entity(key), self.number)
        with Lock(write, wait_s=WAIT_S) as lock:
            lock[write] = v

    def get_int(self, key):
        read = Read(self.world, entity(key), self.number)
        with Lock(read, wait_s=WAIT_S) as lock:
            return lock[read]

    def update(self, key):
        write = Write(self.world, entity(key), self.number)
        with Lock(write, wait_s=WAIT_S) as lock:
            lock[write] = lock[write] + 1

    def multi(self, rkeys, wkeys):
        reads = [Read(self.world, entity(key), self.number) for key in rkeys]
        writes = [Write(self.world, entity(key), self.number) for key in wkeys]
        with Lock(*reads, *writes, wait_s=WAIT_S) as lock:
            for read in reads:
                lock[read]
            for write in writes:
                lock[write] = lock[write] + 1

    # ---------------------------------------------------------------- arrays

    def store(self, item, arr):
        write = Write(self.world, entity(item.name), self.array)
        with Lock(write, wait_s=WAIT_S) as lock:
            lock[write] = arr

    @contextlib.contextmanager
    def fetch(self, item):
        read = Read(self.world, entity(item.name), self.array)
        with Lock(read, wait_s=WAIT_S) as lock:
            yield lock[read]

    @contextlib.contextmanager
    def fetch_many(self, items):
        reads = [Read(self.world, entity(item.name), self.array) for item in items]
        with Lock(*reads, wait_s=WAIT_S) as lock:
            yield [lock[read] for read in reads]

    # ---------------------------------------------------------------- changes

    def subscribe(self, items):
        groups = {entity(item.name).name.partition("/")[0] for item in items}
        (group,) = groups  # the harness names what belongs together alike
        self.names = {entity(item.name): item.name for item in items}
        pattern = f"{group}/*" if len(items) > 1 else entity(items[0].name)
        self.watch = self.world.watch(pattern, self.array)
        while self.watch.next(timeout_s=0.0) is not None:
            pass  # what is there now; the harness asks for changes from here on

    def wait(self, timeout):
        found = []
        change = self.watch.next(timeout_s=timeout)
        while change is not None:
            if change.entity in self.names:
                found.append(self.names[change.entity])
            change = self.watch.next(timeout_s=0.0)
        return found


class Peer(harness.Peer):
    """One shard's daemon."""

    name = "enact"
    caps = dict(  # noqa: C408, RUF012 (as the harness has it)
        lease=1, fencing=1, rw=1, multi="atomic", cross_host=1, zero_copy="same host", notify="push"
    )

    def start(self):
        carrier, durable = self.args.carrier, self.args.durable
        self.name += (f"-{carrier}" if carrier != "auto" else "") + ("-durable" if durable else "")
        self.folder = Path(tempfile.mkdtemp(prefix="enact-peer-", dir=harness.RUN))
        self.processes = CellProcesses(self.folder, ["s0"], pins={}, ttl_s=2.0)
        self.processes.start_shard("s0")
        durability = Durability.DURABLE if durable else Durability.VOLATILE
        self.cfg = {
            "file": str(self.processes.file),
            "carrier": carrier,
            "durability": durability.value,
        }

    def stop(self):
        self.processes.__exit__()
        shutil.rmtree(self.folder)


def options(parser):
    """Add this peer's options to those of the harness."""
    parser.add_argument("--carrier", choices=("auto", "zenoh", "socket"), default="auto")
    parser.add_argument("--durable", action="store_true")


if __name__ == "__main__":
    harness.main(Peer, Client, options)
