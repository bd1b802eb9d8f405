"""Causes and effects in the page of a recording, as the cell knew them."""

import threading
from pathlib import Path

import pytest
from polling import until
from quiet_browser import QuietClient
from view_samples import ARM, POSE, SHOWS, SPEED, moved

from enact_dist import Aspect, Entity, Lock, Read, Write
from enact_dist.recording.recorder import Recorder
from enact_dist.view.pages.page import Page
from enact_dist.view.pages.viewer import Viewer, ViewSettings
from enact_dist.view.recorded import RecordingSource
from enact_dist.wire.payload import decode_untyped

REPORT = Aspect("report", str)
CELL = Entity("system")
STORED = Path(__file__).parents[1] / "e2e" / "stored_before" / "recording.mcap"
"""A recording of format 1, made by an earlier version."""


def report_on(cell, text):
    """Write a report on the pose of `online` and the speed of `truth`."""
    online, truth = cell.world("online"), cell.world("truth")
    report, pose = Write(online, CELL, REPORT), Read(online, ARM, POSE)
    speed = Read(truth, ARM, SPEED)
    with Lock(report, pose, speed) as lock:
        lock[report] = f"{text}: {lock[pose][0, 3]} at {lock[speed]}"


def recorded(cell, path, *, more=lambda: None, **options):
    """Record a pose made of a speed, two reports made of that pose, and more."""
    online = cell.world("online")
    cell.world("truth").init(ARM, SPEED, 0.25)
    recorder, stop, begun = Recorder(cell, path, **options), threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: recorder.run(stop, tell=lambda _: begun.set()))
    thread.start()
    try:
        assert begun.wait(60)
        pose, speed = Write(online, ARM, POSE), Read(online, ARM, SPEED)
        with Lock(pose, speed) as lock:
            lock[pose] = moved(lock[speed])
        report_on(cell, "first")
        report_on(cell, "second")
        more()
    finally:
        stop.set()
        thread.join(60)
    return RecordingSource(path)


def shape(tree):
    """Return what a tree shows of each version."""
    said = (str(tree.slot), tree.version, tree.kind, tree.actor, tree.host, tree.pid)
    more = (tree.position, tree.elsewhere, tree.unfollowed, tree.left_out, tree.held_s)
    return (*said, *more, tuple(shape(child) for child in tree.children))


def newest(source, world, entity, aspect):
    slot = next(s for s in source.catalogue.slots(world) if s[1:] == (entity, aspect))
    return source.data_at([slot], source.timeline.newest_ns).data[slot]


@pytest.mark.parametrize("depth", [1, 4])
def test_trees_are_those_of_the_cell(cell, tmp_path, depth):
    """Through commits and through what was there before, over two world contexts."""
    source = recorded(cell, tmp_path / "run.mcap")
    report = newest(source, "online", "system", "report")
    found, known = (
        source.tree_of("why", report, depth),
        cell.why("online", CELL, REPORT, depth=depth),
    )
    assert shape(found) == shape(known)
    assert {str(one.slot) for one in found.walk()} >= {"online:arm/pose", "truth:arm/speed"}
    speed = newest(source, "online", "arm", "speed")
    effects = source.tree_of("impact", speed, depth)
    assert shape(effects) == shape(cell.impact("online", ARM, SPEED, 1, depth=depth))
    assert sum(one.aspect == "report" for one in effects.walk()) == (2 if depth == 4 else 0)


def test_what_was_not_recorded_is_named(cell, tmp_path):
    """A cause in a world context that was left out stands in the tree, unknown."""
    source = recorded(cell, tmp_path / "run.mcap", worlds=["online"])
    tree = source.tree_of("why", newest(source, "online", "system", "report"), 4)
    (other,) = (one for one in tree.walk() if one.world == "truth")
    assert (str(other.slot), other.version) == ("truth:arm/speed", 1)
    assert other.made_by == "not in the recording"
    assert not other.known


def test_a_page_shows_the_tree_and_goes_to_its_steps(cell, tmp_path):
    """A step in another world context changes to it, and to the moment of that commit."""
    source = recorded(cell, tmp_path / "run.mcap")
    with Viewer(source, ViewSettings(SHOWS, "online")) as viewer:
        page = Page(viewer, QuietClient())
        page.start()
        handles = page._client.gui.handles
        until(lambda: "datum" in handles and "system/report" in handles["datum"].options)
        page._send("datum", "system/report")
        page._send("lineage", "why")
        until(lambda: any("online:arm/pose v2" in one for one in handles["step"].options))
        shown = [str(handle.content) for handle in handles.values()]
        assert any("truth:arm/speed v1" in content for content in shown)
        step = next(one for one in handles["step"].options if "truth:arm/speed v1" in one)
        page._send("lineage step", step)
        until(lambda: page.contents.world == "truth")
        assert page.contents.at_ns == source.timeline.oldest_ns
        until(lambda: any("truth:arm/speed" in str(h.content) for h in [*handles.values()]))
        page.close()
        page._thread.join()


def test_rows_of_a_recording_are_as_of_its_moment(cell, tmp_path):
    """Value, version and writer; a chosen datum has its numbers of the whole recording."""
    speed = Write(cell.world("online"), ARM, SPEED)

    def speed_up():
        for number in range(1, 21):
            with Lock(speed) as lock:
                lock[speed] = 0.5 + number

    source = recorded(cell, tmp_path / "run.mcap", more=speed_up)
    with Viewer(source, ViewSettings(SHOWS, "online")) as viewer:
        page = Page(viewer, QuietClient())
        page.start()
        handles = page._client.gui.handles

        def row(*wanted):
            texts = [str(handle.content) for handle in [*handles.values()]]
            return any(all(one in text for one in wanted) for text in texts)

        page._send("seconds", source.timeline.span_s)
        until(lambda: row("<b>arm/speed</b> 20.5", "v21", "by writer"))
        page._send("step", -1)
        until(lambda: row("<b>arm/speed</b> 19.5", "v20"))
        page._send("datum", "arm/speed")
        until(lambda: row("<b>online:arm/speed</b>", "19.5", "<svg"))
        page.close()
        page._thread.join()
    slot = next(s for s in source.catalogue.slots("online") if s.aspect == "speed")
    assert len(source.samples(slot, 100, 64)) == 21
    spread = [decode_untyped(datum) for _, datum in source.samples(slot, 6, 64)]
    assert spread == [0.5 + number for number in range(0, 21, 4)]


def test_numbers_of_a_recording_are_those_of_small_versions(cell, tmp_path):
    """Large ones would all be in memory at once, for nothing that is shown."""
    report = Write(cell.world("online"), CELL, REPORT)

    def write():
        for text in ("x" * 100_000, "y" * 100_000, "small"):
            with Lock(report) as lock:
                lock[report] = text

    source = recorded(cell, tmp_path / "run.mcap", more=write)
    slot = next(s for s in source.catalogue.slots("online") if s.aspect == "report")
    found = [decode_untyped(datum) for _, datum in source.samples(slot, 100, 4096)]
    assert [text[:6] for text in found] == ["first:", "second", "small"]


def test_a_recording_of_before_has_no_causes_and_names_its_writers():
    """Its versions are shown as before."""
    source = RecordingSource(STORED)
    slots = source.catalogue.slots(source.catalogue.worlds()[0])
    data = source.data_at(slots, source.timeline.newest_ns).data
    assert data
    for version in data.values():
        tree = source.tree_of("why", version, 4)
        assert (tree.kind, tree.children) == ("unknown", ())
        assert tree.made_by.startswith("its cause is not known")
