"""Who is at the other end of a socket, and what its death proves."""

import os
import socket
import threading

import pytest
from socket_parts import COUNT, CUP, add_one, counters

from enact_dist import Entity, Lock, Write, connect
from enact_dist.errors import LinkError
from enact_dist.link.socket import peers as socket_peers
from enact_dist.link.socket.peers import Deaths, check_peer, peer_of

pytestmark = pytest.mark.carrier("socket")


def test_peer_of_another_user_is_refused_by_name():
    """The kernel says who is there; a stranger is named."""
    near, far = socket.socketpair()

    assert peer_of(near).pid == os.getpid()
    assert check_peer(near, users=frozenset((os.geteuid(),)), group=None).user == os.geteuid()
    assert check_peer(near, users=frozenset(), group=os.getegid()).group == os.getegid()
    with pytest.raises(LinkError, match=f"process {os.getpid()} of user {os.geteuid()}"):
        check_peer(near, users=frozenset((123_456,)), group=123_457)
    near.close()
    far.close()


# ---------------------------------------------------------------- death

HOLDER = """
import os, sys, threading
from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
from enact_dist.world import connecting
connecting.TTL_S = float(os.environ.get("LEASE_S", connecting.TTL_S))
cell = connect(sys.argv[1], actor="holder")
request = Write(cell.world("online"), Entity("cup"), Aspect("count", int, Durability.VOLATILE))
with Lock(request) as lock:
    assert cell._client.carrier.transport_of("s0") == sys.argv[2], cell._client.carrier.transport_of("s0")
    exec(sys.argv[3])
    print("held", flush=True)
    sys.stdin.readline()
    lock[request] = 7
print("done", flush=True)
"""
FORKS = """
child = os.fork()
if child == 0:
    os.read(0, 1)
    os._exit(0)
print(child, flush=True)
"""
FORKS_AND_CHILD_ENDS = """
child = os.fork()
if child == 0:
    os._exit(0)
os.waitpid(child, 0)
"""
CLOSES_ALL_SOCKETS = """
for name in os.listdir("/proc/self/fd"):
    try:
        if "socket" in os.readlink(f"/proc/self/fd/{name}") and int(name) > 2:
            with open(f"/proc/self/net/unix") as file:
                inode = os.readlink(f"/proc/self/fd/{name}")[8:-1]
                if any(line.split()[6] == inode for line in file):
                    os.close(int(name))
    except OSError:
        pass
"""


@pytest.fixture
def long_leases(lease):
    """What a lease alone frees, it frees after three times as long as the next one waits."""
    lease(60.0)


def wait_while(endpoint, happens):
    """Wait for the lock on the cup while `happens()`, until it is granted."""
    with connect(endpoint, actor="next") as cell:
        request = Write(cell.world("online"), CUP, COUNT)
        add_one(cell, Entity("warm"))
        granted = []

        def wait():
            with Lock(request, wait_s=20.0):
                granted.append(request)

        waiting = threading.Thread(target=wait)
        waiting.start()
        while not any(not lock.granted for lock in cell.locks()):
            assert waiting.is_alive()
        happens()
        waiting.join()
        assert granted


@pytest.mark.slow
@pytest.mark.usefixtures("long_leases")
def test_killed_holder_loses_its_lock_at_once(daemon, endpoint, program):
    """The kernel says that the process is gone: nobody waits for the lease."""
    shard = daemon(endpoint)
    for _ in range(5):
        process = program(HOLDER, endpoint, "socket", "pass")
        assert process.stdout.readline() == "held\n", process.stderr.read()
        wait_while(endpoint, process.kill)

    assert counters(shard)["sessions_died"] == 5
    assert "leases_expired" not in counters(shard)


@pytest.mark.slow
@pytest.mark.usefixtures("long_leases")
def test_killed_holder_loses_its_lock_though_a_forked_child_lives(daemon, endpoint, program):
    """A child that has inherited the connections does not keep the session alive."""
    shard = daemon(endpoint)
    process = program(HOLDER, endpoint, "socket", FORKS)
    process.stdout.readline()
    assert process.stdout.readline() == "held\n"

    wait_while(endpoint, process.kill)

    assert counters(shard)["sessions_died"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("act", [FORKS_AND_CHILD_ENDS, CLOSES_ALL_SOCKETS])
def test_living_holder_keeps_its_lock_whatever_happens_to_its_sockets(
    daemon, endpoint, program, act, until
):
    """Neither the end of a forked child nor closed connections prove a death."""
    shard = daemon(endpoint)
    process = program(HOLDER, endpoint, "socket", act)
    later = program(HOLDER.replace("cup", "bowl"), endpoint, "socket", "pass")
    assert process.stdout.readline() == "held\n", process.stderr.read()
    assert later.stdout.readline() == "held\n", later.stderr.read()
    later.kill()
    until(lambda: counters(shard).get("sessions_died"))  # so a death of before is known, too

    output, errors = process.communicate("\n", timeout=60)

    assert output == "done\n", errors
    assert counters(shard)["sessions_died"] == 1
    with connect(endpoint) as cell:
        request = Write(cell.world("online"), CUP, COUNT)
        with Lock(request) as lock:
            assert lock[request] == 7


def test_goodbye_before_the_end_is_no_death(daemon, endpoint, until):
    """A client that closes its cell and lives on is not reported."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        add_one(cell)
    until(lambda: shard._sockets._count == 0)

    assert "sessions_died" not in counters(shard)


def test_process_is_watched_until_it_ends(program, tmp_path, until):
    """Its end is reported once, a moment after its last connection or before."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "s"))
    listener.listen()
    died = []
    deaths = Deaths(died.append)
    text = (
        "import socket, sys; s = socket.socket(socket.AF_UNIX); s.connect(sys.argv[1]);"
        "print(flush=True); s.recv(1); s.close(); print(flush=True); sys.stdin.read()"
    )
    process = program(text, tmp_path / "s")
    connected, _ = listener.accept()
    deaths.connected("a", connected)
    process.stdout.readline()
    connected.close()
    process.stdout.readline()
    deaths.disconnected("a", connected)
    assert died == []

    process.kill()

    until(lambda: died == ["a"])
    deaths.close()
    listener.close()


def test_process_is_watched_while_any_of_its_connections_is_open(
    program, tmp_path, until, monkeypatch
):
    """The kernel had no descriptor left when the first one came; the order of their ends is any."""
    monkeypatch.setattr(socket_peers, "LINGER_S", 0.0)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(tmp_path / "s"))
    listener.listen()
    died = []
    deaths = Deaths(died.append)
    text = (
        "import socket, sys; many = [socket.socket(socket.AF_UNIX) for _ in range(3)];"
        "[s.connect(sys.argv[1]) for s in many]; print(flush=True); sys.stdin.read()"
    )
    process = program(text, tmp_path / "s")
    first, second, third = (listener.accept()[0] for _ in range(3))
    with monkeypatch.context() as full:
        full.setattr(socket_peers, "process_of", lambda _: None)
        deaths.connected("a", first)
    deaths.connected("a", second)
    deaths.connected("a", third)
    deaths.disconnected("a", second)
    deaths.disconnected("a", third)
    deaths.connected("b", second)
    deaths.disconnected("b", second)
    until(lambda: "b" not in deaths._watched)  # it has swept since

    process.kill()

    until(lambda: died == ["a"])
    deaths.close()
    for opened in (listener, first, second, third):
        opened.close()
