"""What a user may rely on when two world contexts are compared."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from slots import delete, put

from enact_dist import Aspect, Entity, Lock, Write, local
from enact_dist.compare.diff import DiffKind
from enact_dist.comparing import Difference, Tolerance
from enact_dist.errors import DatumTypeError, LockHeldError, MisuseError, UnknownWorldError

pytestmark = pytest.mark.carrier("local", "drawn")

SHIFT = Aspect("shift_mm", float, compare=Tolerance(absolute=0.5, unit="mm"))
COUNT, NAME = Aspect("count", int), Aspect("name", str)
LARGE = Aspect("large", np.ndarray)
piece, bench, tray = Entity("piece"), Entity("bench"), Entity("tray/1")


@dataclass(frozen=True, slots=True)
class Seen:
    label: str
    captured_ns: int


SEEN = Aspect("seen", Seen, compare=Tolerance(fields={"captured_ns": None}))


@pytest.fixture
def training(cell):
    return cell.world("training")


@pytest.fixture
def fetched(monkeypatch):
    """The slots whose data were asked for."""
    from enact_dist.access import snapshot

    asked = []

    def watched(client, cache, lock, readings, alive):
        readings = list(readings)
        asked.extend(reading.state.slot for reading in readings)
        return fetch_all(client, cache, lock, readings, alive)

    fetch_all = snapshot.fetch_all
    monkeypatch.setattr(snapshot, "fetch_all", watched)
    return asked


def shown(diff):
    return [(row.entity.name, row.aspect, row.kind.value) for row in diff]


def test_diff_names_what_each_side_lacks_and_what_changed(training, online):
    """Rows come in the order of their names; what is equal is counted."""
    for world in (training, online):
        put(world, piece, NAME, "milk")
    put(training, bench, COUNT, 1)
    put(online, tray, COUNT, 7)
    put(training, piece, COUNT, 1)
    put(online, piece, COUNT, 3)

    diff = training.diff(online)

    assert shown(diff) == [
        ("bench", "count", "only left"),
        ("piece", "count", "changed"),
        ("tray/1", "count", "only right"),
    ]
    assert (bool(diff), len(diff), diff.equal, diff.same, diff.within) == (True, 3, 1, 0, 0)
    changed = diff.of(DiffKind.CHANGED)[0]
    assert (changed.difference.distance, changed.difference.what) == (2.0, "1 against 3")
    assert (changed.left.version, changed.right.version) == (1, 1)
    assert diff.rows[0].right is None
    assert diff.rows[0].difference is None


def test_diff_is_the_same_from_the_other_side(training, online):
    """Left and right change places, and nothing else does."""
    put(training, bench, COUNT, 1)
    put(training, piece, SHIFT, 1.0)
    put(online, piece, SHIFT, 3.0)
    one, other = training.diff(online), online.diff(training)
    assert shown(one) == [("bench", "count", "only left"), ("piece", "shift_mm", "changed")]
    assert shown(other) == [("bench", "count", "only right"), ("piece", "shift_mm", "changed")]
    assert one.rows[1].difference.distance == other.rows[1].difference.distance == 2.0


def test_tolerance_of_the_aspect_decides(training, online):
    """What stays within its tolerance is no row, and is counted as what it is."""
    put(training, piece, SHIFT, 1.0)
    put(online, piece, SHIFT, 1.5)
    put(training, bench, SEEN, Seen("box", 1))
    put(online, bench, SEEN, Seen("box", 2))

    diff = training.diff(online, "**", SHIFT, SEEN)

    assert not diff
    assert (diff.equal, diff.within) == (1, 1)
    put(online, piece, SHIFT, 1.75)
    (row,) = training.diff(online, "**", SHIFT, SEEN)
    assert (row.difference.distance, row.difference.unit, row.difference.tolerance) == (
        0.75,
        "mm",
        0.5,
    )


def test_entities_and_aspects_limit_a_diff(training, online):
    """A pattern, one entity, aspects and their names each leave out the rest."""
    for entity in (piece, tray):
        put(online, entity, COUNT, 1)
        put(online, entity, NAME, "x")
    assert shown(training.diff(online, "tray/*", COUNT)) == [("tray/1", "count", "only right")]
    assert shown(training.diff(online, piece, "name")) == [("piece", "name", "only right")]


def test_deleted_data_are_no_data(training, online):
    """Null on both sides is no row, however it came about."""
    for world in (training, online):
        put(world, piece, COUNT, 1)
    delete(online, piece, COUNT)
    assert shown(training.diff(online)) == [("piece", "count", "only left")]
    delete(training, piece, COUNT)
    assert not training.diff(online)


def test_context_does_not_differ_from_itself_and_nothing_is_fetched(online, fetched):
    """The same slot and stamp are the same version."""
    put(online, piece, LARGE, np.zeros(100_000))
    diff = online.diff(online)
    assert (diff.rows, diff.equal, diff.same) == ((), 1, 1)
    assert fetched == []


def test_only_data_that_differ_in_version_are_fetched(training, online, fetched):
    """One-sided data are not looked at; large ones of two versions are."""
    for world in (training, online):
        put(world, piece, LARGE, np.zeros(100_000))
    put(online, bench, LARGE, np.zeros(100_000))
    diff = training.diff(online)
    assert {slot.entity for slot in fetched} == {"piece"}
    assert shown(diff) == [("bench", "large", "only right")]
    assert (diff.equal, diff.same) == (1, 0)


def test_large_arrays_are_compared_where_they_differ(training, online):
    """The row says where, and what stands there."""
    array = np.zeros((300, 400))
    put(training, piece, LARGE, array)
    array = array.copy()
    array[17, 3] = 4.0
    put(online, piece, LARGE, array)
    (row,) = training.diff(online, "**", LARGE)
    assert (row.difference.where, row.difference.distance) == ("[17, 3]", 4.0)


def test_data_are_fetched_some_at_a_time(training, online, fetched, monkeypatch):
    """No more than a batch of data, or one pair, is held at once."""
    from enact_dist.compare import diff as diffing

    monkeypatch.setattr(diffing, "BATCH_BYTES_MAX", 2_000_000)
    sizes = []
    of_batch = diffing._batches

    def measured(pairs):
        for batch in of_batch(pairs):
            sizes.append(sum(pair.left.state.size + pair.right.state.size for pair in batch))
            yield batch

    monkeypatch.setattr(diffing, "_batches", measured)
    for number in range(5):
        for world, value in ((training, 0.0), (online, 1.0)):
            put(world, Entity(f"tray/{number}"), LARGE, np.full(100_000, value))
    put(training, piece, LARGE, np.zeros(200_000))
    put(online, piece, LARGE, np.ones(200_000))
    assert len(training.diff(online)) == 6
    assert len(sizes) == 6
    assert sorted(sizes)[-2] <= 2_000_000
    assert max(sizes) > 3_000_000


def test_data_without_a_known_type_are_compared_as_they_came(training, online):
    """Where no aspect of that name was used here, dataclasses are dicts and nothing is allowed."""
    put(training, piece, SEEN, Seen("box", 1))
    put(online, piece, SEEN, Seen("box", 2))
    training.session._entries.clear()
    (row,) = training.diff(online)
    assert (row.difference.where, row.difference.distance) == (".captured_ns", 1.0)


def test_own_comparator_is_asked_with_data_of_its_type(training, online):
    """Any callable of two data may be a comparator."""
    asked = []

    def labels(left, right):
        asked.append((left, right))
        return Difference(2.0, 1.0, True, "labels")

    own = Aspect("seen", Seen, compare=labels)
    put(training, piece, own, Seen("box", 1))
    put(online, piece, own, Seen("can", 1))
    (row,) = training.diff(online, "**", own)
    assert asked == [(Seen("box", 1), Seen("can", 1))]
    assert row.difference.unit == "labels"


def test_error_of_a_comparator_names_its_data(training, online):
    """A comparator that fails says for which slot."""

    def broken(left, right):
        raise ZeroDivisionError

    own = Aspect("count", int, compare=broken)
    put(training, piece, own, 1)
    put(online, piece, own, 2)
    with pytest.raises(ZeroDivisionError) as caught:
        training.diff(online, "**", own)
    assert "piece/count" in caught.value.__notes__[0]


def test_unknown_aspect_and_another_type_are_refused(training, online):
    """A name that nobody registered is a mistake, and so is a type that is not the registered one."""
    put(online, piece, COUNT, 1)
    with pytest.raises(
        MisuseError, match=r"'cuont' is registered; did you mean 'count'\? \(known: count\)"
    ):
        training.diff(online, "**", "cuont")
    with pytest.raises(MisuseError, match="no aspect 'cuont'"):
        training.diff(online, "**", Aspect("cuont", object))
    with pytest.raises(DatumTypeError):
        training.diff(online, "**", Aspect("count", str))


def test_diff_inside_a_lock_is_refused(training, online):
    """A diff waits for shards, which whoever holds a lock must not."""
    with Lock(Write(online, piece, COUNT)), pytest.raises(LockHeldError):
        training.diff(online)


def test_diff_as_json_says_all_it_knows(training, online):
    """What no number can say has no distance there."""
    put(training, piece, NAME, "milk")
    put(online, piece, NAME, "tea")
    told = json.loads(json.dumps(training.diff(online).to_json(), allow_nan=False))
    (row,) = told["rows"]
    assert (told["left"], told["right"], told["equal"]) == ("training", "online", 0)
    assert (row["kind"], row["distance"], row["what"]) == ("changed", None, "'milk' against 'tea'")
    assert row["left"]["version"] == row["right"]["version"] == 1


def test_contexts_of_two_cells_are_compared_by_their_data(online):
    """Names and stamps mean nothing across cells; the data decide."""
    with local(worlds=["online"]) as other_cell:
        other = other_cell.world("online")
        put(online, piece, COUNT, 1)
        put(other, piece, COUNT, 1)
        put(other, bench, NAME, "x")
        diff = online.diff(other)
        assert shown(diff) == [("bench", "name", "only right")]
        assert (diff.equal, diff.same) == (1, 0)


def test_diff_shows_no_commit_half(training, online):
    """Both contexts are seen at one moment: what one lock writes to both never differs."""
    import threading

    left, right = Write(training, piece, COUNT), Write(online, piece, COUNT)
    stop = threading.Event()

    def write():
        value = 0
        while not stop.is_set():
            value += 1
            with Lock(left, right) as lock:
                lock[left] = lock[right] = value

    put(training, piece, COUNT, 0)
    put(online, piece, COUNT, 0)
    writer = threading.Thread(target=write)
    writer.start()
    try:
        found = [training.diff(online, piece, COUNT) for _ in range(50)]
    finally:
        stop.set()
        writer.join()
    assert not any(found)
    assert len({one.equal for one in found}) == 1


def test_past_and_present_of_one_context_are_compared(online, fetched):
    """What has not been written since is the same version; what was is compared as it stood."""
    put(online, bench, LARGE, np.zeros(100_000))
    put(online, piece, COUNT, 1)
    with Lock(Write(online, tray, COUNT)) as lock:
        lock[Write(online, tray, COUNT)] = 1
    before = online.at(lock.position)
    put(online, piece, COUNT, 4)
    delete(online, tray, COUNT)

    diff = before.diff(online)

    assert shown(diff) == [("piece", "count", "changed"), ("tray/1", "count", "only left")]
    assert diff.rows[0].difference.distance == 3.0
    assert (diff.equal, diff.same) == (1, 1)
    assert {slot.entity for slot in fetched} == {"piece"}
    assert shown(online.diff(before)) == [
        ("piece", "count", "changed"),
        ("tray/1", "count", "only right"),
    ]
    assert not before.diff(online.at(lock.position))


def test_contexts_of_capture_stamps_are_refused(training, online):
    """They show data of no one moment."""
    put(online, piece, COUNT, 1)
    with pytest.raises(MisuseError, match="capture stamps"):
        training.diff(online.at(stamp_ns=5))


def test_context_that_is_gone_is_named(online, cell):
    """Nothing in sight may mean that there is no such context any more."""
    from enact_dist import WorldContext

    with pytest.raises(UnknownWorldError, match="no world context 'gone'"):
        online.diff(WorldContext("gone", online.session))


def test_what_a_fork_has_not_written_is_not_fetched(online, fetched):
    """A fork shares its versions with its source, and a fork of a fork with both."""
    put(online, bench, LARGE, np.zeros(100_000))
    put(online, piece, LARGE, np.zeros(100_000))
    put(online, piece, COUNT, 1)
    first = online.fork("what_if")
    second = first.fork("what_then")
    assert not online.diff(first)
    assert fetched == []
    put(second, piece, LARGE, np.ones(100_000))

    for source in (online, first):
        diff = source.diff(second)
        assert shown(diff) == [("piece", "large", "changed")]
        assert (diff.equal, diff.same) == (2, 2)
        assert {(slot.entity, slot.aspect) for slot in fetched} == {("piece", "large")}
    assert shown(first.diff(second, bench)) == []


def test_fork_is_compared_with_what_its_source_has_become(online, fetched):
    """The version that both had is not the newest of the source any more."""
    put(online, piece, LARGE, np.zeros(100_000))
    fork = online.fork("what_if")
    put(online, piece, LARGE, np.ones(100_000))
    (row,) = online.diff(fork)
    assert row.difference.distance == 1.0
    assert not fork.diff(online.at(row.right.position))
