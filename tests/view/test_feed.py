"""The present and the past of a cell as pages get them, without a browser."""

import threading

import numpy as np
import pytest
from polling import until
from view_samples import ARM, POSE, SHOWS, SLOT, SPEED, SPEED_SLOT, move

from enact_dist import Aspect, Entity, Lock, Write
from enact_dist.access.snapshot import HeldView
from enact_dist.config.shows import GUESSED, Shows
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import ConfigError, MisuseError, UnknownWorldError
from enact_dist.recording import Recorder
from enact_dist.view import feed as feeds
from enact_dist.view.activity import Activity
from enact_dist.view.feed import Feed
from enact_dist.view.pages import datum
from enact_dist.view.pages.comparing import MARKED, NOW, Side
from enact_dist.view.pages.contents import PageContents
from enact_dist.view.pages.datum import Lineage, Samples, recording_of
from enact_dist.view.pages.texts import datum_of
from enact_dist.view.pages.viewer import Viewer, ViewSettings
from enact_dist.view.recorded import RecordingFeed, RecordingSource
from enact_dist.view.source import CellSource
from enact_dist.wire.payload import decode_untyped


@pytest.fixture
def feed(cell):
    found = Feed(
        CellSource(cell), lambda aspect: SHOWS.get(aspect, GUESSED), rate_hz=50.0, bytes_s=1e9
    )
    found.start()
    yield found
    found.stop()


def contents_of(cell, feed):
    viewer = Viewer.compare
    return PageContents(feed, CellSource(cell), lambda *sides: viewer(Shim(cell), *sides))


class Shim:
    """What `Viewer.compare` needs of a viewer."""

    def __init__(self, cell):
        self.cell = CellSource(cell)
        self._settings = ViewSettings()


def test_the_feed_follows_what_pages_show(cell, feed):
    """Only wanted data are fetched; an aspect without `shows` is looked at once."""
    feed.wish("page", [SLOT])
    until(lambda: SLOT in feed.shown([SLOT]) and feed.kinds("speed"))
    assert feed.kinds("speed") == {"json"}
    assert feed.in_scene([SLOT, SPEED_SLOT]) == [SLOT]
    until(lambda: feed.shown([SPEED_SLOT]) == {})
    move(cell, 2.0)
    until(lambda: feed.shown([SLOT])[SLOT].value[0, 3] == 2.0)
    feed.wish("page", None)
    assert feed.problem == ""


def test_passed_over_versions_and_bytes_are_counted(cell):
    """A limit of bytes lets data wait, and only the newest comes."""
    slow = Feed(CellSource(cell), lambda _: SHOWS["pose"], rate_hz=50.0, bytes_s=300.0)
    slow.start()
    try:
        slow.wish("page", [SLOT])
        until(lambda: SLOT in slow.shown([SLOT]))
        for x_m in range(1, 9):
            move(cell, float(x_m))
        until(lambda: slow.shown([SLOT])[SLOT].value[0, 3] == 8.0)
        assert slow.passed_over + slow.held_back > 0
    finally:
        slow.stop()


def test_a_datum_counts_for_the_limit_of_bytes_before_it_was_ever_shown(cell):
    """Its shard knows its size: not all large data come at once when a page opens."""
    slots = [Slot("online", f"part/{number}", "pose") for number in range(4)]
    for slot in slots:
        cell.world("online").init(Entity(slot.entity), POSE, np.zeros((100, 100)))
    slow = Feed(CellSource(cell), lambda _: SHOWS["pose"], rate_hz=50.0, bytes_s=4000.0)
    slow.start()
    try:
        slow.wish("page", slots)
        until(lambda: slow.held_back)
        assert len(slow.shown(slots)) == 1
    finally:
        slow.stop()


def test_what_the_past_has_shown_is_not_fetched_again(cell, monkeypatch):
    """At a later moment only the slot that changed in between is fetched."""
    position, source, fetched = move(cell, 1.0), CellSource(cell), []
    fetch = HeldView.fetch

    def counted(view, readings):
        fetched.append(len([*readings]))
        return fetch(view, readings)

    monkeypatch.setattr(HeldView, "fetch", counted)
    found = source.data_at([SLOT, SPEED_SLOT], position.stamp_ns).data
    after = move(cell, 2.0)
    again = source.data_at([SLOT, SPEED_SLOT], after.stamp_ns, found).data
    assert fetched == [2, 1]
    assert again[SPEED_SLOT] is found[SPEED_SLOT]
    assert decode_untyped(again[SLOT].datum)[0, 3] == 2.0


def test_images_of_many_cameras_come_in_turns(cell, monkeypatch):
    """At first all at once; then those of four cameras in a round, the longest not shown first."""
    online, image = cell.world("online"), Aspect("image", np.ndarray)
    eyes = [Entity(f"camera/{number}") for number in range(6)]
    slots = [Slot("online", str(eye), "image") for eye in eyes]
    source, asked = CellSource(cell), []
    real = source.data_at
    monkeypatch.setattr(source, "data_at", lambda *a, **b: asked.append(a[0]) or real(*a, **b))
    for eye in eyes:
        online.init(eye, image, np.zeros((4, 4, 3), np.uint8))
    feed = Feed(source, lambda _: Shows(("image",)), rate_hz=50.0, bytes_s=1e9)
    feed.start()
    try:
        feed.wish("page", slots)
        until(lambda: len(feed.shown(slots)) == 6)
        writes = [Write(online, eye, image) for eye in eyes]
        first = len(asked)
        with Lock(*writes) as lock:
            for write in writes:
                lock[write] = np.ones((4, 4, 3), np.uint8)
        until(lambda: all(one.value.any() for one in feed.shown(slots).values()))
        assert [len(each) for each in asked[first:]] == [4, 2]
        assert {slot for each in asked[first:] for slot in each} == set(slots)
    finally:
        feed.stop()


def test_an_odd_datum_is_named_and_takes_no_other_with_it(cell, feed, monkeypatch):
    """Its next version is shown again."""
    real, tried = feeds.shown_of, []

    def odd(recorded, shows):
        if recorded.slot == SLOT and recorded.version == 1:
            tried.append(recorded)
            raise ZeroDivisionError("no scale")
        return real(recorded, shows)

    monkeypatch.setattr(feeds, "shown_of", odd)
    feed.wish("page", [SLOT, SPEED_SLOT])
    until(lambda: feed.shown([SPEED_SLOT]) and feed.problem)
    assert feed.problem == "online:arm/pose v1 cannot be shown: no scale"
    until(lambda: feed.moment_ns == feed.catalogue.newest_ns)
    assert len(tried) == 1
    move(cell, 2.0)
    until(lambda: feed.shown([SLOT]))
    assert feed.problem == ""


def test_the_feed_outlives_whatever_its_watch_raises(cell, feed, monkeypatch):
    """It names the error, begins another watch and then shows data without the error."""
    real, failures = feeds.Watch, [RuntimeError("out of luck")]

    def watch(*given, **options):
        if failures:
            raise failures.pop()
        return real(*given, **options)

    monkeypatch.setattr(feeds, "Watch", watch)
    feed.wish("page", [SLOT])
    until(lambda: feed.problem == "out of luck")
    until(lambda: feed.shown([SLOT]))
    assert feed.problem == ""


def test_the_moment_goes_on_while_nothing_that_is_shown_changes(cell, feed):
    """A commit to another slot moves it."""
    feed.wish("page", [SPEED_SLOT])
    until(lambda: feed.shown([SPEED_SLOT]))
    position = move(cell, 1.0)
    until(lambda: feed.moment_ns == position.stamp_ns)


def test_world_contexts_are_those_of_the_cell(cell):
    """Empty ones too; of a dropped one nothing stays."""
    with Viewer(cell, ViewSettings()) as viewer:
        catalogue = viewer.feed.catalogue
        assert catalogue.worlds() == ["online", "truth"]
        cell.create_world("trial").init(ARM, SPEED, 0.5)
        viewer.feed.wish("page", [])
        viewer.list_for("page", [])
        until(lambda: catalogue.slots("trial"))
        cell.drop_world("trial")
        until(lambda: catalogue.worlds() == ["online", "truth"])
        assert catalogue.state(Slot("trial", "arm", "speed")) is None


def test_an_unknown_world_context_is_refused_with_those_there_are(cell, tmp_path):
    """Of a running cell as of a recording."""
    with pytest.raises(UnknownWorldError, match=r"'nosuch'.* \(it has online, truth\)"):
        Viewer(cell, ViewSettings(world="nosuch"))
    name, content = recording_of(CellSource(cell), "online", move(cell, 1.0).stamp_ns, SHOWS)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UnknownWorldError, match=r"'nosuch' \(it has online\)"):
        Viewer(RecordingSource(tmp_path / name), ViewSettings(world="nosuch"))


def test_the_past_is_exact_and_forgotten_data_are_named(cell, feed):
    """A datum is decoded once per version, and what retention dropped is left out by name."""
    positions = [move(cell, float(x_m)) for x_m in range(1, 7)]
    feed.wish("page", [SLOT])
    until(lambda: feed.catalogue.slots("online") == [SLOT, SPEED_SLOT])
    contents = contents_of(cell, feed)
    contents.world = "online"
    contents.look_back([SLOT, SPEED_SLOT])
    timeline = contents.player.timeline
    assert len(timeline.stamps_ns) >= 3
    contents.player.at_ns = positions[4].stamp_ns
    data = contents.data([SLOT, SPEED_SLOT])
    assert data[SLOT].value[0, 3] == 5.0
    assert contents.data([SLOT, SPEED_SLOT])[SLOT] is data[SLOT]
    contents.player.at_ns = positions[4].stamp_ns + 1
    assert contents.data([SLOT, SPEED_SLOT])[SLOT] is data[SLOT]
    assert contents.forgotten == ()
    # Recent moments stay a while longer than their retention, until a later commit.
    gone_ns, source = positions[0].stamp_ns, CellSource(cell)
    until(lambda: move(cell, 7.0) and source.data_at([SLOT], gone_ns).forgotten)
    contents.player.at_ns = gone_ns
    assert contents.data([SLOT, SPEED_SLOT]).keys() == {SPEED_SLOT}
    assert contents.forgotten == (SLOT,)


def test_a_difference_is_coloured_and_labelled(cell, feed):
    """Against a marked moment, and against another world context."""
    feed.wish("page", [SLOT])
    until(lambda: feed.shown([SLOT]))
    contents = contents_of(cell, feed)
    contents.world = "online"
    before = move(cell, 1.0)
    after = move(cell, 2.0)
    contents.player.look_back(contents.player.timeline.including([after.stamp_ns]), after.stamp_ns)
    contents.marked_ns = before.stamp_ns
    contents.comparing.against = MARKED
    scenes = contents.scenes(contents.data([SLOT]))
    (mine,) = (node for name, node in scenes[""].nodes.items() if "#pose" in name)
    assert mine.colour == (255, 150, 0)
    assert "label arm" in scenes[""].nodes
    (other,) = scenes["right "].nodes.values()
    assert other.matrix[0, 3] == 1.0
    assert "1 differ" in contents.comparing.content

    contents.comparing.against = "truth"
    scenes = contents.scenes(contents.data([SLOT]))
    assert "only left" in contents.comparing.content
    assert list(scenes) == [""]
    contents.comparing.against = ""
    assert contents.scenes(contents.data([SLOT]))[""].nodes.keys() == {"online:arm/pose#pose"}
    assert contents.comparing.right_tints() == {}


class Differences:
    """What a page compares, and how often it did."""

    def __init__(self, cell, feed):
        self.made, self.catalogue = 0, feed.catalogue
        self.error = None
        viewer = Shim(cell)

        def compare(*sides):
            self.made += 1
            if self.error:
                raise self.error
            return Viewer.compare(viewer, *sides)

        self.shown = PageContents(feed, CellSource(cell), compare).comparing

    def look(self, left, *, live):
        now_ns = self.catalogue.newest_ns
        self.shown.look(left, live=live, now_ns=now_ns, marked_ns=left.at_ns)
        return self.made

    def until(self, made, left, *, live):
        until(lambda: self.look(left, live=live) == made)


@pytest.mark.parametrize(("against", "differ"), [(NOW, 0), ("truth", 1), (MARKED, 0)])
def test_a_difference_with_the_present_is_made_when_its_data_change(
    cell, feed, monkeypatch, against, differ
):
    """At once, and neither by a clock nor because another world context has changed."""
    cell.world("online").fork("elsewhere")
    feed.wish("page", [])
    before = move(cell, 1.0)
    move(cell, 1.0, "truth")
    until(lambda: all(map(feed.catalogue.state, (SPEED_SLOT, Slot("truth", "arm", "pose")))))
    until(lambda: feed.catalogue.newest_ns >= before.stamp_ns)
    found, left = Differences(cell, feed), Side("online", before.stamp_ns)
    found.shown.against = against
    monkeypatch.setattr("enact_dist.view.pages.comparing.PAUSE", 0.0)
    monkeypatch.setattr("enact_dist.view.pages.comparing.AGAIN_S", 0.0)
    live = against != NOW
    for _ in range(3):
        assert found.look(left, live=live) == 1
    assert f"{differ} differ" in found.shown.content

    other = move(cell, 5.0, "elsewhere")
    until(lambda: feed.catalogue.newest_ns >= other.stamp_ns)
    assert found.look(left, live=live) == 1

    move(cell, 2.0)
    found.until(2, left, live=live)
    assert f"{differ + 1} differ" in found.shown.content


def test_a_slow_difference_takes_a_tenth_of_the_time_and_a_choice_is_shown_at_once(
    cell, feed, monkeypatch
):
    """A new commit waits for the pause; a new moment or world context does not."""
    feed.wish("page", [])
    before = move(cell, 1.0)
    until(lambda: feed.catalogue.state(SLOT))
    found, left = Differences(cell, feed), Side("online", before.stamp_ns)
    found.shown.against = NOW
    monkeypatch.setattr("enact_dist.view.pages.comparing.PAUSE", 1e9)
    assert found.look(left, live=False) == 1
    after = move(cell, 2.0)
    until(lambda: feed.catalogue.newest_ns >= after.stamp_ns)
    assert found.look(left, live=False) == 1
    assert found.look(Side("online", after.stamp_ns), live=False) == 2
    found.shown.against = "truth"
    assert found.look(Side("online", after.stamp_ns), live=False) == 3


def test_a_difference_that_failed_is_tried_again_after_a_pause(cell, feed, monkeypatch):
    """Until the pause is over, the page keeps the reason."""
    feed.wish("page", [])
    before = move(cell, 1.0)
    until(lambda: feed.catalogue.state(SLOT))
    found, left = Differences(cell, feed), Side("online", before.stamp_ns)
    found.shown.against, found.error = NOW, MisuseError("a shard is away")
    assert found.look(left, live=False) == 1
    assert "a shard is away" in found.shown.content
    found.error = None
    assert found.look(left, live=False) == 1
    monkeypatch.setattr(found.shown, "_due_s", 0.0)
    assert found.look(left, live=False) == 2
    assert "0 differ" in found.shown.content


def test_causes_are_steps_and_a_label_keeps_them(cell, feed):
    """The first step is the datum itself, and the label pins what the tree shows."""
    move(cell, 1.0)
    feed.wish("page", [SLOT])
    until(lambda: feed.shown([SLOT]))
    lineage, pinned = Lineage(), []
    lineage.ask(CellSource(cell), feed.shown([SLOT])[SLOT], "why")
    assert next(iter(lineage.steps)).startswith("1. online:arm/pose v2")
    said = lineage.pin("incident-7", lambda *given: pinned.append(given))
    assert (pinned[0][0], said.split()[0]) == ("incident-7", str(len(pinned[0][1])))


def test_numbers_have_the_history_of_their_datum(cell):
    """In the order of the commits, until the slot is no longer shown."""
    speed = Write(cell.world("online"), ARM, SPEED)
    for value in (1.0, 2.0):
        with Lock(speed) as lock:
            lock[speed] = value
    samples = Samples()
    samples.learn(SPEED_SLOT, CellSource(cell).samples(SPEED_SLOT, 120, 4096))
    assert [numbers[""] for _, numbers in samples.of(SPEED_SLOT)] == [0.5, 1.0, 2.0]
    samples.only(set())
    assert samples.of(SPEED_SLOT) == []


def test_locks_actors_and_shards_are_tables(cell, feed):
    """A held lock appears with its holder, and an entry with its cause."""
    feed.wish("page", [SLOT])
    until(lambda: feed.catalogue.slots("online"))
    activity = Activity(CellSource(cell), feed.catalogue)
    activity.start()
    try:
        with Lock(Write(cell.world("online"), ARM, POSE)):
            activity.list("page", [SLOT])
            until(lambda: activity.now.held)
        assert "held by writer" in activity.now.held["online:arm/pose"]
        assert "online:arm/pose" in activity.now.locks
        assert "open" in activity.now.shards
        until(lambda: activity.entry(SLOT))
        assert activity.entry(SLOT).cause.actor == "writer"
        assert activity.type_of("pose")
    finally:
        activity.stop()


def test_a_moment_is_a_recording_that_can_be_shown(cell, tmp_path):
    """What a page downloads opens again, with the data of that moment."""
    before = move(cell, 1.0)
    move(cell, 2.0)
    name, content = recording_of(CellSource(cell), "online", before.stamp_ns, SHOWS)
    (tmp_path / name).write_bytes(content)
    source = RecordingSource(tmp_path / name)
    data = source.data_at([SLOT], source.timeline.newest_ns).data
    assert decode_untyped(data[SLOT].datum)[0, 3] == 1.0


def test_a_moment_too_large_for_a_browser_is_refused_and_leaves_no_file(cell, monkeypatch):
    """The refusal names the command that writes it."""
    monkeypatch.setattr(datum, "FILE_BYTES_MAX", 100)
    with pytest.raises(ConfigError, match=r"more than 100 bytes.*enact world export online"):
        recording_of(CellSource(cell), "online", move(cell, 1.0).stamp_ns, SHOWS)


def test_a_recording_is_a_past(cell, tmp_path):
    """Forwards and backwards."""
    recorder, stop = Recorder(cell, tmp_path / "run.mcap"), threading.Event()
    done = threading.Thread(target=recorder.run, args=(stop,))
    done.start()
    until(lambda: (tmp_path / "run.mcap").exists() and (tmp_path / "run.mcap").stat().st_size)
    positions = [move(cell, x_m) for x_m in (1.0, 2.0, 3.0)]
    cell.wait(positions[-1])
    until(lambda: recorder.summary.versions >= 5)
    stop.set()
    done.join()
    source = RecordingSource(tmp_path / "run.mcap")
    feed = RecordingFeed(source, lambda aspect: SHOWS.get(aspect, GUESSED))
    assert feed.in_scene(source.catalogue.slots("online")) == [SLOT]
    for position, x_m in ((positions[2], 3.0), (positions[0], 1.0), (positions[1], 2.0)):
        contents = PageContents(feed, source, lambda *_: None)
        contents.player.look_back(source.timeline, position.stamp_ns)
        found = contents.data([SLOT])[SLOT]
        assert found.value[0, 3] == x_m
        assert "by writer, process" in datum_of(contents, Samples(), SLOT, found)
