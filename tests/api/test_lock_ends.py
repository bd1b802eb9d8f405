"""Every way into and out of a lock leaves nothing behind: no grant, no flag, no lane."""

import contextlib
import ctypes
import gc
import signal
import subprocess
import sys
import threading

import pytest

from enact_dist import (
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    ViewEach,
    Write,
    WriteEach,
)
from enact_dist.access import lock
from enact_dist.core.protocol.messages import Acquire, Commit
from enact_dist.errors import (
    CommitUnknownError,
    LeaseLostError,
    LockHeldError,
    LockReleasedError,
    LockTimeoutError,
    MisuseError,
)
from enact_dist.link.client import lanes

pytestmark = pytest.mark.carrier("local", "drawn")

COUNT = Aspect("count", int)
bench, piece = Entity("work_bench"), Entity("work_piece")


class Meddler:
    """Calls `before` and `after` around each request of one kind, once."""

    def __init__(self, inner, kind, *, before=None, after=None):
        self._inner, self._kind = inner, kind
        self._before, self._after = before, after

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def request(self, shard, message, *, timeout_s, **more):
        before = after = None
        if isinstance(message, self._kind):
            before, self._before = self._before, None
            after, self._after = self._after, None
        if before:
            before()
        answer = self._inner.request(shard, message, timeout_s=timeout_s, **more)
        if after:
            after()
        return answer


def meddle(cell, kind, **acts):
    cell._client.carrier = Meddler(cell._client.carrier, kind, **acts)


def interrupt():
    raise KeyboardInterrupt


def assert_nothing_left(cell, online):
    assert [info for info in cell.locks() if info.state != "kept"] == []
    assert cell._client.core.live_locks() == []
    with Lock(Write(online, bench, COUNT), wait_s=0):
        assert cell._client._lanes._made == 1


def in_thread(act):
    thread = threading.Thread(target=act)
    thread.start()
    thread.join()


def hold_elsewhere(request):
    """Hold a lock in another thread; returns the function that ends it."""
    inside, leave = threading.Event(), threading.Event()

    def hold():
        with Lock(request):
            inside.set()
            leave.wait(60)

    holder = threading.Thread(target=hold)
    holder.start()
    inside.wait(60)

    def end():
        leave.set()
        holder.join()

    return end


def test_lock_is_asked_for_once_when_wait_is_zero(online):
    """wait_s=0 takes a free lock, and refuses a taken one at once, naming the holder."""
    count = Write(online, bench, COUNT)
    with Lock(count, wait_s=0) as granted:
        granted[count] = 1
    end = hold_elsewhere(count)
    with pytest.raises(LockTimeoutError, match=r"work_bench/count.*held by"):
        Lock(count, wait_s=0).__enter__()
    end()
    assert online.view(View(online, bench, COUNT))[View(online, bench, COUNT)] == 1


def test_lock_may_wait_for_ever(online):
    """An infinite wait is a wait, no overflow."""
    with Lock(Read(online, bench, COUNT), wait_s=float("inf")) as granted:
        assert granted.valid()


def test_thread_may_lock_again_when_its_lock_was_left_in_another_thread(cell, online):
    """The flag *one lock per thread* follows the lock, wherever its block is left."""
    left = Lock(Write(online, piece, COUNT))
    left.__enter__()
    with pytest.raises(LockHeldError):
        Lock(Read(online, bench, COUNT)).__enter__()
    in_thread(lambda: left.__exit__(None, None, None))
    assert_nothing_left(cell, online)


def test_thread_may_lock_again_when_a_generator_with_its_lock_is_closed_elsewhere(cell, online):
    """A generator suspended inside a block gives its lock back where it is closed."""

    def produce():
        with Lock(Write(online, piece, COUNT)):
            yield 1

    generator = produce()
    next(generator)
    with pytest.raises(LockHeldError):
        Lock(Read(online, bench, COUNT)).__enter__()
    in_thread(generator.close)
    assert_nothing_left(cell, online)


def test_lock_raises_when_left_twice(cell, online):
    """A second exit is a misuse and frees nobody else's lane."""
    left = Lock(Write(online, bench, COUNT))
    left.__enter__()
    left.__exit__(None, None, None)
    with pytest.raises(LockReleasedError, match="cannot be left"):
        left.__exit__(None, None, None)
    assert cell._client._lanes.free == [0]


def test_lock_entered_within_itself_raises_lock_held(online):
    """`with lock: with lock:` is a second lock of the thread, whichever object it is."""
    outer = Lock(Write(online, bench, COUNT))
    with outer, pytest.raises(LockHeldError), outer:
        pass


@pytest.mark.parametrize("acts", [{"before": interrupt}, {"after": interrupt}])
@pytest.mark.parametrize("kind", [Acquire, Commit])
def test_nothing_is_held_when_ctrl_c_strikes_a_call(cell, online, kind, acts):
    """KeyboardInterrupt while a lock is asked for or committed leaves nothing held."""
    count = Write(online, bench, COUNT)
    meddle(cell, kind, **acts)
    with pytest.raises(KeyboardInterrupt), Lock(count) as interrupted:
        interrupted[count] = 1
    assert_nothing_left(cell, online)


def test_nothing_is_held_when_ctrl_c_strikes_after_the_grant(cell, online, monkeypatch):
    """An interrupt between the grant and the block's first line leaves nothing held."""
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(lock, "Readings", lambda *_: interrupt())
        Lock(Write(online, bench, COUNT)).__enter__()
    assert_nothing_left(cell, online)


def test_nothing_is_held_when_ctrl_c_strikes_before_the_commit(cell, online, monkeypatch):
    """An interrupt at the start of a block's end publishes nothing and leaves nothing held."""
    count = Write(online, bench, COUNT)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt), Lock(count) as held:
        held[count] = 1
        patch.setattr(lock.Writing, "by_shard", lambda *_: interrupt())
    assert online.view(View(online, bench, COUNT)).get(View(online, bench, COUNT)) is None
    assert_nothing_left(cell, online)


class Interrupts:
    """As a long computation in C, during which Ctrl-C is pressed: `here[SIGINT]` is no call."""

    __getitem__ = ctypes.PyDLL(None)["raise"]  # `signal.raise_signal` would handle it at once


def test_ctrl_c_that_strikes_before_the_end_of_a_block_begins_leaves_the_thread_usable(
    cell, online
):
    """The thread could never lock again: its lock ran on, and nobody would call `__exit__`."""
    count, here = Write(online, bench, COUNT), Interrupts()
    with pytest.raises(KeyboardInterrupt), Lock(count) as interrupted:
        interrupted[count] = 1
        here[signal.SIGINT]
    assert interrupted.running
    with Lock(count, wait_s=0) as granted:
        assert granted.is_null(count)
    assert not interrupted.running
    assert_nothing_left(cell, online)


@pytest.mark.carrier("local")
def test_shard_in_process_decides_whole_when_ctrl_c_strikes_within(cell, online):
    """Ctrl-C inside the shard's code is raised when the decision is made, never half way."""
    shard = cell._host._shard
    handle = shard.handle

    def struck(message, **arguments):
        if isinstance(message, Acquire):  # the timer's thread comes by here as well
            shard.handle = handle
            signal.raise_signal(signal.SIGINT)
        return handle(message, **arguments)

    shard.handle = struck
    with pytest.raises(KeyboardInterrupt):
        Lock(Write(online, bench, COUNT)).__enter__()
    assert cell._host.failure is None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert_nothing_left(cell, online)


def test_own_exception_stands_when_cell_was_closed_inside_the_block(cell, online):
    """Closing the cell does not hide what the block itself raised."""
    with pytest.raises(ZeroDivisionError), Lock(Write(online, bench, COUNT)):
        cell.close()
        1 / 0  # noqa: B018


def test_block_ends_with_misuse_when_cell_was_closed_inside(cell, online):
    """A commit that was never sent because the cell is closed is no unknown commit."""
    count = Write(online, bench, COUNT)
    with pytest.raises(MisuseError, match="closed"), Lock(count) as held:
        held[count] = 1
        cell.close()
        assert not held.valid()


def test_commit_is_unknown_when_cell_is_closed_before_its_answer(cell, online):
    """A commit that was sent and not answered is told as unknown, whatever came in between."""

    def close():
        cell.close()
        raise MisuseError("the connection is closed")

    count = Write(online, bench, COUNT)
    meddle(cell, Commit, after=close)
    with pytest.raises(CommitUnknownError, match="took effect is unknown"), Lock(count) as held:
        held[count] = 1


def test_lock_stays_valid_in_process_for_as_long_as_it_may_be_held():
    """Where the shard lives in the process, no lease runs out between keep-alives."""
    from enact_dist import testing

    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as cell:
        read = Read(cell.world("online"), bench, COUNT)
        with pytest.raises(LeaseLostError, match="limit of 60 s"), Lock(read, hold_s=60.0) as held:
            clock.advance(30.0)
            assert held.valid()
            clock.advance(31.0)
            assert not held.valid()
            held.check()


def test_lost_lock_tells_the_operators_reason_when_a_keep_alive_shows_it_first(cell, online):
    """The cause is asked of the shard where the keep-alive only showed that the lock is gone."""
    count = Write(online, bench, COUNT)
    with pytest.raises(LeaseLostError, match="robot stands in the way"), Lock(count) as held:
        held[count] = 2
        info = cell.locks()[0]
        cell.break_lock(info.number, shard=info.shard, reason="robot stands in the way")
        cell._client.renew_once()
        assert not held.valid()


def test_waiting_lock_ends_when_its_process_is_told_to_stop(cell, online):
    """An interrupt ends the waiting, says so, and leaves no waiter at the shard."""
    end = hold_elsewhere(Write(online, bench, COUNT))
    stop = threading.Event()
    waiting = Lock(Write(online, bench, COUNT), wait_s=60.0)
    waiting._interrupt = stop
    meddle(cell, Acquire, after=stop.set)
    with pytest.raises(LockTimeoutError, match="interrupted after waiting"):
        waiting.__enter__()
    assert [info.granted for info in cell.locks()] == [True]
    end()


def test_thread_beyond_the_limit_is_refused_by_name(online, monkeypatch):
    """One session serves so many threads at once; one more is told what to do."""
    monkeypatch.setattr(lanes, "LANES_MAX", 1)
    end = hold_elsewhere(Read(online, bench, COUNT))
    with pytest.raises(MisuseError, match=r"1 threads of this process.*several processes"):
        Lock(Read(online, bench, COUNT)).__enter__()
    end()
    with Lock(Read(online, bench, COUNT)):
        pass


def test_lock_refuses_more_requests_and_writes_than_a_frame_carries(online):
    """The limit of a lock is the same in process and over a network, and says what to use."""
    with pytest.raises(MisuseError, match=r"5000 requests.*pattern"):
        Lock(*[Read(online, Entity(f"e/{number}"), COUNT) for number in range(5000)])
    with pytest.raises(MisuseError, match="view with 5000"):
        online.view(*[View(online, Entity(f"e/{number}"), COUNT) for number in range(5000)])
    each = WriteEach(online, Entities("e/*"), COUNT)
    with pytest.raises(MisuseError, match="4096 data"), Lock(each) as held:
        for number in range(5000):
            held[each][Entity(f"e/{number}")] = number


def test_pattern_of_many_entities_is_looped_over_by_the_lock(online):
    """`lock[each][entity]` in a loop is one mapping: 10,000 entities take linear time."""
    each, entities = WriteEach(online, Entities("e/*"), COUNT), []
    for start in range(0, 10_000, 2_500):
        with Lock(each) as held:
            for number in range(start, start + 2_500):
                entities.append(Entity(f"e/{number}"))
                held[each][entities[-1]] = number
    seen = ViewEach(online, Entities("e/*"), COUNT)
    snapshot = online.view(seen)[seen]
    with Lock(each) as held:
        assert sum(held[each][entity] for entity in entities) == sum(range(10_000))
    assert len(snapshot) == 10_000


def test_pattern_shows_what_another_request_of_the_lock_wrote(online):
    """Two requests of one lock that cover one slot show the same datum."""
    each, one = WriteEach(online, Entities("e/*"), COUNT), Write(online, Entity("e/1"), COUNT)
    narrow = WriteEach(online, Entities("e/1*"), COUNT)
    with Lock(each, one, narrow) as held:
        held[one] = 1
        assert held[each][Entity("e/1")] == held[narrow][Entity("e/1")] == 1
        held[each][Entity("e/2")] = 2
        assert set(held[narrow]) == {Entity("e/1")}
        del held[narrow][Entity("e/1")]
        assert Entity("e/1") not in held[each]


FORKED = """
import os, sys
from enact_dist import *
from enact_dist.errors import MisuseError
N, e = Aspect("n", int), Entity("e")
with local(worlds=["a"]) as cell:
    a = cell.world("a")
    request = Write(a, e, N)
    with Lock(request) as lock:
        child = os.fork()
        if not child:
            refused = 0
            for use in (lambda: lock[request], lambda: lock.put(request, 1), lock.check,
                        lambda: a.view(View(a, e, N)), lambda: a.watch("**"), cell.locks,
                        lambda: cell.create_world("b"), cell.worlds, cell.actors,
                        lambda: lock.__exit__(None, None, None)):
                try:
                    use()
                except MisuseError as error:
                    refused += "fork" in str(error)
            cell.close()
            with local(worlds=["a"]) as own, Lock(Write(own.world("a"), e, N)):
                os._exit(refused if not lock.valid() else 100)
        lock[request] = 7
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    print(a.view(View(a, e, N))[View(a, e, N)])
"""


def test_forked_child_is_refused_every_use_and_may_open_its_own_cell():
    """Ten uses of the parent's cell raise MisuseError in a child; its own cell and lock work."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORKED],
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert done.stdout.split() == ["10", "7"], done.stderr


def test_interpreter_ends_when_a_cell_was_never_closed():
    """A cell, a lock and a watch left open do not hang the exit."""
    text = (
        "from enact_dist import *\nimport threading\n"
        "a = local(worlds=['a']).world('a')\n"
        "lock = Lock(Write(a, Entity('e'), Aspect('n', int))); lock.__enter__()\n"
        "watch = threading.Thread(target=local(worlds=['b']).world('b').session.client.subscribe)\n"
        "watch.start(); print('end')"
    )
    done = subprocess.run(
        [sys.executable, "-c", text], capture_output=True, text=True, timeout=180, check=True
    )
    assert (done.stdout, done.stderr) == ("end\n", "")


FOLLOWED = """
import atexit, sys, threading
from enact_dist import *
begun, threads = threading.Event(), []
atexit.register(lambda: threads[0].join(60))  # after the cell's end
cell = local(worlds=["a", "b"])
a, b = cell.world("a"), cell.world("b")
a.init(Entity("e"), Aspect("n", int), 1)
def follow():
    for _ in eval(sys.argv[1]):
        begun.set()
    print("ended")
threads.append(threading.Thread(target=follow, daemon=True))
threads[0].start()
begun.wait(60)
"""


@pytest.mark.parametrize("followed", ["a.watch('**')", "a.watch_diff(b)"])
def test_a_watch_ends_quietly_with_the_interpreter(followed):
    """Its cell is closed by the end of the process, which is no misuse of its thread."""
    done = subprocess.run(
        [sys.executable, "-c", FOLLOWED, followed],
        capture_output=True, text=True, timeout=180, check=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("ended\n", "")


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("request_", [Read, View, Write, ReadEach, ViewEach, WriteEach])
def test_data_of_a_lock_go_with_its_block(cell, online, request_, fails):
    """They wait for no garbage collection, in which 70 images of 0.9 MB would pile up."""
    asked = request_(
        online, Entities("work_*") if request_.__name__.endswith("Each") else bench, COUNT
    )

    def use():
        with contextlib.suppress(KeyError), Lock(asked) as lock:
            data = lock[asked]
            if request_ is Write:
                lock[asked] = data + 1
            elif request_ is WriteEach:
                data[piece] = 1
            if fails:
                raise KeyError

    with Lock(Write(online, bench, COUNT)) as lock:
        lock[Write(online, bench, COUNT)] = 1
    use()  # what is made once
    gc.collect()
    gc.disable()
    try:
        use()
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_pattern_data_kept_beyond_the_block_are_refused(online):
    """What was looked at is gone, and the error says which lock."""
    each = ReadEach(online, Entities("work_*"), COUNT)
    with Lock(Write(online, bench, COUNT)) as lock:
        lock[Write(online, bench, COUNT)] = 1
    with Lock(each) as lock:
        data = lock[each]
        assert data[bench] == 1

    with pytest.raises(LockReleasedError, match=r"Lock\(ReadEach.*outside its `with` block"):
        data[bench]
