"""One browser's page: takes its events, shows its contents, at a bounded rate, in one thread."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from enact_dist.view import markup
from enact_dist.view.drawing.scene import extent_of
from enact_dist.view.follower import stand_back
from enact_dist.view.pages import texts
from enact_dist.view.pages.canvas import Canvas
from enact_dist.view.pages.comparing import MARKED, NOW
from enact_dist.view.pages.contents import PageContents
from enact_dist.view.pages.datum import SMALL_BYTES, Lineage, Samples, file_of, recording_of
from enact_dist.view.pages.panels import CellPanel, DatumPanel, Text, TimePanel, TreePanel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from viser import ClientHandle

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.view.catalogue import Listing
    from enact_dist.view.drawing.scene import SceneView, ShownDatum
    from enact_dist.view.pages.panels import Input
    from enact_dist.view.pages.viewer import Viewer

    _Event = tuple[str, Any, Input | None]

_log = logging.getLogger(__name__)

LISTED_S: Final = 0.5
"""How often tables are made anew."""
FILLING_S: Final = 0.02
FILLED_S: Final = 1.0
"""How often, and how long after an event, a page looks for what its new rows lack."""
RATE_WINDOW_S: Final = 3.0
UP: Final = ".."
FITTED_S: Final = 2.0
"""How long a new page waits for all data before it looks at those that have come."""


class Page:
    """What one browser sees.

    Args:
        viewer: What all pages share.
        client: The browser.
    """

    def __init__(self, viewer: Viewer, client: ClientHandle) -> None:
        self._viewer, self._client = viewer, client
        self._events: queue.SimpleQueue[_Event] = queue.SimpleQueue()
        self._closed = False
        self.contents = PageContents(viewer.feed, viewer.source.of_page(), viewer.compare)
        self._canvas = Canvas(client)
        self._lineage, self._samples = Lineage(), Samples()
        self._path = self._filter = self._said = self._failed = ""
        self._datum: Slot | None = None
        self._listing: Listing | None = None
        self._drawable: list[Slot] = []
        self._listed_s = self._ticked_s = 0.0
        self._lacking: list[Slot] = []
        self._learning = False
        self._learned: Slot | None = None
        self._fits = 2
        self._begun_s = self._acted_s = time.monotonic()
        self._draws: deque[float] = deque()
        self._remarks: tuple[str, ...] = ()
        self._thread = threading.Thread(target=self._run, name="view page", daemon=True)

    def start(self) -> None:
        """Begin to show."""
        self._thread.start()

    def close(self) -> None:
        """End; returns at once."""
        self._closed = True
        self._send("", None)

    # ------------------------------------------------------------ the thread

    def _send(self, name: str, value: Any, source: Input | None = None) -> None:
        self._events.put((name, value, source))

    def _run(self) -> None:
        stand_back(self._thread.name)
        try:
            if self._guarded(self._build):
                return
            while not self._closed:
                begun_s = time.monotonic()
                self._failed = self._guarded(self._tick)
                took_s = time.monotonic() - begun_s
                # At most half of the time is spent here, however much there is to draw.
                rested_s = begun_s + 2.0 * took_s
                hurries = self._fills or self._begins
                period_s = FILLING_S if hurries else 1.0 / self._viewer.rate_hz
                self._take_events(rested_s, max(begun_s + period_s, rested_s))
        finally:
            self._viewer.feed.wish(self, None)
            self._viewer.list_for(self, None)

    def _take_events(self, rested_s: float, until_s: float) -> None:
        while not self._closed and (left_s := until_s - time.monotonic()) > 0.0:
            try:
                events = [self._events.get(timeout=left_s)]
            except queue.Empty:
                return
            while not self._events.empty():
                events.append(self._events.get())
            newest = {name for name, *_ in events if name == "seconds"}
            for at, (name, value, source) in enumerate(events):
                later = (other for other, *_ in events[at + 1 :])
                if name and not (name in newest and name in later):
                    if source is not None:
                        source.taken()
                    self._said, self._listed_s = "", 0.0
                    act = getattr(self, f"_on_{name.replace(' ', '_')}")
                    self._said = self._guarded(act, value) or self._said
                    now_s = time.monotonic()
                    if now_s > self._acted_s + 1.0 / self._viewer.rate_hz:
                        until_s = rested_s  # a click is shown at once, a drag at the rate
                    self._acted_s = now_s

    def _guarded(self, act: Any, *given: Any) -> str:
        """Do something; show on the page what goes wrong, and return it."""
        try:
            act(*given)
        except Exception as error:  # noqa: BLE001 - the page goes on
            wrong = str(error) or repr(error)
            if wrong not in (self._said, self._failed):
                _log.warning("the page goes on after: %s", wrong, exc_info=error)
            with contextlib.suppress(Exception):  # the browser may have gone
                self._show_status(wrong)
            return wrong
        return ""

    def _build(self) -> None:
        gui = self._client.gui
        self._status = Text(gui)
        tabs = gui.add_tab_group()
        is_cell = self._viewer.cell is not None
        with tabs.add_tab("world"):
            self._tree = TreePanel(self._client, self._send)
        with tabs.add_tab("time"):
            self._time = TimePanel(self._client, self._send, live=is_cell)
        with tabs.add_tab("datum"):
            self._detail = DatumPanel(self._client, self._send, cell=is_cell)
        if is_cell:
            with tabs.add_tab("cell"):
                self._cell = CellPanel(self._client)
        if not is_cell:
            self.contents.player.look_back(self._viewer.timeline)
        self.contents.world = self._viewer.world

    def _tick(self) -> None:
        now_s = time.monotonic()
        contents, player = self.contents, self.contents.player
        player.advance(min(1.0, now_s - self._ticked_s))
        self._ticked_s = now_s
        listing_due = now_s - self._listed_s >= (FILLING_S if self._begins else LISTED_S)
        if listing_due:
            self._listed_s = now_s
            self._list()
        elif player.playing:
            self._drawable = contents.drawable()
        drawn = contents.drawn(self._drawable)
        labelled, rows = contents.labelled(), self._followed()
        wanted = list(dict.fromkeys([*drawn, *labelled, *rows]))
        self._viewer.feed.wish(self, wanted if player.live else ())
        data = contents.data(wanted)
        for slot in rows:
            if slot in data and (player.live or self._viewer.cell is None):
                self._samples.add(data[slot])
        shown = {slot: data[slot] for slot in (*drawn, *labelled) if slot in data}
        whole = len(shown) >= len(drawn) or now_s > self._begun_s + FITTED_S
        scenes = contents.scenes(shown, self._canvas.sides_px())
        line = player.timeline
        with self._client.atomic():  # sent at once: each message alone costs as much as all
            self._draw(scenes, fits=self._fits > (0 if whole else 1))
            at_s = line.span_s if player.live else line.seconds(player.at_ns)
            self._time.range(line.span_s, at_s)
            lacking = [slot for slot in self._rows() if self._lacks(slot, rows, data)]
            if listing_due or lacking != self._lacking:
                self._lacking = lacking
                self._show_panels(data)
        if listing_due and player.live and not self._fills:
            contents.learn_history(self._of_history())
        self._ask_for_history()

    @property
    def _begins(self) -> bool:
        """Whether the page is new and still empty."""
        return not self._draws and time.monotonic() < self._begun_s + FITTED_S

    @property
    def _fills(self) -> bool:
        """Whether what an event has listed is still to come."""
        return bool(self._lacking) and time.monotonic() < self._acted_s + FILLED_S

    def _lacks(self, slot: Slot, followed: list[Slot], data: Mapping[Slot, ShownDatum]) -> bool:
        """Whether a listed datum will have a size or a value that have not come yet."""
        if self._viewer.cell is None:
            return False
        return self._viewer.entry(slot) is None or (slot in followed and slot not in data)

    def _draw(self, scenes: dict[str, SceneView], *, fits: bool) -> None:
        if fits and scenes[""].nodes:
            self._fit(scenes[""])
        if self._canvas.draw(scenes):
            self._draws.append(time.monotonic())
        while self._draws and self._draws[0] < time.monotonic() - RATE_WINDOW_S:
            self._draws.popleft()
        self._remarks = tuple(one for scene in scenes.values() for one in scene.remarks)

    def _fit(self, scene: SceneView) -> None:
        """Look at all that is there, and choose the size of what has none."""
        extent = extent_of(scene)
        if extent is None:
            return
        self._canvas.fit(*extent)
        self._fits -= 1

    # ------------------------------------------------------------ lists

    def _list(self) -> None:
        catalogue, contents = self._viewer.feed.catalogue, self.contents
        worlds = catalogue.worlds()
        if not contents.world and worlds:
            contents.world = worlds[0]
        self._listing = catalogue.listing(
            contents.world, self._path, self._filter, contents.past_ns
        )
        self._drawable = contents.drawable()
        self._samples.only(set(self._rows()))
        self._viewer.list_for(self, self._rows())
        self._tree.show_worlds(worlds, contents.world)

    def _rows(self) -> list[Slot]:
        rows = list(self._listing.slots) if self._listing is not None else []
        return rows if self._datum is None or self._datum in rows else [*rows, self._datum]

    def _followed(self) -> list[Slot]:
        """Return the listed data whose values are shown: small ones, and the chosen datum."""
        return [slot for slot in self._rows() if slot == self._datum or self._is_small(slot)]

    def _is_small(self, slot: Slot) -> bool:
        size = self._viewer.size(slot)
        return size is not None and size <= SMALL_BYTES

    def _show_panels(self, data: Mapping[Slot, ShownDatum]) -> None:
        contents, player, listing = self.contents, self.contents.player, self._listing
        assert listing is not None
        below, past_ns = "" if self._filter else self._path, contents.past_ns
        rows = [
            texts.row_of(self._viewer, self._samples, slot, data.get(slot), below, past_ns)
            for slot in listing.slots
        ]
        more = (
            f"<div>… and {listing.left_out} more: use the filter</div>" if listing.left_out else ""
        )
        names = [markup.slot_name(slot) for slot in self._rows()]
        ways = [(name, f"{name}/ ({count})") for name, count in listing.branches]
        if self._path and not self._filter:
            ways.insert(0, (UP, UP))
        self._tree.show_place(markup.small(markup.text(f"{contents.world}:{self._path}")), ways)
        chosen = markup.slot_name(self._datum) if self._datum is not None else ""
        self._tree.show_rows(markup.small("".join(rows) + more), names, chosen)
        aspects = sorted({slot.aspect for slot in self._drawable})
        others = sorted({slot.aspect for slot in self._rows()} - set(aspects))
        self._tree.show_layers(aspects, others, contents.label)
        shown = data.get(self._datum) if self._datum is not None else None
        self._detail.show(texts.datum_of(contents, self._samples, self._datum, shown))
        options = [*(() if player.live else (NOW,)), *((MARKED,) if contents.marked_ns else ())]
        others = [name for name in self._viewer.feed.catalogue.worlds() if name != contents.world]
        if self._viewer.cell is not None:
            self._time.compare(
                [*options, *others], contents.comparing.against, contents.comparing.content
            )
            now = self._viewer.activity_now()
            self._cell.show((now.locks, now.actors, now.shards))
        self._time.show(
            markup.small(texts.moment_of(contents)), live=player.live, playing=player.playing
        )
        self._show_status()

    def _show_status(self, wrong_now: str = "") -> None:
        feed, contents = self._viewer.feed, self.contents
        rate_hz = len(self._draws) / RATE_WINDOW_S
        parts = [f"{self._viewer.name} · {contents.world} · {rate_hz:.1f} updates/s"]
        if feed.passed_over:
            parts.append(f"{feed.passed_over} versions not shown: newer ones came first")
        if feed.held_back:
            parts.append(f"{feed.held_back} times data waited for the limit of bytes")
        if contents.left_out:
            parts.append(f"{contents.left_out} data not drawn: too many, switch layers off")
        lines = [markup.text(part) for part in (*parts, *self._remarks[:5])]
        wrong = dict.fromkeys(filter(None, (feed.problem, contents.unfit, self._said, wrong_now)))
        lines += [f'<span style="color:#b00">{markup.text(one)}</span>' for one in wrong]
        self._status.show(markup.small("<br>".join([*lines, "&nbsp;"])))

    # ------------------------------------------------------------ events

    def _on_world(self, name: str) -> None:
        if name:
            self.contents.world, self._path, self._datum = name, "", None

    def _on_filter(self, wanted: str) -> None:
        self._filter = wanted.strip()

    def _on_branch(self, name: str) -> None:
        if name == UP:
            self._path = self._path.rstrip("/").rpartition("/")[0]
            self._path += "/" if self._path else ""
        else:
            self._path += f"{name}/"

    def _on_datum(self, name: str) -> None:
        found = [slot for slot in self._rows() if markup.slot_name(slot) == name]
        self._datum = found[0] if found else None
        self._learned = None

    def _ask_for_history(self) -> None:
        """Ask for that of the chosen datum beside the page, one at a time: a cell may be slow.

        It waits for the datum's size, and until the datum itself is shown.
        """
        slot = self._datum
        if slot is None or slot == self._learned or self._learning or not self._is_small(slot):
            return
        self._learning, self._learned = True, slot
        ask = partial(self._read_history, slot)
        threading.Thread(target=ask, name="view history", daemon=True).start()

    def _read_history(self, slot: Slot) -> None:
        stand_back("view history")
        found: object
        try:
            found = self._viewer.source.samples(slot, markup.SAMPLES_MAX, SMALL_BYTES)
        except Exception as error:  # noqa: BLE001 - the page shows it
            found = error
        self._send("learned", (slot, found))

    def _on_learned(self, answer: tuple[Slot, Any]) -> None:
        slot, found = answer
        self._learning = False
        if isinstance(found, Exception):
            raise found
        self._samples.learn(slot, found)

    def _on_layer(self, box: tuple[str, bool]) -> None:
        aspect, is_on = box
        (self.contents.hidden.discard if is_on else self.contents.hidden.add)(aspect)

    def _on_label(self, aspect: str) -> None:
        self.contents.label = aspect

    def _on_trails(self, wanted: bool) -> None:
        self.contents.trails = wanted

    def _on_fit(self, _: object) -> None:
        self._fits = 1

    def _on_live(self, wanted: bool) -> None:
        if wanted:
            self.contents.follow()
        else:
            self._look_back()

    def _look_back(self, at_ns: int = 0) -> None:
        self.contents.look_back(self._of_history(), at_ns)

    def _of_history(self) -> list[Slot]:
        slots = [*self.contents.drawn(self._drawable), *self._followed()]
        return list(dict.fromkeys(slots))

    def _past(self) -> None:
        if self.contents.player.live:
            self._look_back()

    def _on_seconds(self, seconds: float) -> None:
        player = self.contents.player
        if player.live:  # its right end is the present, which has gone on since the slider was set
            back_s = self._time.high_s - seconds
            self._look_back()
            seconds = player.timeline.span_s - back_s
        self.contents.go_to(player.timeline.at(seconds))

    def _on_step(self, by: int) -> None:
        self._past()
        player = self.contents.player
        player.at_ns, player.playing = player.timeline.step(player.at_ns, by), False

    def _on_play(self, wanted: bool) -> None:
        self._past()
        player = self.contents.player
        if wanted and player.at_ns >= player.timeline.newest_ns:
            player.at_ns = player.timeline.oldest_ns
        player.playing = wanted

    def _on_speed(self, speed: str) -> None:
        self.contents.player.speed = float(speed)

    def _on_mark(self, _: object) -> None:
        self.contents.marked_ns = self.contents.at_ns

    def _on_against(self, against: str) -> None:
        self.contents.comparing.against = against

    def _on_lineage(self, way: str) -> None:
        shown = self._chosen()
        if shown is not None:
            self._lineage.ask(self._viewer.source, shown, way)
            self._detail.show_tree(self._lineage.content, list(self._lineage.steps))

    def _on_lineage_step(self, step: str) -> None:
        if step in self._lineage.steps:
            slot, at_ns = self._lineage.steps[step]
            self.contents.world, self._datum, self._path = slot.context, slot, ""
            self._list()
            # What was there before a recording began is seen from its begin on.
            self._look_back(max(at_ns, self._viewer.timeline.oldest_ns))

    def _on_pin(self, label: str) -> None:
        self._said = self._lineage.pin(label.strip(), self._viewer.pin)

    def _on_download(self, kind: str) -> None:
        if kind == "MCAP" and self._viewer.cell is not None:
            at_ns = self.contents.at_ns
            name, content = recording_of(
                self._viewer.cell, self.contents.world, at_ns, self._viewer.shows
            )
        else:
            shown = self._chosen()
            if shown is None:
                return
            name, content = file_of(shown, kind)
        self._client.send_file_download(name, content, save_immediately=True)

    def _chosen(self) -> ShownDatum | None:
        """Return the chosen datum as of the moment; say on the page if there is none."""
        shown = self.contents.data([self._datum]).get(self._datum) if self._datum else None
        if shown is None:
            self._said = "no datum is chosen, or it is not there at this moment"
        return shown
