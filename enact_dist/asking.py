"""What several parts of the API ask shards: about versions, and for their present."""

from __future__ import annotations

from typing import TYPE_CHECKING

from enact_dist.core.messages import AwaitStamp, Reached, Refused, Versions
from enact_dist.errors import ProtocolError
from enact_dist.link.refusals import error_of

if TYPE_CHECKING:
    from enact_dist.core.messages import Answer
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


def present_ns(client: CellClient) -> int:
    """Return a stamp that no commit reported so far exceeds.

    Raises:
        ShardUnreachableError: A shard does not answer.
    """
    answers = client.call_all([(shard, AwaitStamp(0, 0)) for shard in client.shards()])
    stamps_ns = [answer.stamp_ns for answer in answers if isinstance(answer, Reached)]
    return max(client.core.seen_stamp_ns, *stamps_ns)
