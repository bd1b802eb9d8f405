"""Calls of a client: their timeouts, and listings assembled from pages."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

from enact_dist.core.protocol.messages import (
    PAGED,
    START,
    Acquire,
    Answer,
    Audited,
    Commit,
    EpochChanged,
    Hello,
    KeepAlive,
    Kept,
    Locks,
    Prepare,
    Request,
    Sessions,
    Surveyed,
    Versions,
    WriteItem,
)

CALL_S: Final = 1.0
"""How long one call may stay unanswered before its outcome is unknown and it is repeated."""
BYTES_PER_S_MIN: Final = 10e6
"""A call that carries data gets this much more time per byte."""
_WITH_DATA: Final = (Commit, Prepare)
_SIGNS_OF_LIFE: Final = (Hello, KeepAlive)
_Page = Surveyed | Locks | Sessions | Audited | Versions | Kept
_ANSWERS: Final = (Surveyed, Locks, Sessions, Audited, Versions, Kept)


class Calls:
    """A set of calls, some of them listings, and their answers so far.

    Attributes:
        asked: The next request to each shard: for a listing, its next page.
        answers: The complete answers; None while an answer is incomplete.
    """

    def __init__(self, calls: Sequence[tuple[str, Request]]) -> None:
        self._first = calls
        self.asked = list(calls)
        self.answers: list[Answer | None] = [None] * len(calls)
        self._pages: dict[int, list[_Page]] = {}

    @property
    def left(self) -> list[int]:
        """The numbers of the calls without a complete answer."""
        return [number for number, answer in enumerate(self.answers) if answer is None]

    def take(self, number: int, answer: Answer) -> bool:
        """Take an answer; return whether another page is needed."""
        shard, asked = self.asked[number]
        if not isinstance(asked, PAGED):
            self.answers[number] = answer
        elif isinstance(answer, EpochChanged) and asked.after != START:
            # The shard has restarted between two pages, so its cursors are invalid.
            self._pages.pop(number, None)
            self.asked[number] = self._first[number]
        elif isinstance(answer, _ANSWERS) and answer.more != START:
            self._pages.setdefault(number, []).append(answer)
            self.asked[number] = shard, replace(asked, after=answer.more)
        else:
            self.answers[number] = _joined(self._pages.pop(number, []), answer)
        return self.answers[number] is None


def _joined(pages: list[_Page], last: Answer) -> Answer:
    """Return one answer with the entries of all pages and the other fields of the first."""
    if not pages or not isinstance(last, _ANSWERS):
        return last
    pages.append(last)
    first = pages[0]
    field = _ENTRIES[type(first)]
    entries = tuple([entry for page in pages for entry in getattr(page, field)])
    whole: _Page = replace(first, **{"more": START, field: entries})  # type: ignore[arg-type]
    return whole


_ENTRIES: Final[dict[type, str]] = {
    Surveyed: "states",
    Locks: "holders",
    Sessions: "sessions",
    Audited: "entries",
    Versions: "entries",
    Kept: "versions",
}
"""The field that pages extend, by type of answer."""


def bytes_with(writes: Iterable[WriteItem]) -> int:
    """Return how many bytes of data a message with these writes carries."""
    size = 0
    for _, datum in writes:
        if datum is not None and not datum.file:
            size += datum.size
    return size


def attempt_timeout_s(request: Request) -> float:
    """Return how long one attempt of a call waits for its answer."""
    if isinstance(request, Acquire):
        return request.wait_ns / 1e9 + CALL_S
    if isinstance(request, _WITH_DATA):
        return CALL_S + bytes_with(request.writes) / BYTES_PER_S_MIN
    if isinstance(request, _SIGNS_OF_LIFE):
        return CALL_S / 2
    return CALL_S
