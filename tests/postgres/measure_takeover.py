"""Measures a takeover: kill -9 of a daemon whose shard has many small states; not a test.

PYTHONPATH=.:tests:tests/link python tests/postgres/measure_takeover.py --states 80000 --runs 3
"""

import argparse
import os
import tempfile
import time
from pathlib import Path

import postgres_nodes
from replicated_cell import COUNT, Counting, ReplicatedCell

from enact_dist import Entity, Lock, Write, connect
from enact_dist.link.log import READY, STANDS_BY

AT_ONCE = 1000
SETTLED_S = 20.0
"""How long a standby has to read a shard ahead."""


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--states", type=int, default=80_000)
    parser.add_argument("--runs", type=int, default=1)
    options = parser.parse_args()
    folder = postgres_nodes.make_folder()
    nodes = [postgres_nodes.Node(folder, name) for name in ("first", "second")]
    try:
        nodes[0].init()
        nodes[0].start()
        postgres_nodes.replicate(*nodes)
        with tempfile.TemporaryDirectory() as own:
            cell = ReplicatedCell(Path(own), nodes[0].url, os.environ)
            try:
                measure(cell, options)
            finally:
                cell.end()
    finally:
        for node in reversed(nodes):
            node.close()


def measure(cell, options):
    """Kill the daemon that serves, and print how long no update succeeded."""
    active = cell.start(0)
    fill(cell.file, options.states)
    for run in range(options.runs):
        standby = cell.start((run + 1) % 2, says=STANDS_BY)
        time.sleep(SETTLED_S)
        client = Counting(cell.file, run)
        client.await_after(0.0)
        killed_s = active.kill()
        standby.expect(READY)
        served_s = time.monotonic() - killed_s
        next_s = client.await_after(killed_s + 1.0, 60.0) + 1.0
        load = os.getloadavg()[0]
        print(
            f"{options.states} states: serves after {served_s:.2f} s, next update after"
            f" {next_s:.2f} s (load {load:.1f})",
            flush=True,
        )
        client.end()
        active = standby


def fill(file, states):
    with connect(file, actor="filling", timeout_s=20.0) as cell:
        world = cell.world("online")
        for first in range(0, states, AT_ONCE):
            writes = [
                Write(world, Entity(f"part/{number}"), COUNT)
                for number in range(first, min(first + AT_ONCE, states))
            ]
            with Lock(*writes, wait_s=30.0) as lock:
                for number, write in enumerate(writes):
                    lock[write] = number
    print(f"filled with {states} states", flush=True)


if __name__ == "__main__":
    main()
