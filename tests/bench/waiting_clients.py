"""What many clients cost while they wait for shards that stand still, and how soon all are answered.

    python tests/bench/waiting_clients.py --clients 200 --processes 20 --seconds 15

Two shards, and clients that take a lock over both, again and again.  Both shards are stopped
(SIGSTOP) for so long, and continued.  Prints one line of JSON: processor time of the clients, in
cores, before, while they wait (after the first 3 s, in which connections are found to be lost, and
over all), and when each of them had its next lock, in seconds after the shards went on.  With
`--idle` the clients only keep their sessions.  Goals: 0.1 core for 200 that wait, all answered
within 5 s, 0.002 core for one that is idle.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import EnactError
from enact_dist.verify.daemons import CellProcesses

COUNT = Aspect("count", int)
LOST_S = 3.0
"""By then every connection to a stopped shard counts as lost, with a TTL of 2 s."""


def client(target: str, number: str, sessions: int, *, idle: bool) -> None:
    """Be one process with so many sessions; says when each had a lock after the line it gets."""
    asked, answered = threading.Event(), []
    cells = [connect(target, actor=f"waiting-{number}", timeout_s=60.0) for _ in range(sessions)]

    def work(index: int) -> None:
        world = cells[index].world("online")
        writes = [Write(world, Entity(f"{side}/{number}/{index}"), COUNT) for side in "ab"]
        if idle:
            asked.wait()
        while True:
            late = asked.is_set()
            try:
                with Lock(*writes, wait_s=30.0) as lock:
                    for write in writes:
                        lock[write] = 1
            except EnactError as error:
                print(error, file=sys.stderr, flush=True)
                continue
            if late:
                answered.append(time.monotonic())
                return
            asked.wait(0.5)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(sessions)]
    for thread in threads:
        thread.start()
    print("ready:", flush=True)
    sys.stdin.readline()
    asked.set()
    for thread in threads:
        thread.join()
    print("answered:", json.dumps(answered), flush=True)
    sys.stdin.read()
    for cell in cells:
        cell.close()


def cpu_s(pids: list[int]) -> float:
    """Return the processor time that processes have used, by the kernel's exact clocks."""
    return sum(time.clock_gettime((~pid << 3) | 2) for pid in pids)


def cores(pids: list[int], seconds_s: float) -> float:
    """Return how many cores processes use for so long."""
    before_s, began_s = cpu_s(pids), time.monotonic()
    time.sleep(seconds_s)
    return (cpu_s(pids) - before_s) / (time.monotonic() - began_s)


def measure(folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Run the cell and its clients; return the figures."""
    here, others = str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (here, others)))  # of the clients
    pins = {"a/**": "left", "b/**": "right"}
    with CellProcesses(folder, ("left", "right"), pins=pins, ttl_s=2.0) as cell:
        for name in ("left", "right"):
            cell.start_shard(name)
        each = arguments.clients // arguments.processes
        clients = []
        for number in range(arguments.processes):
            words = [str(number), str(each), *(["--idle"] if arguments.idle else [])]
            clients.append(cell.start_client(Path(__file__).stem, "--client", *words))
            clients[-1].expect("ready:")
        pids = [one.pid for one in clients]
        time.sleep(LOST_S)
        found = {"clients": each * len(clients), "before": cores(pids, 5.0)}
        for shard in cell.shards.values():
            shard.signal(signal.SIGSTOP)
        first = cores(pids, LOST_S)
        found["waiting"] = cores(pids, arguments.seconds - LOST_S)
        part = LOST_S / arguments.seconds
        found["stopped"] = part * first + (1 - part) * found["waiting"]
        began_s = time.monotonic()
        for shard in cell.shards.values():
            shard.signal(signal.SIGCONT)
        for one in clients:
            one.tell("answered?")
        times_s = sorted(
            at_s - began_s for one in clients for at_s in json.loads(one.expect("answered:"))
        )
        found["answered_median_s"] = times_s[len(times_s) // 2]
        found["answered_last_s"] = times_s[-1]
    return {name: round(figure, 4) for name, figure in found.items()}


def main() -> None:
    """Measure, or be one of the clients."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--processes", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--idle", action="store_true")
    if sys.argv[2:3] == ["--client"]:
        target, _, number, sessions, *more = sys.argv[1:]
        client(target, number, int(sessions), idle=bool(more))
        return
    with tempfile.TemporaryDirectory(prefix="enact-waiting-") as folder:
        print(json.dumps(measure(Path(folder), parser.parse_args())))


if __name__ == "__main__":
    main()
