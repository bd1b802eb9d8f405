"""A cell inside the test's own process, or one shard behind a socket, with two world contexts."""

import socket

import pytest

from enact_dist import connect, local

WORLDS = ("online", "training")
OVER_A_SOCKET_TOO = ("test_lock", "test_world", "test_watch", "test_diff", "test_diff_watch")
"""What a user may rely on, wherever the shard is."""


def pytest_generate_tests(metafunc):
    """Run these modules over a socket, too."""
    module = metafunc.module.__name__.rpartition(".")[2]
    if "cell" in metafunc.fixturenames and module in OVER_A_SOCKET_TOO:
        metafunc.parametrize("cell", ["local", "socket"], indirect=True)


@pytest.fixture
def cell(request, tmp_path, monkeypatch):
    """The paper's mode; parametrised indirectly with "socket" or "zenoh", a shard beside it."""
    carrier = getattr(request, "param", "local")
    if carrier == "local":
        with local(worlds=list(WORLDS)) as opened:
            yield opened
        return
    from enact_dist.core.messages import PlacementMap, ShardEntry
    from enact_dist.core.shard_state import ShardSettings
    from enact_dist.link.shard_daemon import DaemonSettings, start_shard

    monkeypatch.setenv("ENACT_CARRIER", carrier)
    monkeypatch.setenv("ENACT_SHARED_FOLDER", str(tmp_path))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    placement = PlacementMap(1, (ShardEntry("local", (endpoint,)),), ())
    settings = ShardSettings("local", placement, worlds=WORLDS)
    shard = start_shard(DaemonSettings("cell", settings, (endpoint,), carrier=carrier))
    try:
        with connect(endpoint) as opened:
            yield opened
    finally:
        shard.stop(drain_s=0.0)


@pytest.fixture
def online(cell):
    return cell.world("online")
