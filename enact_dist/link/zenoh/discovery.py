"""Finds shards at an endpoint: for a client's first contact, and before a daemon starts.

A client may know only one endpoint.  It queries `enact/*/*/…`; every shard within reach answers
with its full name, and the client learns the rest of the cell from that shard's welcome.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import zenoh

from enact_dist.core.protocol.messages import Refused, Welcome
from enact_dist.errors import ProtocolError, ShardUnreachableError
from enact_dist.link.refusals import error_of
from enact_dist.link.zenoh.carrier import POLL_S, QUESTION, answer_in, wait_connected
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.link.zenoh.endpoints import unknown_hosts
from enact_dist.wire.frames import encode_frame
from enact_dist.wire.keys import ANY, NAMELESS, identity_of, parse_request_key, request_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from enact_dist.core.protocol.messages import Answer, Hello, Request

PROBE_LEASE_S: Final = 1.0
"""Link lease of the short sessions that only look for shards."""


@dataclass(frozen=True, slots=True)
class FoundShard:
    """A shard that answers, and its cell."""

    cell: str
    shard: str


def find_shards(endpoints: Sequence[str], *, timeout_s: float) -> tuple[FoundShard, ...]:
    """Return the shards that answer at one of `endpoints`; empty if none does.

    Raises:
        ConfigError: An endpoint cannot be read.
    """
    deadline_s = time.monotonic() + timeout_s
    session = open_session(connect=endpoints, lease_s=PROBE_LEASE_S, open_s=timeout_s)
    try:
        return _find(session, deadline_s)
    finally:
        close_session(session)


def discover(endpoints: Sequence[str], hello: Hello, *, timeout_s: float) -> tuple[str, Welcome]:
    """Say hello to the first shard that answers; return its cell's name and its welcome.

    Raises:
        ShardUnreachableError: None answered within `timeout_s`.
        ConfigError: An endpoint cannot be read.
        ProtocolError: An answer cannot be read, or does not answer a hello.
    """
    deadline_s = time.monotonic() + timeout_s
    session = open_session(connect=endpoints, lease_s=PROBE_LEASE_S, open_s=timeout_s)
    silent = ""
    try:
        while time.monotonic() < deadline_s:
            for found in _find(session, deadline_s):
                silent = found.shard
                answer = _greet(session, found, hello, deadline_s)
                if isinstance(answer, Welcome):
                    return found.cell, answer
                if isinstance(answer, Refused):
                    raise error_of(answer)
                if answer is not None:
                    raise ProtocolError(f"shard {found.shard} answered a hello with {answer!r}")
    finally:
        close_session(session)
    where = ", ".join(endpoints)
    if silent:
        raise ShardUnreachableError(
            f"shard {silent} is running at {where} but did not answer a hello for {timeout_s:g} s;"
            " perhaps its disk is stalled: see its log",
            shard=silent,
            endpoint=where,
        )
    unknown = ", ".join(unknown_hosts(endpoints))
    raise ShardUnreachableError(
        f"no shard answers at {where} (waited {timeout_s:g} s);"
        + (f" the host name {unknown} cannot be resolved;" if unknown else "")
        + " is one running there? (enact shard run, enact doctor)",
        endpoint=where,
    )


def ask_shards(
    endpoints: Sequence[str], shards: Sequence[FoundShard], message: Request, *, timeout_s: float
) -> dict[FoundShard, Answer]:
    """Send one request to each of `shards`; return the answers that come in time.

    Raises:
        ConfigError: An endpoint cannot be read.
        ProtocolError: An answer cannot be read.
    """
    deadline_s = time.monotonic() + timeout_s
    answers: dict[FoundShard, Answer] = {}
    session = open_session(connect=endpoints, lease_s=PROBE_LEASE_S, open_s=timeout_s)
    try:
        while (left_s := deadline_s - time.monotonic()) > 0 and len(answers) < len(shards):
            # A hung shard must leave the others time for a second query after they connect.
            asked = [
                (shard, _get(session, _key(shard, message), message, max(0.05, left_s / 2)))
                for shard in shards
                if shard not in answers
            ]
            for shard, replies in asked:
                for reply in replies:
                    if reply.ok is not None:
                        answers[shard] = answer_in(reply.ok, shard.shard)
            if len(answers) < len(shards):
                time.sleep(POLL_S)
    finally:
        close_session(session)
    return answers


def _key(shard: FoundShard, message: Request, identity: str = NAMELESS) -> str:
    return request_key(shard.cell, shard.shard, verb_of(message), identity)


def _find(session: zenoh.Session, deadline_s: float) -> tuple[FoundShard, ...]:
    """Query until a shard has answered or time is up."""
    if not wait_connected(session, deadline_s - time.monotonic()):
        return ()
    key = request_key(ANY, ANY, verb_of(QUESTION), NAMELESS)
    while (left_s := deadline_s - time.monotonic()) > 0:
        keys = [
            str(reply.ok.key_expr)
            for reply in _get(session, key, QUESTION, left_s)
            if reply.ok is not None
        ]
        if keys:
            return tuple({FoundShard(*parse_request_key(key)[:2]): None for key in keys})
        time.sleep(POLL_S)  # connected, but the peer's queryables are not known yet
    return ()


def _greet(
    session: zenoh.Session, found: FoundShard, hello: Hello, deadline_s: float
) -> Answer | None:
    key = _key(found, hello, identity_of(hello.actor, hello.host, hello.pid))
    for reply in _get(session, key, hello, max(0.05, deadline_s - time.monotonic())):
        if reply.ok is not None:
            return answer_in(reply.ok, found.shard)
    return None


def _get(
    session: zenoh.Session, key: str, message: Request, timeout_s: float
) -> zenoh.Handler[zenoh.Reply]:
    header, payload = encode_frame(message)
    return session.get(
        key,
        payload=payload,
        attachment=header,
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
        congestion_control=zenoh.CongestionControl.BLOCK,
    )
