"""Kept grants at the ends of blocks, sessions and shards: nothing stays behind, nothing is stale."""

import contextlib
import dis
import errno
import fcntl
import os
import sys
import threading
import time

import numpy as np
import pytest
from kept_processes import RETAINER, Waiting, heard, keep, kept_of, slot, used_again
from socket_parts import COUNT, CUP, add_one, counters

from enact_dist import Aspect, Durability, Entity, Lock, Read, Write, connect
from enact_dist.core.protocol.messages import Goodbye
from enact_dist.core.state import tenure
from enact_dist.errors import EnactError
from enact_dist.link.client import kept, locks
from enact_dist.link.memory import payload_client, use_marks
from enact_dist.link.memory.use_marks import ClientPage, page_name
from enact_dist.link.store.store import Store

pytestmark = [pytest.mark.carrier("socket", "zenoh"), pytest.mark.kept_grants]
drawn = pytest.mark.carrier("drawn")
IMAGE = Aspect("image", np.ndarray, Durability.VOLATILE)


@pytest.fixture
def shard(daemon, endpoint):
    """The shard, in this process."""
    return daemon(endpoint)


@pytest.fixture
def two(shard, endpoint):
    """Two clients in this process, each with a session of its own."""
    with connect(endpoint, actor="one") as one, connect(endpoint, actor="other") as other:
        add_one(one)
        add_one(other)
        yield one, other


def pages(shard):
    return [path.name for path in shard._shared.path.glob("uses-*")]


# ---------------------------------------------------------------- what is kept


def test_session_that_locks_again_and_again_keeps_its_grant(two):
    """The third lock of the same data is the last that is asked for."""
    cell, other = two
    keep(cell, slot(cell))
    before = used_again(cell)
    for _ in range(10):
        add_one(cell)

    assert used_again(cell) == before + 10
    assert used_again(other) == 0
    with Lock(slot(other)) as lock:
        assert lock[slot(other)] == 12


@drawn
def test_threads_of_a_process_use_a_kept_grant_in_turns(two):
    """Each lock is of one thread, and no update is lost."""
    cell, other = two
    keep(cell, slot(cell))

    def add():
        for _ in range(100):
            with Lock(slot(cell), wait_s=60.0) as lock:
                lock[slot(cell)] += 1

    threads = [threading.Thread(target=add) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    with Lock(slot(other)) as lock:
        assert lock[slot(other)] == 202


def test_large_data_of_the_session_itself_are_shown_as_it_has_written_them(two):
    """0.9 MB under a kept grant: written, read again, written by another, read again."""
    cell, other = two

    def image(of):
        return Write(of.world("online"), CUP, IMAGE), Read(of.world("online"), CUP, IMAGE)

    (write, read), (theirs, _) = image(cell), image(other)
    for number in range(1, 30):
        mine = write if number % 10 else theirs
        with Lock(mine) as lock:
            if number > 1:
                assert (lock[mine] == number - 1).all()
            lock[mine] = np.full(112_500, number, np.float64)
            assert (lock[mine] == number).all()
        with Lock(write) as lock:
            assert (lock[write] == number).all()
    assert used_again(cell) > 30
    for _ in range(10):
        with Lock(read) as lock:
            assert (lock[read] == 29).all()

    assert used_again(cell) > 35
    assert "payload_fallbacks" not in cell.statistics()


@drawn
@pytest.mark.parametrize("side", ["client", "shard"])
def test_nothing_is_kept_where_it_is_switched_off(daemon, endpoint, monkeypatch, side):
    """ENACT_RETAIN=0 on either side is enough."""
    if side == "shard":
        monkeypatch.setenv("ENACT_RETAIN", "0")
    shard = daemon(endpoint)
    monkeypatch.setenv("ENACT_RETAIN", "1" if side == "shard" else "0")
    with connect(endpoint) as cell:
        for _ in range(6):
            add_one(cell)

        assert kept_of(cell) == {}
        assert cell.locks() == ()
        assert pages(shard) == []
        assert "grants_kept" not in counters(shard)
        assert "pages_of_grants_failed" not in cell.statistics()


@drawn
def test_page_goes_with_its_session(shard, endpoint, two):
    """Nothing of a session stays in the folder, and its grants are free."""
    cell, _ = two
    with connect(endpoint) as third:
        keep(third, slot(third, Entity("plate")))
        assert pages(shard) == [page_name(third._client.core.session)]

    assert pages(shard) == []
    assert cell.locks() == ()


@drawn
def test_grant_that_is_merely_kept_is_no_lost_lock_and_holds_no_context(shard, endpoint, two):
    """Its context can be dropped; the end of its session is no loss, on which alarms look."""
    cell, other = two
    cell.create_world("trial")
    trial = Write(cell.world("trial"), CUP, COUNT)
    keep(cell, trial)

    other.drop_world("trial")

    with connect(endpoint) as third:
        keep(third, slot(third, Entity("plate")))
        third._client.carrier.request("s0", Goodbye(third._client.core.session), timeout_s=30)
    assert [info for info in cell.locks() if info.state != "kept"] == []
    assert not {"leases_expired", "sessions_died", "fenced"} & set(counters(shard))


# ---------------------------------------------------------------- pages that cannot be used


def missing(folder, name):
    os.unlink(name, dir_fd=folder)


def link(folder, name):
    os.rename(name, f"{name}.real", src_dir_fd=folder, dst_dir_fd=folder)
    os.symlink(f"{name}.real", name, dir_fd=folder)


def short(folder, name):
    opened = os.open(name, os.O_RDWR, dir_fd=folder)
    os.ftruncate(opened, 8)
    os.close(opened)


@drawn
@pytest.mark.parametrize("damage", [missing, link, short])
def test_page_that_cannot_be_opened_costs_its_grants_and_nothing_else(
    shard, endpoint, monkeypatch, damage
):
    """It is counted once; all locks are asked for as without it, and the shard bears its end."""

    class Damaged(ClientPage):
        def __init__(self, folder, owner, session):
            damage(folder, page_name(session))
            super().__init__(folder, owner, session)

    monkeypatch.setattr(payload_client, "ClientPage", Damaged)
    with connect(endpoint) as cell:
        for _ in range(6):
            add_one(cell)

        assert kept_of(cell) == {}
        assert cell.statistics()["pages_of_grants_failed"] == 1
        with Lock(slot(cell)) as lock:
            assert lock[slot(cell)] == 6

    with connect(endpoint) as cell:
        add_one(cell)
    assert "grants_kept" not in counters(shard)


NO_LOCKS = """
import errno, fcntl
real = fcntl.fcntl
def refuses(descriptor, command, *arguments):
    if command in (fcntl.F_OFD_SETLK, fcntl.F_OFD_GETLK):
        raise OSError(errno.{error}, "no such locks here")
    return real(descriptor, command, *arguments)
fcntl.fcntl = refuses
"""
ADDS = """
for _ in range(6):
    add_one()
tell(cell.statistics().get("pages_of_grants_failed", 0), len(kept))
hear()
"""


@drawn
@pytest.mark.slow
@pytest.mark.parametrize("error", ["EINVAL", "ENOLCK"])
def test_client_without_such_locks_keeps_nothing(shard, endpoint, program, error):
    """A file system or sandbox without them: all works as without kept grants."""
    process = program(NO_LOCKS.format(error=error) + RETAINER, endpoint, ADDS)

    heard(process, "1 0")
    assert "grants_kept" not in counters(shard)


@drawn
@pytest.mark.slow
def test_shard_without_such_locks_lets_nothing_stay(process, endpoint, shared_root):
    """And leaves no page behind for which there is no use."""
    process(endpoint, first=NO_LOCKS.format(error="EINVAL"))
    with connect(endpoint) as cell:
        for _ in range(6):
            add_one(cell)

        assert kept_of(cell) == {}
        assert list(shared_root.glob("*/uses-*")) == []
        assert "pages_of_grants_failed" not in cell.statistics()


@drawn
def test_grant_is_asked_for_where_its_mark_cannot_be_taken(two, monkeypatch):
    """The kernel has no room for one more lock."""
    cell, other = two
    keep(cell, slot(cell))
    real = fcntl.fcntl

    def refuses(descriptor, command, *arguments):
        if command == fcntl.F_OFD_SETLK:
            raise OSError(errno.ENOLCK, "no locks available")
        return real(descriptor, command, *arguments)

    with monkeypatch.context() as full:
        full.setattr(fcntl, "fcntl", refuses)
        add_one(cell)

    assert cell.statistics()["pages_of_grants_failed"] == 1
    add_one(other)
    add_one(cell)
    assert kept_of(cell) == {}


@drawn
def test_shard_goes_on_where_the_kernel_does_not_say_what_is_marked(shard, two, monkeypatch, until):
    """In doubt a block uses the grant: it is recalled, and over when the shard looks again."""
    cell, other = two
    keep(cell, slot(cell))
    real = fcntl.fcntl

    def refuses(descriptor, command, *arguments):
        if command == fcntl.F_OFD_GETLK:
            raise OSError(errno.EIO, "no answer")
        return real(descriptor, command, *arguments)

    with monkeypatch.context() as doubtful:
        doubtful.setattr(fcntl, "fcntl", refuses)
        waiting = Waiting(slot(other))
        until(lambda: counters(shard).get("grants_recalled"))
        assert not waiting.granted.is_set()
    waiting.end()

    assert shard.host.failure is None


# ---------------------------------------------------------------- what is cut off


LOOKS = {"RESUME", "CALL", "CALL_KW", "CALL_FUNCTION_EX", "JUMP_BACKWARD"}
"""After these instructions the interpreter looks for signals, and after no others."""


def interrupted(act, number):
    """Call `act` and interrupt it the so many-th time that it could be; return whether it could."""
    files = {kept.__file__, locks.__file__, use_marks.__file__}
    left, before = number, {}

    def local(frame, event, _):
        nonlocal left
        if event == "opcode":
            left -= before.get(frame) in LOOKS
            before[frame] = dis.opname[frame.f_code.co_code[frame.f_lasti]]
            if left == 0:
                left = -1
                raise KeyboardInterrupt
        return local

    def called(frame, _event, _argument):
        if frame.f_code.co_filename not in files:
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return local

    sys.settrace(called)
    with contextlib.suppress(KeyboardInterrupt):
        try:
            act()
        finally:
            sys.settrace(None)
    return left < 0


@drawn
@pytest.mark.slow
@pytest.mark.parametrize("writes", [False, True])
def test_lock_that_is_interrupted_anywhere_leaves_no_mark(
    two, monkeypatch, record_property, writes
):
    """Wherever the interpreter looks for signals, in and out; others have the lock soon."""
    monkeypatch.setattr(tenure, "ROW_MAX", tenure.ROW_MIN)
    cell, other = two
    request = slot(cell)

    def use():
        with Lock(request) as lock:
            if writes:
                lock[request] = 1

    number, longest_s = 1, 0.0
    while True:
        if not kept_of(cell):
            keep(cell, request)
        had = interrupted(use, number)
        before_s = time.monotonic()
        with Lock(slot(other), wait_s=20.0):
            longest_s = max(longest_s, time.monotonic() - before_s)
        if not had:
            break
        number += 1
    record_property("longest_s", longest_s)
    assert number > 35
    assert cell._client.core.live_locks() == []


STRUCK = """
from enact_dist.link.memory.use_marks import ClientPage

def strikes(act, *, first):
    def struck(page, number):
        setattr(ClientPage, act.__name__, act)
        if not first:
            act(page, number)
        os.kill(os.getpid(), signal.SIGINT)
        if first:
            act(page, number)
    setattr(ClientPage, act.__name__, struck)

keep()
where = sys.argv[3]
if where == "begin":
    strikes(ClientPage.mark, first=False)
if where == "end":
    strikes(ClientPage.unmark, first=True)
try:
    with Lock(write) as lock:
        if where == "block":
            os.kill(os.getpid(), signal.SIGINT)
            os.read(0, 1)
except KeyboardInterrupt:
    tell("struck")
hear()
add_one()
tell("added")
"""


@drawn
@pytest.mark.slow
@pytest.mark.parametrize("where", ["begin", "block", "end"])
def test_process_that_ctrl_c_strikes_keeps_nobody_waiting(
    shard, endpoint, program, where, record_property
):
    """It lives on and uses nothing; the next lock of others is granted."""
    process = program(RETAINER, endpoint, STRUCK, where)
    heard(process, "struck")
    with connect(endpoint) as cell:
        before_s = time.monotonic()
        add_one(cell)
        record_property("waited_s", time.monotonic() - before_s)

    process.stdin.write("\n")
    process.stdin.flush()
    heard(process, "added")


@drawn
def test_exception_in_a_block_leaves_the_grant_free_for_others(two):
    """And for the next lock of the session, which sees nothing of what was not committed."""
    cell, other = two
    keep(cell, slot(cell))
    with pytest.raises(ZeroDivisionError), Lock(slot(cell)) as lock:
        lock[slot(cell)] = 77
        1 / 0  # noqa: B018
    before = used_again(cell)
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 2
    assert used_again(cell) == before + 1
    add_one(other)


MARKS = """
import os, sys
from enact_dist.link.memory.use_marks import ClientPage
page = ClientPage(os.open(sys.argv[1], os.O_PATH), os.geteuid(), "s")
page.mark(5)
child = os.fork()
if not child:
    page.close()
    os.write(1, b"left\\n")
    os.read(0, 1)
    os._exit(0)
os.read(0, 1)
"""


@pytest.mark.carrier("drawn")
def test_forked_child_that_has_left_its_parents_page_holds_none_of_its_marks(
    program, tmp_path, folder, until
):
    """The marks end with the parent, though the child lives."""
    marks = use_marks.ShardMarks(folder)
    marks.keep("s", 5)
    page = marks._pages["s"]
    process = program(MARKS, folder.path)
    heard(process, "left")
    assert page.locked(5)
    assert page.locked(0)

    process.kill()
    process.wait()

    assert not page.locked(5)
    assert not page.locked(0)
    marks.drop("s")


def test_session_that_ends_while_its_commit_is_on_its_way_to_the_disk_leaves_nothing(
    daemon, endpoint, tmp_path, monkeypatch, until
):
    """Its page is gone before its kept grant is; the shard goes on, and the lock is free."""
    goes_on, write = threading.Event(), Store.write
    goes_on.set()

    def write_when_it_goes_on(store, batch):
        assert goes_on.wait(60)
        write(store, batch)

    monkeypatch.setattr(Store, "write", write_when_it_goes_on)
    shard = daemon(endpoint, folder=tmp_path, durability="durable")
    durable = Aspect("count", int)
    with connect(endpoint) as other:
        one = connect(endpoint)
        request, theirs = (Write(each.world("online"), CUP, durable) for each in (one, other))
        keep(one, request)
        goes_on.clear()

        def commit():
            with contextlib.suppress(EnactError), Lock(request) as lock:
                lock[request] = 5

        committing = threading.Thread(target=commit)
        committing.start()
        tenures = shard.host._shard.state.tenures
        until(lambda: any(each.committing for each in tenures.by_lock.copy().values()))
        one._client.carrier.request("s0", Goodbye(one._client.core.session), timeout_s=30)
        goes_on.set()

        with Lock(theirs, wait_s=60.0) as lock:
            assert lock[theirs] == 5
        one.close()
        committing.join()
        assert shard.host.failure is None
        assert pages(shard) == []
