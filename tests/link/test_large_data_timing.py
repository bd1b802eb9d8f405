"""Nobody waits for large data but who asked for them: latencies beside a publication of 100 MB."""

import contextlib
import signal
import threading
import time
from statistics import median

import numpy as np
import pytest
from latency_rounds import judge

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


def latencies_s(cell):
    """Return how long whole updates of a number take, in seconds."""
    write = Write(cell.world("online"), Entity("counter"), COUNT)
    took = []
    for _ in range(200):
        began_s = time.perf_counter()
        with Lock(write) as lock:
            lock[write] = 1
        took.append(time.perf_counter() - began_s)
    return took


@pytest.fixture
def far(process, endpoint, monkeypatch, tmp_path):
    """A cell whose clients share no memory with the shard, which has some."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    process(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    with connect(endpoint) as cell:
        yield cell


@contextlib.contextmanager
def publishing(program, endpoint, *, stopped=False):
    """A process that publishes, or that was stopped in the midst of it."""
    publisher = program(PUBLISHER, endpoint)
    assert publisher.stdout.readline() == "go\n"
    if stopped:
        publisher.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        publisher.kill()


@pytest.mark.parametrize("stopped", [False, True])
def test_another_process_that_publishes_delays_nobody(far, program, endpoint, stopped):
    """Updates go on while one publication of 100 MB follows the other, or stays half done."""
    judge(
        lambda: latencies_s(far),
        lambda: publishing(program, endpoint, stopped=stopped),
        "beside a stopped publisher" if stopped else "beside a publisher",
    )


def test_thread_that_publishes_delays_no_other_of_its_process(far):
    """Locks and keep-alives of the process that publishes wait for nothing of it."""
    data = np.zeros(BYTES, np.uint8)
    write = Write(far.world("online"), Entity("tray"), CLOUD)
    published, unanswered = [], []

    def publish(over):
        while not over.is_set():
            with Lock(write, wait_s=60.0) as lock:
                lock[write] = data
            published.append(lock.position)

    @contextlib.contextmanager
    def publishing_here():
        over, before = threading.Event(), far.statistics().get("keep_alives_unanswered", 0)
        thread = threading.Thread(target=publish, args=(over,))
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
        unanswered.append(far.statistics().get("keep_alives_unanswered", 0) - before)

    judge(lambda: latencies_s(far), publishing_here, "beside a thread that publishes")
    assert published
    assert median(unanswered) == 0
