"""Sockets between client and shard on one host: chosen, lost, refused, and what death proves."""

import os
import queue
import socket
import statistics
import threading
import time

import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
from enact_dist.core.messages import (
    AwaitStamp,
    Committed,
    Granted,
    Hello,
    ListLocks,
    ListSessions,
    Locks,
    Reached,
    Refused,
    Waiting,
)
from enact_dist.errors import ConfigError, LinkError
from enact_dist.link import socket_service
from enact_dist.link.shared_folder import open_shared
from enact_dist.link.socket_carrier import SocketCarrier
from enact_dist.link.socket_frames import Kind, Stream, prefixed, send_frame
from enact_dist.link.socket_peers import Deaths, check_peer, peer_of
from enact_dist.link.zenoh_carrier import ZenohCarrier
from enact_dist.terms import Access
from enact_dist.wire.frames import decode_frame, encode_frame

COUNT = Aspect("count", int, Durability.VOLATILE)
CUP = Entity("cup")
over_socket = pytest.mark.parametrize("carry", ["socket"], indirect=True)


def counters(shard):
    return shard.host._shard.counters


def carrier_of(cell):
    return cell._client.carrier


def add_one(cell, entity=CUP):
    request = Write(cell.world("online"), entity, COUNT)
    with Lock(request) as lock:
        lock[request] = lock.get(request, 0) + 1
    return request


@pytest.fixture
def raw(daemon, endpoint):
    """Sockets to a shard without a client around them: `raw(session)`; the shard is `raw.shard`."""
    shard, opened = daemon(endpoint), []

    def connected(session="raw", *, greet=True):
        folder = shard._shared
        near = socket.socket(socket.AF_UNIX)
        near.connect(folder.address("socket"))
        opened.append(near)
        if greet:
            send_frame(near, session.encode(), kind=Kind.OPEN)
            assert Stream(near).receive()[0] == Kind.OPENED
        return near

    connected.shard = shard
    yield connected
    for near in opened:
        near.close()


def ask(near, message, stream=None):
    send_frame(near, encode_frame(message)[0])
    _, header, payload = (stream or Stream(near)).receive()
    return decode_frame(header, payload)


# ---------------------------------------------------------------- which way


def test_socket_is_taken_where_both_ends_share_the_folder(daemon, endpoint):
    """Nobody has to ask for it; the first call after the welcome takes it."""
    daemon(endpoint)

    with connect(endpoint) as cell:
        add_one(cell)
        carrier = carrier_of(cell)

        assert carrier.way_to("s0") == "socket"
        assert carrier.calls["zenoh"] == 0
        assert carrier.calls["socket"] >= 2
        assert [shard.carrier for shard in cell.shards()] == ["socket"]


def test_zenoh_alone_is_taken_where_it_is_asked_for(daemon, endpoint, monkeypatch):
    """`ENACT_CARRIER=zenoh` makes a client without sockets."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")

    with connect(endpoint) as cell:
        add_one(cell)

        assert isinstance(carrier_of(cell), ZenohCarrier)


def test_unknown_carrier_is_refused_by_name(daemon, endpoint, monkeypatch):
    """A misspelt choice is no silent default, also where only an endpoint is given."""
    monkeypatch.setenv("ENACT_CARRIER", "sokcet")

    with pytest.raises(ConfigError, match="sokcet"):
        connect(endpoint)


def test_zenoh_is_taken_where_the_folder_is_not_shared(daemon, endpoint, monkeypatch, tmp_path):
    """A client with other shared memory falls back without an error, and says why to people."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    with connect(endpoint) as cell:
        request = add_one(cell)
        with Lock(request) as lock:
            assert lock[request] == 1

        assert "not shared with this process" in carrier_of(cell).way_to("s0")
        assert carrier_of(cell).calls["socket"] == 0


def test_zenoh_is_taken_where_the_folder_is_another_one(daemon, endpoint, shared_root):
    """A folder of the same name with another nonce, as after a restart with new memory."""
    shard = daemon(endpoint)
    nonce = shard._shared.path / "nonce"
    nonce.chmod(0o600)
    nonce.write_bytes(os.urandom(16))

    with connect(endpoint) as cell:
        add_one(cell)

        assert "nonces differ" in carrier_of(cell).way_to("s0")


def test_socket_that_is_asked_for_and_impossible_is_an_error(
    daemon, endpoint, monkeypatch, tmp_path
):
    """Forced, a client does not fall back: it says what is wrong with the socket."""
    daemon(endpoint)
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))

    with pytest.raises(LinkError, match=r"socket is asked for.*not shared with this process"):
        connect(endpoint)


# ---------------------------------------------------------------- lost on the way


def test_calls_go_on_over_zenoh_when_the_socket_is_gone(daemon, endpoint):
    """The file is deleted and all connections broken: no call fails, and the way is told."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        request = add_one(cell)
        shard._sockets.close()
        (shard._shared.path / "socket").unlink()

        for _ in range(5):
            add_one(cell)
        with Lock(request) as lock:
            assert lock[request] == 6

        assert carrier_of(cell).way_to("s0").startswith("zenoh")


def test_open_connections_outlive_the_file(daemon, endpoint):
    """A deleted file ends no call; only what has to connect anew takes the other way."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        request = add_one(cell)
        (shard._shared.path / "socket").unlink()
        before = carrier_of(cell).calls["socket"]
        with Lock(request) as lock:
            waiting = threading.Thread(target=lambda: add_one(cell))
            waiting.start()
            time.sleep(0.05)
            lock[request] = 10
        waiting.join()
        with Lock(request) as lock:
            assert lock[request] == 11

        assert carrier_of(cell).calls["socket"] > before


def test_socket_is_taken_again_after_a_restart(daemon, endpoint, until):
    """The next welcome names the new folder; nothing of the old one is left."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        add_one(cell)
        first = shard._shared.path
        shard.stop(drain_s=0.0)
        assert not first.exists()
        again = daemon(endpoint)

        add_one(cell)

        until(lambda: carrier_of(cell).way_to("s0") == "socket")
        before = dict(carrier_of(cell).calls)
        add_one(cell)
        after = carrier_of(cell).calls
        assert after["zenoh"] == before["zenoh"]
        assert after["socket"] >= before["socket"] + 2
        assert again._shared.path.exists()


@over_socket
def test_late_answer_never_meets_the_next_call(daemon, carry, endpoint):
    """A connection whose answer was not waited for is thrown away."""
    daemon(endpoint)
    carrier = carry(endpoint)

    for _ in range(5):
        assert carrier.request("s0", AwaitStamp(2**62, 150_000_000), timeout_s=0.05) is None
        assert isinstance(carrier.request("s0", ListLocks(), timeout_s=5), Locks)
    time.sleep(0.2)

    assert isinstance(carrier.request("s0", ListLocks(), timeout_s=5), Locks)
    assert carrier.calls["zenoh"] <= 1  # the first hello


@over_socket
def test_calls_beyond_the_connections_of_a_client_take_zenoh(daemon, carry, endpoint):
    """More calls at once than a client may have connections: all of them are answered."""
    daemon(endpoint)
    carrier = carry(endpoint)

    answers = carrier.request_all([("s0", AwaitStamp(2**62, 300_000_000))] * 120, timeout_s=5)

    assert {type(answer) for answer in answers} == {Reached}
    assert carrier.calls["socket"] == 100
    assert isinstance(carrier.request("s0", ListLocks(), timeout_s=5), Locks)


# ---------------------------------------------------------------- what the shard refuses


def test_connection_without_a_greeting_is_refused_and_the_others_served(raw):
    """Garbage in place of a greeting ends that connection, by name and counted."""
    stranger = raw(greet=False)
    stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")

    kind, text, _ = Stream(stranger).receive()

    assert kind == Kind.REFUSED
    assert b"begins no frame" in text
    assert counters(raw.shard)["connections_refused"] == 1
    assert isinstance(ask(raw(), ListLocks()), Locks)


def test_answer_that_another_thread_brings_at_once_is_sent_once(raw, monkeypatch):
    """The connection's thread looks for its answer while another one is sending it."""
    near = raw()
    stream = Stream(near)
    sending, submit, threads = threading.Event(), raw.shard.host.submit, []
    send_what_fits = socket_service._Connection._send_what_fits

    def slowly(connection, answer):
        sending.set()
        time.sleep(0.1)  # as if the kernel had let the other thread run
        return send_what_fits(connection, answer)

    def brought_by_another(message, reply):
        answers = queue.SimpleQueue()
        submit(message, answers.put)
        answer = answers.get(timeout=5)
        threads.append(threading.Thread(target=reply, args=(answer,)))
        threads[-1].start()
        assert sending.wait(5)

    monkeypatch.setattr(socket_service._Connection, "_send_what_fits", slowly)
    monkeypatch.setattr(raw.shard.host, "submit", brought_by_another)
    first = ask(near, AwaitStamp(0, 0), stream)
    sending.clear()
    threads[0].join()
    second = ask(near, ListLocks(), stream)

    assert (type(first), type(second)) == (Reached, Locks)


def test_frame_that_cannot_be_read_is_refused_and_the_connection_goes_on(raw):
    """A damaged message is answered with its refusal; the next one is served."""
    near = raw()
    stream = Stream(near)
    send_frame(near, b"\xff\x00garbage")
    _, header, _ = stream.receive()

    assert isinstance(decode_frame(header), Refused)
    assert isinstance(ask(near, ListLocks(), stream), Locks)
    assert counters(raw.shard)["frames_refused"] == 1


def test_answer_in_place_of_a_request_is_refused(raw):
    """Only requests are handled."""
    answer = ask(raw(), Locks(1, ()))

    assert isinstance(answer, Refused)
    assert "no request" in answer.text


def test_session_with_too_many_connections_is_refused_by_name(raw, monkeypatch):
    """One process cannot take all threads of a shard; what is refused is counted."""
    monkeypatch.setattr(socket_service, "SESSION_CONNECTIONS_MAX", 3)
    kept = [raw("greedy") for _ in range(3)]
    one_more = raw("greedy", greet=False)
    send_frame(one_more, b"greedy", kind=Kind.OPEN)

    kind, text, _ = Stream(one_more).receive()

    assert (kind, b"3 connections" in text) == (Kind.REFUSED, True)
    assert isinstance(ask(raw("modest"), ListLocks()), Locks)
    assert isinstance(ask(kept[0], ListLocks()), Locks)


def test_place_of_a_connection_is_free_again_when_it_ends(raw, monkeypatch, until):
    """What has left counts no more."""
    monkeypatch.setattr(socket_service, "CONNECTIONS_MAX", 2)
    first, _ = raw("a"), raw("b")
    first.close()

    until(lambda: raw.shard._sockets._count == 1)

    assert isinstance(ask(raw("c"), ListLocks()), Locks)


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


def test_shard_serves_no_stranger(raw):
    """A peer that is neither the shard's user nor root gets no connection."""
    raw.shard._sockets._users = frozenset((123_456,))
    near = raw(greet=False)
    send_frame(near, b"stranger", kind=Kind.OPEN)

    kind, text, _ = Stream(near).receive()

    assert (kind, b"for user 123456" in text) == (Kind.REFUSED, True)


# ---------------------------------------------------------------- slow clients


def speak(carrier, make_peer, session):
    peer = make_peer(lambda shard, m: carrier.request(shard, m, timeout_s=5), session=session)
    peer.hello()
    return peer


@over_socket
def test_client_that_reads_no_answers_delays_nobody(raw, carry, make_peer, endpoint, monkeypatch):
    """It loses its connection after a while, counted; the others never notice."""
    monkeypatch.setattr(socket_service, "SEND_S", 0.3)
    carrier = carry(endpoint, session="good")
    peer = speak(carrier, make_peer, "good")
    peer.write("cup", os.urandom(50_000))
    stopped = raw("stopped")
    ask(stopped, Hello("stopped", 0, 2_000_000_000, "stopped", "h", 1, False))
    view = make_peer(lambda _, message: message, session="stopped", epoch=peer.epoch)
    for _ in range(200):  # each answer has 50 kB, nobody reads them
        frame = encode_frame(view.acquire_message("cup", access=Access.READ))[0]
        try:
            stopped.send(prefixed(frame, 0), socket.MSG_DONTWAIT)
        except BlockingIOError:
            break
    slowest_s, end_s = 0.0, time.monotonic() + 1.0
    while time.monotonic() < end_s:
        started_s = time.monotonic()
        assert isinstance(peer.write("plate", b"1"), Committed)
        slowest_s = max(slowest_s, time.monotonic() - started_s)

    assert slowest_s < 0.25
    assert counters(raw.shard)["answers_dropped"] == 1


@over_socket
def test_grant_for_a_waiter_that_does_not_read_delays_nobody(raw, carry, make_peer, endpoint):
    """Whoever releases a lock sends the next grant only as far as that goes without waiting."""
    carrier = carry(endpoint, session="good")
    peer = speak(carrier, make_peer, "good")
    peer.write("cup", os.urandom(60_000))
    held = peer.acquire("cup")
    waiting = []
    for number in range(5):
        near = raw(f"waiter{number}")
        near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        ask(near, Hello(f"waiter{number}", 0, 2_000_000_000, "waiter", "h", 1, False))
        waiter = make_peer(None, session=f"waiter{number}", epoch=peer.epoch)
        message = waiter.acquire_message("cup", wait_s=0.9, access=Access.READ)
        send_frame(near, encode_frame(message)[0])
        waiting.append(near)
    while len(peer.call("s0", ListLocks()).holders) < 6:
        time.sleep(0.002)
    started_s = time.monotonic()

    assert isinstance(peer.commit(held, "cup", os.urandom(60_000)), Committed)

    assert time.monotonic() - started_s < 0.2
    for near in waiting:
        _, header, payload = Stream(near).receive()
        answer = decode_frame(header, payload)
        assert isinstance(answer, Granted | Waiting)


def test_watcher_that_does_not_read_delays_no_commit(raw, make_peer):
    """Notices are kept for it up to a number, then dropped and counted; commits go on."""
    watcher, writer = raw("watcher"), raw("writer")
    send_frame(watcher, b"", kind=Kind.WATCH)
    stream = Stream(writer)
    peer = make_peer(lambda _, message: ask(writer, message, stream), session="writer")
    peer.hello()
    raw_put = socket_service.NOTICES_MAX
    socket_service.NOTICES_MAX = 100
    try:
        for number in range(1500):
            assert isinstance(_write(peer, writer, stream, number), Committed)
    finally:
        socket_service.NOTICES_MAX = raw_put

    assert counters(raw.shard)["notices_dropped"] > 0


def _write(peer, writer, stream, number):
    granted = peer.acquire("cup")
    from enact_dist.core.datum import Datum, Slot
    from enact_dist.core.messages import Commit, WriteItem

    datum = Datum(b"\x01", b"%d" % number, len(b"%d" % number))
    item = WriteItem(Slot("online", "cup", "count"), datum)
    header, payload = encode_frame(Commit(granted.lock, granted.token, (item,), 0))
    send_frame(writer, header, [payload])
    _, header, payload = stream.receive()
    return decode_frame(header, payload)


# ---------------------------------------------------------------- death

HOLDER = """
import os, sys, threading
from enact_dist import Aspect, Durability, Entity, Lock, Write, connect
cell = connect(sys.argv[1], actor="holder")
request = Write(cell.world("online"), Entity("cup"), Aspect("count", int, Durability.VOLATILE))
with Lock(request) as lock:
    assert cell._client.carrier.way_to("s0") == sys.argv[2], cell._client.carrier.way_to("s0")
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


def next_grant_s(endpoint, before):
    """Wait for the lock on the cup while `before()` happens; return how long the grant took."""
    with connect(endpoint, actor="next") as cell:
        request = Write(cell.world("online"), CUP, COUNT)
        add_one(cell, Entity("warm"))
        started = threading.Event()
        granted_s = []

        def wait():
            started.set()
            with Lock(request, wait_s=20.0):
                granted_s.append(time.monotonic())

        waiting = threading.Thread(target=wait)
        waiting.start()
        started.wait()
        while not any(not lock.granted for lock in cell.locks()):
            time.sleep(0.002)
        killed_s = time.monotonic()
        before()
        waiting.join()
        return granted_s[0] - killed_s


@pytest.mark.slow
def test_killed_holder_loses_its_lock_at_once(daemon, endpoint, program):
    """The kernel says that the process is gone: nobody waits for the lease."""
    shard = daemon(endpoint)
    waits_s = []
    for _ in range(5):
        process = program(HOLDER, endpoint, "socket", "pass")
        assert process.stdout.readline() == "held\n", process.stderr.read()
        waits_s.append(next_grant_s(endpoint, process.kill))

    assert statistics.median(waits_s) < 0.1, waits_s
    assert counters(shard)["sessions_died"] == 5
    assert "leases_expired" not in counters(shard)


@pytest.mark.slow
def test_killed_holder_loses_its_lock_though_a_forked_child_lives(daemon, endpoint, program):
    """A child that has inherited the connections does not keep the session alive."""
    shard = daemon(endpoint)
    process = program(HOLDER, endpoint, "socket", FORKS)
    process.stdout.readline()
    assert process.stdout.readline() == "held\n"

    assert next_grant_s(endpoint, process.kill) < 0.5
    assert counters(shard)["sessions_died"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("act", [FORKS_AND_CHILD_ENDS, CLOSES_ALL_SOCKETS])
def test_living_holder_keeps_its_lock_whatever_happens_to_its_sockets(
    daemon, endpoint, program, act, until
):
    """Neither the end of a forked child nor closed connections prove a death."""
    shard = daemon(endpoint)
    process = program(HOLDER, endpoint, "socket", act)
    assert process.stdout.readline() == "held\n", process.stderr.read()
    time.sleep(1.0)

    output, errors = process.communicate("\n", timeout=20)

    assert output == "done\n", errors
    assert "sessions_died" not in counters(shard)
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
    deaths.disconnected("a")
    assert died == []

    process.kill()

    until(lambda: died == ["a"])
    deaths.close()
    listener.close()


# ---------------------------------------------------------------- many threads


@pytest.mark.timing
def test_waiting_threads_do_not_slow_a_fast_one(daemon, endpoint):
    """Eight threads in long polls: the ninth is as fast as alone, each has its own connection."""
    daemon(endpoint)
    with connect(endpoint) as cell, connect(endpoint) as other:
        held, free = Write(cell.world("online"), CUP, COUNT), Entity("free")
        add_one(cell, free)

        def median_s():
            times_s = []
            for _ in range(200):
                started_s = time.perf_counter()
                add_one(cell, free)
                times_s.append(time.perf_counter() - started_s)
            return statistics.median(times_s)

        alone_s = min(median_s() for _ in range(3))
        release, holding = threading.Event(), threading.Event()

        def hold():
            with Lock(Write(other.world("online"), CUP, COUNT)):
                holding.set()
                release.wait()

        threads = [threading.Thread(target=hold)]
        threads[0].start()
        holding.wait()
        threads += [threading.Thread(target=lambda: add_one(cell)) for _ in range(8)]
        for thread in threads[1:]:
            thread.start()
        while sum(not lock.granted for lock in other.locks()) < 8:
            time.sleep(0.002)
        beside_s = min(median_s() for _ in range(3))
        release.set()
        for thread in threads:
            thread.join()
        with Lock(held) as lock:
            assert lock[held] == 8

    assert beside_s < 1.5 * alone_s + 50e-6


def test_carrier_says_what_went_over_what(daemon, endpoint):
    """The sessions of a shard are those of the clients, whichever way they come."""
    daemon(endpoint)
    with connect(endpoint, actor="one") as cell:
        answer = carrier_of(cell).request("s0", ListSessions(), timeout_s=5)

        assert [(info.actor, info.token_present) for info in answer.sessions] == [("one", True)]
        assert isinstance(carrier_of(cell), SocketCarrier)


def test_folder_of_the_shard_is_the_one_of_its_welcome(daemon, carry, endpoint):
    """What a WELCOME says can be opened."""
    shard = daemon(endpoint)
    hello = Hello("me", 0, 2_000_000_000, "me", "h", 1, True)
    welcome = carry(endpoint).request("s0", hello, timeout_s=5)

    opened = open_shared(welcome.shared, welcome.shared_nonce)

    assert opened.path == shard._shared.path
    opened.close()
