"""The panels of a page: their inputs send events, their outputs take HTML."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from viser import ClientHandle

NONE: Final = "-"
"""The option of a list that stands for no choice."""
SPEEDS: Final = ("0.1", "0.25", "0.5", "1", "2", "5", "10")


class Send(Protocol):
    """Takes the name of an event, its value and the input that it comes from; returns at once."""

    def __call__(self, name: str, value: Any, source: Input | None = None) -> None:
        """Take it."""


class Input:
    """An input of the page, which a person sets, and the page, too.

    What a person has set stays until the page has taken it: a tick in between would set back
    what the page knows.
    """

    def __init__(self, handle: Any, send: Send, name: str) -> None:
        self._handle, self._send, self._name = handle, send, name
        self.known = handle.value
        handle.on_update(self._changed)

    async def _changed(self, event: Any) -> None:
        """Send what a person sets, not what the page itself sets; in order, as it is awaited."""
        if event.client_id is not None:
            self._send(self._name, self._value_of(event.target.value), self)

    def _value_of(self, value: Any) -> Any:
        return value

    def taken(self) -> None:
        """The page has taken what a person has set."""
        self.known = self._handle.value

    def put(self, value: object) -> None:
        """Set it, if the page knows another value."""
        if self.known != value:
            self.known = self._handle.value = value


class Text:
    """HTML that is sent only if it has changed."""

    def __init__(self, gui: Any) -> None:
        self._handle, self._content = gui.add_html(""), ""

    def show(self, content: str) -> None:
        """Show it."""
        if content != self._content:
            self._handle.content = self._content = content


class Choice(Input):
    """A list to choose from whose options change."""

    def __init__(self, gui: Any, label: str, send: Send, name: str) -> None:
        super().__init__(gui.add_dropdown(label, (NONE,), initial_value=NONE), send, name)
        self._options: tuple[str, ...] = (NONE,)

    def _value_of(self, value: Any) -> Any:
        return "" if value == NONE else value

    def show(self, options: Sequence[str], chosen: str) -> None:
        """Show options, and which of them is chosen; "": none."""
        wanted = (NONE, *dict.fromkeys(options))
        if chosen and chosen not in wanted:
            wanted = (*wanted, chosen)
        if wanted != self._options:
            self._options = wanted
            self._handle.options = wanted
        self.put(chosen or NONE)


class TimePanel:
    """Now, or a moment of the past; play, step, mark and compare."""

    def __init__(self, client: ClientHandle, send: Send, *, live: bool) -> None:
        gui = client.gui
        self._where = Text(gui)
        self._live = Input(gui.add_checkbox("live", live, disabled=not live), send, "live")
        self._slider = gui.add_slider("seconds", 0.0, 1.0, 0.001, 0.0)
        self._seconds = Input(self._slider, send, "seconds")
        steps = gui.add_button_group("commit", ("previous", "next"))
        steps.on_click(lambda event: send("step", -1 if event.target.value == "previous" else 1))
        self._playing = Input(gui.add_checkbox("play", initial_value=False), send, "play")
        Input(gui.add_dropdown("speed", SPEEDS, initial_value="1"), send, "speed")
        gui.add_button("mark this moment").on_click(lambda _: send("mark", None))
        self._against = Choice(gui, "compare with", send, "against")
        self._difference = Text(gui)

    def show(self, where: str, *, live: bool, playing: bool) -> None:
        """Show which moment the page shows."""
        self._where.show(where)
        self._live.put(live)
        self._playing.put(playing)

    @property
    def high_s(self) -> float:
        """The right end of the slider: seconds after its left end."""
        return float(self._slider.max)

    def range(self, span_s: float, seconds: float) -> None:
        """Show how far back the slider goes, and where it is."""
        high = max(0.001, round(span_s, 3))
        if self._slider.max != high:
            self._seconds.put(min(self._seconds.known, high))
            self._slider.max = high
        if abs(self._seconds.known - seconds) > 5e-4:
            self._seconds.put(min(round(seconds, 3), high))

    def compare(self, options: Sequence[str], chosen: str, difference: str) -> None:
        """Show with what the moment is compared, and how the two differ."""
        self._against.show(options, chosen)
        self._difference.show(difference)


class TreePanel:
    """World contexts, entities and data; a filter; what is drawn."""

    def __init__(self, client: ClientHandle, send: Send) -> None:
        self._gui, self._send = client.gui, send
        self._world = Choice(client.gui, "world context", send, "world")
        wanted = client.gui.add_text("filter", "", hint="part of a name, or a pattern")
        Input(wanted, send, "filter")
        self._place = Text(client.gui)
        self._branches = client.gui.add_folder("entities")
        self._buttons: list[Any] = []
        self._names: tuple[str, ...] = ()
        self._rows = Text(client.gui)
        self._chosen = Choice(client.gui, "datum", send, "datum")
        self._layers = client.gui.add_folder("layers", expand_by_default=False)
        self._boxes: dict[str, Any] = {}
        with self._layers:
            self._label = Choice(client.gui, "labels", send, "label")
            Input(client.gui.add_checkbox("trails of poses", initial_value=True), send, "trails")
            client.gui.add_button("fit the view").on_click(lambda _: send("fit", None))

    def show_worlds(self, worlds: Sequence[str], chosen: str) -> None:
        """Show the world contexts."""
        self._world.show(worlds, chosen)

    def show_place(self, place: str, branches: Sequence[tuple[str, str]]) -> None:
        """Show where in the tree the page is: a text, and a button (name, label) for each way."""
        self._place.show(place)
        labels = tuple(label for _, label in branches)
        if labels == self._names:
            return
        self._names = labels
        for button in self._buttons:
            button.remove()
        self._buttons = []
        with self._branches:
            for name, label in branches:
                button = self._gui.add_button(label)
                button.on_click(partial(self._branch, name))
                self._buttons.append(button)

    def _branch(self, name: str, _: object) -> None:
        self._send("branch", name)

    def _layer(self, aspect: str, event: Any) -> None:
        self._send("layer", (aspect, event.target.value))

    def show_rows(self, content: str, names: Sequence[str], chosen: str) -> None:
        """Show the listed data, and which of them is chosen."""
        self._rows.show(content)
        self._chosen.show(names, chosen)

    def show_layers(self, aspects: Sequence[str], labels: Sequence[str], label: str) -> None:
        """Show the aspects that can be drawn, each with a box, and those that can be labels."""
        with self._layers:
            for aspect in aspects:
                if aspect not in self._boxes:
                    box = self._boxes[aspect] = self._gui.add_checkbox(aspect, initial_value=True)
                    box.on_update(partial(self._layer, aspect))
        self._label.show(labels, label)


class DatumPanel:
    """The chosen datum: value, plot, causes and effects, pins and downloads."""

    def __init__(self, client: ClientHandle, send: Send, *, cell: bool) -> None:
        gui = client.gui
        self._value = Text(gui)
        files = gui.add_button_group("download", ("PNG", "PLY", *(("MCAP",) if cell else ())))
        files.on_click(lambda event: send("download", event.target.value))
        ways = gui.add_button_group("lineage", ("why", "impact"))
        ways.on_click(lambda event: send("lineage", event.target.value))
        self._tree = Text(gui)
        self._step = Choice(gui, "step", send, "lineage step")
        if not cell:
            return
        self._label = gui.add_text("label", "", hint="letters, digits, _ . - and slashes")
        gui.add_button("keep under this label").on_click(lambda _: send("pin", self._label.value))

    def show(self, content: str) -> None:
        """Show the datum."""
        self._value.show(content)

    def show_tree(self, content: str, steps: Sequence[str]) -> None:
        """Show causes or effects, and the steps that can be looked at."""
        self._tree.show(content)
        self._step.show(steps, "")


class CellPanel:
    """Locks, actors and shards."""

    def __init__(self, client: ClientHandle) -> None:
        self._texts = []
        for title in ("locks", "actors", "shards"):
            with client.gui.add_folder(title):
                self._texts.append(Text(client.gui))

    def show(self, contents: Sequence[str]) -> None:
        """Show the three tables."""
        for text, content in zip(self._texts, contents, strict=True):
            text.show(content)
