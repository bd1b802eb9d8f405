"""Nobody waits for large data but who asked for them: latencies beside a publication of 100 MB."""

import signal
import threading
import time

import numpy as np
import pytest
from quiet_moments import judge, met_once

from enact_dist import Aspect, Durability, Entity, Lock, Write, connect

pytestmark = [pytest.mark.slow, pytest.mark.timing]

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
COUNT = Aspect("count", int, Durability.VOLATILE)
BYTES = 100_000_000

PUBLISHER = """
import sys
import numpy as np
from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
cloud = Aspect("cloud", np.ndarray, Durability.VOLATILE)
data = np.zeros(100_000_000, np.uint8)
with connect(sys.argv[1]) as cell:
    write = Write(cell.world("online"), Entity("tray"), cloud)
    carrier, begun = cell._client.carrier, 0
    begin = carrier.begin
    def count(*arguments, **options):
        global begun
        begun += 1
        if begun == 20:
            print("go", flush=True)
        return begin(*arguments, **options)
    carrier.begin = count
    while True:
        with Lock(write, wait_s=60.0) as lock:
            lock[write] = data
"""


def latencies_s(cell, count):
    """Return how long whole updates of a number take, sorted, in seconds."""
    write = Write(cell.world("online"), Entity("counter"), COUNT)
    took = []
    for _ in range(count):
        began_s = time.perf_counter()
        with Lock(write) as lock:
            lock[write] = 1
        took.append(time.perf_counter() - began_s)
    return sorted(took)


@pytest.fixture
def far(process, endpoint, monkeypatch, tmp_path):
    """A cell whose clients share no memory with the shard, which has some."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    process(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    with connect(endpoint) as cell:
        yield cell


def publishing(program, endpoint):
    """Start a process that publishes, and return it as soon as it does."""
    publisher = program(PUBLISHER, endpoint)
    assert publisher.stdout.readline() == "go\n"
    return publisher


def test_another_process_that_publishes_delays_nobody(far, program, endpoint):
    """Updates go on while a publication of 100 MB follows the other."""

    def attempt():
        calm = latencies_s(far, 1000)
        publisher = publishing(program, endpoint)
        beside = latencies_s(far, 1000)
        publisher.kill()
        judge(calm, beside, "beside a publisher")

    met_once(attempt)


def test_publisher_that_is_stopped_in_the_midst_delays_nobody(far, program, endpoint):
    """A client that stops while 100 MB are on their way leaves the others as fast as they were."""

    def attempt():
        calm = latencies_s(far, 1000)
        publisher = publishing(program, endpoint)
        publisher.send_signal(signal.SIGSTOP)
        beside = latencies_s(far, 1000)
        publisher.kill()
        judge(calm, beside, "beside a stopped publisher")

    met_once(attempt)


def test_thread_that_publishes_delays_no_other_of_its_process(far):
    """Locks and keep-alives of the process that publishes wait for nothing of it."""
    data = np.zeros(BYTES, np.uint8)
    write = Write(far.world("online"), Entity("tray"), CLOUD)
    published = []

    def publish(over):
        while not over.is_set():
            with Lock(write, wait_s=60.0) as lock:
                lock[write] = data
            published.append(lock.position)

    def attempt():
        calm, over = latencies_s(far, 1000), threading.Event()
        before = far.statistics().get("keep_alives_unanswered", 0)
        thread = threading.Thread(target=publish, args=(over,))
        thread.start()
        try:
            beside = latencies_s(far, 1000)
        finally:
            over.set()
            thread.join()
        judge(calm, beside, "beside a thread that publishes")
        assert far.statistics().get("keep_alives_unanswered", 0) == before

    met_once(attempt)
    assert published
