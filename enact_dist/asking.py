"""What several parts of the API ask shards: about versions, and for their present."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from enact_dist.core.messages import AwaitStamp, Reached, Refused, Versions
from enact_dist.errors import ProtocolError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from enact_dist.core.messages import Answer, Request
    from enact_dist.link.client import CellClient


def versions_in(answer: Answer) -> Versions:
    """Return an answer that is to list versions.

    Raises:
        EnactError: What a refusal stands for.
        ProtocolError: It is something else.
    """
    if isinstance(answer, Refused):
        raise error_of(answer)
    if not isinstance(answer, Versions):
        raise ProtocolError(f"{type(answer).__name__} came where versions were asked for")
    return answer


def ask_in_parts(
    client: CellClient,
    kind: Callable[[Any], Request],
    parts: Sequence[tuple[str, tuple[Any, ...]]],
) -> Iterator[tuple[tuple[Any, ...], Versions]]:
    """Ask shards about data, all at once; yield each part that was asked, and its answer.

    A part whose answer is too long is asked again in halves; that to a single datum may leave some
    out all the same.

    Args:
        client: Who asks.
        kind: Makes the request about some data.
        parts: Shards, and what each is asked about in one request.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    while parts:
        halves: list[tuple[str, tuple[Any, ...]]] = []
        answers = client.call_all([(shard, kind(asked)) for shard, asked in parts])
        for (shard, asked), answer in zip(parts, answers, strict=True):
            found, half = versions_in(answer), len(asked) // 2
            if found.left_out and half:
                halves += (shard, asked[:half]), (shard, asked[half:])
            else:
                yield asked, found
        parts = halves


def present_ns(client: CellClient) -> int:
    """Return a stamp that no commit reported so far exceeds.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    answers = client.call_all([(shard, AwaitStamp(0, 0)) for shard in client.shards()])
    stamps_ns = [answer.stamp_ns for answer in answers if isinstance(answer, Reached)]
    return max(client.core.seen_stamp_ns, *stamps_ns)
