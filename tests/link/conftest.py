"""Shards to talk to with plain messages: `peer` speaks for one session over any carrier."""

import os
import secrets
import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import polling
import pytest
from ports import free_endpoint

from enact_dist.core.protocol.datum import Datum, LockId, Slot
from enact_dist.core.protocol.messages import (
    Acquire,
    AspectEntry,
    Commit,
    Goodbye,
    Hello,
    Item,
    PlacementMap,
    Register,
    ShardEntry,
    Stage,
    WriteItem,
)
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.log import in_words
from enact_dist.link.memory.shared_folder import SharedFolder
from enact_dist.link.socket.frames import FrameKind, Stream, greeting_of, send_frame
from enact_dist.terms import Access

sys.path.insert(0, str(Path(__file__).parent))

WORLD, ASPECT = "online", "count"
TTL_S = 2.0
LINK_S = 30.0
"""A link outlives what stands still: who asks once without a second try is answered."""


def settings_of(name="s0", *, endpoints=(), durability="volatile", others=()):
    """Return the settings of a shard with one world and one aspect."""
    return ShardSettings(
        name,
        PlacementMap(1, (ShardEntry(name, tuple(endpoints)), *others), ()),
        worlds=(WORLD,),
        aspects=(AspectEntry(ASPECT, "", durability),),
    )


@dataclass
class Peer:
    """One session that speaks in messages."""

    call: object
    shard: str = "s0"
    session: str = field(default_factory=lambda: secrets.token_hex(16))
    epoch: int = 0
    seq: int = 0
    durability: str = "volatile"

    def hello(self, *, ttl_s=TTL_S, actor="peer"):
        message = Hello(self.session, self.epoch, int(ttl_s * 1e9), actor, "host", 1, False)
        welcome = self.call(self.shard, message)
        self.epoch = welcome.epoch
        entry = AspectEntry(ASPECT, "int", self.durability)
        self.call(self.shard, Register(self.session, (WORLD,), (entry,)))
        return welcome

    def acquire_message(self, *entities, wait_s=0.0, access=Access.WRITE, hold_s=60.0):
        self.seq += 1
        items = tuple(Item(int(access), WORLD, entity, ASPECT) for entity in entities)
        lock = LockId(self.session, 0, self.seq)
        return Acquire(lock, self.epoch, 1, 0, items, int(wait_s * 1e9), int(hold_s * 1e9), 0)

    def acquire(self, *entities, **options):
        return self.call(self.shard, self.acquire_message(*entities, **options))

    def commit(self, granted, entity, body, *, encoding=b"\x01"):
        datum = Datum(encoding, body, len(body))
        write = WriteItem(Slot(WORLD, entity, ASPECT), datum)
        return self.call(self.shard, Commit(granted.lock, granted.token, (write,), 0))

    def write(self, entity, body):
        """Lock, write and release one datum; return the answer to the commit."""
        return self.commit(self.acquire(entity), entity, body)

    def write_in_slices(self, entity, body, *, slice_bytes=1 << 20):
        """As `write`, of data that are too large for a commit."""
        granted = self.acquire(entity)
        file = f"{self.session}-{granted.lock.seq:x}"
        for offset in range(0, len(body), slice_bytes):
            part = body[offset : offset + slice_bytes]
            slice_ = Datum(b"", part, len(part))
            self.call(self.shard, Stage(self.session, file, offset, len(body), slice_))
        named = Datum(b"\x01", b"", len(body), file=file)
        write = WriteItem(Slot(WORLD, entity, ASPECT), named)
        return self.call(self.shard, Commit(granted.lock, granted.token, (write,), 0))

    def goodbye(self):
        return self.call(self.shard, Goodbye(self.session))


@pytest.fixture
def make_settings():
    """Settings of a shard: world `online`, aspect `count`."""
    return settings_of


@pytest.fixture
def make_peer():
    """Sessions that speak in messages over a `call(shard, message)`."""
    return Peer


@pytest.fixture
def endpoint():
    """An endpoint of the loopback at which nobody listens yet."""
    return free_endpoint()


@pytest.fixture
def free_endpoints():
    """Endpoints of the loopback, `free_endpoints(count)`."""
    return lambda count: [free_endpoint() for _ in range(count)]


@pytest.fixture
def daemon(make_settings):
    """Start shards in this process: `daemon(endpoint, name=…)`; stopped after the test."""
    from enact_dist.link.daemon.daemon import start_shard
    from enact_dist.link.daemon.settings import DaemonSettings

    running = []

    def start(endpoint, name="s0", *, folder=None, cell="cell", **options):
        shard = make_settings(name, endpoints=(endpoint,), **options)
        settings = DaemonSettings(cell, shard, (endpoint,), folder, link_lease_s=LINK_S)
        started = start_shard(settings)
        running.append(started)
        return started

    yield start
    for shard in running:
        shard.stop(drain_s=0.0)


@pytest.fixture(autouse=True)
def _patient_sockets(monkeypatch):
    """A process that stands still has its socket all the same: what is tested is not the pause."""
    monkeypatch.setattr("enact_dist.link.socket.line.CONNECT_S", 30.0)
    monkeypatch.setattr("enact_dist.link.socket.connection.OPEN_S", 60.0)


@pytest.fixture(autouse=True)
def shared_root(tmp_path_factory, monkeypatch):
    """A root of shared folders of the test's own, in shared memory where there is some."""
    memory = Path("/dev/shm")
    parent = memory if memory.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="enact-test-", dir=parent) as root:
        monkeypatch.setenv("ENACT_SHARED_FOLDER", root)
        yield Path(root)


@pytest.fixture
def carry(request):
    """Open carriers: `carry(endpoint, …)`; closed after the test.

    Parametrised indirectly with "socket" they are socket carriers that have met shard `s0`.
    """
    from enact_dist.link.socket.carrier import SocketCarrier
    from enact_dist.link.zenoh.carrier import ZenohCarrier

    opened = []
    over_socket = getattr(request, "param", "zenoh") == "socket"

    def open_carrier(*endpoints, session="", ttl_s=2 * LINK_S, **options):
        session = session or secrets.token_hex(16)
        carrier = ZenohCarrier("cell", session, "tester", endpoints, ttl_s=ttl_s, **options)
        if over_socket:
            carrier = SocketCarrier(carrier, session, "tester", forced=True)
        opened.append(carrier)
        if over_socket:
            hello = Hello(session, 0, int(TTL_S * 1e9), "tester", "host", os.getpid(), True)
            while carrier.request("s0", hello, timeout_s=1) is None:
                assert carrier.calls["zenoh"] < 100
            assert carrier.transport_of("s0") == "socket"
        return carrier

    yield open_carrier
    for carrier in opened:
        carrier.close()


@pytest.fixture
def until():
    """Ask again until what comes back is true; return it."""
    return polling.until


@pytest.fixture
def program():
    """Run Python text in a process of its own; `program(text, *arguments)`, killed afterwards."""
    started = []

    def run(text, *arguments):
        process = subprocess.Popen(
            [sys.executable, "-c", text, *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdin=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def lease(monkeypatch):
    """Set the TTL of sessions that join at an endpoint: `lease(seconds)`, here and in programs.

    A program takes it from `LEASE_S`; no variable of the product concerns an endpoint.
    """

    def set_for_all(seconds):
        monkeypatch.setattr("enact_dist.world.connecting.TTL_S", seconds)
        monkeypatch.setenv("LEASE_S", str(seconds))

    return set_for_all


@pytest.fixture
def free():
    """Returns further endpoints of the loopback at which nobody listens yet."""
    return free_endpoint


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
            send_frame(near, greeting_of(session, "tester"), kind=FrameKind.OPEN)
            assert Stream(near).receive()[0] == FrameKind.OPENED
        return near

    connected.shard = shard
    yield connected
    for near in opened:
        near.close()


DAEMON = """
import sys
from pathlib import Path
from enact_dist.core.protocol.messages import AspectEntry, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.link.daemon.process import run_shard
from enact_dist.link.daemon.settings import DaemonSettings
endpoint, folder, log, durability = sys.argv[1:]
shard = ShardSettings(
    "s0",
    PlacementMap(1, (ShardEntry("s0", (endpoint,)),), ()),
    worlds=("online",),
    aspects=(AspectEntry("count", "", durability),),
)
path = Path(folder) if folder else None
sys.exit(run_shard(DaemonSettings("cell", shard, (endpoint,), path, log)))
"""


@pytest.fixture
def process(program):
    """Start a daemon as a process; returns it once it said that it is ready."""

    def start(endpoint, folder="", *, first="", log="text", durability="volatile", ready=True):
        started = program(first + DAEMON, endpoint, folder, log, durability)
        if ready:
            line = in_words(started.stdout.readline())
            assert line.startswith("ready: shard s0 of cell cell at "), line + started.stderr.read()
        return started

    return start


@pytest.fixture
def memory(tmp_path):
    """A folder in memory: what is killed, and not cut off its power, leaves the same there."""
    from store_disk import memory_folder

    with memory_folder(tmp_path) as made:
        yield made


@pytest.fixture
def folder(shared_root):
    """The folder that a shard shares with clients of its host."""
    made = SharedFolder("cell", "s0", root=shared_root)
    yield made
    made.close()
