"""Answers of a shard on their way into frames, for every transport."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final

from enact_dist.core.protocol.messages import (
    Answer,
    Audited,
    Granted,
    Locks,
    Refusals,
    Registered,
    Sessions,
    Slice,
    Surveyed,
    Versions,
    Viewed,
    Welcome,
)
from enact_dist.core.protocol.pages import bytes_in_frame
from enact_dist.errors import ProtocolError
from enact_dist.wire.frames import encode_parts, refusal_of

SURVEYED_BYTES: Final = 160
"""Estimated length of one slot in the answer to a `Survey`."""
VERSION_BYTES: Final = 1024
"""Estimated length of one version, its cause included, in a listing."""
CATALOGUE_BYTES: Final = 64
"""Estimated length of one world context or aspect in a catalogue."""

_log = logging.getLogger("enact.link")


def encoded(
    answer: Answer, count: Callable[[str, int], None]
) -> tuple[bytes, list[bytes | memoryview]]:
    """Return header and bodies of an answer, or of a refusal if it cannot be encoded."""
    try:
        return encode_parts(answer)
    except ProtocolError as error:
        count("answers_refused", 1)
        _log.warning(
            "answer %s cannot be encoded, so the client gets a refusal: %s",
            type(answer).__name__,
            error,
        )
        return encode_parts(refusal_of(error))


def size_of(answer: Answer) -> int:
    """Estimate the length of an answer's data in bytes, without encoding it."""
    estimate = _SIZE_OF.get(type(answer))
    return estimate(answer) if estimate is not None else 0


def _size_of_states(answer: Granted | Viewed) -> int:
    size = SURVEYED_BYTES * len(answer.states)
    for state in answer.states:
        if state.datum is not None and not state.large:
            size += state.size
    return size


def _size_of_catalogue(answer: Welcome | Registered) -> int:
    return CATALOGUE_BYTES * (len(answer.worlds) + len(answer.aspects))


_SIZE_OF: Final[dict[type, Callable[[Any], int]]] = {
    Granted: _size_of_states,
    Viewed: _size_of_states,
    Welcome: _size_of_catalogue,
    Registered: _size_of_catalogue,
    Slice: lambda answer: answer.body.size,
    Surveyed: lambda answer: SURVEYED_BYTES * len(answer.states),
    Versions: lambda answer: VERSION_BYTES * len(answer.entries),
    Locks: lambda answer: bytes_in_frame(answer.holders),
    Sessions: lambda answer: bytes_in_frame(answer.sessions + answer.aspects),
    Audited: lambda answer: bytes_in_frame(answer.entries),
    Refusals: lambda answer: bytes_in_frame(answer.entries),
}
