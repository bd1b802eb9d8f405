"""The chosen datum of a page: its history as a plot, its causes and effects, its files."""

from __future__ import annotations

import tempfile
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

from enact_dist.errors import ConfigError, EnactError, MisuseError
from enact_dist.view import markup
from enact_dist.view.drawing.files import ply_of, png_of
from enact_dist.wire.payload import decode_untyped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from enact_dist.config.shows import Shows
    from enact_dist.core.protocol.datum import Datum, Slot
    from enact_dist.view.drawing.scene import ShownDatum
    from enact_dist.view.source import CellSource, DataSource
    from enact_dist.world.lineage import CauseTree, EffectTree, Made

DEPTH: Final = 4
"""Steps of causes and effects that are followed."""
STEPS_MAX: Final = 60
SMALL_BYTES: Final = 4096
"""Larger data are not followed for their numbers."""
FILE_BYTES_MAX: Final = 256 << 20
"""A larger file is not sent to a browser: `enact world export` writes it."""


class Samples:
    """The numbers of listed data over time.  Used by one thread."""

    def __init__(self) -> None:
        self._known: dict[Slot, deque[tuple[int, dict[str, float]]]] = {}

    def add(self, shown: ShownDatum) -> None:
        """Take a version, unless it is known or older."""
        recorded = shown.recorded
        if recorded.datum is not None and recorded.datum.size <= SMALL_BYTES:
            self._add(recorded.slot, recorded.stamp_ns, shown.value)

    def _add(self, slot: Slot, stamp_ns: int, value: object) -> None:
        known = self._known.setdefault(slot, deque(maxlen=markup.SAMPLES_MAX))
        if not known or known[-1][0] < stamp_ns:
            numbers = markup.numbers_in(value)
            if numbers:
                known.append((stamp_ns, numbers))

    def of(self, slot: Slot, until_ns: int = 0) -> list[tuple[int, dict[str, float]]]:
        """Return what is known of a slot, up to a moment if one is given."""
        known = self._known.get(slot, ())
        return [one for one in known if not until_ns or one[0] <= until_ns]

    def only(self, slots: set[Slot]) -> None:
        """Forget all other slots."""
        for slot in self._known.keys() - slots:
            del self._known[slot]

    def learn(self, slot: Slot, learned: Iterable[tuple[int, Datum]]) -> None:
        """Take the history of a slot, see `DataSource.samples`."""
        newer = list(self._known.pop(slot, ()))
        for stamp_ns, datum in learned:
            self._add(slot, stamp_ns, decode_untyped(datum))
        known = self._known.setdefault(slot, deque(maxlen=markup.SAMPLES_MAX))
        known.extend(one for one in newer if not known or one[0] > known[-1][0])


class Lineage:
    """Causes or effects of a version.

    Attributes:
        content: The tree as HTML, or why there is none.
        steps: What can be looked at, by the text of each.
    """

    def __init__(self) -> None:
        self.content = ""
        self.steps: dict[str, tuple[Slot, int]] = {}
        self._tree: CauseTree | EffectTree | None = None

    def ask(self, source: DataSource, shown: ShownDatum, way: str) -> None:
        """Ask for the causes (``why``) or the effects (``impact``) of a version."""
        try:
            self._tree = source.tree_of(way, shown.recorded, DEPTH)
        except EnactError as error:
            self._tree, self.content, self.steps = None, markup.small(markup.text(error)), {}
            return
        self.content = markup.tree_lines(self._tree)
        found = [one for one in self._tree.walk() if one.position.stamp_ns][:STEPS_MAX]
        self.steps = {
            f"{number}. {one.slot} v{one.version}": (one.slot, one.position.stamp_ns)
            for number, one in enumerate(found, 1)
        }

    def pin(self, label: str, pin: Callable[[str, list[Made]], None]) -> str:
        """Pin the versions of the tree; return what was done.

        Args:
            label: Under which label.
            pin: Does it, as `Cell.pin`.

        Raises:
            ForgottenError: Some had left their retention; the others are pinned.
            MisuseError: The label cannot be used, or no tree is shown.
            ShardUnreachableError: A shard does not answer.
        """
        if self._tree is None:
            raise MisuseError("ask for why or impact first: a label keeps the versions of a tree")
        versions: list[Made] = [one for one in self._tree.walk() if one.known]
        pin(label, versions)
        return f"{len(versions)} versions are kept under {label}; enact world unpin ends that"


def file_of(shown: ShownDatum, kind: str) -> tuple[str, bytes]:
    """Return a datum as a file: its name, its bytes.

    Args:
        shown: The datum.
        kind: "PNG" or "PLY".

    Raises:
        ConfigError: The datum cannot be such a file.
    """
    slot = shown.recorded.slot
    name = f"{slot.entity}_{slot.aspect}_v{shown.recorded.version}".replace("/", "_")
    return f"{name}.{kind.lower()}", png_of(shown) if kind == "PNG" else ply_of(shown)


def recording_of(
    source: CellSource, world: str, at_ns: int, shows: Mapping[str, Shows]
) -> tuple[str, bytes]:
    """Return a world context as of a moment as an MCAP file: its name, its bytes.

    Raises:
        ConfigError: It is too large for a browser.
        ForgottenError: The moment has left the retention of some data.
        ShardUnreachableError: A shard does not answer.
    """
    from enact_dist.recording.exporting import FileTooLargeError, export_world

    with tempfile.TemporaryDirectory(prefix="enact-view-") as folder:
        path = Path(folder) / "export.mcap"
        context = source.cell.world(world)
        try:
            export_world(context, path, at_ns=at_ns, shows=shows, bytes_max=FILE_BYTES_MAX)
        except FileTooLargeError as error:
            raise ConfigError(
                f"{world} takes more than {FILE_BYTES_MAX} bytes, too many for a browser: use"
                f" enact world export {world} --out FILE.mcap"
            ) from error
        return f"{world}_{at_ns}.mcap", path.read_bytes()
