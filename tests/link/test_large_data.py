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
from enact_dist.errors import LeaseLostError
from enact_dist.link.shard_daemon import DaemonSettings, start_shard

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
tray = Entity("tray")


@pytest.fixture
def far(request, make_settings, endpoint, monkeypatch):
    """A shard behind a network: `far()` opens a cell through `far.proxy`."""
    monkeypatch.setenv("ENACT_CARRIER", "zenoh")
    port = int(endpoint.rpartition(":")[2])
    cells = []
    with TcpProxy(port, bytes_per_s=getattr(request, "param", None)) as proxy:
        shard = make_settings("s0", endpoints=(proxy.endpoint,))
        started = start_shard(DaemonSettings("cell", shard, (endpoint,), None))

        def open_cell(*, direct=False):
            cells.append(connect(endpoint if direct else proxy.endpoint))
            return cells[-1]

        open_cell.proxy = proxy
        yield open_cell
        for cell in cells:
            cell.close()
        started.stop(drain_s=0.0)


def recorded(cell):
    """Return the list to which the calls of slices of `cell` are added: what, begun or waited."""
    carrier, seen = cell._client.carrier, []
    begin = carrier.begin

    class Begun:
        def __init__(self, message, begun):
            self._message, self._begun = message, begun
            self.abandon = begun.abandon

        def wait(self, into=None):
            seen.append(("waited", self._message))
            return self._begun.wait(into)

    def note(shard, message, *, timeout_s):
        seen.append(("begun", message))
        return Begun(message, begin(shard, message, timeout_s=timeout_s))

    carrier.begin = note
    return seen


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
    assert 0 < repeated <= 8 * far.proxy.cuts
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
