"""What a user may rely on of a standing diff: what crosses its tolerance is told, both ways."""

import threading

import pytest
from slots import delete, put

from enact_dist import Aspect, Entity, Lock, Write, local
from enact_dist.comparing import Tolerance
from enact_dist.errors import LockHeldError, MisuseError, UnknownWorldError

pytestmark = pytest.mark.carrier("local", "drawn")

SHIFT = Aspect("shift_mm", float, compare=Tolerance(absolute=0.5, unit="mm"))
COUNT = Aspect("count", int)
piece, bench = Entity("piece"), Entity("bench")
SOON_S = 30.0


@pytest.fixture
def training(cell):
    return cell.world("training")


def told(watch, timeout_s=SOON_S):
    row = watch.next(timeout_s)
    return row and (row.entity.name, row.kind.value)


def test_what_differs_at_the_start_comes_first(training, online):
    """Then it is quiet until something changes."""
    put(training, piece, SHIFT, 0.0)
    put(online, piece, SHIFT, 2.0)
    put(online, bench, SHIFT, 1.0)
    with training.watch_diff(online, "**", SHIFT) as watch:
        assert told(watch, 0) == ("bench", "only right")
        assert told(watch, 0) == ("piece", "changed")
        assert told(watch, 0) is None


def test_each_crossing_is_told_in_both_directions(training, online):
    """Within the tolerance nothing is told, whatever is written; beyond and back are."""
    put(training, piece, SHIFT, 0.0)
    put(online, piece, SHIFT, 0.0)
    with training.watch_diff(online, "**", SHIFT) as watch:
        put(online, piece, SHIFT, 0.5)
        assert told(watch, 0.2) is None
        put(online, piece, SHIFT, 0.75)
        row = watch.next(SOON_S)
        assert (row.kind.value, row.difference.distance) == ("changed", 0.75)
        put(online, piece, SHIFT, 3.0)
        assert told(watch, 0.2) is None
        put(training, piece, SHIFT, 2.75)
        row = watch.next(SOON_S)
        assert (row.kind.value, row.difference.distance) == ("equal", 0.25)


def test_sides_that_come_and_go_are_told(training, online):
    """A slot of one side differs until the other side has it, too, or nobody."""
    with training.watch_diff(online) as watch:
        put(online, piece, COUNT, 1)
        assert told(watch) == ("piece", "only right")
        put(training, piece, COUNT, 2)
        assert told(watch) == ("piece", "changed")
        delete(online, piece, COUNT)
        assert told(watch) == ("piece", "only left")
        delete(training, piece, COUNT)
        assert told(watch) == ("piece", "equal")


def test_aspects_that_come_later_are_followed(training, online):
    """No aspect named means all, those of the future included."""
    with training.watch_diff(online) as watch:
        put(online, piece, Aspect("weight_kg", float), 1.0)
        assert told(watch) == ("piece", "only right")


def test_standing_diff_follows_only_what_it_names(training, online):
    """Other entities and aspects are left out."""
    with training.watch_diff(online, piece, COUNT) as watch:
        put(online, bench, COUNT, 1)
        put(online, piece, SHIFT, 1.0)
        put(online, piece, COUNT, 1)
        assert told(watch) == ("piece", "only right")
        assert told(watch, 0) is None


@pytest.mark.parametrize("against", ["present", "past"])
def test_what_was_told_is_compared_once(training, online, monkeypatch, against):
    """The first look covers what the watch lists; it is not fetched and compared again."""
    from enact_dist.compare import watch_diff as diff_watch

    looks = []
    compared = diff_watch.compared

    def counted(pairs, *rest):
        pairs = list(pairs)
        looks.append([pair.place for pair in pairs])
        return compared(pairs, *rest)

    monkeypatch.setattr(diff_watch, "compared", counted)
    put(training, piece, COUNT, 1)
    put(online, piece, COUNT, 1)
    with Lock(Write(online, piece, COUNT)) as lock:
        lock[Write(online, piece, COUNT)] = 1
    other = training if against == "present" else online.at(lock.position)
    with online.watch_diff(other) as watch:
        assert told(watch, 0) is None
        put(online, piece, COUNT, 1)
        while len(looks) < 2:
            assert told(watch, 0.2) is None
        assert told(watch, 0.2) is None
    assert looks == [[("piece", "count")], [("piece", "count")]]


def test_slow_reader_gets_the_newest_and_knows_what_it_missed(training, online, monkeypatch):
    """Notices that overflowed are healed: the last state is compared, the gap counted."""
    from enact_dist.link import notices

    monkeypatch.setattr(notices.NoticeQueue.__init__, "__kwdefaults__", {"notices_max": 4})
    put(training, piece, SHIFT, 0.0)
    put(online, piece, SHIFT, 0.0)
    with training.watch_diff(online, "**", SHIFT) as watch:
        assert told(watch, 0) is None
        for value in range(20):
            put(online, piece, SHIFT, float(value))
        row = watch.next(SOON_S)
        assert row.difference.distance == 19.0
        assert watch.missed > 0


def test_error_loses_no_change(training, online, monkeypatch):
    """What could not be looked at is looked at by the next call."""
    from enact_dist.compare import watch_diff as diff_watch

    with training.watch_diff(online) as watch:
        both_sides = diff_watch.both_sides
        monkeypatch.setattr(diff_watch, "both_sides", lambda *_, **__: 1 / 0)
        put(online, piece, COUNT, 1)
        with pytest.raises(ZeroDivisionError):
            watch.next(SOON_S)
        monkeypatch.setattr(diff_watch, "both_sides", both_sides)
        assert told(watch, 0) == ("piece", "only right")


def test_next_ends_in_time_while_data_keep_changing(training, online):
    """A writer that never crosses the tolerance holds up nobody."""
    put(training, piece, SHIFT, 0.0)
    stop = threading.Event()

    def write():
        while not stop.is_set():
            put(online, piece, SHIFT, 0.25)

    put(online, piece, SHIFT, 0.0)
    writer = threading.Thread(target=write)
    with training.watch_diff(online, "**", SHIFT) as watch:
        writer.start()
        try:
            assert told(watch, 0.3) is None
        finally:
            stop.set()
            writer.join()


def test_close_from_another_thread_ends_the_iteration(training, online):
    """A loop that waits ends, and its rows are whole."""
    watch = training.watch_diff(online)
    seen, begun = [], threading.Event()

    def read():
        for row in watch:
            seen.append(row)
            begun.set()

    reader = threading.Thread(target=read)
    reader.start()
    put(online, piece, COUNT, 1)
    assert begun.wait(SOON_S)
    watch.close()
    reader.join(SOON_S)
    assert not reader.is_alive()
    assert [row.entity for row in seen] == [piece]


def test_what_cannot_be_watched_together_is_refused(training, online):
    """Two connections have no common moment, and whoever holds a lock must not wait."""
    with local(worlds=["online"]) as other, pytest.raises(MisuseError, match="two connections"):
        training.watch_diff(other.world("online"))
    with Lock(Write(online, piece, COUNT)), pytest.raises(LockHeldError):
        training.watch_diff(online)


def test_past_context_is_a_reference_that_stays(online):
    """The present is held against what was; the past is looked at once."""
    with Lock(Write(online, piece, SHIFT)) as lock:
        lock[Write(online, piece, SHIFT)] = 1.0
    before = online.at(lock.position)
    with online.watch_diff(before, "**", SHIFT) as watch:
        assert told(watch, 0) is None
        put(online, piece, SHIFT, 2.0)
        assert told(watch) == ("piece", "changed")
        put(online, bench, SHIFT, 2.0)
        assert told(watch) == ("bench", "only left")
        put(online, piece, SHIFT, 1.25)
        assert told(watch) == ("piece", "equal")
    with online.watch_diff(before, "**", SHIFT) as watch:
        assert told(watch, 0) == ("bench", "only left")
        assert told(watch, 0) is None
    with pytest.raises(MisuseError, match="never change"):
        from enact_dist.compare.watch_diff import DiffWatch

        DiffWatch(before, before, "**", ())


def test_context_that_is_dropped_ends_its_standing_diff(cell, online):
    """Whoever follows it is told that it is gone, not that all its data differ."""
    put(online, piece, COUNT, 1)
    fork = online.fork("what_if")
    with online.watch_diff(fork) as watch:
        assert told(watch, 0) is None
        cell.drop_world("what_if")
        with pytest.raises(UnknownWorldError, match="what_if"):
            watch.next(SOON_S)
    with pytest.raises(UnknownWorldError, match="what_if"):
        online.diff(fork)
