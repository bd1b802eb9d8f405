"""What many clients cost while they wait for shards that stand still, and how soon all are answered.

    python tests/bench/waiting_clients.py --clients 200 --processes 20 --seconds 15

Two shards, and clients that take a lock over both, again and again.  Both shards are stopped
(SIGSTOP) for so long, and continued.  Prints one line of JSON: processor time of the clients, in
cores, before, while they wait (in the first 3 s, in which connections are found to be lost, after
these, and over all), and when each of them had its next lock, in seconds after the shards went on.
All but the last are split by the names of threads (those of Python have that of the process) into
cores in user time, cores in system time, and wake-ups per second.  With `--idle` the clients only
keep their sessions.  Goals: 0.1 core for 200 that wait, all answered within 5 s, 0.002 core for one
that is idle.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from enact_dist import Aspect, Entity, Lock, Write, connect
from enact_dist.errors import EnactError
from enact_dist.verify.daemons import CellProcesses, LineProcess

COUNT = Aspect("count", int)
TICKS = os.sysconf("SC_CLK_TCK")
"""Of the kernel's clocks for user and system time in a second."""
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
    time.sleep(seconds_s)  # the time over which it is measured
    return (cpu_s(pids) - before_s) / (time.monotonic() - began_s)


@dataclass
class Use:
    """What a thread has used: seconds of a processor, and how often it woke."""

    user_s: float = 0.0
    system_s: float = 0.0
    wakes: int = 0

    def since(self, before: Use, seconds_s: float) -> list[float]:
        """Return the cores in user and system time and the wake-ups per second since then."""
        user, system = self.user_s - before.user_s, self.system_s - before.system_s
        wakes = self.wakes - before.wakes
        return [figure / seconds_s for figure in (user, system, wakes)]


def used(pids: list[int]) -> dict[int, tuple[str, Use]]:
    """Return what each thread of processes has used, with its name."""
    found = {}
    for task in (task for pid in pids for task in Path(f"/proc/{pid}/task").iterdir()):
        with contextlib.suppress(OSError):  # it has ended
            name, _, fields = (task / "stat").read_text().partition("(")[2].rpartition(")")
            status = (task / "status").read_text().split("\nvoluntary_ctxt_switches:")[1]
            ticks = [int(field) / TICKS for field in fields.split()[11:13]]
            use = Use(ticks[0], ticks[1], int(status.split()[0]))
            found[int(task.name)] = name.rstrip("-0123456789"), use
    return found


def shares(pids: list[int], seconds_s: float) -> tuple[float, dict[str, list[float]]]:
    """Return how many cores processes use for so long, and what their threads do, by name."""
    before, began_s = used(pids), time.monotonic()
    share = cores(pids, seconds_s)
    lasted_s = time.monotonic() - began_s
    by: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0])
    for thread, (name, use) in used(pids).items():
        figures = use.since(before[thread][1] if thread in before else Use(), lasted_s)
        by[name] = [one + more for one, more in zip(by[name], figures, strict=True)]
    return share, {name: [round(one, 4) for one in figures] for name, figures in by.items()}


def started(cell: CellProcesses, arguments: argparse.Namespace) -> list[LineProcess]:
    """Start the shards, and clients that have each had a lock."""
    for name in ("left", "right"):
        cell.start_shard(name)
    each = str(arguments.clients // arguments.processes)
    clients = []
    for number in range(arguments.processes):
        words = [str(number), each, *(["--idle"] if arguments.idle else [])]
        clients.append(cell.start_client(Path(__file__).stem, "--client", *words))
        clients[-1].expect("ready:")
    return clients


def measure(folder: Path, arguments: argparse.Namespace) -> dict[str, object]:
    """Run the cell and its clients; return the figures."""
    here, others = str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (here, others)))  # of the clients
    pins = {"a/**": "left", "b/**": "right"}
    with CellProcesses(folder, ("left", "right"), pins=pins, ttl_s=2.0) as cell:
        clients = started(cell, arguments)
        pids = [one.pid for one in clients]
        cores(pids, LOST_S)  # what the start costs counts for nothing
        before, before_by = shares(pids, 10.0)
        for shard in cell.shards.values():
            shard.signal(signal.SIGSTOP)
        first, first_by = shares(pids, LOST_S)
        waiting, waiting_by = shares(pids, arguments.seconds - LOST_S)
        part = LOST_S / arguments.seconds
        began_s = time.monotonic()
        for shard in cell.shards.values():
            shard.signal(signal.SIGCONT)
        for one in clients:
            one.tell("answered?")
        times_s = sorted(
            at_s - began_s for one in clients for at_s in json.loads(one.expect("answered:"))
        )
    return {
        "clients": len(times_s),
        "before": round(before, 4),
        "before_by": before_by,
        "first": round(first, 4),
        "first_by": first_by,
        "waiting": round(waiting, 4),
        "waiting_by": waiting_by,
        "stopped": round(part * first + (1 - part) * waiting, 4),
        "answered_median_s": round(times_s[len(times_s) // 2], 3),
        "answered_last_s": round(times_s[-1], 3),
    }


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
