"""What a user of `Lock` may rely on, on a shard inside the process."""

import threading
from dataclasses import dataclass

import numpy as np
import pytest

from enact_dist import (
    Aspect,
    Entities,
    Entity,
    Lock,
    Read,
    ReadEach,
    View,
    Write,
    WriteEach,
    local,
)
from enact_dist.errors import (
    ChangedError,
    DatumTypeError,
    LeaseLostError,
    LockHeldError,
    LockReleasedError,
    LockTimeoutError,
    MisuseError,
    NotRequestedError,
    NullDatumError,
    ReadonlyError,
    UnknownWorldError,
)

pytestmark = pytest.mark.carrier("local", "socket", "zenoh")

COUNT = Aspect("count", int)
NAME = Aspect("name", str)
CLOUD = Aspect("cloud", np.ndarray)
bench, piece = Entity("work_bench"), Entity("work_piece")


@dataclass(frozen=True)
class Mesh:
    vertices_m: np.ndarray
    lowest_z_m: float


MESH = Aspect("mesh", Mesh)


def test_lock_publishes_all_writes_when_block_ends_cleanly(cell, online):
    """A clean exit publishes every write, and the next lock reads them."""
    count, name = Write(online, bench, COUNT), Write(online, bench, NAME)
    with Lock(count, name) as lock:
        lock[count] = 3
        lock[name] = "bench"

    assert lock.position is not None
    with Lock(Read(online, bench, COUNT), Read(online, bench, NAME)) as after:
        assert after[Read(online, bench, COUNT)] == 3
        assert after[Read(online, bench, NAME)] == "bench"


def test_lock_publishes_nothing_when_block_raises(online):
    """An exception in the block discards its writes."""
    online.init(bench, COUNT, 1)
    count = Write(online, bench, COUNT)

    with pytest.raises(ZeroDivisionError), Lock(count) as lock:
        lock[count] = 5
        1 / 0  # noqa: B018

    assert online.view(View(online, bench, COUNT))[View(online, bench, COUNT)] == 1


def test_write_reads_what_was_there_and_what_it_set(online):
    """A Write shows the old datum until the lock sets a new one, then that."""
    online.init(bench, COUNT, 7)
    count = Write(online, bench, COUNT)
    with Lock(count) as lock:
        assert lock[count] == 7
        lock[count] += 1
        assert lock[count] == 8
        del lock[count]
        assert lock.get(count) is None


def test_null_raises_with_reason_and_get_returns_default(online):
    """A null datum raises NullDatumError that says why; get() gives the default."""
    count = Write(online, bench, COUNT)
    with Lock(count) as lock:
        with pytest.raises(NullDatumError, match="never set"):
            lock[count]
        assert lock.get(count, 4) == 4
        lock[count] = 1
    with Lock(count) as lock:
        del lock[count]
    with Lock(count) as lock, pytest.raises(NullDatumError, match="deleted"):
        lock[count]


def test_version_is_never_reused_when_slot_is_deleted(online):
    """Deleting counts as a write; the version goes on from there."""
    count = Write(online, bench, COUNT)
    versions = []
    for step in range(3):
        with Lock(count) as lock:
            versions.append(lock.version(count))
            if step == 1:
                del lock[count]
            else:
                lock[count] = step
    assert versions == [0, 1, 2]


def test_second_lock_in_thread_raises_naming_first(online):
    """One thread holds one lock; also init, view, watch, wait and create_world refuse."""
    with Lock(Read(online, bench, COUNT)) as lock:
        with pytest.raises(LockHeldError, match="work_bench"), Lock(Read(online, piece, COUNT)):
            pass
        for forbidden in (
            lambda: online.init(piece, COUNT, 1),
            lambda: online.view(View(online, piece, COUNT)),
            lambda: online.watch(Entities("**"), COUNT),
        ):
            with pytest.raises(LockHeldError):
                forbidden()
        assert lock.valid()
    with Lock(Read(online, piece, COUNT)):
        pass


def test_blocking_cell_calls_inside_lock_raise(cell, online):
    """create_world and wait inside a lock would hold and wait."""
    with Lock(Write(online, bench, COUNT)) as lock:
        lock[Write(online, bench, COUNT)] = 1
        with pytest.raises(LockHeldError):
            cell.create_world("other")
    with Lock(Read(online, bench, COUNT)), pytest.raises(LockHeldError):
        cell.wait(lock.position)


def test_lock_used_after_block_raises(online):
    """Data are reachable only inside the block."""
    count = Read(online, bench, COUNT)
    with Lock(count) as lock:
        pass
    with pytest.raises(LockReleasedError):
        lock[count]
    with pytest.raises(LockReleasedError):
        lock.check()
    with pytest.raises(LockReleasedError), lock:
        pass


def test_access_outside_requests_raises(online):
    """Only what was asked for is reachable, and only as it was asked."""
    read = Read(online, bench, COUNT)
    with Lock(read) as lock:
        with pytest.raises(NotRequestedError, match="work_piece"):
            lock[Read(online, piece, COUNT)]
        with pytest.raises(ReadonlyError):
            lock[read] = 3
        with pytest.raises(ReadonlyError):
            del lock[read]


def test_wrong_datum_type_raises_at_assignment(online):
    """A datum of another type is refused where it is assigned."""
    count = Write(online, bench, COUNT)
    with pytest.raises(DatumTypeError, match="five"), Lock(count) as lock:
        lock[count] = "five kg"
    with pytest.raises(DatumTypeError):
        online.init(piece, MESH, {"vertices_m": 1})


def test_aspect_with_other_type_is_refused_by_name(cell, online):
    """An aspect's type is fixed once it is registered."""
    online.init(bench, COUNT, 1)
    with (
        pytest.raises(DatumTypeError, match="count"),
        Lock(Read(online, bench, Aspect("count", str))),
    ):
        pass


def test_array_from_lock_is_readonly(online):
    """In-place change of delivered data raises instead of changing anything."""
    online.init(piece, MESH, Mesh(np.zeros((3, 3)), 0.0))
    mesh = Read(online, piece, MESH)
    with Lock(mesh) as lock, pytest.raises(ValueError, match="read-only"):
        lock[mesh].vertices_m[0, 0] = 1.0


def test_array_is_copied_when_assigned(online):
    """Changing the own array after assignment changes nothing that was published."""
    array = np.arange(5)
    cloud = Write(online, piece, CLOUD)
    with Lock(cloud) as lock:
        lock[cloud] = array
        array[0] = 99
    assert online.view(View(online, piece, CLOUD))[View(online, piece, CLOUD)][0] == 0


def test_requests_with_two_accesses_to_one_datum_raise(online):
    """Read and Write of one datum in one lock are refused by name."""
    with pytest.raises(MisuseError, match="different accesses"):
        Lock(Read(online, bench, COUNT), Write(online, bench, COUNT))


def test_requests_are_values(online):
    """A request made anew finds its datum."""
    online.init(bench, COUNT, 2)
    with Lock(Read(online, bench, COUNT)) as lock:
        assert lock[Read(online, Entity("work_bench"), Aspect("count", int))] == 2


def test_unknown_world_lists_those_that_exist(cell):
    """The error names what was asked and what there is."""
    with pytest.raises(UnknownWorldError, match=r"onlin.*online, training") as caught:
        cell.world("onlin")
    assert caught.value.known == ("online", "training")


def test_lock_timeout_names_holder(online):
    """A lock that is not granted in time says who is in the way, and holds nothing."""
    inside, leave = threading.Event(), threading.Event()

    def hold():
        with Lock(Write(online, bench, COUNT)):
            inside.set()
            leave.wait(60)

    holder = threading.Thread(target=hold)
    holder.start()
    inside.wait(60)
    with pytest.raises(LockTimeoutError, match="work_bench/count") as caught:
        Lock(Read(online, bench, COUNT), wait_s=0.05).__enter__()
    leave.set()
    holder.join()

    assert "write" in caught.value.holders[0]
    with Lock(Read(online, bench, COUNT), wait_s=30.0):
        pass


def test_waiting_lock_is_granted_when_holder_leaves(online):
    """A waiter gets the lock as soon as it is free, with the data as of then."""
    inside, waiting = threading.Event(), threading.Event()
    seen = []

    def wait():
        inside.wait(60)
        waiting.set()
        with Lock(Read(online, bench, COUNT)) as lock:
            seen.append(lock[Read(online, bench, COUNT)])

    waiter = threading.Thread(target=wait)
    waiter.start()
    with Lock(Write(online, bench, COUNT)) as lock:
        inside.set()
        waiting.wait(60)
        lock[Write(online, bench, COUNT)] = 11
    waiter.join()

    assert seen == [11]


def test_lock_over_two_contexts_reads_both(cell, online):
    """One lock may name several world contexts, as deviation detection does."""
    training = cell.world("training")
    training.init(piece, COUNT, 1)
    online.init(piece, COUNT, 2)
    with Lock(Read(training, piece, COUNT), Write(online, piece, COUNT)) as lock:
        lock[Write(online, piece, COUNT)] = lock[Read(training, piece, COUNT)] + 10
    assert online.view(View(online, piece, COUNT))[View(online, piece, COUNT)] == 11


def test_hold_limit_ends_lock_and_commit_is_refused():
    """A lock held longer than hold_s is lost; its commit writes nothing."""
    from enact_dist import testing

    clock = testing.ManualClock()
    with testing.worlds("online", clock=clock) as cell:
        online = cell.world("online")
        online.init(bench, COUNT, 1)
        count = Write(online, bench, COUNT)
        with pytest.raises(LeaseLostError, match="held longer"), Lock(count, hold_s=5.0) as lock:
            lock[count] = 2
            clock.advance(6.0)
        view = View(online, bench, COUNT)
        assert online.view(view)[view] == 1


def test_broken_lock_raises_with_operators_reason(cell, online):
    """A lock that an operator breaks is lost, and its holder is told why."""
    count = Write(online, bench, COUNT)
    with pytest.raises(LeaseLostError, match="robot stands in the way"), Lock(count) as lock:
        lock[count] = 2
        info = cell.locks()[0]
        assert info.granted
        assert cell.break_lock(info.number, shard=info.shard, reason="robot stands in the way")


def test_expected_view_that_moved_on_fails_commit(online):
    """After expect(view), a commit fails if the viewed slot has a newer version."""
    online.init(bench, COUNT, 1)
    view, write = View(online, bench, COUNT), Write(online, piece, COUNT)

    def move_on():
        with Lock(Write(online, bench, COUNT)) as other:
            other[Write(online, bench, COUNT)] = 2

    with pytest.raises(ChangedError, match="work_bench"), Lock(view, write) as lock:
        lock.expect(view)
        lock[write] = lock[view]
        mover = threading.Thread(target=move_on)
        mover.start()
        mover.join()
    with Lock(view, write) as lock:
        lock.expect(view)
        lock[write] = lock[view]
    assert online.view(View(online, piece, COUNT))[View(online, piece, COUNT)] == 2


def test_pattern_read_shows_matching_entities(online):
    """ReadEach is a mapping of the entities that match and have a datum."""
    for index in range(3):
        online.init(Entity(f"view/{index}"), COUNT, index)
    online.init(Entity("other/0"), COUNT, 9)
    each = ReadEach(online, Entities("view/*"), COUNT)
    with Lock(each) as lock:
        assert dict(lock[each]) == {Entity(f"view/{index}"): index for index in range(3)}


def test_pattern_write_creates_one_entity_when_two_look_first(online):
    """Look, then create, is safe under WriteEach: two perceptions make one entity."""
    each = WriteEach(online, Entities("package/*"), NAME)
    together = threading.Barrier(2)

    def perceive():
        together.wait(60)
        with Lock(each) as lock:
            packages = lock[each]
            if "milk" not in packages.values():
                packages[Entity.fresh("package")] = "milk"

    threads = [threading.Thread(target=perceive) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(online.entities("package/*")) == 1


def test_pattern_write_sets_deletes_and_refuses_strangers(online):
    """Entities of the pattern are set and deleted by assignment; others are refused."""
    each = WriteEach(online, Entities("package/*"), COUNT)
    one, two = Entity("package/1"), Entity("package/2")
    with Lock(each) as lock:
        data = lock[each]
        data[one] = 1
        data[two] = 2
        assert dict(data) == {one: 1, two: 2}
        with pytest.raises(MisuseError, match="does not match"):
            data[Entity("tray/1")] = 3
    with Lock(each) as lock:
        del lock[each][one]
        assert dict(lock[each]) == {two: 2}
    assert online.entities("package/*") == (two,)


def test_increments_from_threads_add_up(online):
    """4 threads x 250 increments through locks are 1,000 exactly."""
    count = Write(online, bench, COUNT)

    def increment():
        for _ in range(250):
            with Lock(count) as lock:
                lock[count] = lock.get(count, 0) + 1

    threads = [threading.Thread(target=increment) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert online.view(View(online, bench, COUNT))[View(online, bench, COUNT)] == 1000


def test_large_array_comes_back_whole(online):
    """Data above the size that travels with the grant arrive unchanged."""
    array = np.arange(3_000_000, dtype=np.float32).reshape(1000, 3000)
    online.init(piece, CLOUD, array)
    cloud = Read(online, piece, CLOUD)
    with Lock(cloud) as lock:
        assert np.array_equal(lock[cloud], array)
    view = View(online, piece, CLOUD)
    assert np.array_equal(online.view(view)[view], array)


def test_statistics_tell_waiting_and_holding(online):
    """lock.statistics() says what the lock went through."""
    with Lock(Read(online, bench, COUNT)) as lock:
        pass
    statistics = lock.statistics()
    assert statistics.granted
    assert statistics.shards == ("local",)
    assert 0 <= statistics.waited_s < 60


def test_local_cell_keeps_durable_data_over_reopening(tmp_path):
    """With a folder, what was committed is there when the cell is opened again."""
    for expected in (None, 1, 2):
        with local(tmp_path / "cell", worlds=["online"]) as cell:
            count = Write(cell.world("online"), bench, COUNT)
            with Lock(count) as lock:
                assert lock.get(count) == expected
                lock[count] = lock.get(count, 0) + 1


def test_closed_cell_raises_misuse(cell, online):
    """After close, every use says so."""
    cell.close()
    with pytest.raises(MisuseError, match="closed"), Lock(Read(online, bench, COUNT)):
        pass


def test_invalid_arguments_raise_with_value(online):
    """wait_s, hold_s and an empty lock are refused where they are written."""
    with pytest.raises(MisuseError, match="-1"):
        Lock(Read(online, bench, COUNT), wait_s=-1)
    with pytest.raises(MisuseError, match="hold_s is 0"):
        Lock(Read(online, bench, COUNT), hold_s=0)
    with pytest.raises(MisuseError, match="nothing"):
        Lock()
    with pytest.raises(MisuseError, match="pattern"):
        Lock(Read(online, Entities("a/*"), COUNT))
