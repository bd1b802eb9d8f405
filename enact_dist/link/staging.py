"""Stages large data at a shard in slices, ahead of the commit, which then only names them.

A commit over a network is therefore always a short message, and urgent commits of this process and
others never wait behind data.  Slices go to all shards of the commit through one window
(`Transfer`).  Each slice carries its position, so slices may arrive twice, late or out of order,
and a transfer resumes after a network cut.

Staged data end with their session at the shard, or when the shard is asked to drop them.  A shard
that has lost them nevertheless answers `no_payload`, and they are sent again.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from enact_dist.core.datum import Datum
from enact_dist.core.messages import EpochChanged, Refused, Stage, Staged, WriteItem
from enact_dist.errors import (
    SHARD_RESTARTED,
    EnactError,
    LeaseLostError,
    ProtocolError,
    ShardUnreachableError,
)
from enact_dist.link.calls import CALL_S
from enact_dist.link.refusals import error_of
from enact_dist.link.session_client import FIRST_STAGED
from enact_dist.link.transfer import Piece, Transfer, in_turn
from enact_dist.wire.limits import PAYLOAD_BYTES_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from enact_dist.core.messages import Answer
    from enact_dist.link.session_client import SessionClient

INLINE_BYTES_MAX: Final = 1 << 20
"""Data up to this total size go with their commit, since one slice costs as much.  Beyond it, data
are staged, the largest first.
"""
_NOTHING: Final = Datum(b"", b"", 0)

_log = logging.getLogger("enact.link")


def stage(
    client: SessionClient,
    writes: Mapping[str, Sequence[WriteItem]],
    alive: Callable[[], None],
) -> Mapping[str, Sequence[WriteItem]]:
    """Stage the large data of these writes at their shards; return writes that name them.

    Args:
        client: The session that will commit them.
        writes: By shard; data that already name a payload stay unchanged.
        alive: Raises once the lock for these writes is lost.

    Raises:
        LeaseLostError: A shard has restarted, which ends the lock.
        NoRoomError: A shard has no room for them; the message states its limit and what to do.
        ShardUnreachableError: A shard does not answer.
        EnactError: Whatever `alive` raises.
    """
    named = {shard: _named(client, each) for shard, each in writes.items()}
    by_shard = {
        shard: [_pieces(client, shard, w.datum) for w in each if w.datum and _is_staged(w.datum)]
        for shard, each in named.items()
        if each is not writes[shard]
    }
    if by_shard:
        try:
            Transfer(client, alive).run(in_turn(by_shard))
        except ShardUnreachableError:
            raise  # no shard to notify
        except BaseException:
            drop_staged(client, named)
            raise
    return named


def _named(client: SessionClient, writes: Sequence[WriteItem]) -> Sequence[WriteItem]:
    """Name each large datum of one shard's writes; return `writes` if nothing is staged."""
    inline = [(n, w.datum) for n, w in enumerate(writes) if w.datum and not w.datum.file]
    left = sum(datum.size for _, datum in inline)
    if left <= INLINE_BYTES_MAX or client.carrier.inside:
        return writes
    named = list(writes)
    inline.sort(key=lambda one: one[1].size, reverse=True)
    for number, datum in inline:
        if datum.size <= PAYLOAD_BYTES_MIN and left <= INLINE_BYTES_MAX:
            break
        left -= datum.size
        file = f"{client.core.session}-{next(client.staged_numbers):x}"
        named[number] = WriteItem(writes[number].slot, replace(datum, file=file))
    return named


def drop_staged(client: SessionClient, writes: Mapping[str, Sequence[WriteItem]]) -> None:
    """Tell the shards that the data staged for these writes will not be committed."""
    drops = [
        (shard, Stage(client.core.session, write.datum.file, 0, 0, _NOTHING))
        for shard, each in writes.items()
        for write in each
        if write.datum is not None and _is_staged(write.datum)
    ]
    if drops:
        try:
            client.carrier.request_all(drops, timeout_s=CALL_S)
        except EnactError as error:  # the shard notices by itself
            _log.info("could not tell a shard to drop staged data: %s", error)


def _is_staged(datum: Datum) -> bool:
    number = datum.file.rpartition("-")[2]
    return bool(number) and int(number, 16) >= FIRST_STAGED


def _pieces(client: SessionClient, shard: str, datum: Datum) -> Iterator[Piece]:
    """Yield the slices of one datum."""
    session, slice_bytes = client.core.session, client.carrier.fetch_bytes
    body = memoryview(datum.body)
    for offset in range(0, datum.size, slice_bytes):
        part = body[offset : offset + slice_bytes]
        request = Stage(session, datum.file, offset, datum.size, Datum(b"", part, len(part)))
        yield Piece(shard, request, len(part), partial(_check_staged, shard, datum.file))


def _check_staged(shard: str, file: str, answer: Answer) -> None:
    """Return if the answer confirms a slice, else raise its error."""
    if isinstance(answer, Staged) and answer.file == file:
        return
    if isinstance(answer, EpochChanged):
        raise LeaseLostError(
            f"shard {shard} has restarted, or ended this session, while data were on their way to"
            " it: the lock is lost and nothing was written; take it again and redo the work",
            cause=SHARD_RESTARTED,
        )
    if isinstance(answer, Refused):
        raise error_of(answer)
    raise ProtocolError(f"{type(answer).__name__} came as the answer to a slice of {file}")
