"""First contact: which shards of which cell answer at an endpoint."""

import pytest

from enact_dist.core.protocol.messages import Hello, ShardEntry, Welcome
from enact_dist.errors import ShardUnreachableError
from enact_dist.link.zenoh.discovery import FoundShard, discover, find_shards


def test_discovery_learns_cell_and_shard_from_one_endpoint(daemon, endpoint):
    """Whoever knows one endpoint finds out which shard of which cell is there."""
    daemon(endpoint, cell="palletizing")

    found = find_shards([endpoint], timeout_s=30)

    assert found == (FoundShard("palletizing", "s0"),)


def test_discovery_brings_the_welcome_of_the_first_shard(daemon, endpoint):
    """A hello to an endpoint is answered by its shard with the whole map of the cell."""
    daemon(endpoint)

    cell, welcome = discover(
        [endpoint], Hello("me", 0, 2_000_000_000, "tester", "h", 1, True), timeout_s=30
    )

    assert cell == "cell"
    assert isinstance(welcome, Welcome)
    assert welcome.placement.shards == (ShardEntry("s0", (endpoint,)),)


def test_discovery_names_the_endpoint_when_nobody_answers(endpoint):
    """No shard at an endpoint is an error that names it, after the time given."""
    hello = Hello("me", 0, 2_000_000_000, "tester", "h", 1, True)

    with pytest.raises(ShardUnreachableError, match=endpoint):
        discover([endpoint], hello, timeout_s=0.3)
