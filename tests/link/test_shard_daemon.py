"""The daemon: starts once, says why not, refuses what it cannot read, ends in time."""

import contextlib
import json
import os
import signal
import socket
import threading
import time

import pytest
from latency_rounds import judge
from parked_parts import parked

from enact_dist import Aspect, Entity, connect
from enact_dist.core.protocol.messages import (
    Committed,
    Granted,
    Item,
    ListLocks,
    ListSessions,
    Locks,
    Refused,
    Waiting,
)
from enact_dist.errors import ConfigError, LinkError, StoreError
from enact_dist.link.daemon import daemon as shard_daemon
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.link.zenoh.service import ZenohService
from enact_dist.terms import Access
from enact_dist.wire.frames import decode_frame, encode_frame

HELD = 250


def speak(carrier, make_peer, **options):
    """Return a session that has said hello over `carrier`."""
    peer = make_peer(
        lambda shard, message: carrier.request(shard, message, timeout_s=30), **options
    )
    peer.hello()
    return peer


# ---------------------------------------------------------------- one daemon per shard


def test_daemon_refuses_to_start_when_its_shard_already_runs(daemon, endpoint):
    """A second daemon of the same name at the same endpoint is refused by name."""
    daemon(endpoint)

    with pytest.raises(LinkError, match="shard s0 of cell cell already runs"):
        daemon(endpoint)


def test_daemon_refuses_to_start_when_its_shard_runs_elsewhere(
    daemon, endpoint, free, make_settings
):
    """Another daemon that answers at the advertised endpoint is found before we serve."""
    daemon(endpoint)
    settings = DaemonSettings("cell", make_settings(endpoints=(endpoint,)), (free(),))

    with pytest.raises(LinkError, match="already runs"):
        start_shard(settings)


def test_daemon_names_an_endpoint_that_another_program_uses(daemon):
    """A port in use is one clear error with the endpoint in it."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"

        with pytest.raises(LinkError, match=f"{endpoint} is in use"):
            daemon(endpoint)


def test_daemon_refuses_a_folder_that_another_daemon_holds(daemon, endpoint, free, tmp_path):
    """Two daemons never write one folder; the second says whose it is."""
    daemon(endpoint, folder=tmp_path)

    with pytest.raises(StoreError, match=str(tmp_path)):
        daemon(free(), "s1", folder=tmp_path)


def test_daemon_that_ends_before_its_threads_have_begun_ends_quietly(daemon, endpoint, monkeypatch):
    """On a busy machine a thread may begin after the end of what it serves."""
    go_on, ended = threading.Event(), threading.Event()
    failures = []

    def begins_late(service, *, _watch_tokens=ZenohService._watch_tokens):
        assert go_on.wait(60)
        try:
            _watch_tokens(service)
        except BaseException as failure:
            failures.append(failure)
        ended.set()

    monkeypatch.setattr(ZenohService, "_watch_tokens", begins_late)
    daemon(endpoint).stop()
    go_on.set()

    assert ended.wait(60)
    assert not failures


def test_daemon_that_fails_at_its_last_step_lets_go_of_everything(
    daemon, endpoint, tmp_path, monkeypatch, shared_root
):
    """Its folder, its endpoint and its socket can be taken by the next one at once."""

    def broken(*_, **__):
        raise LinkError("no queryable")

    with monkeypatch.context() as patched:
        patched.setattr(shard_daemon, "ZenohService", broken)
        with pytest.raises(LinkError, match="no queryable"):
            daemon(endpoint, folder=tmp_path)
    assert list(shared_root.iterdir()) == []

    assert daemon(endpoint, folder=tmp_path).host.epoch > 0


def test_daemon_refuses_settings_without_an_endpoint(make_settings):
    """A shard that listens nowhere could never be used."""
    with pytest.raises(ConfigError, match="no endpoint"):
        start_shard(DaemonSettings("cell", make_settings(), ()))


# ---------------------------------------------------------------- frames that cannot be read


@pytest.mark.parametrize(
    "header",
    [b"", b"\xff\xfe garbage", os.urandom(200), encode_frame(Locks(1, ()))[0]],
    ids=["empty", "garbage", "random", "an answer"],
)
def test_daemon_refuses_and_counts_what_it_cannot_read(daemon, carry, endpoint, header):
    """A frame that is no request is answered with a refusal; the next request is served."""
    daemon(endpoint)
    carrier = carry(endpoint)
    session = open_session(connect=[endpoint], lease_s=30.0)
    try:
        carrier.request("s0", ListLocks(), timeout_s=30)
        replies = session.get("enact/cell/s0/acquire/x", attachment=header, timeout=30)
        sample = replies.recv().ok
        answer = decode_frame(bytes(sample.attachment), bytes(sample.payload))
    finally:
        close_session(session)

    counters = carrier.request("s0", ListSessions(), timeout_s=30).counters

    assert isinstance(answer, Refused)
    assert answer.code == "protocol"
    assert ("frames_refused", 1) in counters


# ---------------------------------------------------------------- the end


def test_daemon_answers_who_is_parked_when_it_stops(daemon, carry, make_peer, endpoint):
    """A client that waits for a lock is told so at the end, long before its wait is over."""
    shard = daemon(endpoint)
    holder = speak(carry(endpoint), make_peer)
    waiter = speak(carry(endpoint), make_peer)
    granted = holder.acquire("cup")
    answers = []
    thread = threading.Thread(target=lambda: answers.append(waiter.acquire("cup", wait_s=0.9)))
    parked = threading.Event()
    waiter.call = _noting(waiter.call, parked)
    thread.start()
    parked.wait(30)
    while len(holder.call("s0", ListLocks()).holders) < 2:
        continue

    shard.stop(drain_s=0.0)
    thread.join(30)

    assert isinstance(granted, Granted)
    assert [type(answer) for answer in answers] == [Waiting]


def _noting(call, event):
    def noting(shard, message):
        event.set()
        return call(shard, message)

    return noting


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.slow
def test_daemon_ends_with_status_0_on_a_signal(process, carry, make_peer, endpoint, number):
    """With a lock held and a wait parked it still drains, and leaves long before they are over."""
    started = process(endpoint)
    holder = speak(carry(endpoint), make_peer)
    holder.acquire("cup", hold_s=600.0)
    other = carry(endpoint)
    begun = other.begin("s0", parked(other, 300.0), timeout_s=300)
    holder.call("s0", ListLocks())

    started.send_signal(number)

    assert started.wait(120) == 0, started.stderr.read()
    assert begun.wait() is not None


@pytest.mark.slow
def test_daemon_ends_in_time_though_nobody_reads_its_log(process, endpoint, shared_root):
    """Its log's pipe is full, as beside a supervisor that hangs: lines are lost, not the shard."""
    running = process(endpoint)
    (folder,) = shared_root.iterdir()
    for _ in range(1000):  # each is worth a warning
        with socket.socket(socket.AF_UNIX) as stranger:
            stranger.connect(str(folder / "socket"))
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            stranger.recv(1)
    running.send_signal(signal.SIGTERM)

    assert running.wait(60) == 0


@pytest.mark.slow
def test_daemon_says_one_line_and_status_1_when_its_endpoint_is_in_use(process):
    """No traceback: who must act reads one line."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        started = process(endpoint, ready=False)
        output, errors = started.communicate(timeout=60)

    assert started.returncode == 1
    assert output == ""
    assert errors == (
        f"shard s0: endpoint {endpoint} is in use by another process of this host; stop it or"
        " listen elsewhere\n"
    )


@pytest.mark.slow
def test_daemon_keeps_what_it_acknowledged_when_it_is_killed(
    process, carry, make_peer, endpoint, tmp_path, until
):
    """A durable commit that was answered is there after kill -9 and a new start."""
    first = process(endpoint, tmp_path, durability="durable")
    peer = speak(carry(endpoint), make_peer, durability="durable")
    assert isinstance(peer.write("cup", b"kept"), Committed)
    first.kill()
    first.wait()

    process(endpoint, tmp_path, durability="durable")
    again = speak(carry(endpoint), make_peer, durability="durable")
    granted = until(lambda: isinstance(g := again.acquire("cup", wait_s=0.5), Granted) and g)

    assert bytes(granted.states[0].datum.body) == b"kept"
    assert granted.states[0].version == 1


FULL_DISK = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))
"""


@pytest.mark.slow
def test_daemon_acknowledges_nothing_and_ends_with_status_1_when_its_disk_is_full(
    process, carry, make_peer, endpoint, tmp_path
):
    """A commit that could not be written is never answered, and the daemon does not go on."""
    started = process(endpoint, tmp_path, first=FULL_DISK, log="json", durability="durable")
    peer = speak(carry(endpoint), make_peer, durability="durable")

    answer = peer.write_in_slices("cup", bytes(3_000_000))
    status = started.wait(60)

    lines = [json.loads(line) for line in started.stderr]
    assert answer is None
    assert status == 1
    assert any(line["level"] == "CRITICAL" and str(tmp_path) in line["text"] for line in lines)


# ---------------------------------------------------------------- one client never delays another

STOPPED = """
import secrets, sys
from enact_dist.core.protocol.messages import Fetch, Hello, Item, Register, AspectEntry, TakeView
from enact_dist.core.protocol.datum import LockId, Slot
from enact_dist.link.zenoh.carrier import ZenohCarrier
from enact_dist.terms import Access
session = secrets.token_hex(16)
carrier = ZenohCarrier("cell", session, "stopped", [sys.argv[1]], ttl_s=4.0)
feed = carrier.subscribe()
hello = Hello(session, 0, 4_000_000_000, "stopped", "h", 1, False)
epoch = carrier.request("s0", hello, timeout_s=30).epoch
lock = LockId(session, 0, 1)
item = Item(int(Access.VIEW), "online", "cloud", "count")
state = carrier.request("s0", TakeView(lock, epoch, 1, 1, (item,), 0), timeout_s=30).states[0]
size = carrier.fetch_bytes
calls = [
    ("s0", Fetch(lock, epoch, state.slot, state.version, start, size))
    for start in range(0, state.size, size)
]
print("go", flush=True)
while True:
    carrier.request_all(calls, timeout_s=30)
"""


@pytest.mark.slow
@pytest.mark.timing
def test_daemon_delays_no_other_client_when_one_is_stopped_with_50_mb_in_flight(
    process, carry, make_peer, endpoint, program, until
):
    """A stopped reader of 50 MB adds less than 50 ms (p99) and 150 ms (max) to anybody else."""
    process(endpoint)
    writer = speak(carry(endpoint), make_peer)
    until(lambda: isinstance(writer.write_in_slices("cloud", bytes(50_000_000)), Committed))

    @contextlib.contextmanager
    def stopped_reader():
        reader = program(STOPPED, endpoint)
        assert reader.stdout.readline() == "go\n"
        writer.call("s0", ListLocks())
        reader.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            reader.kill()

    judge(lambda: _latencies_s(writer), stopped_reader, "beside a stopped reader")


def _latencies_s(peer):
    """Return how long whole updates took, in seconds."""
    took = []
    for _ in range(200):
        began_s = time.perf_counter()
        assert isinstance(peer.write("cup", b"x"), Committed)
        took.append(time.perf_counter() - began_s)
    return took


def test_drain_that_is_over_names_the_holders_of_all_pages(daemon, endpoint, caplog):
    """A page of the listing has two hundred of them; the warning counted those alone."""
    shard = daemon(endpoint)
    with connect(endpoint) as cell:
        world = cell.world("online")
        for name in ("first", "last"):
            world.init(Entity(name), Aspect("number", int), 0)
        names = [f"part/{number:03}" for number in range(HELD)] + ["last"]
        items = [Item(int(Access.WRITE), "online", name, "number") for name in names]
        locks = [cell._client.acquire([one], wait_s=30.0, hold_s=60.0) for one in items]
        shard._name_holders(0.0)
        for lock in locks:
            cell._client.release(lock)

    assert f"{HELD + 1} locks are lost" in caplog.text
    assert "online:last/number (write)" in caplog.text
