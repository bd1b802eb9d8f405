"""History of durable aspects after a restart of its shard, seen by a user of the API."""

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, View, Write, connect
from enact_dist.errors import StoreError

CLOUD = Aspect("cloud", np.ndarray, Durability.DURABLE, retention=4)
TRAY = Entity("tray")
SIZE = 200_000


def publish(world, number):
    """Commit an array that says which one it is."""
    request = Write(world, TRAY, CLOUD)
    with Lock(request) as lock:
        lock[request] = np.full(SIZE, number, np.uint8)
    return lock.position


@pytest.fixture
def restarted(daemon, endpoint, tmp_path):
    """A shard that has kept versions, forks and labels, was stopped, and starts with `start()`."""
    shard = daemon(endpoint, folder=tmp_path)
    with connect(endpoint) as cell:
        online = cell.world("online")
        positions = [publish(online, 1)]
        cell.pin("first", online.history(TRAY, CLOUD))
        positions += [publish(online, number) for number in range(2, 7)]
        online.fork("fork", at=positions[2])
    shard.stop()

    def start():
        daemon(endpoint, folder=tmp_path)
        return connect(endpoint)

    start.positions, start.folder = positions, tmp_path / "blobs"
    return start


def test_history_forks_and_labels_are_there_after_a_restart(restarted):
    """Versions with their data, as of their times, and the fork that shares one of them."""
    with restarted() as cell:
        online, fork = cell.world("online"), cell.world("fork")
        found = online.history(TRAY, CLOUD)
        assert [version.version for version in found] == [1, 3, 4, 5, 6]
        assert [int(version.datum()[0]) for version in found] == [1, 3, 4, 5, 6]
        assert cell.pinned()["first"][0].version == 1
        for world in (fork, online.at(restarted.positions[2])):
            request = View(world, TRAY, CLOUD)
            assert int(world.view(request)[request][0]) == 3


def test_damaged_version_is_refused_by_its_file_and_the_shard_goes_on(restarted):
    """The start does not read history; who reads that version is told, everybody else is served."""
    damaged = min(restarted.folder.iterdir())
    content = bytearray(damaged.read_bytes())
    number = content[-1]
    content[SIZE // 2] ^= 1
    damaged.write_bytes(content)
    with restarted() as cell:
        found = {v.version: v for v in cell.world("online").history(TRAY, CLOUD)}
        with pytest.raises(StoreError, match=f"{damaged} is damaged"):
            found.pop(number).datum()
        for version, entry in found.items():
            assert int(entry.datum()[0]) == version
        publish(cell.world("online"), 7)
