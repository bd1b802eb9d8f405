"""An array from a lock cannot be changed by accident, on any way that its bytes took.

Measured with numpy 2: it lets nobody set `writeable` while the memory below an array says that it
is read-only, so each of these ways ends in an error.  Only Open3D does not ask; `actors` copy for
it, see `tests/actors/test_open3d_arrays.py`.
"""

from dataclasses import dataclass

import numpy as np
import pytest

from enact_dist import (
    Aspect,
    Durability,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
    local,
    register_codec,
)

piece = Entity("work_piece")
CARRIERS = pytest.mark.carrier("local", "socket", "zenoh")
ROWS = pytest.mark.parametrize("rows", [4, 3_000, 400_000], ids=["grant", "fetch", "slices"])
"""With the grant; fetched in one; 4.8 MB, which the carriers fetch in slices."""


@dataclass(frozen=True)
class Pose:
    matrix: np.ndarray


@dataclass(frozen=True)
class Scan:
    points_m: np.ndarray
    pose: Pose
    layers: list[np.ndarray]
    named: dict[str, np.ndarray]
    pair: tuple[np.ndarray, int]
    maybe: np.ndarray | None
    any: dict


class Track:
    """Known by a codec only."""

    def __init__(self, points_m):
        self.points_m = points_m


register_codec(Track, "read_only.track", encode=lambda t: t.points_m, decode=Track)
CLOUD, SCAN, TRACK = Aspect("cloud", np.ndarray), Aspect("scan", Scan), Aspect("track", Track)
KEPT = Aspect("kept", np.ndarray, Durability.DURABLE)


def points(rows, seed=0):
    return np.random.default_rng(seed).random((rows, 3)).astype(np.float32)


def scan(rows):
    structured = np.zeros(8, [("x", "<f8"), ("n", "<i4", (2,))])
    return Scan(
        points(rows),
        Pose(np.asfortranarray(np.eye(4) + np.arange(4))),
        [points(rows, 1), points(3, 2).astype(">f4")],
        {"a": structured, "flat": np.array(7.0)},
        (points(5, 3), 1),
        points(6, 4),
        {"inner": [points(7, 5)]},
    )


def arrays_of(found):
    """Return every array of a scan."""
    return [
        found.points_m,
        found.pose.matrix,
        *found.layers,
        *found.named.values(),
        found.pair[0],
        found.maybe,
        found.any["inner"][0],
    ]


class Borrowed:
    """Another library's object that says where the memory of an array lies."""

    def __init__(self, array):
        self.__array_interface__ = array.__array_interface__


def set_writeable(array):
    array.flags.writeable = True


WAYS = {
    "assignment": lambda a: a.__setitem__(..., 0),
    "in place": lambda a: np.copyto(a, np.zeros_like(a)),
    "fill": lambda a: a.fill(0),
    "the flag": set_writeable,
    "setflags": lambda a: a.setflags(write=True),
    "flag of a view": lambda a: set_writeable(a[...]),
    "flag of a turned view": lambda a: set_writeable(a.T),
    "asarray": lambda a: np.asarray(a).fill(0),
    "frombuffer": lambda a: np.frombuffer(a, "u1").fill(0),
    "memoryview": lambda a: np.asarray(memoryview(a)).fill(0),
    "flag over a memoryview": lambda a: set_writeable(np.asarray(memoryview(a))),
    "data": lambda a: np.asarray(a.data).fill(0),
    "base": lambda a: np.asarray(a.base).fill(0),
    "flag of the base": lambda a: set_writeable(np.asarray(a.base)),
    "buffer": lambda a: np.ndarray(a.shape, a.dtype, a, strides=a.strides).fill(0),
    "interface": lambda a: np.asarray(Borrowed(a)).fill(0),
    "strides": lambda a: np.lib.stride_tricks.as_strided(a).fill(0),
    "record": lambda a: a.view(np.recarray).fill(0),
    "byteswap": lambda a: a.byteswap(True),
    "shuffle": lambda a: np.random.default_rng(1).shuffle(a, axis=a.ndim - 1),
}


def check_read_only(array):
    """No way yields a writable array, and none has changed a bit."""
    before = array.tobytes()
    for name, way in WAYS.items():
        with pytest.raises((ValueError, TypeError, BufferError)):
            way(array)
            pytest.fail(f"{name} went through")
    for field in array.dtype.names or ():
        with pytest.raises(ValueError, match="read-only"):
            array[0][field] = 1
        with pytest.raises(ValueError, match="read-only"):
            array[field][0] = 1
    below = array.base
    while isinstance(below, np.ndarray):
        assert not below.flags.writeable
        below = below.base
    assert memoryview(below).readonly
    assert array.tobytes() == before


def test_the_ways_go_through_on_a_writable_array():
    """The list bites: on an array of one's own each way changes it or sets the flag."""
    for name, way in WAYS.items():
        own = np.arange(1.0, 25.0).reshape(2, 12)
        before = own.copy()
        way(own)
        assert "flag" in name or (own != before).any(), name
    with pytest.raises(pytest.fail.Exception, match="went through"):
        check_read_only(np.arange(8.0)[...])


@CARRIERS
@ROWS
def test_no_way_yields_a_writable_array(cell, online, rows):
    """Neither of a lock, nor of a pattern, nor of a view, however the bytes came."""
    value = points(rows)
    online.init(piece, CLOUD, value)
    one, each = Read(online, piece, CLOUD), ReadEach(online, Entities("*"), CLOUD)
    with Lock(one, each) as lock:
        for array in (lock[one], lock[each][piece]):
            check_read_only(array)
            np.testing.assert_array_equal(array, value)
    view = View(online, piece, CLOUD)
    check_read_only(online.view(view)[view])


@CARRIERS
@ROWS
def test_inner_arrays_are_read_only_too(cell, online, rows):
    """Fields of dataclasses, parts of lists, dicts and tuples, and what a codec gets."""
    value = scan(rows)
    online.init(piece, SCAN, value)
    online.init(piece, TRACK, Track(points(rows, 9)))
    whole, track = Read(online, piece, SCAN), Read(online, piece, TRACK)
    with Lock(whole, track) as lock:
        found = arrays_of(lock[whole])
        for array, given in zip(found, arrays_of(value), strict=True):
            check_read_only(array)
            assert array.dtype == given.dtype
            np.testing.assert_array_equal(array, given)
        check_read_only(lock[track].points_m)


@CARRIERS
@ROWS
def test_a_writer_keeps_its_arrays_and_may_change_them(cell, online, rows, tmp_path):
    """A datum is a copy, made when it is assigned: nothing done later reaches it."""
    value, own = scan(rows), points(rows, 7)
    mapped = np.memmap(tmp_path / "mapped", np.float32, "w+", shape=(rows, 3))
    mapped[...] = own
    kept = [array.copy() for array in arrays_of(value)]
    turned = np.asfortranarray(own)
    given = {"own": own, "mapped": mapped, "fortran": turned, "view": own.T, "part": own[::2]}
    names = {name: Entity(name) for name in given}
    clouds, whole = WriteEach(online, Entities("*"), CLOUD), Write(online, piece, SCAN)
    wanted = {name: np.array(array) for name, array in given.items()}
    with Lock(clouds, whole) as lock:
        lock[whole] = value
        for name, array in given.items():
            lock[clouds][names[name]] = array
        for array in (*arrays_of(value), mapped, turned):
            array[...] = np.zeros((), array.dtype)  # before the commit
        check_read_only(lock[whole].points_m)
        np.testing.assert_array_equal(lock[whole].points_m, kept[0])
    own[...] = -1.0  # after it
    with Lock(clouds, whole) as lock:
        for array, before in zip(arrays_of(lock[whole]), kept, strict=True):
            np.testing.assert_array_equal(array, before)
        for name, entity in names.items():
            np.testing.assert_array_equal(lock[clouds][entity], wanted[name])
            check_read_only(lock[clouds][entity])


def test_an_array_read_and_assigned_again_stays_apart(online):
    """What one lock read and another wrote on is never the same memory that a writer may change."""
    online.init(piece, CLOUD, points(3_000))
    cloud = Write(online, piece, CLOUD)
    with Lock(cloud) as lock:
        changed = lock[cloud].copy()
        changed[0] = 5.0
        lock[cloud] = changed
        changed[1] = 6.0
    with Lock(cloud) as lock:
        assert lock[cloud][0, 0] == 5.0
        assert lock[cloud][1, 0] != 6.0


def test_an_array_over_a_file_of_the_store_is_read_only(tmp_path):
    """After a restart a large durable datum lies in the file itself, mapped."""
    value = points(100_000)
    with local(tmp_path, worlds=["online"]) as cell:
        cell.world("online").init(piece, KEPT, value)
    for _ in range(2):
        with local(tmp_path) as cell:
            kept = Read(cell.world("online"), piece, KEPT)
            with Lock(kept) as lock:
                check_read_only(lock[kept])
                np.testing.assert_array_equal(lock[kept], value)


@CARRIERS
@ROWS
def test_open3d_leaves_a_locks_array_alone(cell, online, rows):
    """What the actors' conversion makes is moved and painted; all later locks read the same."""
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    from actors.geometry.open3d_arrays import point_cloud, tensor

    value = points(rows)
    online.init(piece, CLOUD, value)
    cloud = Read(online, piece, CLOUD)
    with Lock(cloud) as lock:
        made = o3d.t.geometry.PointCloud(tensor(lock[cloud]))
        made.translate([1.0, 2.0, 3.0]).scale(2.0, [0.0, 0.0, 0.0])
        made.point.positions += 5.0
        point_cloud(lock[cloud]).translate([1.0, 2.0, 3.0])
        np.testing.assert_array_equal(lock[cloud], value)
        held = lock[cloud]
    with Lock(cloud) as lock:
        np.testing.assert_array_equal(lock[cloud], value)
    np.testing.assert_array_equal(held, value)
