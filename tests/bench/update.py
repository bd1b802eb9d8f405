"""The canonical workload: one whole update, beside the floor of the transport in the same run.

    python tests/bench/update.py

An update is lock, read an int, write it, release.  The floor is one raw Zenoh query between two
processes.  Prints median, p99 and the ratio; no arguments needed.
"""

import os
import platform
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import zenoh

from enact_dist import Aspect, Durability, Entity, Lock, Write, connect, local

COUNT = 1000
WARM = 100
ECHO = """
import sys, zenoh
config = zenoh.Config.from_json5(sys.argv[1])
with zenoh.open(config) as session:
    queryable = session.declare_queryable("floor", zenoh.handlers.FifoChannel(1024), complete=True)
    print("ready:", flush=True)
    for query in queryable:
        with query:
            query.reply("floor", b"x" * 64)
"""


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def timed(act):
    """Return the times of many calls in microseconds."""
    for _ in range(WARM):
        act()
    times = []
    for _ in range(COUNT):
        started = time.perf_counter()
        act()
        times.append((time.perf_counter() - started) * 1e6)
    return sorted(times)


def started(arguments):
    """Start a child and wait until it is ready."""
    child = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, text=True)
    for line in child.stdout:
        if line.startswith("ready:"):
            return child
    raise SystemExit("a child ended before it was ready")


def floor_us():
    """Time raw Zenoh queries."""
    port = free_port()
    quiet = '"scouting": {"multicast": {"enabled": false}, "gossip": {"enabled": false}}'
    echo = started(
        [
            "-c",
            ECHO,
            f'{{"mode": "peer", "listen": {{"endpoints": ["tcp/127.0.0.1:{port}"]}}, {quiet}}}',
        ]
    )
    config = f'{{"mode": "peer", "connect": {{"endpoints": ["tcp/127.0.0.1:{port}"]}}, {quiet}}}'
    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        querier = session.declare_querier("floor", consolidation=zenoh.ConsolidationMode.NONE)
        while not querier.matching_status.matching:
            time.sleep(0.01)
        times = timed(lambda: querier.get(payload=b"x" * 64).recv())
    echo.kill()
    echo.communicate()
    return times


def update_us(cell, aspect):
    """Time whole updates of one slot."""
    request = Write(cell.world("online"), Entity("counter"), aspect)

    def update():
        with Lock(request) as lock:
            lock[request] = lock.get(request, 0) + 1

    return timed(update)


def main():
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, n = {COUNT}"
    )
    floor = floor_us()
    rows = [("raw Zenoh query", floor)]
    with tempfile.TemporaryDirectory() as folder:
        port = free_port()
        file = Path(folder) / "cell.toml"
        file.write_text(
            f'name = "bench"\nworlds = ["online"]\ndata_folder = "{folder}/data"\n'
            f'[shards.s0]\nlisten = "tcp/127.0.0.1:{port}"\n'
        )
        shard = started(["-m", "enact_dist.cli.main", "shard", "run", "s0", "--cell", str(file)])
        with connect(file) as cell:
            for durability in (Durability.VOLATILE, Durability.OS, Durability.DURABLE):
                aspect = Aspect(durability.value, int, durability)
                rows.append((f"update over Zenoh, {durability.value}", update_us(cell, aspect)))
        shard.terminate()
        shard.communicate()
    with local(worlds=["online"]) as cell:
        rows.append(("update in the process", update_us(cell, Aspect("count", int))))
    for name, times in rows:
        median = statistics.median(times)
        print(
            f"{name:32} median {median:7.0f} us   p99 {times[int(COUNT * 0.99)]:7.0f} us"
            f"   {median / statistics.median(floor):5.2f} x floor"
        )


if __name__ == "__main__":
    main()
