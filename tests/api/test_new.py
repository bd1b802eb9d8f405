"""`lock.new`: arrays that are filled in place and committed without a copy."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from polling import until

from enact_dist import Aspect, Durability, Entity, Lock, Read, View, Write
from enact_dist.errors import DatumTypeError, LockReleasedError, MisuseError, ReadonlyError
from enact_dist.link.memory.maps import leftovers

piece = Entity("work_piece")
CARRIERS = pytest.mark.carrier("local", "socket", "zenoh")
ROWS = pytest.mark.parametrize("rows", [0, 4, 50_000, 1_000_000])
"""Of 12 bytes: nothing, with the commit, and two payloads."""


@dataclass(frozen=True)
class Pose:
    matrix: np.ndarray


@dataclass(frozen=True)
class Surface:
    vertices_m: np.ndarray
    triangles: np.ndarray
    pose: Pose
    name: str
    note: str


@dataclass(frozen=True)
class Points:
    points_m: NDArray[np.float32]
    colors: np.ndarray


@dataclass(frozen=True)
class Colored:
    colors: NDArray[np.float64]

    def __post_init__(self):
        if self.colors.shape[1] != 3 or not (self.colors <= 1.0).all():
            raise ValueError("three columns, of at most 1")


@dataclass(frozen=True)
class Counted:
    numbers: np.ndarray
    total: np.ndarray = field(init=False)


VIEW = Aspect("view", Points, Durability.VOLATILE)
CLOUD = Aspect("cloud", np.ndarray, Durability.VOLATILE)
COLORED = Aspect("colored", Colored, Durability.VOLATILE)
COUNTED = Aspect("counted", Counted, Durability.VOLATILE)
SURFACE = Aspect("surface", Surface, Durability.VOLATILE)
TEXT = Aspect("text", str, Durability.VOLATILE)


def payloads():
    """Return the names of all payloads in this test's shared folders."""
    root = Path(os.environ.get("ENACT_SHARED_FOLDER", "/nonexistent"))
    return [path.name for path in root.glob("*/*-*") if not path.name.startswith("uses-")]


def come_down_to(count):
    """Wait until so many payloads are left: a shard lets go of the others after its answers."""
    until(lambda: len(payloads()) <= count, missed=payloads)
    return len(payloads()) == count


@CARRIERS
@ROWS
def test_array_is_filled_in_place(online, rows):
    """What is in it at the end of the block is what everybody reads, stamp and all."""
    write, read = Write(online, piece, CLOUD), Read(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (rows, 3), np.float32, stamp_ns=5)
        assert (cloud.shape, cloud.dtype, cloud.flags.writeable) == ((rows, 3), np.float32, True)
        cloud[:] = np.arange(3 * rows).reshape(rows, 3)
        assert lock[write].shape == (rows, 3)

    with Lock(read) as lock:
        found, stamp_ns = lock[read], lock.stamp_ns(read)
    assert np.array_equal(found, np.arange(3 * rows).reshape(rows, 3))
    assert (found.dtype, stamp_ns) == (np.float32, 5)


@CARRIERS
def test_dataclass_is_filled_in_place(online):
    """Its arrays look like those of `like`, order included; everything else is taken over."""
    write, read = Write(online, piece, SURFACE), Read(online, piece, SURFACE)
    like = Surface(
        np.empty((30_000, 3), np.float64),
        np.empty((50, 3), np.int32, order="F"),
        Pose(np.empty((4, 4))),
        "tray",
        "n" * 500,
    )
    with Lock(write) as lock:
        surface = lock.new(write, like=like)
        surface.vertices_m[:] = 1.5
        surface.triangles[:] = 7
        surface.pose.matrix[:] = np.eye(4)

    assert not surface.vertices_m.flags.writeable
    with Lock(read) as lock:
        found = lock[read]
    assert (found.name, found.note) == ("tray", "n" * 500)
    assert found.triangles.flags.f_contiguous
    assert (found.vertices_m == 1.5).all()
    assert (found.triangles == 7).all()
    assert np.array_equal(found.pose.matrix, np.eye(4))


@CARRIERS
def test_dataclass_of_arrays_is_filled_in_place(online):
    """Shapes stand by field; dtypes as annotated, as given for all, or as given by field."""
    write, read = Write(online, piece, VIEW), Read(online, piece, VIEW)
    shapes = {"points_m": (20_000, 3), "colors": (20_000, 3)}
    with Lock(write) as lock:
        view = lock.new(write, shapes)
        view.points_m[:] = 0.5
        view.colors[:] = 7
    with Lock(read) as lock:
        found = lock[read]
    assert (found.points_m == 0.5).all()
    assert (found.points_m.dtype, found.colors.dtype) == (np.float32, np.float64)
    with Lock(write) as lock:
        assert lock.new(write, shapes, {"colors": np.uint8}).colors.dtype == np.uint8
        del lock[write]
        lock.new(write, shapes, np.float32)


def test_wrong_fields_and_shapes_are_named(online):
    """Each wrong way to ask for a dataclass or an array says what was asked and what there is."""
    write, surface = Write(online, piece, VIEW), Write(online, piece, SURFACE)
    cloud, colored = Write(online, piece, CLOUD), Write(online, piece, COLORED)
    counted = Write(online, piece, COUNTED)
    with Lock(write, surface, cloud, colored, counted) as lock:
        with pytest.raises(DatumTypeError, match=r"\['points_m'\] were given; the fields"):
            lock.new(write, {"points_m": (3, 3)})
        with pytest.raises(DatumTypeError, match=r"dtypes of \['normals'\]"):
            lock.new(write, {"points_m": 1, "colors": 1}, {"normals": np.uint8})
        with pytest.raises(DatumTypeError, match="no dataclass of arrays alone; give like"):
            lock.new(surface, {"vertices_m": (3, 3)})
        with pytest.raises(DatumTypeError, match="no dataclass of arrays alone; give like"):
            lock.new(cloud, {"points_m": (3, 3)})
        with pytest.raises(DatumTypeError, match="no array of shape -1"):
            lock.new(cloud, -1)
        with pytest.raises(DatumTypeError, match="no array of shape"):
            lock.new(cloud, (3,), "no dtype")
        with pytest.raises(MisuseError, match="either shape and dtype, or like"):
            lock.new(cloud, dtype=np.float32, like=np.zeros(3, np.uint8))
        with pytest.raises(DatumTypeError, match=r"Colored takes no arrays.*three columns.*like="):
            lock.new(colored, {"colors": (9, 2)})
        with pytest.raises(DatumTypeError, match=r"Counted takes no arrays.*total.*give like="):
            lock.new(counted, {"numbers": 9, "total": 1})


@CARRIERS
@pytest.mark.parametrize("rows", [4, 50_000])
def test_checks_of_a_dataclass_see_zeros(online, rows):
    """Not what the memory of the process happens to hold, which they might refuse or not."""
    write = Write(online, piece, COLORED)
    waste = [np.full(3 * rows, np.nan) for _ in range(8)]  # what a new array may then lie in
    del waste
    with Lock(write) as lock:
        lock.new(write, {"colors": (rows, 3)}).colors[:] = 0.5

    with Lock(Read(online, piece, COLORED)) as lock:
        assert (lock[Read(online, piece, COLORED)].colors == 0.5).all()


@CARRIERS
def test_part_that_nobody_fills_is_none_of_the_memory_of_the_writer(online, monkeypatch):
    """What lies there by chance would be everybody's to read."""
    write, empty = Write(online, piece, CLOUD), np.empty

    def with_secrets(*arguments, **options):
        array = empty(*arguments, **options)
        array[...] = 0x5A
        return array

    with Lock(write) as lock:
        monkeypatch.setattr(np, "empty", with_secrets)
        lock.new(write, (1000,), np.uint8)[:10] = 1
        monkeypatch.undo()

    with Lock(Read(online, piece, CLOUD)) as lock:
        assert lock[Read(online, piece, CLOUD)].sum() == 10


@CARRIERS
@ROWS
def test_array_is_read_only_after_the_block(online, rows):
    """Its writer cannot change what was committed by accident."""
    write = Write(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (rows, 3), np.float32)
        cloud[:] = 1.0

    with pytest.raises(ValueError, match="read-only"):
        cloud[...] = 2.0
    assert (cloud == 1.0).all()


def change(array, kept, value):
    """Write to a committed array through a view of before, and by making it writable again."""
    kept[:] = value
    try:
        array.setflags(write=True)
    except ValueError:  # numpy refuses it where the memory is read-only by itself
        return
    array[0] = value


@CARRIERS
@pytest.mark.parametrize("size", [1000, 1 << 16, (1 << 16) + 1, 1_000_000, 9_000_000])
def test_view_made_before_the_commit_reaches_nobody_after_it(online, size):
    """A stray write stays with its array: neither who has read it sees it, nor who reads it then.

    The array itself keeps what was committed until then.
    """
    write, view = Write(online, piece, CLOUD), View(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (size,), np.uint8)
        cloud[:] = 1
        kept, seen = cloud[10:20], lock[write]
    with Lock(view) as lock:
        before = lock[view]
    assert leftovers().wait(30.0)
    assert (cloud == 1).all()

    change(cloud, kept, 99)

    assert (kept == 99).all()
    with Lock(view) as lock:
        after = lock[view]
    assert [int(each.max()) for each in (before, after)] == [1, 1]
    assert not seen.flags.writeable
    with pytest.raises(ValueError, match="WRITEABLE"):
        after.setflags(write=True)


@pytest.mark.carrier("socket", "zenoh")
@pytest.mark.parametrize("size", [1000, 1_000_000, 9_000_000])
def test_stray_write_reaches_nobody_where_no_memory_is_shared(online, size):
    """The shard has its own copy, and what this process remembers of it is none of its arrays."""
    online.session.client.payloads.close()  # from here on all data travel
    assert online.session.client.payloads.draft("local", 1_000_000) is None
    write, view = Write(online, piece, CLOUD), View(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (size,), np.uint8)
        cloud[:] = 1
        kept = cloud[10:20]
    with Lock(view) as lock:
        before = lock[view]

    change(cloud, kept, 99)

    for _ in range(2):  # the second time it may come from the cache
        with Lock(view) as lock:
            assert (lock[view] == 1).all()
    assert (before == 1).all()


@pytest.mark.carrier("local")
@pytest.mark.parametrize("size", [1_000_000, 9_000_000])
def test_stray_write_reaches_nobody_where_no_file_can_be_had(online, size, monkeypatch):
    """Without a descriptor left, say, the commit copies; a counter tells."""

    def refuse(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(os, "memfd_create", refuse)
    write, view = Write(online, piece, CLOUD), View(online, piece, CLOUD)
    with Lock(write) as lock:
        cloud = lock.new(write, (size,), np.uint8)
        cloud[:] = 1
        kept = cloud[10:20]

    change(cloud, kept, 99)

    with Lock(view) as lock:
        assert (lock[view] == 1).all()
    assert online.session.client.counters["payload_fallbacks"] == 1


@pytest.mark.carrier("local")
def test_descriptors_of_new_arrays_go_with_the_block(online):
    """Committed, dropped or replaced: none is left open once they are cut off."""
    write = Write(online, piece, CLOUD)

    def fail():
        with Lock(write) as lock:
            lock.new(write, (1_000_000,), np.uint8)[:] = 1
            raise KeyError("on purpose")

    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(20):
        with Lock(write) as lock:
            lock.new(write, (1_000_000,), np.uint8)[:] = 1
            lock[write] = np.ones(3)
        with Lock(write) as lock:
            lock.new(write, (1_000_000,), np.uint8)[:] = 1
        with pytest.raises(KeyError):
            fail()
    assert leftovers().wait(30.0)

    assert len(list(Path("/proc/self/fd").iterdir())) == before


@CARRIERS
def test_block_that_raises_leaves_nothing(online):
    """No datum, no file."""
    write = Write(online, piece, CLOUD)

    def fail():
        with Lock(write) as lock:
            lock.new(write, (1_000_000,), np.uint8)[:] = 1
            raise KeyError("on purpose")

    with pytest.raises(KeyError):
        fail()

    assert come_down_to(0)
    with Lock(write) as lock:
        assert lock.is_null(write)


@CARRIERS
def test_last_write_of_a_block_counts(online):
    """A put or a deletion takes the place of what was handed out; its file goes."""
    write, read = Write(online, piece, CLOUD), Read(online, piece, CLOUD)
    with Lock(write) as lock:
        lock.new(write, (200_000,), np.uint8)[:] = 1
        del lock[write]
        lock.new(write, (300_000,), np.uint8)[:] = 2
        lock[write] = np.full(100_000, 3, np.uint8)
    with Lock(read) as lock:
        assert np.array_equal(lock[read], np.full(100_000, 3, np.uint8))
    assert come_down_to(0 if online.session.client.carrier.transport_of("local") == "call" else 1)

    with Lock(write) as lock:
        lock.new(write, (200_000,), np.uint8)[:] = 1
        del lock[write]
        assert lock.is_null(write)
    with Lock(read) as lock:
        assert lock.is_null(read)


@CARRIERS
@pytest.mark.parametrize("size", [1000, 1_000_000])
def test_second_new_of_a_block_is_refused(online, size):
    """It would commit what nobody has filled; the first one stands, and can be given up."""
    write, read = Write(online, piece, CLOUD), Read(online, piece, CLOUD)
    with Lock(write) as lock:
        first = lock.new(write, (size,), np.uint8)
        first[:] = 1
        with pytest.raises(MisuseError, match=r"datum of work_piece/cloud.*`del lock\[request\]`"):
            lock.new(write, (size + 1,), np.uint8)
        first[:2] = 2
    with Lock(read) as lock:
        assert lock[read][:4].tolist() == [2, 2, 1, 1]

    with Lock(write) as lock:
        lock.new(write, (size + 1,), np.uint8)[:] = 3  # of another length: no file is made ahead
        del lock[write]
        lock.new(write, (5,), np.uint8)[:] = 4
        lock[write] = np.full(5, 5, np.uint8)
        lock.new(write, (6,), np.uint8)[:] = 6
    with Lock(read) as lock:
        assert lock[read].tolist() == [6] * 6
    shared = size > 1000 and online.session.client.carrier.transport_of("local") != "call"
    assert come_down_to(1 if shared else 0)  # what was committed and replaced


@CARRIERS
@pytest.mark.parametrize("size", [1000, 5_000_000])
def test_array_that_was_put_may_be_changed_afterwards(online, size):
    """Only what `new` hands out is the datum itself: `put` copies."""
    write, read = Write(online, piece, CLOUD), Read(online, piece, CLOUD)
    mine = np.full(size, 1, np.uint8)
    with Lock(write) as lock:
        lock.put(write, mine, stamp_ns=9)
        mine[:] = 2

    mine[:] = 3
    with Lock(read) as lock:
        assert (lock[read] == 1).all()


def test_misuse_is_named(online):
    """Neither shape nor like, another dtype, no array, another access, after the block."""
    write, read = Write(online, piece, CLOUD), Read(online, Entity("other"), CLOUD)
    text = Write(online, piece, TEXT)
    with Lock(write, read, text) as lock:
        with pytest.raises(MisuseError, match="either shape and dtype, or like"):
            lock.new(write)
        with pytest.raises(DatumTypeError, match="Python objects"):
            lock.new(write, (3,), object)
        with pytest.raises(DatumTypeError, match="has none"):
            lock.new(text, like="x" * 100_000)
        with pytest.raises(ReadonlyError):
            lock.new(read, (3,), np.float32)
    with pytest.raises(LockReleasedError):
        lock.new(write, (3,), np.float32)
