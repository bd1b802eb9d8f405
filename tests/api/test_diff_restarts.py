"""Diffs of a shard that restarts: nothing is compared with what is gone, and nothing is missed."""

import numpy as np
import pytest
from ports import free_endpoint
from slots import put

from enact_dist import Aspect, Durability, Entity, Tolerance, connect
from enact_dist.core.protocol.messages import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import ForgottenError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings

SHIFT = Aspect("shift_mm", float, compare=Tolerance(absolute=0.5))
SEEN = Aspect("seen", np.ndarray, Durability.VOLATILE)
piece = Entity("piece")
SOON_S = 30.0


@pytest.fixture
def restart(tmp_path, monkeypatch):
    """A shard with a folder, which the returned function kills and starts again."""
    monkeypatch.setenv("ENACT_CARRIER", "socket")
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path / "shared"))
    (tmp_path / "shared").mkdir()
    endpoint = free_endpoint()
    placement = PlacementMap(1, (ShardEntry("local", (endpoint,)),), ())
    settings = ShardSettings("local", placement, worlds=("training", "online"), ttl_ns_max=10**9)
    daemon = DaemonSettings(
        "cell", settings, (endpoint,), carrier="socket", folder=tmp_path / "data"
    )
    running = [start_shard(daemon)]

    def again():
        running.pop().stop(drain_s=0.0)
        running.append(start_shard(daemon))

    again.endpoint = endpoint
    yield again
    running.pop().stop(drain_s=0.0)


@pytest.fixture
def cell(restart):
    with connect(restart.endpoint) as opened:
        yield opened


def told(watch):
    row = watch.next(SOON_S)
    return row and (row.entity.name, row.aspect, row.kind.value)


def test_watch_of_a_diff_outlives_a_restart(cell, restart):
    """What was written before and after is told; what the shard lost is, too."""
    training, online = cell.world("training"), cell.world("online")
    for world in (training, online):
        put(world, piece, SHIFT, 0.0)
    put(online, piece, SEEN, np.zeros(3))
    with training.watch_diff(online) as watch:
        assert told(watch) == ("piece", "seen", "only right")
        restart()
        assert told(watch) == ("piece", "seen", "equal")
        put(online, piece, SHIFT, 2.0)
        assert told(watch) == ("piece", "shift_mm", "changed")


def test_diff_after_a_restart_takes_a_new_look(cell, restart, monkeypatch):
    """A shard that restarts between the cut and its data costs another cut, and no error."""
    from enact_dist.compare.two_worlds import SideView

    large = Aspect("large", np.ndarray)
    training, online = cell.world("training"), cell.world("online")
    for world, value in ((training, 0.0), (online, 3.0)):
        put(world, piece, large, np.full(100_000, value))
    fetch, restarts = SideView.fetch, []

    def fetch_late(self, readings):
        if not restarts:
            restarts.append(restart())
            self.session.cache.__init__()
            self.session.client.payloads.close()
        return fetch(self, readings)

    monkeypatch.setattr(SideView, "fetch", fetch_late)
    (row,) = training.diff(online, "**", large)
    assert row.difference.distance == 3.0
    assert len(restarts) == 1


def test_past_of_a_volatile_datum_ends_with_its_shard(cell, restart):
    """What is not known any more is said so, and never shown as the present."""
    online = cell.world("online")
    before = online.at(put(online, piece, SEEN, np.zeros(3)))
    assert not online.diff(before)
    restart()
    with pytest.raises(ForgottenError):
        before.diff(online)
