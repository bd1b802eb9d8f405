"""Grants that stay with a session, between real processes: whatever happens to one, others go on.

A retainer is a process that keeps the grant of the cup.  What a stopped, held or dead one costs
others is measured by `record_property`; what is asserted are events.
"""

import signal
import time

import pytest
from kept_processes import (
    RETAINER,
    Waiting,
    heard,
    slot,
    stopped,
    waiters,
)
from socket_parts import add_one

from enact_dist import Entity, Lock, connect

pytestmark = [pytest.mark.carrier("socket", "zenoh"), pytest.mark.kept_grants]

WAIT_S = 20.0

KEEPS_AND_ADDS = """
keep()
tell("kept")
while hear() == "add":
    add_one()
    tell("added")
"""
HELD_UNUSED = """
keep()
tell("kept")
hold_interpreter()
add_one()
tell("added")
"""
USES = """
keep()
with Lock(write) as lock:
    tell("in")
    hear()
    lock[write] = lock.get(write, 0) + 1
tell("out")
hear()
"""
HELD_IN_USE = """
keep()
with Lock(write) as lock:
    tell("in")
    hold_interpreter()
    lock[write] = lock.get(write, 0) + 1
tell("out")
hear()
"""


@pytest.fixture
def long_leases(lease):
    """What a lease alone frees, it frees after three times as long as the next one waits."""
    lease(3 * WAIT_S)


@pytest.fixture
def short_leases(lease):
    """What stands still loses its lease soon."""
    lease(0.5)


@pytest.fixture
def shard(daemon, endpoint):
    """The shard, in this process."""
    return daemon(endpoint)


@pytest.fixture
def cell(shard, endpoint):
    """A client beside the retainer."""
    with connect(endpoint, actor="next") as opened:
        add_one(opened, Entity("warm"))
        yield opened


def lock_of(cell, actor="retainer"):
    (found,) = [info for info in cell.locks() if info.actor == actor]
    return found


def taken(request):
    """Lock once; return how long that took, in milliseconds."""
    before_s = time.perf_counter()
    with Lock(request, wait_s=WAIT_S):
        return (time.perf_counter() - before_s) * 1e3


# ---------------------------------------------------------------- stopped, held, killed


@pytest.mark.usefixtures("long_leases")
def test_stopped_process_holds_up_nobody_with_a_grant_that_it_does_not_use(
    cell, endpoint, program, record_property
):
    """The grant is revoked while the process is stopped; running again, it asks anew."""
    process = program(RETAINER, endpoint, KEEPS_AND_ADDS)
    heard(process, "kept")
    assert lock_of(cell).state == "kept"

    stopped(process)
    record_property("granted_ms", taken(slot(cell)))
    add_one(cell)
    process.send_signal(signal.SIGCONT)

    process.stdin.write("add\n")
    process.stdin.flush()
    heard(process, "added")
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 2


@pytest.mark.usefixtures("long_leases")
def test_held_interpreter_holds_up_nobody_with_a_grant_that_it_does_not_use(
    cell, endpoint, program, record_property
):
    """A library that keeps the interpreter for long answers no message, and need not."""
    process = program(RETAINER, endpoint, HELD_UNUSED)
    heard(process, "kept")

    record_property("granted_ms", taken(slot(cell)))
    add_one(cell)
    process.stdin.write("\n")
    process.stdin.flush()

    heard(process, "added")
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 2


@pytest.mark.usefixtures("long_leases")
@pytest.mark.parametrize("text", [USES, HELD_IN_USE], ids=["free", "held"])
def test_grant_in_use_lasts_to_the_end_of_its_block_and_no_longer(
    cell, endpoint, program, until, text, record_property
):
    """Who waits has it then, with what the block has written; the process goes on without it."""
    process = program(RETAINER, endpoint, text)
    heard(process, "in")
    waiting = Waiting(slot(cell), wait_s=WAIT_S)
    until(lambda: waiters(cell))
    assert lock_of(cell).state == "recalled"
    assert not waiting.granted.is_set()

    before_s = time.perf_counter()
    process.stdin.write("\n")
    process.stdin.flush()
    waiting.end()
    record_property("granted_ms", (time.perf_counter() - before_s) * 1e3)

    heard(process, "out")
    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 1


@pytest.mark.usefixtures("long_leases")
@pytest.mark.parametrize("text", [KEEPS_AND_ADDS, USES], ids=["unused", "used"])
def test_killed_process_keeps_nobody_waiting(cell, endpoint, program, until, text, record_property):
    """The kernel gives its marks up with it, over either carrier."""
    process = program(RETAINER, endpoint, text)
    process.stdout.readline()
    if text is USES:
        waiting = Waiting(slot(cell), wait_s=WAIT_S)
        until(lambda: waiters(cell))
        before_s = time.perf_counter()
        process.kill()
        waiting.end()
        record_property("granted_ms", (time.perf_counter() - before_s) * 1e3)
    else:
        process.kill()
        record_property("granted_ms", taken(slot(cell)))

    with Lock(slot(cell)) as lock:
        assert lock.get(slot(cell), 0) == 0


@pytest.mark.slow
def test_block_that_outlived_its_lease_shows_nothing_stale_as_good(
    short_leases, cell, endpoint, program
):
    """Stopped for longer than a TTL in a read-only block: it ends as lost, and the next is fresh."""
    text = """
keep(read)
try:
    with Lock(read) as lock:
        lock.get(read, 0)
        tell("in")
        hear()
    tell("good")
except EnactError as error:
    tell(type(error).__name__)
with Lock(read) as lock:
    tell(lock.get(read, 0))
hear()
"""
    process = program(RETAINER, endpoint, text)
    heard(process, "in")
    stopped(process)
    with Lock(slot(cell), wait_s=60.0) as lock:
        lock[slot(cell)] = 7
    process.stdin.write("\n")
    process.stdin.flush()
    process.send_signal(signal.SIGCONT)

    heard(process, "LeaseLostError")
    heard(process, "7")


@pytest.mark.slow
def test_grant_that_outlived_its_lease_is_asked_for_anew(
    short_leases, shard, cell, endpoint, program, until
):
    """As above, stopped between two blocks; the session keeps grants again afterwards."""
    text = """
keep(read)
tell("kept")
hear()
with Lock(read) as lock:
    tell(lock.get(read, 0))
kept.clear()
keep(read)
tell("kept")
hear()
"""
    process = program(RETAINER, endpoint, text)
    heard(process, "kept")
    stopped(process)
    with Lock(slot(cell), wait_s=60.0) as lock:
        lock[slot(cell)] = 7
    sessions = shard.host._shard.state.sessions.by_id
    until(lambda: all(session.actor != "retainer" for session in sessions.copy().values()))
    process.stdin.write("\n\n")
    process.stdin.flush()
    process.send_signal(signal.SIGCONT)

    heard(process, "7")
    heard(process, "kept")


# ---------------------------------------------------------------- forks

FORKS_UNUSED = """
keep()
child = os.fork()
if not child:
    os.read(0, 1)
    os._exit(0)
add_one()
tell("forked")
hear()
"""
FORKS_IN_USE = """
keep()
with Lock(write) as lock:
    child = os.fork()
    if not child:
        try:
            lock.__exit__(None, None, None)
        except EnactError:
            pass
        os.read(0, 1)
        os._exit(0)
    tell("forked")
    signal.sigwait({signal.SIGUSR1})
    lock[write] = 5
tell("out")
hear()
"""


@pytest.mark.slow
@pytest.mark.usefixtures("long_leases")
def test_child_forked_between_two_blocks_holds_nothing(cell, endpoint, program):
    """It lives on; the parent's grant is used, revoked and kept as without it."""
    process = program(RETAINER, endpoint, FORKS_UNUSED)
    heard(process, "forked")

    add_one(cell)

    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == 2
    process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("long_leases")
@pytest.mark.parametrize("killed", [False, True])
def test_child_forked_in_a_block_neither_frees_nor_holds_its_parents_grant(
    cell, endpoint, program, until, killed
):
    """The grant ends with the parent's block, or with the parent."""
    process = program(RETAINER, endpoint, FORKS_IN_USE)
    heard(process, "forked")
    waiting = Waiting(slot(cell), wait_s=WAIT_S)
    until(lambda: waiters(cell))
    assert lock_of(cell).state == "recalled"
    assert not waiting.granted.is_set()

    process.send_signal(signal.SIGKILL if killed else signal.SIGUSR1)
    waiting.end()

    with Lock(slot(cell)) as lock:
        assert lock.get(slot(cell), 0) == (0 if killed else 5)


# ---------------------------------------------------------------- order and sums

READS_IN_A_LOOP = """
keep(read)
with Lock(read):
    tell("in")
    hear()
with Lock(read, wait_s=60.0) as lock:
    tell(lock[read])
while True:
    with Lock(read, wait_s=60.0) as lock:
        lock[read]
"""


@pytest.mark.slow
def test_waiters_behind_a_process_that_locks_in_a_loop_all_get_their_turn(
    cell, endpoint, program, until
):
    """It comes after all that asked before it asked again; they come in their order."""
    with Lock(slot(cell)) as lock:
        lock[slot(cell)] = 0
    process = program(RETAINER, endpoint, READS_IN_A_LOOP)
    heard(process, "in")
    order, request = [], slot(cell)

    class Adding(Waiting):
        def _wait(self):
            with Lock(request, wait_s=60.0) as lock:
                lock[request] += 1
                order.append(self)
            self.granted.set()

    waiting = []
    for number in range(8):
        waiting.append(Adding(request))
        until(lambda number=number: len(waiters(cell)) == number + 1)
    process.stdin.write("\n")
    process.stdin.flush()
    for each in waiting:
        each.end()

    heard(process, "8")
    assert order == waiting


UPDATES = 60
COUNTS = """
for _ in range(int(sys.argv[3])):
    add_one()
tell(cell.statistics().get("grants_used_again", 0))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("count", "retain"), [(2, "1"), (4, "1"), (4, "0")])
def test_processes_that_add_to_one_slot_lose_no_update(
    cell, endpoint, program, monkeypatch, count, retain
):
    """The value is the number of updates that were told as done."""
    monkeypatch.setenv("ENACT_RETAIN", retain)
    processes = [program(RETAINER, endpoint, COUNTS, UPDATES) for _ in range(count)]
    again = []
    for process in processes:
        line = process.stdout.readline()
        assert line, process.stderr.read()
        again.append(int(line))

    with Lock(slot(cell)) as lock:
        assert lock[slot(cell)] == count * UPDATES
    assert retain != "0" or again == [0] * count
