"""One world context as of one moment, every datum of it: read, or written into a recording."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from enact_dist.access.snapshot import HeldView
from enact_dist.config.shows import GUESSED, Shows
from enact_dist.core.protocol.messages import Item
from enact_dist.errors import ConfigError
from enact_dist.recording.exact import recorded_of
from enact_dist.recording.file import RecordingFile
from enact_dist.terms import Access
from enact_dist.world.version_data import Retained, Wanted, causes_of

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator, Mapping

    from enact_dist.core.client.plan import Reading
    from enact_dist.recording.exact import Recorded
    from enact_dist.world.context import WorldContext

PORTION_BYTES: Final = 64 << 20
"""How much is fetched at once."""


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """What an export holds.

    Attributes:
        at_ns: The timestamp of the exported state.
        versions: Data in it.
        size_bytes: Bytes on the disk.
        counts: What else happened, by name (see `file.RecordingFile`).
    """

    path: str
    at_ns: int
    versions: int
    size_bytes: int
    counts: dict[str, int] = field(default_factory=dict)


def world_as_of(world: WorldContext, at_ns: int = 0) -> Iterator[Recorded]:
    """Yield every datum of a world context, all of one moment, over all shards, with its cause.

    Not more than `PORTION_BYTES` of data are in memory at once, or the largest datum; the shards
    keep the rest until then.  A program that may not observe the cell gets no causes.

    Args:
        world: The world context.
        at_ns: The timestamp to export; 0: now.

    Raises:
        ForgottenError: A state as of `at_ns` has left its retention.
        ShardUnreachableError: A shard does not answer.
    """
    session = world.session
    session.client.greet()
    aspects = session.client.aspect_entries()
    items = [Item(int(Access.VIEW_EACH), world.name, "**", aspect) for aspect in sorted(aspects)]
    if not items:
        return
    with HeldView(session, items, past_ns=at_ns) as view:
        states = [reading for reading in view.states if not reading.state.null_reason]
        states.sort(key=lambda reading: reading.state.slot)
        wanted = {s.slot: Wanted(s.stamp_ns, s.slot, s.version, shard) for shard, _, s in states}
        causes = causes_of(session, [*wanted.values()])  # now: data that change lose them
        for portion in _portions(states):
            data = view.fetch(portion)
            for one in (wanted[reading.state.slot] for reading in portion):
                yield recorded_of(one, causes.get(one), Retained("", data.pop(one.slot)), 0)


def _portions(readings: list[Reading]) -> Iterator[list[Reading]]:
    portion: list[Reading] = []
    size = 0
    for reading in readings:
        if portion and size + reading.state.size > PORTION_BYTES:
            yield portion
            portion, size = [], 0
        portion.append(reading)
        size += reading.state.size
    if portion:
        yield portion


class FileTooLargeError(ConfigError):
    """A file has passed the size that it may have."""


def _check_size(file: RecordingFile, bytes_max: int) -> None:
    if bytes_max and file.size > bytes_max:
        raise FileTooLargeError(f"{file.path} takes more than {bytes_max} bytes")


def export_world(
    world: WorldContext,
    path: str | os.PathLike[str],
    *,
    at_ns: int = 0,
    shows: Mapping[str, Shows] | None = None,
    compression: str = "zstd",
    bytes_max: int = 0,
) -> ExportSummary:
    """Write a world context as of one moment into a recording; `replay` makes it again.

    Args:
        world: The world context.
        path: The file; it must not exist.
        at_ns: The timestamp to export; 0: now.
        shows: How to show the data of an aspect; unnamed aspects are guessed.
        compression: "none", "lz4" or "zstd".
        bytes_max: Size that the file must not pass; 0: any.  A larger one is deleted as soon as
            it has passed it, so little more is ever fetched or written.

    Raises:
        ForgottenError: A state as of `at_ns` has left its retention.
        ConfigError: The file exists, cannot be made, or passes `bytes_max`.
        OSError: The disk refuses.
    """
    declared = dict(shows or {})
    log_ns = at_ns or time.time_ns()
    versions = world_as_of(world, at_ns)
    first = next(versions, None)  # forgotten data raise before the file is made
    file = RecordingFile(
        path,
        {"worlds": world.name, "entities": "**", "aspects": "", "begin_ns": str(log_ns)},
        aspects=lambda name: world.session.client.aspect_entries().get(name),
        shows=lambda name: declared.get(name, GUESSED),
        compression=compression,
    )
    count = 0
    try:
        while first is not None:
            file.add_commit((first,), log_ns)
            _check_size(file, bytes_max)
            count += 1
            first = next(versions, None)
        file.close({"versions": str(count), "commits": "0", "missing": "0"})
        _check_size(file, bytes_max)
    except FileTooLargeError:
        file.abandon()
        file.path.unlink()
        raise
    except BaseException:
        file.abandon()
        raise
    return ExportSummary(str(path), log_ns, count, file.size, dict(file.counts))
