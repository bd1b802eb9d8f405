"""Nobody waits for large data but who asked for them: latencies beside a publication of 100 MB."""

import signal
import threading
import time

import numpy as np
import pytest

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


def judge(calm, disturbed, what):
    p99_s, median_s = disturbed[len(disturbed) * 99 // 100], calm[len(calm) // 2]
    print(
        f"{what}: calm p50 {median_s * 1e3:.2f} p99 {calm[len(calm) * 99 // 100] * 1e3:.2f} ms,"
        f" disturbed p50 {disturbed[len(disturbed) // 2] * 1e3:.2f} p99 {p99_s * 1e3:.2f}"
        f" max {disturbed[-1] * 1e3:.2f} ms, n = {len(disturbed)}"
    )
    assert p99_s - median_s < 0.050
    assert disturbed[-1] - median_s < 0.150


@pytest.fixture
def far(process, endpoint, monkeypatch, tmp_path):
    """A cell whose clients share no memory with the shard, which has some."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    process(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    with connect(endpoint) as cell:
        yield cell


def test_another_process_that_publishes_delays_nobody(far, program, endpoint):
    """Updates go on while a publication of 100 MB follows the other."""
    calm = latencies_s(far, 300)
    publisher = program(PUBLISHER, endpoint)
    assert publisher.stdout.readline() == "go\n"

    judge(calm, latencies_s(far, 1500), "beside a publisher")


def test_publisher_that_is_stopped_in_the_midst_delays_nobody(far, program, endpoint):
    """A client that stops while 100 MB are on their way leaves the others as fast as they were."""
    calm = latencies_s(far, 300)
    publisher = program(PUBLISHER, endpoint)
    assert publisher.stdout.readline() == "go\n"
    publisher.send_signal(signal.SIGSTOP)

    judge(calm, latencies_s(far, 3000), "beside a stopped publisher")


def test_thread_that_publishes_delays_no_other_of_its_process(far):
    """Locks and keep-alives of the process that publishes wait for nothing of it."""
    calm = latencies_s(far, 300)
    data, over = np.zeros(BYTES, np.uint8), threading.Event()
    write = Write(far.world("online"), Entity("tray"), CLOUD)
    published = []

    def publish():
        while not over.is_set():
            with Lock(write, wait_s=60.0) as lock:
                lock[write] = data
            published.append(lock.position)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        disturbed = latencies_s(far, 1500)
    finally:
        over.set()
        thread.join()

    judge(calm, disturbed, "beside a thread that publishes")
    assert published
    assert far.statistics().get("keep_alives_unanswered", 0) == 0
