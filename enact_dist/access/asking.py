"""What several parts of the API ask shards: about versions, and for their present."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import AwaitStamp, Reached, Refused, Versions
from enact_dist.errors import ProtocolError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from enact_dist.core.protocol.messages import Answer
    from enact_dist.link.client.locks import CellClient

EARLY_PAUSE_S: Final = 0.02
"""Pause before a question is asked again that a shard has answered before its time."""


def versions_in(answer: Answer) -> Versions:
    """Return an answer that is to list versions.

    Raises:
        EnactError: The error of a refusal.
        ProtocolError: It is something else.
    """
    if isinstance(answer, Refused):
        raise error_of(answer)
    if not isinstance(answer, Versions):
        raise ProtocolError(f"{type(answer).__name__} came where versions were asked for")
    return answer


def await_stamp(
    client: CellClient, shard: str, stamp_ns: int, *, wait_s: float, timeout_s: float | None = None
) -> bool:
    """Wait until a shard shows every commit up to a stamp, one slice at most; say whether it does.

    Args:
        client: The client that asks.
        shard: Whom it asks.
        stamp_ns: Up to which stamp.
        wait_s: How long the shard may wait for it.
        timeout_s: How long the shard may stay without an answer (None: `patience_s`).

    Raises:
        ShardUnreachableError: It does.
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
        client.rest(EARLY_PAUSE_S)  # too many of this process wait, or the shard ends
    return reached


def present_ns(client: CellClient) -> int:
    """Return a stamp that no commit reported so far exceeds.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    answers = client.call_all([(shard, AwaitStamp(0, 0)) for shard in client.shards()])
    stamps_ns = [answer.stamp_ns for answer in answers if isinstance(answer, Reached)]
    return max(client.core.seen_stamp_ns, *stamps_ns)
