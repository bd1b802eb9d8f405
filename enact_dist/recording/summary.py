"""What a recording holds, and why it lacks what it does not hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

FORGOTTEN: Final = "forgotten before it was fetched"
DISK_SLOW: Final = "disk too slow"
UNSEEN: Final = "forgotten before it was noticed"
UNREACHABLE: Final = "its shard did not answer"
DROPPED: Final = "its world context was dropped"
DENIED: Final = "not readable with the rights of this program"


@dataclass(slots=True)
class RecordingSummary:
    """What a recording holds, and what it does not.

    Attributes:
        seconds: How long it was recorded.
        commits: Commits in it, whole; the initial data do not count as one.
        versions: Versions in it.
        initial: … of which were there when it began.
        size_bytes: Bytes on the disk.
        chunks: Whole chunks on the disk.
        gaps: Versions that are missing, by reason.
        gap_slots: Versions that are missing, by slot.
        out_of_order: Commits whose notice came so late that they follow later ones.
        counts: What else happened, by name (see `file.RecordingFile`).
        unknown_aspects: Requested aspects that the cell does not know so far.
    """

    path: str
    seconds: float = 0.0
    commits: int = 0
    versions: int = 0
    initial: int = 0
    size_bytes: int = 0
    chunks: int = 0
    gaps: dict[str, int] = field(default_factory=dict)
    gap_slots: dict[str, int] = field(default_factory=dict)
    out_of_order: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    unknown_aspects: tuple[str, ...] = ()

    @property
    def missing(self) -> int:
        """Return how many versions are missing, for whatever reason."""
        return sum(self.gaps.values())
