"""Finds damage in the middle of an SQLite write-ahead log, which SQLite itself ignores.

SQLite reads a log up to the first frame with a wrong checksum and treats the rest as remains of a
crash.  That is right for a torn tail and wrong for a damaged sector: acknowledged commits would
silently disappear.  The two can be distinguished because each frame's checksum continues its
predecessor's *stored* checksum.  If a frame after the bad one continues its predecessor and carries
the same salts, it was written later, so the bad frame was complete once.

File format: https://www.sqlite.org/fileformat2.html#walformat.  Remains of an older generation of
the log carry other salts and prove nothing.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

HEADER_BYTES: Final = 32
FRAME_HEADER_BYTES: Final = 24
_MAGIC_LITTLE: Final = 0x377F0682
_MAGIC_BIG: Final = 0x377F0683
_VERSION: Final = 3_007_000
_PAGE_BYTES: Final = frozenset(1 << power for power in range(9, 17))
_FRAMES_AT_ONCE: Final = 1024


@dataclass(frozen=True, slots=True)
class WalVerdict:
    """The result of a check.

    Attributes:
        frames: Number of valid frames from the start.
        page_bytes: Length of a page, 0 if the header does not tell.
        damaged_at: Offset in bytes of the header or frame that was damaged after it was completely
            written; None: no such damage.  A torn tail is no damage.
    """

    frames: int
    page_bytes: int
    damaged_at: int | None

    @property
    def end(self) -> int:
        """Offset in bytes behind the last valid frame, 0 without any."""
        length = FRAME_HEADER_BYTES + self.page_bytes
        return HEADER_BYTES + self.frames * length if self.frames else 0


def check_wal(path: Path) -> WalVerdict:
    """Read the log at `path` and look for damage in its middle.

    A missing, empty or cut log passes: other checks detect missing batches.

    Raises:
        OSError: As the system reports it.
    """
    try:
        size = path.stat().st_size
    except FileNotFoundError:
        return WalVerdict(0, 0, None)
    if size < HEADER_BYTES:
        return WalVerdict(0, 0, None)
    raw = np.memmap(path, dtype=np.uint8, mode="r")
    header = raw[:HEADER_BYTES].view(">u4").astype(np.uint32)
    if not _header_checks(raw, header):
        return WalVerdict(0, 0, 0 if _any_belong_together(raw, header) else None)
    page_bytes = int(header[2])
    frames = _frames(raw, page_bytes)
    good = _continuing(frames, header) & (_words(frames, 0, 4)[:, 0] != 0)
    good &= (_words(frames, 8, 16) == header[4:6]).all(axis=1)
    if good.all():
        return WalVerdict(len(good), page_bytes, None)
    first_bad = int(np.argmin(good))
    offset = HEADER_BYTES + first_bad * (FRAME_HEADER_BYTES + page_bytes)
    damaged = bool(good[first_bad + 1 :].any())
    return WalVerdict(first_bad, page_bytes, offset if damaged else None)


def commit_ends(path: Path) -> list[int]:
    """Return the offset in bytes behind each commit that SQLite reads from the log, oldest first.

    Raises:
        OSError: As the system reports it.
    """
    verdict = check_wal(path)
    if not verdict.frames:
        return []
    frames = _frames(np.memmap(path, dtype=np.uint8, mode="r"), verdict.page_bytes)
    is_commit = _words(frames[: verdict.frames], 4, 8)[:, 0] != 0
    length = FRAME_HEADER_BYTES + verdict.page_bytes
    return [HEADER_BYTES + (int(frame) + 1) * length for frame in np.flatnonzero(is_commit)]


def _any_belong_together(raw: NDArray[np.uint8], header: NDArray[np.uint32]) -> bool:
    """Return whether later frames prove that a log's bad header was valid once.

    SQLite treats such a log as empty.  Since any field of the header may be wrong, each page length
    is tried; the header's stored checksum counts like a frame's.
    """
    for page_bytes in sorted(_PAGE_BYTES):
        frames = _frames(raw, page_bytes)
        if len(frames):
            first = _checksums(_covered(frames[:1]), header[None, 6:8], _order(header))
            if (first == _words(frames[:1], 16, 24)).all() or _continuing(frames, header)[1:].any():
                return True
    return False


def _header_checks(raw: NDArray[np.uint8], header: NDArray[np.uint32]) -> bool:
    if header[0] not in {_MAGIC_LITTLE, _MAGIC_BIG} or header[1] != _VERSION:
        return False
    if int(header[2]) not in _PAGE_BYTES:
        return False
    summed = _checksums(raw[None, :24], np.zeros((1, 2), np.uint32), _order(header))
    return bool((summed[0] == header[6:8]).all())


def _order(header: NDArray[np.uint32]) -> str:
    """Byte order of checksummed words; little if a damaged header does not tell."""
    return ">u4" if header[0] == _MAGIC_BIG else "<u4"


def _frames(raw: NDArray[np.uint8], page_bytes: int) -> NDArray[np.uint8]:
    """Return the complete frames of the log, (frames, bytes of a frame) uint8, without a copy."""
    length = FRAME_HEADER_BYTES + page_bytes
    count = (len(raw) - HEADER_BYTES) // length
    return raw[HEADER_BYTES : HEADER_BYTES + count * length].reshape(count, length)


def _words(frames: NDArray[np.uint8], begin: int, end: int) -> NDArray[np.uint32]:
    """Return header words of all frames, (frames, words) uint32."""
    return np.ascontiguousarray(frames[:, begin:end]).view(">u4").astype(np.uint32)


def _covered(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the part of a frame under its checksum: eight bytes of its header, then its page."""
    return np.hstack([frames[:, :8], frames[:, FRAME_HEADER_BYTES:]])


def _continuing(frames: NDArray[np.uint8], header: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Return for each frame whether it continues its predecessor's checksum and salts, (frames,).

    The first frame continues the header.
    """
    stored = _words(frames, 16, 24)
    salts = _words(frames, 8, 16)
    seeds = np.vstack([header[None, 6:8], stored])[:-1]
    good: NDArray[np.bool_] = (salts == np.vstack([header[None, 4:6], salts])[:-1]).all(axis=1)
    for begin in range(0, len(frames), _FRAMES_AT_ONCE):
        part = slice(begin, begin + _FRAMES_AT_ONCE)
        found = _checksums(_covered(frames[part]), seeds[part], _order(header))
        good[part] &= (found == stored[part]).all(axis=1)
    return good


def _checksums(
    covered: NDArray[np.uint8], seeds: NDArray[np.uint32], order: str
) -> NDArray[np.uint32]:
    """Return SQLite's two-word checksum of each row of bytes, (rows, 2) uint32.

    The sums are linear in seed and words modulo 2^32, so each word has a fixed weight.
    """
    words = np.ascontiguousarray(covered).view(order).astype(np.uint32)
    on_words, on_seed = _weights(words.shape[1])
    found = np.empty((len(words), 2), np.uint32)
    for part in range(2):
        found[:, part] = (words * on_words[part]).sum(axis=1, dtype=np.uint32)
        found[:, part] += (seeds * on_seed[part]).sum(axis=1, dtype=np.uint32)
    return found


@functools.cache
def _weights(words: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the weights of words, (2, words), and of the seed, (2, 2), in both sums.

    One pair of words (x, y) takes (s0, s1) to (s0 + s1 + x, s0 + 2 s1 + x + y); from the last pair
    to the first, each earlier one passes that step once more.
    """
    step = np.array(((1, 1), (1, 2)), np.uint32)
    power = np.identity(2, np.uint32)
    on_words = np.empty((2, words), np.uint32)
    for pair in range(words - 2, -1, -2):
        on_words[:, pair] = power.sum(axis=1, dtype=np.uint32)
        on_words[:, pair + 1] = power[:, 1]
        power = power @ step
    return on_words, power
