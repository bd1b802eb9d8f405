"""Large data of a real cell over a network that is slow or cut, seen by a user of the API."""

import threading

import numpy as np
import pytest
from tcp_proxy import TcpProxy

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    ViewEach,
    Write,
    connect,
)
from enact_dist.core.protocol.messages import Pin, PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import LeaseLostError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.folder.blobs import BlobFolder

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
TTL_S = 8.0
tray = Entity("tray")


@pytest.fixture
def far(request, make_settings, endpoint, monkeypatch, tmp_path):
    """A shard behind a network: `far()` opens a cell through `far.proxy`."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    port = int(endpoint.rpartition(":")[2])
    cells = []
    with TcpProxy(port, bytes_per_s=getattr(request, "param", None)) as proxy:
        shard = make_settings("s0", endpoints=(proxy.endpoint,))
        settings = DaemonSettings(
            "cell", shard, (endpoint,), shared_bytes_max=0, link_lease_s=TTL_S / 2
        )
        started = start_shard(settings)

        file = tmp_path / "cell.toml"
        file.write_text(  # a lease that a busy machine does not outlast while the network is cut
            f'name = "cell"\nworlds = ["online"]\nsession_ttl_s = {TTL_S}\n'
            f'[shards.s0]\nlisten = "{endpoint}"\nadvertise = "{proxy.endpoint}"\n'
        )

        def open_cell(*, direct=False):
            cells.append(connect(endpoint if direct else file))
            return cells[-1]

        def restart():
            open_cell.shard.stop(drain_s=0.0)
            open_cell.shard = start_shard(settings)

        open_cell.proxy, open_cell.shard, open_cell.restart = proxy, started, restart
        yield open_cell
        for cell in cells:
            cell.close()
        open_cell.shard.stop(drain_s=0.0)


def recorded(cell):
    """Return the list to which what happens to slices of `cell` is added, in order."""
    carrier, seen = cell._client.carrier, []
    begin = carrier.begin

    class Begun:
        def __init__(self, message, begun):
            self._message, self._begun = message, begun
            self.abandon = begun.abandon

        def wait(self, into=None):
            seen.append(("waited", self._message))
            answer = self._begun.wait(into)
            if answer is not None:
                seen.append(("answered", self._message))
            return answer

    def note(shard, message, *, timeout_s):
        seen.append(("begun", message))
        return Begun(message, begin(shard, message, timeout_s=timeout_s))

    carrier.begin = note
    return seen


def asked_after_their_answer(seen):
    """Return the slices that travelled again though they had come."""
    answered = set()
    again = []
    for what, message in seen:
        if what == "begun" and message.offset in answered:
            again.append(message.offset)
        if what == "answered":
            answered.add(message.offset)
    return again


def test_fetch_goes_on_after_the_network_was_cut(far):
    """What came before the cut stays, only slices that were under way are asked again."""
    sent = np.random.default_rng(1).integers(0, 255, 60_000_000, np.uint8)
    far(direct=True).world("online").init(tray, CLOUD, sent)
    cell = far()
    seen = recorded(cell)
    read = Read(cell.world("online"), tray, CLOUD)
    with Lock(read) as lock:
        far.proxy.cut_after(25_000_000)
        came = lock[read]

    assert far.proxy.cuts == 1
    assert np.array_equal(came, sent)
    fetches = [message.offset for what, message in seen if what == "begun"]
    repeated = len(fetches) - len(set(fetches))
    assert repeated > 0
    assert asked_after_their_answer(seen) == []
    assert cell.statistics()["slices_repeated"] == repeated


def test_fetch_ends_by_name_when_the_lock_is_lost_meanwhile(far):
    """A lock that somebody breaks, and whose datum is replaced, gets no mixture."""
    direct = far(direct=True)
    direct.world("online").init(tray, CLOUD, np.zeros(40_000_000, np.uint8))
    cell = far()
    begin = cell._client.carrier.begin

    def replace():
        (held,) = direct.locks()
        direct.break_lock(held.number, shard="s0")
        write = Write(direct.world("online"), tray, CLOUD)
        with Lock(write) as other:
            other[write] = np.ones(40_000_000, np.uint8)

    def begin_and_replace(shard, message, *, timeout_s):
        if message.offset == 20 << 20:
            in_thread(replace)
        return begin(shard, message, timeout_s=timeout_s)

    cell._client.carrier.begin = begin_and_replace
    read = Read(cell.world("online"), tray, CLOUD)
    with pytest.raises(LeaseLostError, match="kept for lock"), Lock(read) as lock:
        lock[read]


def in_thread(run):
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()


IMAGES = Entities("camera/*")
CAMERAS = [Entity(f"camera/{number}") for number in range(6)]


@pytest.fixture
def images(far):
    """Six images of 0.5 MB, and a far cell that records how it fetches them."""
    direct = far(direct=True).world("online")
    for number, camera in enumerate(CAMERAS):
        direct.init(camera, CLOUD, np.full(500_000, number, np.uint8))
    cell = far()
    return cell.world("online"), recorded(cell)


@pytest.mark.parametrize(
    ("look", "together"),
    [
        (lambda data: list(data.values()), 6),
        (lambda data: list(data.items()), 6),
        (lambda data: [data[camera] for camera in data], 1),
        (lambda data: data[CAMERAS[3]], 1),
    ],
)
def test_data_of_a_pattern_come_together_when_all_are_read(images, look, together):
    """Going through a pattern keeps several under way; a single look-up asks for one."""
    online, seen = images
    each = ReadEach(online, IMAGES, CLOUD)
    with Lock(each) as lock:
        look(lock[each])
        first_wait = [what for what, _ in seen].index("waited")
        again = dict(lock[each].items())

    assert [int(again[camera][0]) for camera in CAMERAS] == list(range(6))
    assert first_wait == min(together, 5)  # the first window holds 2 MiB
    assert sum(what == "begun" for what, _ in seen) == 6


def test_second_look_in_order_brings_those_that_follow(images):
    """The first is fetched alone, the second shows that all will be read."""
    online, seen = images
    each = ReadEach(online, IMAGES, CLOUD)
    with Lock(each) as lock:
        data = lock[each]
        counts = []
        for camera in CAMERAS:
            data[camera]
            counts.append(sum(what == "begun" for what, _ in seen))

    assert counts == [1, 6, 6, 6, 6, 6]


def test_requests_of_one_lock_come_together_from_the_second_on(images):
    """Two of the data that a lock reads were looked at: the others come with the second."""
    online, seen = images
    reads = [Read(online, camera, CLOUD) for camera in CAMERAS]
    with Lock(*reads) as lock:
        lock[reads[4]]
        alone = len([what for what, _ in seen if what == "begun"])
        lock[reads[0]]
        both = len([what for what, _ in seen if what == "begun"])

    assert (alone, both) == (1, 6)


def test_views_are_fetched_together_and_never_twice(images):
    """A second view of unchanged data asks for nothing, of a pattern too."""
    online, seen = images
    views = [View(online, camera, CLOUD) for camera in CAMERAS[:3]]
    each = ViewEach(online, IMAGES, CLOUD)

    snapshot = online.view(*views, each)
    first = [what for what, _ in seen]
    again = online.view(*views, each)

    assert first.index("waited") >= 4
    assert first.count("begun") == 6
    assert len(seen) == len(first)
    assert np.array_equal(again[views[1]], snapshot[views[1]])


# ---------------------------------------------------------------- publishing


def publish(cell, entity, data):
    write = Write(cell.world("online"), entity, CLOUD)
    with Lock(write, wait_s=30.0) as lock:
        lock[write] = data


def found(cell, entity):
    view = View(cell.world("online"), entity, CLOUD)
    return cell.world("online").view(view)[view]


def drafts(far):
    return far.shard.host.payloads.figures()["payload_drafts"]


def test_publication_goes_on_after_the_network_was_cut(far):
    """What the shard had before the cut stays there, and the commit is a short message."""
    sent = np.random.default_rng(1).integers(0, 255, 60_000_000, np.uint8)
    cell = far()
    cell.world("online").init(tray, CLOUD, sent[:10])
    seen = recorded(cell)
    far.proxy.cut_after(25_000_000)

    publish(cell, tray, sent)

    assert far.proxy.cuts == 1
    assert np.array_equal(found(far(direct=True), tray), sent)
    begun = [message.offset for what, message in seen if what == "begun"]
    repeated = len(begun) - len(set(begun))
    assert repeated > 0
    assert asked_after_their_answer(seen) == []
    assert cell.statistics()["slices_repeated"] == repeated
    assert drafts(far) == 0


def test_threads_of_one_process_publish_at_once(far):
    """Each has a window of its own; names are never taken twice, nothing gets mixed."""
    cell = far()
    data = {camera: np.full(9_000_000, n, np.uint8) for n, camera in enumerate(CAMERAS)}
    threads = [
        threading.Thread(target=publish, args=(cell, camera, each)) for camera, each in data.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    reader = far(direct=True)
    for camera, each in data.items():
        assert np.array_equal(found(reader, camera), each)
    assert drafts(far) == 0


def test_publication_fails_by_name_when_the_shard_restarts_meanwhile(far):
    """The lock is lost with the restart; the datum is what it was, and a second try succeeds."""
    cell = far()
    begin, restarts = cell._client.carrier.begin, iter([True])

    def begin_and_restart(shard, message, *, timeout_s):
        if message.offset == 20 << 20 and next(restarts, False):
            far.restart()
        return begin(shard, message, timeout_s=timeout_s)

    cell._client.carrier.begin = begin_and_restart
    with pytest.raises(LeaseLostError, match=r"restarted|lost"):
        publish(cell, tray, np.ones(40_000_000, np.uint8))
    publish(cell, tray, np.full(5_000_000, 2, np.uint8))

    assert int(found(cell, tray).sum()) == 10_000_000
    assert drafts(far) == 0


def test_publication_whose_lock_is_lost_leaves_nothing_behind(far):
    """A lock that is broken while its data travel commits nothing, and its drafts are dropped."""
    direct, cell = far(direct=True), far()
    publish(direct, tray, np.zeros(10, np.uint8))
    begin = cell._client.carrier.begin

    def lose():
        (held,) = direct.locks()
        direct.break_lock(held.number, shard="s0")

    def begin_and_lose(shard, message, *, timeout_s):
        if message.offset == 20 << 20:
            in_thread(lose)
        return begin(shard, message, timeout_s=timeout_s)

    cell._client.carrier.begin = begin_and_lose
    with pytest.raises(LeaseLostError, match="nothing was written"):
        publish(cell, tray, np.ones(40_000_000, np.uint8))

    assert found(direct, tray).size == 10
    assert drafts(far) == 0


@pytest.mark.parametrize(("size", "again"), [(1_500_000, 0), (3_000_000, 1)])
def test_shard_that_lost_what_was_staged_gets_the_bytes_once_more(far, size, again):
    """The caller does not notice that a shard has given up the drafts of its session.

    Up to the bound of a commit they travel with it, above it ahead of it as before.
    """
    cell = far()
    begin = cell._client.carrier.begin
    data = np.arange(size, dtype=np.uint8)
    files = {}

    class Dropping:
        def __init__(self, begun):
            self._begun, self.abandon = begun, begun.abandon

        def wait(self, into=None):
            answer = self._begun.wait(into)
            if files.setdefault(answer.file, len(files)) == 0:
                far.shard.host.payloads.drop(answer.file)
            return answer

    cell._client.carrier.begin = lambda *a, **k: Dropping(begin(*a, **k))
    publish(cell, tray, data)

    assert np.array_equal(found(far(direct=True), tray), data)
    assert len(files) == 1 + again


def test_many_small_data_of_one_commit_travel_ahead_of_it(far):
    """What is below the size of a payload each and together more than a commit carries."""
    cell = far()
    world = cell.world("online")
    requests = [Write(world, Entity(f"small/{number}"), CLOUD) for number in range(60)]
    with Lock(*requests) as lock:
        for number, request in enumerate(requests):
            lock[request] = np.full(60_000, number, np.uint8)

    other = far(direct=True)
    for number in (0, 30, 59):
        assert np.array_equal(
            found(other, Entity(f"small/{number}")), np.full(60_000, number, np.uint8)
        )
    assert drafts(far) == 0


def test_commit_over_shards_stores_each_large_body_once(tmp_path, monkeypatch, free_endpoints):
    """What was prepared becomes the slot's own: no body is written to a disk a second time."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    written, write_blob = [], BlobFolder.write

    def count(self, body, *, durable):
        written.append((self.folder.parent.name, len(body)))
        return write_blob(self, body, durable=durable)

    monkeypatch.setattr(BlobFolder, "write", count)
    endpoints = dict(zip(("s0", "s1"), free_endpoints(2), strict=True))
    entries = tuple(ShardEntry(name, (endpoint,)) for name, endpoint in endpoints.items())
    placement = PlacementMap(1, entries, (Pin("left/**", "s0"), Pin("right/**", "s1")))
    shards = [
        start_shard(
            DaemonSettings(
                "cell",
                ShardSettings(name, placement, worlds=("online",)),
                (endpoint,),
                tmp_path / name,
                shared_bytes_max=0,
            )
        )
        for name, endpoint in endpoints.items()
    ]
    model = Aspect("model", np.ndarray, Durability.DURABLE)
    try:
        with connect(endpoints["s0"]) as cell:
            online = cell.world("online")
            left = Write(online, Entity("left/a"), model)
            right = Write(online, Entity("right/a"), model)
            with Lock(left, right, wait_s=30.0) as lock:
                lock[left] = np.zeros(3_000_000, np.uint8)
                lock[right] = np.ones(2_000_000, np.uint8)
    finally:
        for shard in shards:
            shard.stop(drain_s=0.0)  # keeps what is on its way to the store

    assert sorted(written) == [("s0", 3_000_000), ("s1", 2_000_000)]
