"""A client that waits for a shard which stands still does next to nothing; measured in counts."""

import os
import signal
import threading
from collections import Counter
from pathlib import Path

import pytest

from enact_dist import Aspect, Entity, Lock, Write, connect

QUIET_S = 3.0
CALLS_MAX = 6
"""In so long; it was 20 calls when every pause ended after 0.3 s."""
WAKES_MAX = 40
"""Of all threads in so long; it was 115, 38 a second."""


def wakes():
    """Return how often threads of this process have gone to sleep so far."""
    count = 0
    for status in Path("/proc/self/task").glob("*/status"):
        for line in status.read_text().splitlines():
            if line.startswith("voluntary_ctxt_switches"):
                count += int(line.split()[1])
    return count


@pytest.mark.carrier("socket", "zenoh")
def test_client_of_a_stopped_shard_sleeps_and_is_answered_when_it_goes_on(
    process, endpoint, until, monkeypatch, carrier
):
    """It makes few calls, wakes few threads, and wakes by itself once the shard is back."""
    monkeypatch.setattr("enact_dist.link.socket.line.CONNECT_S", 0.5)  # as in the product
    shard = process(endpoint)
    with connect(endpoint, timeout_s=30.0) as cell:
        write = Write(cell.world("online"), Entity("part"), Aspect("number", int))
        with Lock(write, wait_s=30.0) as lock:
            lock[write] = 0
        client, calls = cell._client, Counter()
        os.kill(shard.pid, signal.SIGSTOP)
        try:
            until(lambda: client.carrier.away("s0"))
            granted = threading.Event()

            def wait_for_lock():
                with Lock(write, wait_s=300.0) as lock:
                    lock[write] = 1
                granted.set()

            waiting = threading.Thread(target=wait_for_lock)
            waiting.start()
            until(client.core.live_locks)
            for name in ("request", "request_all"):
                _count(monkeypatch, client.carrier, name, calls)
            before = wakes()
            assert not granted.wait(QUIET_S)
            assert wakes() - before <= WAKES_MAX
            assert calls.total() <= CALLS_MAX
        finally:
            os.kill(shard.pid, signal.SIGCONT)
        assert granted.wait(30.0)
        waiting.join()


def _count(monkeypatch, carrier, name, calls):
    """Count the calls of one method of a carrier."""
    method = getattr(carrier, name)

    def counting(*arguments, **options):
        calls[name] += 1
        return method(*arguments, **options)

    monkeypatch.setattr(carrier, name, counting)
