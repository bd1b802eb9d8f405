"""What is left of a connection that was closed, and of a cell that was dropped."""

import gc
import itertools
import re
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect, local
from enact_dist.errors import StoreError
from enact_dist.link.client.dropped import when_dropped
from enact_dist.link.client.pauses import Pauses

CYCLES = 50
ROUNDS = 3
"""A leak shows in each round, what the allocator takes ahead does not."""
KEPT_BYTES_MAX = 8_000
"""Most that a cycle may leave; 15,600 stayed before the shard's watch was ended on its own."""


def own_bytes():
    """Return the memory that this process has for itself."""
    _, resident, shared, *_ = map(int, Path("/proc/self/statm").read_text().split())
    return (resident - shared) * 4096


def test_connecting_and_closing_leaves_nothing_behind(process, endpoint):
    """Neither memory, nor objects, threads or descriptors, however often."""
    process(endpoint)

    def cycles(count):
        for _ in range(count):
            connect(endpoint, timeout_s=30.0).close()
        gc.collect()
        return own_bytes(), len(gc.get_objects()), threading.active_count()

    cycles(CYCLES)  # what is made once
    states = [cycles(1), *(cycles(CYCLES) for _ in range(ROUNDS))]

    assert states[-1][2] <= states[0][2]
    assert states[-1][1] - states[0][1] < ROUNDS * CYCLES
    grown = [after[0] - before[0] for before, after in itertools.pairwise(states)]
    assert min(grown) < CYCLES * KEPT_BYTES_MAX


def dropped(users, until):
    """Let nobody refer to what uses a cell; return the warning of that.

    A thread in the middle of a call may be the last that refers to it.
    """
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", ResourceWarning)
        users.clear()
        gc.collect()
        until(lambda: warned)
    (warning,) = warned
    assert warning.category is ResourceWarning
    return str(warning.message)


def test_cell_that_is_dropped_is_closed_and_says_where_it_was_opened(daemon, endpoint, until):
    """Whatever was made by it keeps it; then its session and its threads end."""
    daemon(endpoint)
    before = threading.active_count()
    online = connect(endpoint, timeout_s=30.0).world("online")
    write = Write(online, Entity("part"), Aspect("number", int))
    with Lock(write, wait_s=30.0) as lock:
        lock[write] = 1
    users = [online.watch("part")]
    del online, write, lock
    gc.collect()
    assert users[0].next(30.0).version == 1  # in use still
    assert threading.active_count() > before
    users[0].close()

    assert re.search(rf"opened at {re.escape(__file__)}:\d+", dropped(users, until))
    until(lambda: threading.active_count() <= before)


def test_local_cell_that_is_dropped_lets_go_of_its_folder(tmp_path, until):
    """Another one may open the folder, and finds what was committed."""
    aspect = Aspect("number", int, Durability.OS)
    users = [local(tmp_path, worlds=["online"])]
    users.append(Write(users[0].world("online"), Entity("part"), aspect))
    with Lock(users[1]) as lock:
        lock[users[1]] = 7
    del lock
    assert "dropped without close" in dropped(users, until)

    def opened():
        try:
            return local(tmp_path)
        except StoreError:
            return None

    with until(opened) as cell:
        view = View(cell.world("online"), Entity("part"), aspect)
        assert cell.world("online").view(view)[view] == 7


class _Carrier:
    """A carrier that only says that it was closed."""

    def __init__(self):
        self.closed = threading.Event()

    def request_all(self, calls, timeout_s):
        return []

    def close(self):
        self.closed.set()


class _Client:
    """What `when_dropped` needs of a session."""

    def __init__(self, carrier, core, pauses):
        self.carrier, self.core, self.pauses = carrier, core, pauses


@pytest.mark.filterwarnings("ignore:cell .* was dropped")
def test_session_that_is_dropped_by_a_thread_with_its_locks_is_ended_all_the_same():
    """The garbage collector runs anywhere: in the session's own thread, between two of its steps."""
    carrier, pauses = _Carrier(), Pauses()
    core = SimpleNamespace(session="s", shards_in_use=list)
    used = [_Client(carrier, core, pauses)]
    when_dropped(used[0], "cell", None)

    def collect():
        with pauses._changed:
            used.clear()

    collecting = threading.Thread(target=collect, daemon=True)
    collecting.start()

    assert carrier.closed.wait(30)
    assert pauses.rest(0.0)
    collecting.join(30)
    assert not collecting.is_alive()
