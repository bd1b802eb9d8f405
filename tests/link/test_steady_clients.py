"""What is left of a connection that was closed, and of a cell that was dropped."""

import gc
import threading
from pathlib import Path

from enact_dist import connect

CYCLES = 100
KEPT_BYTES_MAX = 8_000
"""Most that a cycle may leave; 15,600 stayed before the shard's watch was ended on its own."""


def own_bytes():
    """Return the memory that this process has for itself."""
    _, resident, shared, *_ = map(int, Path("/proc/self/statm").read_text().split())
    return (resident - shared) * 4096


def test_connecting_and_closing_leaves_nothing_behind(process, endpoint):
    """Neither memory, nor objects, threads or descriptors, however often."""
    process(endpoint)

    def cycles(count):
        for _ in range(count):
            connect(endpoint, timeout_s=30.0).close()
        gc.collect()
        return own_bytes(), len(gc.get_objects()), threading.active_count()

    cycles(CYCLES // 2)  # what is made once, and what the allocator takes ahead
    before = cycles(1)
    after = cycles(CYCLES)

    assert after[2] <= before[2]
    assert after[1] - before[1] < CYCLES
    assert after[0] - before[0] < CYCLES * KEPT_BYTES_MAX
