"""Two accounts on two shards, for what is committed over both; and daemons with a trap in them."""

from pathlib import Path

from enact_dist import Aspect, Entity

LAUNCHER = Path(__file__).with_name("dying_shard.py")
COUNT = Aspect("count", int)
LEFT, RIGHT = Entity("account/left"), Entity("account/right")
PINS = """
[[pins]]
entities = "account/left"
shard = "s0"
[[pins]]
entities = "account/right"
shard = "s1"
"""


def two_shards(make_cell, *, ttl_s):
    """Return a cell of two shards with one account on each; nothing is started."""
    return make_cell(shards=("s0", "s1"), pins=PINS, ttl_s=ttl_s)


def two_trapped_shards(make_cell, *, ttl_s):
    """Return such a cell whose daemons run with the trap in them."""
    cell = two_shards(make_cell, ttl_s=ttl_s)
    for name in cell.ports:
        start_trapped(cell, name)
    return cell


def start_trapped(cell, name):
    """Start a shard's daemon with the trap in it, and wait until it serves."""
    return cell.start(name, launcher=(str(LAUNCHER),))


def open_accounts(joined, left=0, right=0):
    """Put numbers on both accounts; return the connection."""
    joined.world("online").init(LEFT, COUNT, left)
    joined.world("online").init(RIGHT, COUNT, right)
    return joined
