"""The present of a cell for all pages: one watch, and the newest data that some page shows.

The watch is open while a page is.  Of a slot that changes faster than pages are drawn only the
newest version is fetched, and no more bytes than the limit; what is passed over is counted.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.access.watch import Watch
from enact_dist.core.protocol.datum import Slot
from enact_dist.errors import EnactError, PermissionDeniedError
from enact_dist.view.catalogue import ListedState, SlotCatalogue
from enact_dist.view.drawing.scene import IN_SCENE, ShownDatum, shown_of
from enact_dist.view.follower import Follower

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from enact_dist.config.shows import Shows
    from enact_dist.recording.exact import Recorded
    from enact_dist.view.source import CellSource

AGAIN_S: Final = 1.0
"""Pause before a watch that failed is opened again."""
GATHER_S: Final = 0.02
"""How long changes are collected after the first one that comes to a quiet cell."""
GATHERED_S: Final = 0.2
"""For so long at most they are collected at once."""
CAMERAS_TOGETHER: Final = 4
"""Cameras whose new images are fetched in one round; those of more cameras come in turns."""
NAMED_MAX: Final = 3
"""Most data that cannot be shown whose reasons are."""
PICTURES: Final = frozenset(("image", "mask"))
PROBED_MAX: Final = 16
"""Aspects without `shows` whose first datum is looked at in one round."""


def drawable(slots: Iterable[Slot], kinds: Callable[[str], frozenset[str] | None]) -> list[Slot]:
    """Return the slots that a scene can show.

    Args:
        slots: Some slots.
        kinds: As what the data of an aspect are shown; None: not known yet.
    """
    shown: dict[str, bool] = {}
    found = []
    for slot in slots:
        if slot.aspect not in shown:
            shown[slot.aspect] = bool(IN_SCENE & (kinds(slot.aspect) or frozenset()))
        if shown[slot.aspect]:
            found.append(slot)
    return found


class Feed(Follower):
    """The thread that follows a cell.

    Args:
        source: The cell.
        shows_of: What an aspect is shown as.
        rate_hz: Most rounds per second.
        bytes_s: Most bytes that are fetched per second.

    Attributes:
        catalogue: All slots.
        passed_over: Versions of shown slots that were not fetched.
        held_back: Rounds in which data waited because of the limit of bytes.
        moment_ns: The moment of the newest data.
    """

    def __init__(
        self,
        source: CellSource,
        shows_of: Callable[[str], Shows],
        *,
        rate_hz: float,
        bytes_s: float,
    ) -> None:
        super().__init__("view feed")
        self._source, self.shows_of = source, shows_of
        self._rate_hz, self._bytes_s = rate_hz, bytes_s
        self.catalogue = SlotCatalogue()
        self._trouble = ""
        self._unfit: dict[Slot, tuple[tuple[int, int], str]] = {}
        self.passed_over = self.held_back = 0
        self.moment_ns = 0
        self._kinds: dict[str, frozenset[str]] = {}
        self._shown: dict[Slot, ShownDatum] = {}
        self._sizes: dict[Slot, int] = {}
        self._wishes: dict[object, frozenset[Slot]] = {}
        self._budget, self._budget_s = bytes_s, time.monotonic()

    # ------------------------------------------------------------ for pages

    @property
    def problem(self) -> str:
        """Why data are missing or old; "" if nothing is wrong."""
        unfit = [
            f"{slot} v{state.version} cannot be shown: {why}"
            for slot, (version, why) in self._unfit.copy().items()
            if (state := self.catalogue.state(slot)) is not None and state[:2] == version
        ]
        away = self._source.away.values()
        return "; ".join([*filter(None, (self._trouble, *away)), *unfit[:NAMED_MAX]])

    def wish(self, page: object, slots: Iterable[Slot] | None) -> None:
        """Set which data a page shows; None: the page has gone."""
        with self._news:
            if slots is None:
                self._wishes.pop(page, None)
            else:
                self._wishes[page] = frozenset(slots)
            self._news.notify_all()

    def shown(self, slots: Iterable[Slot]) -> dict[Slot, ShownDatum]:
        """Return the newest data of some slots, as far as they have come."""
        with self._news:
            return {slot: self._shown[slot] for slot in slots if slot in self._shown}

    def kinds(self, aspect: str) -> frozenset[str] | None:
        """Return as what an aspect's data are shown; None: not known yet."""
        declared = self.shows_of(aspect).kinds
        return frozenset(declared) if declared else self._kinds.get(aspect)

    def in_scene(self, slots: Iterable[Slot]) -> list[Slot]:
        """Return the slots that the scene can show."""
        return drawable(slots, self.kinds)

    # ------------------------------------------------------------ the thread

    def _run(self) -> None:
        while self._waits_for_pages():
            try:
                client = self._source.session.client
                with Watch(client, (), ("**",), (), lenient=True) as watch:
                    self.catalogue.clear()  # whatever was dropped while no watch was open
                    self._follow(watch)
            except Exception as error:  # noqa: BLE001 - this thread is that of all pages
                self._trouble = str(error) or repr(error)
                with self._news:
                    self._news.wait_for(lambda: self._stopped, AGAIN_S)

    def _waits_for_pages(self) -> bool:
        with self._news:
            self._news.wait_for(lambda: self._stopped or self._wishes)
            return not self._stopped

    def _follow(self, watch: Watch) -> None:
        due_s, came = 0.0, False
        while not self._stopped and self._wishes:
            now_s = time.monotonic()
            if now_s < due_s:
                # Where data change all the time, each change that wakes this thread costs more
                # than to look for all of them when the next round is due.
                came = self._gathered(watch, due_s) if came else self._noted(watch, due_s - now_s)
                if came:
                    self._gathered(watch, min(due_s, time.monotonic() + GATHER_S))
                continue
            self._round(now_s)
            # At most half of the time is spent here, however large the data are.
            due_s = now_s + max(1.0 / self._rate_hz, 2.0 * (time.monotonic() - now_s))

    def _gathered(self, watch: Watch, until_s: float) -> bool:
        """Let changes collect for a while and note them; return whether there was one."""
        left_s = min(until_s - time.monotonic(), GATHERED_S)
        if left_s > 0.0:
            with self._news:
                self._news.wait_for(lambda: self._stopped, left_s)
        return self._noted(watch, 0.0)

    def _noted(self, watch: Watch, wait_s: float) -> bool:
        """Note a change and those that came with it; return whether there was one."""
        first = change = watch.next(max(0.0, wait_s))
        now_s = time.monotonic()
        while change is not None:
            slot = Slot(change.world, change.entity.name, change.aspect)
            state = ListedState(
                change.version, change.position.stamp_ns, change.null, change.captured_ns
            )
            self.catalogue.note(slot, state, gap=change.gap, now_s=now_s)
            change = watch.next_here()
        return first is not None

    def _round(self, now_s: float) -> None:
        """Fetch what has changed."""
        with self._news:
            wanted = frozenset().union(*self._wishes.values())
            for slot in [slot for slot in self._shown if slot not in wanted]:
                del self._shown[slot]
        probes = self._probes()
        changed = self._in_turns([slot for slot in wanted if self._is_new(slot)])
        away = self._source.still_away()
        asked = [s for s in {*changed, *probes} if self._source.shard_of(s) not in away]
        if not asked:  # what is shown is of this moment, too
            self.moment_ns = self.catalogue.newest_ns
            return
        try:
            affordable = self._affordable(asked, now_s)
            if affordable:
                self._fetch(affordable)
            self._trouble = ""
        except EnactError as error:
            self._trouble = str(error)

    def _is_new(self, slot: Slot) -> bool:
        state, shown = self.catalogue.state(slot), self._shown.get(slot)
        if state is None or self._unfit.get(slot, ((0, 0), ""))[0] == state[:2]:
            return False
        if shown is None:
            return not state.null
        return shown.recorded.state != state[:2]

    def _in_turns(self, changed: list[Slot]) -> list[Slot]:
        """Return what has changed, of images and masks those of the cameras longest not shown."""
        turns: dict[str, int] = {}
        pictures: list[Slot] = []
        for slot in changed:
            shown = self._shown.get(slot)
            if shown is not None and not PICTURES.isdisjoint(shown.drawables):
                pictures.append(slot)
                stamp_ns = shown.recorded.stamp_ns
                turns[shown.frame] = min(stamp_ns, turns.get(shown.frame, stamp_ns))
        later = set(sorted(turns, key=lambda frame: turns[frame])[CAMERAS_TOGETHER:])
        waiting = {slot for slot in pictures if self._shown[slot].frame in later}
        return [slot for slot in changed if slot not in waiting]

    def _probes(self) -> list[Slot]:
        """Return one datum of each aspect whose kinds have to be guessed."""
        found: dict[str, Slot] = {}
        for slot in self.catalogue.first_of_aspects():
            if self.kinds(slot.aspect) is None and len(found) < PROBED_MAX and self._is_new(slot):
                found.setdefault(slot.aspect, slot)
        return list(found.values())

    def _affordable(self, slots: list[Slot], now_s: float) -> list[Slot]:
        """Return the slots for which the limit of bytes has room.

        A datum is taken to be as large as its last fetched version, a new one as its shard says.
        Those that were fetched longest ago come first, so that each has its turn.
        """
        self._learn_sizes([slot for slot in slots if slot not in self._sizes])
        self._budget = min(self._bytes_s, self._budget + self._bytes_s * (now_s - self._budget_s))
        self._budget_s = now_s
        found = []
        for slot in sorted(slots, key=self._fetched_ns):
            if self._budget <= 0.0:
                self.held_back += 1
                break
            self._budget -= self._sizes.get(slot, 0)
            found.append(slot)
        return found

    def _learn_sizes(self, slots: list[Slot]) -> None:
        states = {slot: self.catalogue.state(slot) for slot in slots}
        asked = {slot: state.version for slot, state in states.items() if state is not None}
        if asked:
            try:
                entries = self._source.explained(asked)
            except PermissionDeniedError as error:
                if error.right != "read":
                    raise
                return  # the data themselves are refused next, each by itself
            for slot, entry in entries.items():
                self._sizes[slot] = entry.state.size

    def _fetched_ns(self, slot: Slot) -> int:
        shown = self._shown.get(slot)
        return shown.recorded.stamp_ns if shown is not None else 0

    def _fetch(self, slots: list[Slot]) -> None:
        at_ns = self.catalogue.newest_ns
        found = self._source.data_at(slots, at_ns)
        with self._news:
            for slot, recorded in found.data.items():
                self._budget += self._sizes.get(slot, 0) - recorded.size
                self._sizes[slot] = recorded.size
                self._show(slot, recorded)
            for slot, why in found.denied:
                state = self.catalogue.state(slot)
                if state is not None:
                    self._unfit[slot] = state[:2], why
            self.moment_ns = at_ns
            self._news.notify_all()

    def _show(self, slot: Slot, recorded: Recorded) -> None:
        before = self._shown.get(slot)
        if before is not None and recorded.version > before.recorded.version + 1:
            self.passed_over += recorded.version - before.recorded.version - 1
        try:
            shown = shown_of(recorded, self.shows_of(slot.aspect))
        except Exception as error:  # noqa: BLE001 - one odd datum takes no other with it
            self._unfit[slot] = recorded.state, str(error) or repr(error)
            return
        self._unfit.pop(slot, None)
        if not shown.shows.kinds and recorded.datum is not None:
            self._kinds[slot.aspect] = frozenset(shown.drawables)
        self._shown[slot] = shown
