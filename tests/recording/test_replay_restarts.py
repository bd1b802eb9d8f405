"""A replay through a restart after which its shard knows the aspects no more, or as others."""

import pytest
from ports import free_endpoint
from recording_samples import counting

from enact_dist import Aspect, Entity, View, connect
from enact_dist.core.protocol.parts import PlacementMap, ShardEntry
from enact_dist.core.shard.state import ShardSettings
from enact_dist.errors import DatumTypeError
from enact_dist.link.daemon.daemon import start_shard
from enact_dist.link.daemon.settings import DaemonSettings
from enact_dist.recording import Replay

piece, other = Entity("piece"), Entity("other")


class Restarted:
    """A shard that keeps nothing: started again, it knows no aspect."""

    def __init__(self):
        self.endpoint = free_endpoint()
        self._start()

    def _start(self):
        placement = PlacementMap(1, (ShardEntry("s0", (self.endpoint,)),), ())
        settings = ShardSettings("s0", placement, worlds=("online",))
        self.running = start_shard(DaemonSettings("cell", settings, (self.endpoint,)))

    def restart(self):
        self.running.stop(drain_s=0.0)
        self._start()


@pytest.fixture
def shard():
    made = Restarted()
    yield made
    made.running.stop(drain_s=0.0)


@pytest.mark.parametrize("type_", [int, str])
def test_restart_before_a_lock_is_noticed_before_the_commit(shard, tmp_path, monkeypatch, type_):
    """What the cell could not read by the type that it has now is not set; else it goes on."""
    path = tmp_path / "run.mcap"
    counting(path, 3).close({"missing": "0"})
    value = Aspect("value", type_)
    with connect(shard.endpoint) as cell:
        acquire, asked = cell._client.acquire, []

        def acquire_late(*items, **options):
            asked.append(items)
            if len(asked) == 2:
                shard.restart()
                with connect(shard.endpoint) as first:
                    first.world("online").init(other, value, type_(7))
            return acquire(*items, **options)

        monkeypatch.setattr(cell._client, "acquire", acquire_late)
        if type_ is str:
            with pytest.raises(DatumTypeError, match="value"):
                Replay(cell, path, speed=0.0).run()
        else:
            Replay(cell, path, speed=0.0).run()
    with connect(shard.endpoint) as cell:
        online = cell.world("online")
        found = online.view(View(online, piece, value), View(online, other, value))
        assert found.get(View(online, other, value)) == type_(7)
        assert found.get(View(online, piece, value)) == (3 if type_ is int else None)
