"""Questions to the shards of a cell: the same to all of them, about versions, about the present."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, TypeVar

from enact_dist.core.protocol.messages import (
    AwaitStamp,
    Explain,
    ListHistory,
    Reached,
    Refused,
    Versions,
)
from enact_dist.errors import ProtocolError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Answer, Request, SlotVersion, VersionEntry
    from enact_dist.link.client.locks import CellClient

A = TypeVar("A")
Part = TypeVar("Part")

EARLY_PAUSE_S: Final = 0.02
"""Pause before a question is repeated that a shard has answered before its time."""
ASKED_MAX: Final = 256
"""Most versions that one question names; the cause of each may name a thousand others."""


def expected(kind: type[A], asked: type[Any], answer: Answer) -> A:
    """Return an answer that must be of one kind.

    Raises:
        EnactError: The error of a refusal.
        ProtocolError: The answer is of another kind.
    """
    if isinstance(answer, kind):
        return answer
    if isinstance(answer, Refused):
        raise error_of(answer)
    raise ProtocolError(f"{type(answer).__name__} came as the answer to {asked.__name__}")


def answers_to(
    client: CellClient, kind: type[A], calls: Sequence[tuple[str, Request]]
) -> list[tuple[str, A]]:
    """Make calls at once; return the shard and the answer of each, all of one kind.

    Raises:
        ShardUnreachableError: A shard does not answer.
        EnactError: A shard refuses a call.
    """
    answers = zip(calls, client.call_all(calls), strict=True)
    return [(shard, expected(kind, type(request), found)) for (shard, request), found in answers]


def ask_all(
    client: CellClient, kind: type[A], request: Request, shards: Iterable[str] | None = None
) -> list[tuple[str, A]]:
    """Send one question to some shards (None: all), as `answers_to` does; listings are complete."""
    shards = client.shards() if shards is None else shards
    return answers_to(client, kind, [(shard, request) for shard in shards])


def in_parts(several: Sequence[Part], most: int = ASKED_MAX) -> Iterator[tuple[Part, ...]]:
    """Yield a sequence in parts of at most so many."""
    for start in range(0, len(several), most):
        yield tuple(several[start : start + most])


def explained(client: CellClient, versions: Iterable[SlotVersion]) -> list[Versions]:
    """Ask who made these versions, and of what; versions that their shard forgot are left out.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    by_shard: dict[str, list[SlotVersion]] = {}
    for version in versions:
        by_shard.setdefault(client.shard_of(version.slot.entity), []).append(version)
    calls = [
        (shard, Explain(some)) for shard, asked in by_shard.items() for some in in_parts(asked)
    ]
    return [answer for _, answer in answers_to(client, Versions, calls)]


def listed(
    client: CellClient, shard: str, slot: Slot, *, since_ns: int = 0, count: int = 0
) -> tuple[VersionEntry, ...]:
    """Return what a shard knows of one slot's versions, oldest first.

    It lists those that were current after `since_ns`, and at most the newest `count` (0: all).

    Raises:
        ShardUnreachableError: The shard does not answer.
    """
    request = ListHistory((slot.context,), (slot.entity,), (slot.aspect,), since_ns, count)
    return expected(Versions, ListHistory, client.call(shard, request)).entries


def await_stamp(
    client: CellClient, shard: str, stamp_ns: int, *, wait_s: float, timeout_s: float | None = None
) -> bool:
    """Wait until a shard shows every commit up to a stamp; say whether it does.

    Args:
        client: The client that asks.
        shard: The shard that is asked.
        stamp_ns: The stamp to wait for.
        wait_s: How long the shard may wait for it, at most one slice.
        timeout_s: How long to wait for an answer of the shard (None: `request_timeout_s`).

    Raises:
        ShardUnreachableError: The shard does not answer.
    """
    core, wait_ns, begin_s = client.core, int(wait_s * 1e9), time.monotonic()
    answers = client.ask_each(
        [shard],
        lambda _, epoch, __: AwaitStamp(stamp_ns, wait_ns, core.session, epoch),
        timeout_s=timeout_s,
    )
    answer = answers[shard]
    if answer is None:
        raise client.unreachable(shard, time.monotonic() - begin_s)
    reached = isinstance(answer, Reached) and answer.reached
    if not reached and time.monotonic() - begin_s < wait_s / 2:
        client.rest(EARLY_PAUSE_S)  # too many questions of this process wait, or the shard ends
    return reached


def present_ns(client: CellClient) -> int:
    """Return a stamp that no commit reported so far exceeds.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    answers = ask_all(client, Reached, AwaitStamp(0, 0))
    return max(client.core.seen_stamp_ns, *(answer.stamp_ns for _, answer in answers))
