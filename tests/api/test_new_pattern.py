"""`new` of a pattern: *look, then create* without a copy."""

import numpy as np
import pytest

from enact_dist import Aspect, Durability, Entities, Entity, Lock, ReadEach, Write, WriteEach
from enact_dist.errors import MisuseError

piece, bench, tray = Entity("work/piece"), Entity("work/bench"), Entity("tray")
CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
pytestmark = [
    pytest.mark.carrier("local", "socket", "zenoh"),
    pytest.mark.parametrize("size", [1000, 1_000_000]),
]


def test_entity_is_created_with_an_array_that_is_filled_in_place(online, size):
    """It is one of the pattern's data from then on, bears its stamp and is read-only in the end."""
    each = WriteEach(online, Entities("work/*"), CLOUD)
    with Lock(each) as lock:
        assert not lock[each]
        cloud = lock[each].new(piece, (size,), np.uint8, stamp_ns=5)
        cloud[:] = 1
        other = lock[each].new(bench, like=np.zeros((size, 1), np.uint8))
        other[:] = 2
        assert [lock[each].stamp_ns(entity) for entity in (piece, bench)] == [5, 0]
        assert {entity: int(found.sum()) for entity, found in lock[each].items()} == {
            piece: size,
            bench: 2 * size,
        }
    assert not cloud.flags.writeable
    assert not other.flags.writeable

    read = ReadEach(online, Entities("work/*"), CLOUD)
    with Lock(read) as lock:
        assert {entity: found.shape for entity, found in lock[read].items()} == {
            piece: (size,),
            bench: (size, 1),
        }
        assert (lock[read][piece] == 1).all()
        assert [lock[read].stamp_ns(entity) for entity in (piece, bench)] == [5, 0]
        with pytest.raises(KeyError):
            lock[read].stamp_ns(tray)
    [version] = online.history(piece, CLOUD)
    assert version.stamp_ns == 5
    assert "payload_fallbacks" not in online.session.client.counters


def test_array_of_a_pattern_is_one_of_the_locks_data(online, size):
    """Given up, replaced and handed out a second time as through a `Write`, and with one."""
    each, write = WriteEach(online, Entities("work/*"), CLOUD), Write(online, piece, CLOUD)
    with Lock(each, write) as lock:
        lock[each].new(piece, (size,), np.uint8)
        for new in (lambda: lock.new(write, 3), lambda: lock[each].new(piece, 3)):
            with pytest.raises(MisuseError, match=r"work/piece/cloud.*`del lock\[request\]\[ent"):
                new()
        del lock[each][piece]
        assert piece not in lock[each]
        lock[each].new(piece, (size,), np.uint8)
        lock[write] = np.ones(3)
        lock[each].new(bench, (size,), np.uint8)[:] = 7
        with pytest.raises(MisuseError, match="does not match"):
            lock[each].new(tray, 3)
        with pytest.raises(MisuseError, match=r"one entity at a time.*\.new\(entity"):
            lock.new(each, 3)

    read = ReadEach(online, Entities("**"), CLOUD)
    with Lock(read) as lock:
        assert {entity: found.sum() for entity, found in lock[read].items()} == {
            piece: 3,
            bench: 7 * size,
        }
