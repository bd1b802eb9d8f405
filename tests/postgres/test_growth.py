"""What a shard takes in its database, and in its daemon, does not grow with the commits."""

import gc
import os
import random
from pathlib import Path

import pytest
from shard_stores import address_of, state

pytestmark = pytest.mark.slow
COMMITS = int(os.environ.get("ENACT_STORE_COMMITS", "3000"))
SLOTS = 50
LARGE_EACH = 20
"""Every so many commits write a body that does not fit into its row."""
TABLES = ("shard", "record", "body")


def sizes_bytes(node):
    """Return what each table takes once its dead rows may be used again."""
    for table in TABLES:
        node.execute(f"VACUUM (ANALYZE) enact.{table}")
    found = [node.execute(f"SELECT pg_total_relation_size('enact.{one}')") for one in TABLES]
    return [size for ((size,),) in found]


def resident_bytes():
    """Return the memory of this process."""
    gc.collect()
    pages = Path("/proc/self/statm").read_text().split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def test_tables_and_memory_do_not_grow_with_the_commits(server, stores):
    """The second half of many commits of the same slots takes no room that the first had not."""
    rng = random.Random(3)
    store, _, _ = stores.open(address_of(server.url, lease_s=60.0))
    halves = []
    for half in range(2):
        for number in range(half * COMMITS // 2, (half + 1) * COMMITS // 2):
            body = rng.randbytes(70_000) if number % LARGE_EACH == 0 else b""
            version = number // SLOTS + 1
            store.write([state(version, f"part/{number % SLOTS}", body=body)])
        halves.append((sizes_bytes(server), resident_bytes()))
        print(COMMITS // 2, "commits:", halves[-1])

    (tables, memory), (tables_later, memory_later) = halves
    for name, before, after in zip(TABLES, tables, tables_later, strict=True):
        assert after <= before * 1.25 + (1 << 20), (name, before, after)
    assert memory_later <= memory + (16 << 20), (memory, memory_later)
