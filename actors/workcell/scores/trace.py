"""What a run left behind: the versions of a recording by aspect, and when each was committed.

The evaluation and the pictures read this and nothing else, so a recording can be scored again.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from actors.workcell import vocabulary as words
from enact_dist import Aspect
from enact_dist.errors import ConfigError
from enact_dist.recording import Recording
from enact_dist.wire.payload import decode_datum

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy.typing as npt

    from enact_dist.core.protocol.datum import Datum
T = TypeVar("T")

ONLINE: Final = "online"
TRUTH: Final = "truth"
ASPECTS: Final[Mapping[str, Aspect[Any]]] = {
    aspect.name: aspect for aspect in vars(words).values() if isinstance(aspect, Aspect)
}
"""The aspects of the workcell by name."""
RECORDED: Final = tuple(sorted(ASPECTS.keys() - {"image", "raw_hull", "background", "wanted"}))
"""What a run records: all but the images and what is only made for pictures."""
LEFT_NS: Final = 400_000_000
"""A person of whom no datum is as new as this has left: null versions are not kept here."""
PACKED_BYTES_MIN: Final = 4096
"""From here on a datum is kept compressed: a mask of 38 kB takes 2 kB, ten minutes hold 48,000."""


@dataclass(frozen=True, slots=True)
class Packed(Generic[T]):
    """A datum of a recording whose body is compressed.

    Attributes:
        datum: Without its body.
        body: The body, compressed by zlib.
        datum_type: What it decodes to.
    """

    datum: Datum
    body: bytes
    datum_type: type[T]

    def unpack(self) -> T:
        """Return the value, decoded anew at each call."""
        whole = dataclasses.replace(self.datum, body=zlib.decompress(self.body))
        value: T = decode_datum(whole, self.datum_type)
        return value


@dataclass(frozen=True, slots=True)
class Kept(Generic[T]):
    """One version.

    Attributes:
        stamp_ns: Capture stamp.
        committed_ns: When it was committed.
        held: The datum, or how to get it.
    """

    stamp_ns: int
    committed_ns: int
    held: T | Packed[T]

    @property
    def datum(self) -> T:
        """Return the datum; a large one is decoded at each call, so ask for it once."""
        return self.held.unpack() if isinstance(self.held, Packed) else self.held


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """The versions of a run, in the order of their commits.

    Attributes:
        versions: By world context, entity and aspect; null versions are left out.
        missing: How many versions the recording does not have.
    """

    versions: Mapping[tuple[str, str, str], list[Kept[Any]]]
    missing: int = 0

    def of(self, entity: str, aspect: Aspect[T], world: str = ONLINE) -> list[Kept[T]]:
        """Return the versions of one slot, oldest first."""
        return self.versions.get((world, entity, aspect.name), [])

    def newest(self, entity: str, aspect: Aspect[T], world: str = ONLINE) -> T:
        """Return the last datum of a slot.

        Raises:
            ConfigError: The run has none.
        """
        found = self.of(entity, aspect, world)
        if not found:
            raise ConfigError(f"the recording has no {world} {entity}/{aspect.name}")
        return found[-1].datum

    def entities(self, aspect: Aspect[Any], world: str = ONLINE) -> list[str]:
        """Return the names of the entities that had a datum of an aspect, in order."""
        return sorted(
            entity
            for context, entity, name in self.versions
            if (context, name) == (world, aspect.name)
        )

    def at(self, entity: str, aspect: Aspect[T], stamp_ns: int, *, since_ns: int = 0) -> T | None:
        """Return the newest datum of a slot from `since_ns` to a stamp, or None."""
        found = [kept for kept in self.of(entity, aspect) if since_ns <= kept.stamp_ns <= stamp_ns]
        return found[-1].datum if found else None

    def people_at(self, aspect: Aspect[T], stamp_ns: int) -> dict[str, T]:
        """Return what was known at a stamp of people who had not left by then, by name."""
        found = {
            human: self.at(human, aspect, stamp_ns, since_ns=stamp_ns - LEFT_NS)
            for human in self.entities(aspect)
        }
        return {human: datum for human, datum in found.items() if datum is not None}

    def boxes(self) -> npt.NDArray[np.float64]:
        """Return the boxes of all static obstacles, (n, 15), as the aspect `boxes` has them."""
        parts = [self.newest(name, words.BOXES) for name in self.entities(words.BOXES)]
        return np.concatenate([np.empty((0, 15)), *parts])

    def joints(self) -> Motion:
        """Return all samples of the arm, each once, in the order of time."""
        data = [kept.datum for kept in self.of(words.ROBOT.name, words.JOINTS)]
        if not data:
            return Motion(np.empty(0, np.int64), *np.empty((2, 0, words.JOINT_COUNT)))
        stamps, first = np.unique(np.concatenate([one.stamp_ns for one in data]), return_index=True)
        q, dq = (
            np.concatenate([getattr(one, name) for one in data])[first] for name in ("q", "dq")
        )
        return Motion(stamps, q, dq)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The arm over time.

    Attributes:
        stamp_ns: (n,) int64, increasing.
        q: (n, 7) float64, rad.
        dq: (n, 7) float64, rad/s.
    """

    stamp_ns: npt.NDArray[np.int64]
    q: npt.NDArray[np.float64]
    dq: npt.NDArray[np.float64]

    def at(self, stamp_ns: int) -> npt.NDArray[np.float64]:
        """Return (7,), the joints at a stamp, interpolated; those of the nearer end outside."""
        return np.array([np.interp(stamp_ns, self.stamp_ns, joint) for joint in self.q.T])


def _held(datum: Datum, datum_type: type[T]) -> T | Packed[T]:
    """Return a value or its packed datum; neither keeps the chunk that it was read from."""
    if datum.size < PACKED_BYTES_MIN:
        value: T = decode_datum(dataclasses.replace(datum, body=bytes(datum.body)), datum_type)
        return value
    packed = zlib.compress(datum.body, level=1)
    return Packed(dataclasses.replace(datum, body=b""), packed, datum_type)


def trace_of(path: Path) -> Trace:
    """Read the recording of a run.

    Raises:
        ConfigError: The file is no recording, or cannot be read.
    """
    recording = Recording(path)
    versions: dict[tuple[str, str, str], list[Kept[Any]]] = defaultdict(list)
    for recorded in (version for commit in recording.commits() for version in commit.versions):
        aspect = ASPECTS.get(recorded.slot.aspect)
        if recorded.datum is not None and aspect is not None:
            slot = (recorded.slot.context, recorded.slot.entity, recorded.slot.aspect)
            held = _held(recorded.datum, aspect.datum_type)
            versions[slot].append(Kept(recorded.captured_ns, recorded.stamp_ns, held))
    return Trace(dict(versions), int(recording.end.get("missing", "0")))
