"""Payload files of versions that a fork, history or a label shares: how long they are there."""

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import ForgottenError, NoRoomError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.link.memory.maps import leftovers

CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE, retention=10)
TRAY = Entity("tray")
SIZE = 200_000
FILES_MAX = 4


@pytest.fixture
def cell(make_settings, endpoint):
    """A cell of one shard whose shared memory holds a few arrays; `cell.files()` counts them."""
    settings = DaemonSettings(
        "cell",
        make_settings("s0", endpoints=(endpoint,)),
        (endpoint,),
        shared_bytes_max=FILES_MAX * (SIZE + 10_000),
    )
    shard = start_shard(settings)
    found = connect(endpoint)

    def files():
        assert leftovers().wait(30)
        return shard.host.payloads.figures()["payload_files"]

    found.files, found.shard = files, shard
    yield found
    found.close()
    shard.stop(drain_s=0.0)


def publish(world, number):
    """Commit an array that says which one it is; nothing of it stays here."""
    request = Write(world, TRAY, CLOUD)
    with Lock(request) as lock:
        lock[request] = np.full(SIZE, number, np.uint8)


def shown(world):
    """Return which array a world context shows."""
    request = View(world, TRAY, CLOUD)
    return int(world.view(request)[request][0])


def test_refusal_names_the_largest_slots_where_there_are_any(cell):
    """A shard that holds nothing lists nothing."""
    source = cell.create_world("source")
    request = Write(source, TRAY, CLOUD)

    with (
        pytest.raises(NoRoomError, match=r"; 0 of at most \d+ are in use; raise shared_bytes_max"),
        Lock(request) as lock,
    ):
        lock[request] = np.zeros(2 * FILES_MAX * SIZE, np.uint8)


def test_payload_of_a_fork_is_there_as_long_as_anything_that_names_it(cell):
    """One file for source, fork and the fork's history; it goes with the last of them."""
    source = cell.create_world("source")
    publish(source, 1)
    fork = source.fork("fork")
    other = source.fork("other")
    assert cell.files() == 1

    publish(fork, 2)
    cell.drop_world("source")
    assert (shown(fork), shown(other)) == (2, 1)
    assert cell.files() == 2
    cell.drop_world("other")
    assert cell.files() == 2
    assert int(fork.history(TRAY, CLOUD)[0].datum()[0]) == 1

    cell.drop_world("fork")
    assert cell.files() == 0


def test_room_is_made_of_the_oldest_history_and_never_of_what_is_kept(cell):
    """At the cap a write goes on as long as history is left; a label's version stays readable."""
    online = cell.world("online")
    publish(online, 1)
    cell.pin("evening", online.history(TRAY, CLOUD))
    for number in range(2, 9):
        publish(online, number)
        assert cell.files() <= FILES_MAX

    assert shown(online) == 8
    found = online.history(TRAY, CLOUD)
    assert [version.version for version in found] == [1, 6, 7, 8]
    assert [int(version.datum()[0]) for version in found] == [1, 6, 7, 8]

    cell.unpin("evening")
    assert cell.files() == 3
    with pytest.raises(ForgottenError):
        found[0].datum()


def test_payload_that_a_fork_names_is_no_room(cell):
    """History whose files something else shows frees nothing, and what that shows stays."""
    online = cell.world("online")
    publish(online, 1)
    fork = online.fork("fork")
    for number in range(2, 7):
        publish(online, number)

    assert (shown(fork), shown(online)) == (1, 6)
    assert cell.files() == FILES_MAX
