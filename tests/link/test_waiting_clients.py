"""A client that waits for a shard which stands still does next to nothing; measured in counts."""

import os
import signal

import pytest
from kept_processes import heard

CALLS_MAX = 6
"""In 3 s; it was 20 calls when every pause ended after 0.3 s."""
WAKES_MAX = 40
"""Of all threads in 3 s; it was 115, 38 a second."""
CLIENT = """
import sys, threading
from collections import Counter
from pathlib import Path
from enact_dist import Aspect, Entity, Lock, Write, connect

def wakes():
    count = 0
    for status in Path("/proc/self/task").glob("*/status"):
        for line in status.read_text().splitlines():
            if line.startswith("voluntary_ctxt_switches"):
                count += int(line.split()[1])
    return count

def counted(name):
    method = getattr(client.carrier, name)
    def counting(*arguments, **options):
        calls[name] += 1
        return method(*arguments, **options)
    setattr(client.carrier, name, counting)

def wait_for_lock():
    with Lock(write, wait_s=300.0) as lock:
        lock[write] = 1
    granted.set()

with connect(sys.argv[1], timeout_s=30.0) as cell:
    write = Write(cell.world("online"), Entity("part"), Aspect("number", int))
    with Lock(write, wait_s=30.0) as lock:
        lock[write] = 0
    client, calls, granted = cell._client, Counter(), threading.Event()
    print("locked", flush=True)
    while not client.carrier.away("s0"):
        granted.wait(0.05)
    waiting = threading.Thread(target=wait_for_lock)
    waiting.start()
    while not client.core.live_locks():
        granted.wait(0.05)
    counted("request")
    counted("request_all")
    before = wakes()
    assert not granted.wait(3.0)
    print("waited", wakes() - before, calls.total(), flush=True)
    waiting.join()
    print("granted", flush=True)
"""


@pytest.mark.carrier("socket", "zenoh")
def test_client_of_a_stopped_shard_sleeps_and_is_answered_when_it_goes_on(
    process, endpoint, program
):
    """It makes few calls, wakes few threads, and wakes by itself once the shard is back."""
    shard = process(endpoint)
    client = program(CLIENT, endpoint)
    heard(client, "locked")
    os.kill(shard.pid, signal.SIGSTOP)
    try:
        _, wakes, calls = client.stdout.readline().split()
        assert int(wakes) <= WAKES_MAX
        assert int(calls) <= CALLS_MAX
    finally:
        os.kill(shard.pid, signal.SIGCONT)
    heard(client, "granted")
