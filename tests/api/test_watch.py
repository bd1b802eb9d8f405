"""What a user of `watch` may rely on: a snapshot, then every change, nothing missed unknowingly."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from polling import until

from enact_dist import Aspect, Entities, Entity, Lock, Write
from enact_dist.core.protocol import pages
from enact_dist.core.protocol.messages import START, Survey
from enact_dist.errors import MisuseError
from enact_dist.link import notices

pytestmark = pytest.mark.carrier("local", "socket", "zenoh")

COUNT, NAME = Aspect("count", int), Aspect("name", str)
IMAGE = Aspect("image", np.ndarray)
bench, piece = Entity("work_bench"), Entity("work_piece")
SOON_S = 30.0


def write(request, datum):
    with Lock(request) as lock:
        lock[request] = datum


def rest(watch):
    """Return what is there now: a quiet watch answers None at once."""
    return [(c.entity.name, c.version, c.gap, c.null) for c in iter(lambda: watch.next(0), None)]


def test_watch_yields_what_is_there_then_each_change(online):
    """First the present state in the order of its commits, then every commit in order."""
    online.init(piece, COUNT, 1)
    online.init(bench, COUNT, 1)
    count = Write(online, bench, COUNT)
    with online.watch("**", COUNT) as watch:
        assert rest(watch) == [("work_piece", 1, 0, False), ("work_bench", 1, 0, False)]
        for value in (2, 3):
            write(count, value)
        with Lock(count) as lock:
            del lock[count]
        assert [watch.next(SOON_S).version for _ in range(3)] == [2, 3, 4]
        assert watch.next(0) is None
        assert watch.missed == 0


def test_watch_follows_only_what_it_names(cell, online):
    """Other entities, aspects and world contexts are left out."""
    with online.watch(Entities("work_*"), NAME) as watch:
        online.init(bench, COUNT, 1)
        online.init(Entity("tray"), NAME, "x")
        cell.world("training").init(bench, NAME, "x")
        online.init(bench, NAME, "x")
        change = watch.next(SOON_S)
        assert (change.entity, change.aspect, change.version) == (bench, "name", 1)
        assert watch.next(0) is None


def test_watch_of_one_entity_takes_all_its_aspects(online):
    """No aspect named means all of them."""
    with online.watch(bench) as watch:
        online.init(bench, COUNT, 1)
        online.init(bench, NAME, "x")
        assert [watch.next(SOON_S).aspect for _ in range(2)] == ["count", "name"]


def test_watch_with_data_shows_the_datum_of_each_change(online, carrier):
    """As its notice brought it; over Zenoh, where anyone may listen, by a view."""
    online.init(bench, COUNT, 1)
    count = Write(online, bench, COUNT)
    with online.watch("**", COUNT, data=True) as watch:
        first = watch.next(SOON_S)
        write(count, 2)
        second = watch.next(SOON_S)
        write(count, 3)
        third = watch.next(SOON_S)
        with Lock(count) as lock:
            del lock[count]
        fourth = watch.next(SOON_S)
        by_view = None
        shown = [watch.value(change) for change in (first, second, third, fourth)]
    over_zenoh = carrier == "zenoh"
    assert shown == [by_view, *([by_view] * 2 if over_zenoh else [2, 3]), None]
    assert fourth.null


def test_watch_of_all_aspects_shows_data_without_their_types(online):
    """As `get_untyped` would."""
    with online.watch(bench, data=True) as watch:
        online.init(bench, NAME, "x")
        change = watch.next(SOON_S)
        assert watch.value(change) == "x"
        with Lock(Write(online, bench, NAME)) as lock:
            del lock[Write(online, bench, NAME)]
        assert watch.value(replace(change, carried=None)) is None
    with online.watch(bench) as watch, pytest.raises(MisuseError, match="data=True"):
        watch.value(change)


@pytest.mark.parametrize("gone", [False, True])
def test_watch_with_data_shows_large_arrays(online, gone):
    """Mapped by their names where there is shared memory; else, and where they are gone, viewed."""
    write_image = Write(online, bench, IMAGE)
    with online.watch("**", IMAGE, data=True) as watch:
        write(write_image, np.full(300_000, 1, np.uint8))
        change = watch.next(SOON_S)
        if gone:
            write(write_image, np.full(300_000, 2, np.uint8))
            until(lambda: watch.next(0) is not None)
        shown = watch.value(change)
    assert shown.shape == (300_000,)
    assert set(shown) <= ({1, 2} if gone else {1})


def test_change_tells_the_position_of_its_commit(cell, online):
    """A change's position is the one that the commit returned."""
    count = Write(online, bench, COUNT)
    with online.watch("**", COUNT) as watch:
        with Lock(count) as lock:
            lock[count] = 1
        assert watch.next(SOON_S).position == lock.position


def test_slow_watch_says_how_much_it_missed_and_has_the_newest(online, monkeypatch):
    """A reader that was away while its queue overflowed gets the newest state with its gap."""
    monkeypatch.setattr(notices.NoticeQueue.__init__, "__kwdefaults__", {"notices_max": 4})
    count, other = Write(online, bench, COUNT), Write(online, piece, COUNT)
    with online.watch("**", COUNT) as watch:
        for value in range(20):
            write(count, value)
        write(other, 1)
        seen = rest(watch)
        assert seen == [("work_bench", 20, 19, False), ("work_piece", 1, 0, False)]
        assert watch.missed == 19
        write(count, 21)
        assert watch.next(SOON_S).gap == 0


def test_deleted_and_made_again_slot_is_told_in_order(online):
    """Deletion is a change; a slot made again goes on counting."""
    count = Write(online, bench, COUNT)
    with online.watch("**", COUNT) as watch:
        online.init(bench, COUNT, 1)
        with Lock(count) as lock:
            del lock[count]
        online.init(bench, COUNT, 2)
        assert [(c.version, c.null) for c in (watch.next(SOON_S) for _ in range(3))] == [
            (1, False),
            (2, True),
            (3, False),
        ]


def test_watch_leaves_out_what_was_deleted_before_it(online):
    """A slot that is null at the start is no news."""
    count = Write(online, bench, COUNT)
    online.init(bench, COUNT, 1)
    with Lock(count) as lock:
        del lock[count]
    with online.watch("**") as watch:
        assert watch.next(0) is None


def test_closed_watch_ends_its_iteration(online):
    """`close` from another thread ends a loop that waits."""
    watch = online.watch("**")
    seen = []
    reader = threading.Thread(target=lambda: seen.extend(watch))
    reader.start()
    online.init(bench, COUNT, 1)
    while not seen:
        assert reader.is_alive()
    watch.close()
    watch.close()
    reader.join(SOON_S)
    assert not reader.is_alive()
    assert watch.next() is None


def test_watch_raises_when_its_cell_is_closed(cell, online):
    """A watch of a closed cell is a misuse, not silence."""
    watch = online.watch("**")
    cell.close()
    with pytest.raises(MisuseError, match="closed"):
        watch.next(SOON_S)


def test_two_watches_do_not_take_from_each_other(online):
    """Each watch sees every change."""
    with online.watch("**") as one, online.watch("**") as other:
        online.init(bench, COUNT, 1)
        assert one.next(SOON_S) == other.next(SOON_S)


class Repeating:
    """A feed whose every notice comes twice, the second time behind the next one."""

    def __init__(self, feed):
        self._feed, self._copies = feed, []

    def get(self, timeout_s):
        notice = self._feed.get(timeout_s)
        if notice is None:
            return self._copies.pop() if self._copies else None
        self._copies.append(notice)
        return notice

    def close(self):
        self._feed.close()


def test_notice_that_comes_again_tells_nothing_twice(online):
    """Copies, and notices that come after newer ones, are known by their numbers."""
    count = Write(online, bench, COUNT)
    with online.watch("**", COUNT) as watch:
        watch._feed = Repeating(watch._feed)
        for value in (1, 2, 3):
            write(count, value)
        assert [watch.next(SOON_S).version for _ in range(3)] == [1, 2, 3]
        assert rest(watch) == []
        assert watch.missed == 0
        assert not watch._feed._copies


def test_versions_from_before_the_watch_are_no_gap_where_the_slot_was_null(online):
    """A slot that was deleted when the watch began is not told of, and nothing of it was missed."""
    count = Write(online, bench, COUNT)
    write(count, 1)
    with Lock(count) as lock:
        del lock[count]
    with online.watch("**", COUNT) as watch:
        assert rest(watch) == []
        write(count, 3)
        change = watch.next(SOON_S)
        assert (change.version, change.gap, change.null) == (3, 0, False)
        assert watch.missed == 0


def test_what_changes_between_two_pages_of_a_listing_is_told_once_and_in_order(
    cell, online, monkeypatch
):
    """A later page shows more than the number of the first; the notices between bring no more."""
    first, second = Write(online, bench, COUNT), Write(online, piece, NAME)
    online.init(bench, COUNT, 1)
    online.init(piece, NAME, "a")
    monkeypatch.setattr(pages, "WORK_MAX", 1)
    carrier, request = cell._client.carrier, cell._client.carrier.request
    writes = iter([(first, 2), (second, "b"), (second, "c"), (first, 3)])

    def between(shard, message, **options):
        if isinstance(message, Survey) and message.after != START:
            for slot, datum in writes:
                write(slot, datum)
        return request(shard, message, **options)

    monkeypatch.setattr(carrier, "request", between)

    with online.watch("**") as watch:
        seen = []
        while len(seen) < 4:
            seen.append(watch.next(SOON_S))

        assert [(c.aspect, c.version, c.gap) for c in seen] == [
            ("count", 1, 0), ("name", 3, 0), ("count", 2, 0), ("count", 3, 0)
        ]  # fmt: skip
        assert (watch.next(0), watch.missed) == (None, 0)
