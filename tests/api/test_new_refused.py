"""`lock.new` and `put` beyond what one lock may write: the block goes on as if never asked."""

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entity, Lock, Read, Write
from enact_dist.access import writes as writing
from enact_dist.errors import MisuseError

piece, bench = Entity("work_piece"), Entity("work_bench")
CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
CARRIERS = pytest.mark.carrier("local", "socket", "zenoh")


@CARRIERS
@pytest.mark.parametrize("size", [1000, 1_000_000])
@pytest.mark.parametrize("limit", ["ITEMS_MAX", "BODY_BYTES_MAX"])
def test_block_goes_on_after_a_new_that_was_refused(online, monkeypatch, limit, size):
    """What it wrote before is committed, and the refusal is the same when it asks again."""
    kept, write = Write(online, bench, CLOUD), Write(online, piece, CLOUD)
    with Lock(kept, write) as lock:
        lock[kept] = np.ones(3)
        monkeypatch.setattr(writing, limit, 1)
        for _ in range(2):
            with pytest.raises(MisuseError, match="several locks"):
                lock.new(write, (size,), np.uint8)

    with Lock(Read(online, bench, CLOUD), Read(online, piece, CLOUD)) as lock:
        assert lock[Read(online, bench, CLOUD)].tolist() == [1, 1, 1]
        assert lock.is_null(Read(online, piece, CLOUD))


@CARRIERS
@pytest.mark.parametrize("size", [1000, 1_000_000])
def test_put_that_is_refused_leaves_what_stood_before_it(online, monkeypatch, size):
    """An array that was handed out can still be filled, and is committed without a detour."""
    write, read = Write(online, piece, CLOUD), Read(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (size,), np.uint8)
        cloud[:] = 1
        monkeypatch.setattr(writing, "BODY_BYTES_MAX", 2 * size)
        for larger in (3 * size, 3_000_000):
            with pytest.raises(MisuseError, match="several locks"):
                lock[write] = np.zeros(larger, np.uint8)
        cloud[:5] = 2

    with Lock(read) as lock:
        assert lock[read][:7].tolist() == [2, 2, 2, 2, 2, 1, 1]
    assert "payload_fallbacks" not in online.session.client.counters
