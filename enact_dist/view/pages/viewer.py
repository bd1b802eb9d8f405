"""What all pages share, and the server that brings them to browsers."""

from __future__ import annotations

import contextlib
import io
import threading
import warnings
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final, Self

from enact_dist.access.watch import Closing
from enact_dist.config.shows import GUESSED
from enact_dist.core.protocol.datum import Position
from enact_dist.errors import ConfigError, MisuseError
from enact_dist.view.activity import Activity, CellActivity
from enact_dist.view.feed import Feed
from enact_dist.view.pages.page import Page
from enact_dist.view.recorded import RecordingFeed, RecordingSource
from enact_dist.view.source import CellSource
from enact_dist.view.timeline import Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from viser import ClientHandle

    from enact_dist.compare.diff import Diff
    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import VersionEntry
    from enact_dist.terms import Aspect
    from enact_dist.view.pages.comparing import Side
    from enact_dist.world.cell import Cell
    from enact_dist.world.lineage import Made

BYTES_S: Final = 150e6
RATE_HZ: Final = 10.0


def require_viser() -> None:
    """Make sure that pages can be served.

    Raises:
        ConfigError: viser is not installed; the message names the extra that brings it.
    """
    if find_spec("viser") is None:
        raise ConfigError(
            "the view needs viser, which this Python does not have: install the extra 'view'"
            " (pip install -e '.[view]' in the clone of enact-dist)"
        )


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """How a cell or a recording is shown.

    Attributes:
        shows: What aspects are shown as; unnamed ones are guessed.
        world: The world context that a page begins with; "": the first.
        rate_hz: Most updates of a page per second.
        bytes_s: Most bytes that are fetched from the cell per second.
        aspects: Returns the aspects that have a comparator; all others are compared exactly.
        pin: Pins versions under a label.
    """

    shows: Mapping[str, Shows] = field(default_factory=dict)
    world: str = ""
    rate_hz: float = RATE_HZ
    bytes_s: float = BYTES_S
    aspects: Callable[[], Sequence[Aspect[Any]]] = tuple
    pin: Callable[[str, list[Made]], None] | None = None


class Viewer(Closing):
    """A cell, or a recording, as pages see it; also a context manager.

    Args:
        shown: An observer's connection, or a recording.
        settings: How it is shown.

    Attributes:
        feed: The present.
        source: The past.
        cell: The cell, None of a recording.
        timeline: All moments of a recording.
    """

    def __init__(self, shown: Cell | RecordingSource, settings: ViewSettings) -> None:
        self.shows, self.world = settings.shows, settings.world
        self.rate_hz, self._settings = settings.rate_hz, settings
        self._pages: dict[int, Page] = {}
        self._guard = threading.Lock()
        self.timeline = Timeline()
        self._activity: Activity | None = None
        self.feed: Feed | RecordingFeed
        self.source: CellSource | RecordingSource
        self.cell: CellSource | None = None
        if isinstance(shown, RecordingSource):
            self.name, self.source, self.timeline = shown.name, shown, shown.timeline
            self.feed = RecordingFeed(shown, self._shows_of)
            return
        self.name, self.source = shown.name, CellSource(shown)
        self.cell = self.source
        self.feed = Feed(
            self.source, self._shows_of, rate_hz=settings.rate_hz, bytes_s=settings.bytes_s
        )
        self._activity = Activity(self.source, self.feed.catalogue)
        self.feed.start()
        self._activity.start()

    def _shows_of(self, aspect: str) -> Shows:
        return self.shows.get(aspect, GUESSED)

    # ------------------------------------------------------------ pages

    def open_page(self, client: ClientHandle) -> None:
        """Show a page in a browser that has connected."""
        page = Page(self, client)
        with self._guard:
            self._pages[client.client_id] = page
        page.start()

    def close_page(self, client: ClientHandle) -> None:
        """End the page of a browser that has gone."""
        with self._guard:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()

    def close(self) -> None:
        """End all pages and threads; twice is harmless."""
        with self._guard:
            pages, self._pages = self._pages, {}
        for page in pages.values():
            page.close()
        if self._activity is not None:
            self._activity.stop()
        if isinstance(self.feed, Feed):
            self.feed.stop()

    # ------------------------------------------------------------ for pages

    def list_for(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which data a page lists; None: the page has gone."""
        if self._activity is not None:
            self._activity.list(page, slots)

    def entry(self, slot: Slot) -> VersionEntry | None:
        """Return size and writer of a listed slot's newest version, as far as they are known."""
        return self._activity.entry(slot) if self._activity is not None else None

    def type_of(self, aspect: str) -> str:
        """Return the type of an aspect in a few words; "" if it is not known."""
        return self._activity.type_of(aspect) if self._activity is not None else ""

    def activity_now(self) -> CellActivity:
        """Return locks, actors and shards."""
        return self._activity.now if self._activity is not None else CellActivity()

    def compare(self, left: Side, right: Side) -> Diff:
        """Return how two world contexts differ, each as of a moment.

        Raises:
            EnactError: A moment is forgotten, a shard does not answer, or a comparator is missing.
        """
        if self.cell is None:
            raise MisuseError("a recording has no difference; replay it into a cell")
        cell = self.cell.cell
        first, second = (cell.world(side.world).at(_moment(side.at_ns)) for side in (left, right))
        compared = {aspect.name: aspect for aspect in self._settings.aspects()}
        names = [name for name, (fingerprint, _) in cell.aspects().items() if fingerprint]
        return first.diff(second, aspects=[compared.get(name, name) for name in sorted(names)])

    def pin(self, label: str, versions: list[Made]) -> None:
        """Pin versions: the one thing that a page changes, and only if a person asks for it.

        Raises:
            EnactError: They cannot be pinned.
        """
        if self._settings.pin is None:
            raise MisuseError("nothing can be pinned in what is shown here")
        self._settings.pin(label, versions)


def _moment(at_ns: int) -> Position:
    """Return a timestamp as `WorldContext.at` takes it; seconds as a float would round it."""
    return Position(at_ns, "")


class ViewServer(Closing):
    """The server of the pages; also a context manager.

    Args:
        viewer: What they show.
        host: Address to listen on.
        port: Port; the next free one if it is taken.

    Raises:
        ConfigError: viser is not installed.
    """

    def __init__(self, viewer: Viewer, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        require_viser()
        from enact_dist.view.pages.unshared import UnsharedServer

        # A browser may go while its page draws: what is on its way then is no loss.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        with contextlib.redirect_stdout(io.StringIO()):  # its own table of addresses
            self._server = UnsharedServer(host, port, label=viewer.name, verbose=False)
        self._server.gui.configure_theme(
            show_share_button=False, show_logo=False, control_width="large"
        )
        # viser's own light makes colours pale, and its shadows cost a browser without a graphics
        # card most of its time.
        scene = self._server.scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light/around", intensity=2.2)
        scene.add_light_directional(
            "/light/above", intensity=1.5, position=(1.0, -2.0, 3.0), cast_shadow=False
        )
        self._server.on_client_connect(viewer.open_page)
        self._server.on_client_disconnect(viewer.close_page)
        self.port = self._server.get_port()

    def close(self) -> None:
        """End it."""
        self._server.stop()

    def __enter__(self) -> Self:
        return self
