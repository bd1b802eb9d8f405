"""The data of one page: which it shows, and as of which moment."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, Protocol

from enact_dist.view.drawing.scene import SceneView, ShownDatum, labels_of, scene_of, shown_of
from enact_dist.view.drawing.trails import Trails
from enact_dist.view.markup import short_value
from enact_dist.view.pages.comparing import ShownDifference, Side
from enact_dist.view.timeline import Player, Timeline

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from enact_dist.compare.diff import Diff
    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.view.catalogue import SlotCatalogue
    from enact_dist.view.source import DataSource

SCENE_MAX: Final = 256
"""Most data in one scene."""
HISTORY_S: Final = 5.0
"""How often a page that follows the present asks how far the past reaches."""
OTHERS_MAX: Final = 64
"""Most data of the right side of a difference that are drawn."""


class Present(Protocol):
    """What pages ask of a feed."""

    catalogue: SlotCatalogue
    shows_of: Callable[[str], Shows]
    moment_ns: int
    passed_over: int
    held_back: int

    @property
    def problem(self) -> str:
        """Why data are missing or old."""

    def wish(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which data a page shows."""

    def shown(self, slots: Iterable[Slot]) -> dict[Slot, ShownDatum]:
        """Return the newest data of some slots."""

    def in_scene(self, slots: Iterable[Slot]) -> list[Slot]:
        """Return the slots that the scene can show."""


class PageContents:
    """What one page shows.  Used by one thread.

    Args:
        feed: The present.
        source: The past.
        compare: Returns how two sides differ.

    Attributes:
        world: The world context that is shown.
        player: The moment.
        marked_ns: The marked moment; 0: none.
        hidden: Aspects that are not drawn.
        label: The aspect whose data stand as labels beside their entities; "": none.
        trails: Whether poses leave trails.
        comparing: The difference that is shown.
        forgotten: Data that have left their retention at the moment.
        left_out: Data that are not drawn because there are too many.
        unfit: Which data of the moment cannot be shown, and why; "" of the present.
    """

    def __init__(
        self, feed: Present, source: DataSource, compare: Callable[[Side, Side], Diff]
    ) -> None:
        self._feed, self._source = feed, source
        self.world = ""
        self.player = Player()
        self.marked_ns = 0
        self.hidden: set[str] = set()
        self.label = ""
        self.trails = True
        self.comparing = ShownDifference(compare, feed.catalogue.changes)
        self.forgotten: tuple[Slot, ...] = ()
        self.left_out = 0
        self.unfit = ""
        self._history_due_s = 0.0
        self._history_of: frozenset[Slot] = frozenset()
        self._trails = Trails()
        self._past: dict[Slot, ShownDatum] = {}
        self._past_key: tuple[object, ...] = ()
        self._others: dict[Slot, ShownDatum] = {}
        self._others_key: object = None

    @property
    def at_ns(self) -> int:
        """The moment that is shown."""
        return self._feed.moment_ns if self.player.live else self.player.at_ns

    @property
    def past_ns(self) -> int:
        """The moment of the past that is shown; 0: the present."""
        return 0 if self.player.live else self.player.at_ns

    def drawable(self) -> list[Slot]:
        """Return the data of the world context that a scene can show, hidden ones too."""
        return self._feed.in_scene(self._feed.catalogue.slots(self.world, self.past_ns))

    def drawn(self, drawable: Iterable[Slot]) -> list[Slot]:
        """Return the data to draw of those that a scene can show, and the models of arms."""
        found = [slot for slot in drawable if slot.aspect not in self.hidden]
        self.left_out = max(0, len(found) - SCENE_MAX)
        drawn = found[:SCENE_MAX]
        models = [
            slot._replace(aspect=model)
            for slot in drawn
            if (model := self._feed.shows_of(slot.aspect).model)
        ]
        return list(dict.fromkeys([*drawn, *models]))

    def labelled(self) -> list[Slot]:
        """Return the data that are labels."""
        if not self.label:
            return []
        slots = self._feed.catalogue.slots(self.world, self.past_ns)
        return [slot for slot in slots if slot.aspect == self.label][:SCENE_MAX]

    def look_back(self, slots: Sequence[Slot], at_ns: int = 0) -> None:
        """Leave the present, for a moment (0: the newest one) of the history of some data."""
        timeline = Timeline.of(self._source.histories(slots))
        self.player.look_back(timeline.including([at_ns]) if at_ns else timeline, at_ns)
        self._trails = Trails()

    def go_to(self, at_ns: int) -> None:
        """Show another moment of the past; it does not play on from there."""
        self.player.at_ns, self.player.playing = at_ns, False
        self._trails = Trails()

    def follow(self) -> None:
        """Follow the present again."""
        self.player.follow()
        self._trails = Trails()
        self._history_of = frozenset()

    def learn_history(self, slots: Sequence[Slot]) -> None:
        """Learn how far the past of some data reaches, unless that was asked a moment ago."""
        begun_s, of = time.monotonic(), frozenset(slots)
        if begun_s >= self._history_due_s + (HISTORY_S if of == self._history_of else 0.0):
            self.player.timeline = Timeline.of(self._source.histories(slots))
            self._history_of = of
            self._history_due_s = begun_s + 20.0 * (time.monotonic() - begun_s)

    def data(self, slots: Sequence[Slot]) -> dict[Slot, ShownDatum]:
        """Return data as of the moment, of the shards that answer.

        Raises:
            LockTimeoutError: A commit before the moment is still undecided.
        """
        if self.player.live:
            self.forgotten, self.unfit = (), ""
            return self._feed.shown(slots)
        key = (self.player.at_ns, frozenset(slots), frozenset(self._source.away))
        if key != self._past_key:
            self._past, self.forgotten, self.unfit = self._as_of(
                slots, self.player.at_ns, self._past
            )
            self._past_key = key
        return self._past

    def _as_of(
        self, slots: Sequence[Slot], at_ns: int, before: dict[Slot, ShownDatum]
    ) -> tuple[dict[Slot, ShownDatum], tuple[Slot, ...], str]:
        """Return data as of a moment, what has left its retention, and what cannot be shown.

        Of a version that was shown before, the same object is returned; it is not fetched again.
        """
        known = {slot: old.recorded for slot, old in before.items()}
        found = self._source.data_at(slots, at_ns, known)
        shown: dict[Slot, ShownDatum] = {}
        unfit = "; ".join(why for _, why in found.denied[:1])
        for slot, recorded in found.data.items():
            if not recorded.version:
                continue  # it was never set before the moment
            if slot in known and known[slot].state == recorded.state:
                shown[slot] = before[slot]
                continue
            try:
                shown[slot] = shown_of(recorded, self._feed.shows_of(slot.aspect))
            except Exception as error:  # noqa: BLE001 - one odd datum takes no other with it
                unfit = f"{slot} v{recorded.version} cannot be shown: {error}"
        return shown, found.forgotten, unfit

    def scenes(
        self, data: dict[Slot, ShownDatum], sides_px: Mapping[str, int] | None = None
    ) -> dict[str, SceneView]:
        """Return the scene of the moment and, of a difference, what the other side has.

        Args:
            data: The data of the moment.
            sides_px: Longest side of the image in each frame.

        Raises:
            LockTimeoutError: A commit before the moment is still undecided.
        """
        left = Side(self.world, self.at_ns)
        self.comparing.look(
            left, live=self.player.live, now_ns=self._now_ns(), marked_ns=self.marked_ns
        )
        tints = {slot: tint for slot in data if (tint := self.comparing.tint(slot))}
        scene = scene_of(data, tints=tints, sides_px=sides_px)
        nodes = dict(scene.nodes)
        if self.trails:
            nodes |= self._trails.follow(scene.nodes, self.at_ns)
        scenes = {"": scene}
        others = {
            slot: tint
            for slot, tint in self.comparing.right_tints().items()
            if slot.aspect not in self.hidden
        }
        wanted = self._feed.in_scene(others)[:OTHERS_MAX]
        if wanted:
            key = (self.comparing.right, tuple(wanted))
            if key != self._others_key:
                at_ns = self.comparing.right.at_ns
                self._others, _, _ = self._as_of(wanted, at_ns, self._others)
                self._others_key = key
            scenes["right "] = scene_of(self._others, tints=others, frames_of=data)
        texts = self.comparing.texts() | {
            slot.entity: f"{slot.aspect}: {short_value(shown.value)}"
            for slot, shown in data.items()
            if slot.aspect == self.label
        }
        nodes |= labels_of(scene, texts)
        scenes[""] = scene._replace(nodes=nodes)
        return scenes

    def _now_ns(self) -> int:
        return self._feed.catalogue.newest_ns
