"""What a user of `WorldContext` may rely on: init, views, listings, raw data."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from enact_dist import Aspect, Entities, Entity, Lock, Read, View, ViewEach, Write
from enact_dist.core.protocol.messages import Fetch, Gone, KeepAlive, Release, TakeView
from enact_dist.errors import (
    DatumTypeError,
    LeaseLostError,
    MisuseError,
    NotRequestedError,
    NullDatumError,
)

pytestmark = pytest.mark.carrier("local", "socket", "zenoh")

COUNT, SIZE = Aspect("count", int), Aspect("size", float)
CLOUD = Aspect("cloud", np.ndarray)
bench, piece = Entity("work_bench"), Entity("work_piece")


@dataclass(frozen=True)
class Pose:
    position_m: np.ndarray
    frame: str


def write(request, datum):
    with Lock(request) as lock:
        lock[request] = datum


def delete(request):
    with Lock(request) as lock:
        del lock[request]


def test_init_sets_once_and_again_after_deletion(online):
    """Init sets a datum where there is none; a deleted one is set anew under a later version."""
    view = View(online, bench, COUNT)
    assert online.init(bench, COUNT, 1)
    assert not online.init(bench, COUNT, 2)
    delete(Write(online, bench, COUNT))
    assert online.init(bench, COUNT, 3)
    snapshot = online.view(view)
    assert (snapshot[view], snapshot.version(view)) == (3, 3)


def test_init_fetches_nothing_when_a_large_datum_is_there(cell, online):
    """Whether a datum exists is told without sending it."""
    online.init(piece, CLOUD, np.zeros(100_000))
    before = cell.shards()[0].counters.get("bytes_fetched", 0)
    assert not online.init(piece, CLOUD, np.ones(100_000))
    assert cell.shards()[0].counters.get("bytes_fetched", 0) == before


def test_init_refuses_a_datum_of_another_type_and_sets_nothing(online):
    """A refused init leaves the slot as it was."""
    with pytest.raises(DatumTypeError):
        online.init(bench, COUNT, 1.5)
    assert online.list_slots() == ()


@pytest.mark.parametrize(
    "datum",
    [
        np.zeros((0, 3)),
        np.array(np.nan),
        np.full((2, 2), np.nan, dtype=np.float32),
        np.zeros(0, dtype=[("x", "<f4"), ("id", ">u2")]),
        np.arange(200_000, dtype=">i4").reshape(400, 500),
        np.asfortranarray(np.arange(30_000.0).reshape(100, 300)),
    ],
)
def test_arrays_come_back_as_they_went(online, datum):
    """Empty, NaN, 0-d, structured, big-endian, Fortran and large arrays survive, read-only."""
    online.init(piece, CLOUD, datum)
    view, read = View(online, piece, CLOUD), Read(online, piece, CLOUD)
    with Lock(read) as lock:
        for found in (lock[read], online_view(online, view)):
            np.testing.assert_array_equal(found, datum)
            assert (found.dtype, found.shape) == (datum.dtype, datum.shape)
            assert not found.flags.writeable


def online_view(online, view):
    """View from another thread: inside a lock this one may not."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(lambda: online.view(view)[view]).result()


def test_nan_and_infinity_are_floats_like_others(online):
    """A float that is not a number is a datum."""
    online.init(bench, SIZE, float("nan"))
    online.init(piece, SIZE, float("-inf"))
    nan, infinite = View(online, bench, SIZE), View(online, piece, SIZE)
    snapshot = online.view(nan, infinite)
    assert snapshot[nan] != snapshot[nan]
    assert snapshot[infinite] == float("-inf")


def test_view_of_null_raises_and_get_gives_the_default(online):
    """Null says why; `get` does not raise."""
    view = View(online, bench, COUNT)
    snapshot = online.view(view)
    with pytest.raises(NullDatumError, match="never set"):
        snapshot[view]
    assert snapshot.get(view, 5) == 5
    assert snapshot.get(view) is None
    assert snapshot.version(view) == 0


def test_view_stays_as_it_was_when_data_change_later(online):
    """A snapshot is of one moment, large data and patterns too."""
    big, each = View(online, piece, CLOUD), ViewEach(online, Entities("work_*"), COUNT)
    online.init(piece, CLOUD, np.zeros(50_000))
    online.init(bench, COUNT, 1)
    snapshot = online.view(big, each)
    write(Write(online, piece, CLOUD), np.ones(50_000))
    write(Write(online, bench, COUNT), 2)
    write(Write(online, piece, COUNT), 2)
    assert not snapshot[big].any()
    assert dict(snapshot[each]) == {bench: 1}


def test_view_of_small_data_costs_one_round_trip(cell, online):
    """Nothing is validated or released where nothing large was seen."""
    online.init(bench, COUNT, 1)
    online.init(piece, CLOUD, np.zeros(50_000))
    asked = []
    carrier = cell._client.carrier
    carried = {name: getattr(carrier, name) for name in ("request", "request_all", "begin")}
    inside = []

    def noting(name, asked_by):
        def carry(*arguments, **options):
            if not inside:  # one of these may use another
                asked.extend(m for m in map(type, asked_by(*arguments)) if m is not KeepAlive)
            inside.append(name)
            try:
                return carried[name](*arguments, **options)
            finally:
                inside.pop()

        return carry

    carrier.request = noting("request", lambda _, message: [message])
    carrier.begin = noting("begin", lambda _, message: [message])
    carrier.request_all = noting("request_all", lambda requests: [m for _, m in requests])

    online.view(View(online, bench, COUNT), ViewEach(online, Entities("**"), COUNT))
    assert asked == [TakeView]
    asked.clear()
    for _ in range(2):
        online.view(View(online, piece, CLOUD))
    shared = carrier.transport_of("local") != "call"  # then the view names a file
    assert asked == [TakeView, *([] if shared else [Fetch]), Release, TakeView, Release]


def test_view_is_taken_anew_when_its_data_are_gone_before_they_came(cell, online):
    """A shard that restarts between a view and its large data costs a second look, no error."""
    online.init(piece, CLOUD, np.arange(50_000))
    view = View(online, piece, CLOUD)
    begin = cell._client.carrier.begin
    gone = iter([True, True])

    def forget(shard, message, **options):
        if isinstance(message, Fetch) and next(gone, False):
            answer = Gone(message.slot, message.version)
            return SimpleNamespace(wait=lambda _into: answer, abandon=lambda: None)
        return begin(shard, message, **options)

    cell._client.carrier.begin = forget
    cell._client.payloads.mapped = lambda *_: None
    assert online.view(view)[view][-1] == 49_999
    gone = iter([True] * 3)
    online.init(bench, CLOUD, np.arange(50_000))
    with pytest.raises(LeaseLostError, match="kept for lock"):
        online.view(View(online, bench, CLOUD))
    assert cell._client.core.live_locks() == []


def test_aspects_made_anew_for_each_view_are_not_kept(online):
    """A program may write `Aspect(…)` in its loop; nothing grows with it."""
    online.init(bench, COUNT, 1)
    for _ in range(1_100):
        online.view(View(online, bench, Aspect("count", int)))
    assert len(online.session._entries) <= 1_024


def test_view_takes_views_of_this_view_only(online):
    """What was not asked for, or locks, is refused by name."""
    view = View(online, bench, COUNT)
    snapshot = online.view(view)
    with pytest.raises(NotRequestedError, match="work_piece"):
        snapshot[View(online, piece, COUNT)]
    with pytest.raises(MisuseError, match="locks"):
        online.view(Read(online, bench, COUNT))
    with pytest.raises(MisuseError, match="nothing"):
        online.view()


def test_view_spans_contexts(cell, online):
    """One view may name several world contexts."""
    training = cell.world("training")
    training.init(bench, COUNT, 1)
    online.init(bench, COUNT, 2)
    views = View(training, bench, COUNT), View(online, bench, COUNT)
    snapshot = online.view(*views)
    assert [snapshot[view] for view in views] == [1, 2]


def test_survey_lists_slots_with_versions_sizes_and_nulls(online):
    """Every slot that was ever written is listed, without its data, in order."""
    online.init(piece, CLOUD, np.zeros(1000))
    online.init(bench, COUNT, 1)
    delete(Write(online, bench, COUNT))
    first, second = online.list_slots()
    assert (first.entity, first.aspect, first.version) == (bench, "count", 2)
    assert first.null_reason == "deleted"
    assert (second.entity, second.version, second.null_reason) == (piece, 1, "")
    assert second.size_bytes >= 8000
    assert online.list_slots("work_p*", ("cloud",)) == (second,)
    assert online.list_slots("other/**") == ()


def test_entities_are_those_with_some_datum(online):
    """An entity whose data are all null is not listed."""
    online.init(bench, COUNT, 1)
    online.init(piece, COUNT, 1)
    online.init(piece, SIZE, 1.0)
    delete(Write(online, bench, COUNT))
    assert online.entities() == (piece,)
    assert online.entities("work_b*") == ()


def test_raw_shows_a_datum_without_its_type(online):
    """A dataclass comes as a dict that names its type; numbers come as they are."""
    online.init(piece, Aspect("pose", Pose), Pose(np.zeros(3), "base"))
    online.init(bench, COUNT, 4)
    raw = online.get_untyped(piece, "pose")
    assert raw["__type__"] == "Pose"
    assert raw["frame"] == "base"
    assert online.get_untyped(bench, "count") == 4
    with pytest.raises(NullDatumError):
        online.get_untyped(piece, "count")
    with pytest.raises(MisuseError, match=r"no aspect 'colour'.*count, pose"):
        online.get_untyped(bench, "colour")


def test_ten_thousand_entities_are_viewed_and_surveyed_whole(online):
    """A pattern over many entities misses none."""
    from enact_dist import WriteEach

    each = WriteEach(online, Entities("part/*"), COUNT)
    for start in range(0, 10_000, 2_500):
        with Lock(each) as lock:
            lock[each].update({Entity(f"part/{n}"): n for n in range(start, start + 2_500)})
    view = ViewEach(online, Entities("part/*"), COUNT)
    assert sum(online.view(view)[view].values()) == sum(range(10_000))
    assert len(online.list_slots("part/*")) == 10_000
