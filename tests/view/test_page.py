"""A page and its server, without a browser: its thread, its bounds, its moments."""

import asyncio
import contextlib
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from polling import until
from quiet_browser import QuietClient
from view_samples import ARM, SHOWS, SLOT, move, moved, shown, slot

from enact_dist import Aspect, Lock, Retention, Write
from enact_dist.cli.main import main
from enact_dist.core.protocol.parts import SlotState
from enact_dist.errors import ConfigError
from enact_dist.view.activity import CellActivity
from enact_dist.view.catalogue import ListedState, SlotCatalogue
from enact_dist.view.pages import page as pages
from enact_dist.view.pages.comparing import MARKED
from enact_dist.view.pages.page import Page
from enact_dist.view.pages.panels import NONE
from enact_dist.view.pages.server import free_port
from enact_dist.view.pages.texts import row_of
from enact_dist.view.pages.viewer import Viewer, ViewSettings

STORED = Path(__file__).parents[1] / "e2e" / "stored_before" / "recording.mcap"


@pytest.fixture
def page(cell):
    with Viewer(cell, ViewSettings(SHOWS, "online", rate_hz=20.0)) as viewer:
        page = Page(viewer, QuietClient())
        yield page
        page.close()
        if page._thread.ident:
            page._thread.join()


def test_a_page_outlives_what_its_tick_and_its_events_raise(page, monkeypatch):
    """It says so as long as it is so; an event's failure stays until the next event."""
    tick, failing = page._tick, [True]

    def odd():
        if failing[0]:
            raise ZeroDivisionError("no scale")
        tick()

    monkeypatch.setattr(page, "_tick", odd)
    monkeypatch.setattr(page, "_on_fit", lambda _: 1 / 0)
    page.start()
    client = page._client
    until(lambda: "no scale" in client.status())
    failing[0] = False
    until(lambda: "updates/s" in client.status() and "no scale" not in client.status())
    page._send("fit", None)
    until(lambda: "division by zero" in client.status())
    assert page._thread.is_alive()


def test_a_click_is_shown_at_once_and_a_drag_in_its_time(page, monkeypatch):
    """However much a person does, the rate bounds what is drawn; the next is due in 0.5 s."""
    ticks, taken, waited_s = [], [], []
    monkeypatch.setattr(page, "_tick", lambda: ticks.append(1))
    monkeypatch.setattr(page, "_on_fit", taken.append)
    page._viewer.rate_hz, page._acted_s = 0.1, time.monotonic() - 20.0
    for number in range(3):
        page._send("fit", number)
        begun_s = time.monotonic()
        page._take_events(begun_s, begun_s + 0.5)
        waited_s.append(time.monotonic() - begun_s)
        assert taken == list(range(number + 1))
    assert waited_s[0] < 0.5 <= min(waited_s[1:])
    assert ticks == []


def test_rows_are_shown_again_as_soon_as_their_values_come(page, monkeypatch):
    """They do not wait for the next listing."""
    page._filter = "nothing"
    page.start()
    until(lambda: len(page._viewer.feed.catalogue.slots("online")) == 2 and page._listed_s)
    monkeypatch.setattr(pages, "LISTED_S", 30.0)
    page._send("filter", "speed")
    handles = page._client.gui.handles
    until(lambda: any("<b>arm/speed</b> 0.5" in str(h.content) for h in [*handles.values()]))


def test_a_choice_outlives_a_tick_that_begins_before_it_is_heard(page, monkeypatch):
    """What a page sets meanwhile is what it knew before."""
    shown = []
    monkeypatch.setattr(page, "_show_status", lambda *_: shown.append(1))
    monkeypatch.setattr(pages, "LISTED_S", 0.0)
    page.contents.marked_ns = 1
    page.start()
    handles = page._client.gui.handles
    until(lambda: "compare with" in handles and MARKED in handles["compare with"].options)
    handle = handles["compare with"]
    handle.value = MARKED
    before = len(shown)
    until(lambda: len(shown) > before + 1)
    assert handle.value == MARKED
    asyncio.run(handle.act(SimpleNamespace(client_id=0, target=handle)))
    until(lambda: page.contents.comparing.against == MARKED)
    page._send("against", "")
    until(lambda: handle.value == NONE)


def test_a_history_comes_when_the_size_of_its_datum_does(page, monkeypatch):
    """A datum can be chosen before its size is known."""
    sizes, asked = {}, []
    monkeypatch.setattr(page._viewer, "size", lambda slot: sizes.get(slot.aspect))
    monkeypatch.setattr(page._viewer.source, "samples", lambda slot, *_: asked.append(slot) or [])
    page.start()
    handles = page._client.gui.handles
    until(lambda: "datum" in handles and "arm/pose" in handles["datum"].options)
    page._send("datum", "arm/pose")
    until(lambda: any("<b>online:arm/pose</b>" in str(h.content) for h in [*handles.values()]))
    assert asked == []
    sizes["pose"] = 8
    until(lambda: [slot.aspect for slot in asked] == ["pose"])


def test_a_page_goes_on_while_a_history_is_read(page, monkeypatch):
    """A second choice meanwhile follows; what cannot be read is told."""
    asked, read = [], threading.Event()

    def samples(slot, *_):
        asked.append(slot.aspect)
        assert read.wait(60)
        raise ConfigError("the file is gone")

    monkeypatch.setattr(page._viewer.source, "samples", samples)
    page.start()
    handles = page._client.gui.handles
    until(lambda: "datum" in handles and "arm/pose" in handles["datum"].options)
    page._send("datum", "arm/pose")
    until(lambda: asked == ["pose"])
    page._send("datum", "arm/speed")
    until(lambda: any("<b>online:arm/speed</b>" in str(h.content) for h in [*handles.values()]))
    assert asked == ["pose"]
    read.set()
    until(lambda: asked == ["pose", "speed"])
    until(lambda: "the file is gone" in page._client.status())


def test_the_slider_reaches_from_the_oldest_moment_to_the_present(page, cell):
    """While the page is live, too: at its right end it shows the newest moment."""
    positions = [move(cell, x_m) for x_m in (1.0, 2.0)]
    page.start()
    slider = page._client.gui.handles
    until(lambda: "seconds" in slider and slider["seconds"].value == slider["seconds"].max != 1.0)
    line = page.contents.player.timeline
    assert slider["seconds"].max == pytest.approx(line.span_s, abs=1e-3)
    page._send("seconds", slider["seconds"].max)
    until(lambda: not page.contents.player.live)
    until(lambda: page.contents.at_ns == positions[-1].stamp_ns)


def test_a_jump_leaves_no_trail(page):
    """From the past back to the present the places between were never seen."""
    contents = page.contents

    def trails_at(x_m, version):
        pose = shown(moved(x_m), "pose", frame="cell", version=version)
        scene = contents.scenes({slot("thing"): pose})[""]
        return [name for name in scene.nodes if name.startswith("trail")]

    assert trails_at(0.0, 1) == []
    assert len(trails_at(1.0, 2)) == 1
    contents.player.look_back(contents.player.timeline)
    contents.follow()
    assert trails_at(9.0, 3) == []
    contents.go_to(contents.at_ns)
    assert trails_at(5.0, 4) == []


def test_an_address_that_cannot_be_listened_on_is_refused():
    """Of another machine, or with its ports taken; viser would wait for ever."""
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1 port 8080: .*assign[^;]*; choose with"):
        free_port("192.0.2.1", 8080, 1000)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"127\.0\.0\.1 port {port}: .*in use; ss -ltnp"):
            free_port("127.0.0.1", port)


def test_a_port_that_is_asked_for_and_taken_is_an_error(capsys):
    """Whoever asked for it would look for the page there."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(STORED), "--port", str(port)]) == 2
    err = capsys.readouterr().err
    assert f"'sport = :{port}' names the process that listens there; end it, or choose" in err


def test_a_default_port_that_is_taken_is_told_with_the_next_one():
    """Whoever holds it, this test or another program."""
    words = [sys.executable, "-m", "enact_dist.cli.main", "view", str(STORED)]
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):
            taken.bind(("127.0.0.1", 8080))
            taken.listen()
        view = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            address = view.stdout.readline()
        finally:
            view.terminate()
            _, err = view.communicate(timeout=60)
    assert re.search(r"http://127\.0\.0\.1:80(8[1-9]|9\d)", address)
    assert err == "enact: port 8080 is taken; this is the next free one\n"


@pytest.mark.parametrize("option", ["--rate", "--bytes"])
def test_a_bound_of_zero_is_refused_in_its_own_words(option, capsys):
    """By the option's name, before anything is connected."""
    with pytest.raises(SystemExit):
        main(["view", "cell.toml", option, "0"])
    assert f"argument {option}: '0' is no number above zero" in capsys.readouterr().err


@pytest.mark.parametrize("factor", ["0.2", "1.5", "nan", "half"])
def test_a_resolution_out_of_range_is_refused(factor, capsys):
    """Too small, above one, and what is no number."""
    with pytest.raises(SystemExit):
        main(["view", "cell.toml", "--resolution", factor])
    assert f"argument --resolution: {factor!r} is no " in capsys.readouterr().err


def shown_row(page, name):
    """Return the row of a datum, "" before there is one."""
    texts = [str(handle.content) for handle in [*page._client.gui.handles.values()]]
    rows = next((text for text in texts if "margin-bottom:3px" in text), "")
    return next((row for row in rows.split("margin-bottom:3px") if f"<b>{name}</b>" in row), "")


def test_rows_of_the_past_say_what_was_there_then(page, cell):
    """Nothing of a datum that came later; why it was null; how large the version was."""
    page.start()
    until(lambda: "by writer" in shown_row(page, "arm/speed"))
    text = Write(cell.world("online"), ARM, Aspect("text", str, retention=Retention(versions=9)))
    before_ns, stamps = move(cell, 1.0).stamp_ns, []
    for value in ("x" * 10_000, None, "now"):
        with Lock(text) as lock:
            if value is None:
                del lock[text]
            else:
                lock[text] = value
        stamps.append(lock.position.stamp_ns)
    until(lambda: "by writer" in shown_row(page, "arm/text"))
    for at_ns, wanted, lacking in (
        (before_ns, "str", " ago"),
        (stamps[0], "10.0 kB · v1 · 0.0 ms ago", "null"),
        (stamps[1], "null: DELETED", "small"),
        (stamps[2], "small · v3 · 0.0 ms ago · by writer", "null"),
    ):
        page.contents.look_back([SLOT], at_ns)

        def is_right(wanted=wanted, lacking=lacking):
            row = shown_row(page, "arm/text")
            return wanted in row and lacking not in row and "None" not in row

        until(is_right)


def test_a_row_names_its_writer_while_the_datum_changes():
    """The newest version whose writer is known is then not the newest one."""
    slot_, samples = slot("arm", "speed"), SimpleNamespace(of=lambda *_: ())
    cause = SimpleNamespace(actor="writer")
    entry = SimpleNamespace(state=SlotState(slot_, 1, 1, 0, None, False, False, ""), cause=cause)
    catalogue = SlotCatalogue()
    catalogue.note(slot_, ListedState(2, 2, null=False), gap=0, now_s=1.0)
    viewer = SimpleNamespace(
        feed=SimpleNamespace(catalogue=catalogue),
        entry=lambda _: entry,
        size=lambda _: 0,
        type_of=lambda _: "float",
        activity_now=CellActivity,
    )
    assert "v2" in row_of(viewer, samples, slot_, None, "", 0)
    assert "by writer" in row_of(viewer, samples, slot_, None, "", 0)
    assert "by writer" not in row_of(viewer, samples, slot_, None, "", 5)


def test_a_row_of_the_past_has_no_rate_size_or_holder_of_the_present():
    """They would be read as those of then."""
    slot_, samples = slot("arm", "speed"), SimpleNamespace(of=lambda *_: ())
    catalogue = SlotCatalogue()
    for version in (1, 2, 3):
        now_s = time.monotonic() - 1.0 + version / 10.0
        state = ListedState(version, round(now_s * 1e9), null=False)
        catalogue.note(slot_, state, gap=0, now_s=now_s)
    activity = CellActivity(held={str(slot_): "held by writer for 2 s"})
    viewer = SimpleNamespace(
        feed=SimpleNamespace(catalogue=catalogue),
        entry=lambda _: None,
        size=lambda _: 10_000,
        type_of=lambda _: "float",
        activity_now=lambda: activity,
    )
    now = row_of(viewer, samples, slot_, None, "", 0)
    assert all(one in now for one in ("float", "10 Hz", "held by writer", "10.0 kB"))
    then = row_of(viewer, samples, slot_, None, "", 5)
    assert "float" in then
    assert not any(one in then for one in ("Hz", "held by", "kB"))
