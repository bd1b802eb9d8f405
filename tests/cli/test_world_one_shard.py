"""Commands do without a shard that is away where its data are not asked for."""

import pytest

from enact_dist import Aspect, Entity, connect

PINS = """
[[pins]]
entities = "near/**"
shard = "left"

[[pins]]
entities = "far/**"
shard = "right"
"""


@pytest.fixture
def half(write_cell, spawn, until):
    """The file of a cell whose shard `right` has run and is away."""
    file = write_cell(PINS)
    shards = [spawn("shard", "run", name, "--cell", file) for name in ("left", "right")]
    for shard in shards:
        until(shard, "ready: shard")
    with connect(file) as cell:
        online = cell.world("online")
        for name in ("near", "far"):
            online.init(Entity(f"{name}/1"), Aspect("count", int), 1)
        online.init(Entity("far/1"), Aspect("only_far", int), 1)
    shards[1].kill()
    shards[1].wait(60)
    return file


def test_datum_of_the_other_shard_can_be_put(half, enact):
    """Read, set and locked; what lies on the shard that is away is refused by its name."""
    near, at = ("online", "near/1/count"), ("--cell", half, "--timeout", "5")

    assert enact("world", "put", *near, "7", *at).status == 0
    assert enact("world", "get", *near, *at).out.strip() == "7"
    assert enact("lock", "hold", "online:near/1/count:write", *at, "--", "true").status == 0
    far = enact("world", "put", "online", "far/1/count", "7", *at)
    held = enact("lock", "hold", "online:far/1/count:write", *at, "--", "true")
    assert (far.status, held.status) == (3, 3)
    assert "shard right at " in far.err
    assert "shard right at " in held.err


def test_aspect_that_only_the_shard_away_may_know_waits_for_it(half, enact):
    """Nobody else can say whether it is registered, and with which type."""
    unknown = enact(
        "world", "put", "online", "near/1/only_far", "7", "--cell", half, "--timeout", "2"
    )

    assert unknown.status == 3
    assert "shard right at " in unknown.err
