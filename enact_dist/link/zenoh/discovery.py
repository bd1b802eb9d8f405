"""Finds shards at an endpoint: for a client's first contact, and before a daemon starts.

A client may know only one endpoint.  It queries `enact/*/*/…`; every shard within reach answers
with its full name, and the client learns the rest of the cell from that shard's welcome.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Welcome
from enact_dist.core.shard.owners import SHARD_PREFIX
from enact_dist.errors import PermissionDeniedError, ShardUnreachableError
from enact_dist.link.refusals import error_for
from enact_dist.link.zenoh.access import barred
from enact_dist.link.zenoh.config import close_session, open_session
from enact_dist.link.zenoh.endpoints import unknown_hosts
from enact_dist.link.zenoh.queries import (
    POLL_S,
    QUESTION,
    ServerNames,
    answer_in,
    send_query,
    wait_connected,
)
from enact_dist.link.zenoh.tls import refusals, why_refused
from enact_dist.wire.keys import ANY, NAMELESS, identity_of, parse_request_key, request_key, verb_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import zenoh

    from enact_dist.core.protocol.messages import Answer, Hello, Request
    from enact_dist.link.zenoh.queries import Replies
    from enact_dist.link.zenoh.tls import KeyFiles

PROBE_LEASE_S: Final = 1.0
"""Link lease of the short sessions that only look for shards."""
CONNECTED_S: Final = 0.1
"""After this time without a connection we look whether certificates are the reason, and after
twice as long again."""
AT_ONCE_S: Final = 0.05
BARRED_COUNT: Final = 5
"""A shard that bars our name ends each query at once; one that opens again does so only briefly."""
SHORTEST_S: Final = 0.05
"""Shortest time given to one query."""


@dataclass(frozen=True, slots=True)
class FoundShard:
    """A shard that answers, and its cell."""

    cell: str
    shard: str


def find_shards(
    endpoints: Sequence[str], *, timeout_s: float, keys: KeyFiles | None = None
) -> tuple[FoundShard, ...]:
    """Return the shards that answer at one of `endpoints`; empty if none does.

    Raises:
        ConfigError: An endpoint cannot be read, or the keys for one cannot be used.
        ShardUnreachableError: A server with another name answers as a shard.
    """
    deadline_s = time.monotonic() + timeout_s
    with _probe(endpoints, timeout_s, keys) as probe:
        return probe.find(deadline_s)


def discover(
    endpoints: Sequence[str], hello: Hello, *, timeout_s: float, keys: KeyFiles | None = None
) -> tuple[str, Welcome]:
    """Say hello to the first shard that answers; return its cell's name and its welcome.

    Raises:
        ShardUnreachableError: None answered within `timeout_s`, or certificates are refused at all
            endpoints, which the message explains.
        ConfigError: An endpoint cannot be read, or the keys for one cannot be used.
        ProtocolError: An answer cannot be read, or does not answer a hello.
        PermissionDeniedError: The shard admits no client with our key.
    """
    began_s = time.monotonic()
    deadline_s = began_s + timeout_s
    silent, ended_at_once = "", 0
    with _probe(endpoints, timeout_s, keys) as probe:
        while shards := probe.find(deadline_s):
            for found in shards:
                silent = found.shard
                asked_s = time.monotonic()
                answer = probe.greet(found, hello, deadline_s)
                if answer is None and keys is not None and time.monotonic() - asked_s < AT_ONCE_S:
                    ended_at_once += 1
                    if ended_at_once == BARRED_COUNT:
                        raise PermissionDeniedError(
                            barred(keys.name, found.shard), identity=keys.name
                        )
                    time.sleep(SHORTEST_S)
                if isinstance(answer, Welcome):
                    return found.cell, answer
                if answer is not None:
                    raise error_for(answer, f"a hello to shard {found.shard}")
    where = ", ".join(endpoints)
    if silent:
        raise ShardUnreachableError(
            f"shard {silent} is running at {where} but did not answer a hello for {timeout_s:g} s;"
            " perhaps its disk is stalled: see its log",
            shard=silent,
            endpoint=where,
        )
    unknown = ", ".join(unknown_hosts(endpoints))
    refused = why_refused(endpoints, keys)
    waited_s = min(timeout_s, round(time.monotonic() - began_s, 1))
    raise ShardUnreachableError(
        f"no shard answers at {where} (waited {waited_s:g} s);"
        + (f" the host name {unknown} cannot be resolved;" if unknown else "")
        + (f" {refused}" if refused else " is one running there? (enact shard run, enact doctor)"),
        endpoint=where,
    )


def ask_shards(
    endpoints: Sequence[str],
    shards: Sequence[FoundShard],
    message: Request,
    *,
    timeout_s: float,
    keys: KeyFiles | None = None,
) -> dict[FoundShard, Answer]:
    """Send one request to each of `shards`; return the answers that come in time.

    Raises:
        ConfigError: An endpoint cannot be read, or the keys for one cannot be used.
        ShardUnreachableError: A server with another name answers as a shard.
        ProtocolError: An answer cannot be read.
    """
    deadline_s = time.monotonic() + timeout_s
    is_shard = keys is not None and keys.name.startswith(SHARD_PREFIX)
    asker = keys.name if keys is not None and is_shard else NAMELESS
    answers: dict[FoundShard, Answer] = {}
    with _probe(endpoints, timeout_s, keys) as probe:
        if keys is not None and not probe.connected(deadline_s):
            return {}
        while (left_s := deadline_s - time.monotonic()) > 0 and len(answers) < len(shards):
            # A hung shard must leave the others time for a second query after they connect.
            wait_s = max(SHORTEST_S, left_s / 2)
            asked = [
                (shard, probe.replies(_key(shard, message, asker), message, wait_s))
                for shard in shards
                if shard not in answers
            ]
            for shard, replies in asked:
                for sample in replies:
                    answers[shard] = answer_in(sample, shard.shard)
            if len(answers) < len(shards):
                time.sleep(POLL_S)
    return answers


@contextmanager
def _probe(endpoints: Sequence[str], timeout_s: float, keys: KeyFiles | None) -> Iterator[_Probe]:
    """Open a short session that only looks for shards."""
    session = open_session(connect=endpoints, lease_s=PROBE_LEASE_S, open_s=timeout_s, keys=keys)
    try:
        names = ServerNames(session) if keys is not None else None
        yield _Probe(session, endpoints, keys, names)
    finally:
        close_session(session)


@dataclass(frozen=True, slots=True)
class _Probe:
    """A short session, our keys, and what checks the names of those that answer on it."""

    session: zenoh.Session
    endpoints: Sequence[str]
    keys: KeyFiles | None
    names: ServerNames | None

    def connected(self, deadline_s: float) -> bool:
        """Wait for a connection; False if time is up or certificates are refused everywhere."""
        wait_s = CONNECTED_S if self.keys is not None else float("inf")
        while (left_s := deadline_s - time.monotonic()) > 0:
            if wait_connected(self.session, min(wait_s, left_s)):
                return True
            if len(refusals(self.endpoints, self.keys)) == len(set(self.endpoints)):
                break
            wait_s *= 2
        return False

    def find(self, deadline_s: float) -> tuple[FoundShard, ...]:
        """Query until a shard has answered; nothing if none will, or time is up."""
        if not self.connected(deadline_s):
            return ()
        key = request_key(ANY, ANY, verb_of(QUESTION), NAMELESS)
        while (left_s := deadline_s - time.monotonic()) > 0:
            found = self.replies(key, QUESTION, left_s)
            keys = [str(sample.key_expr) for sample in found]
            if keys:
                return tuple({FoundShard(*parse_request_key(key)[:2]): None for key in keys})
            time.sleep(POLL_S)  # connected, but the peer's queryables are not known yet
        return ()

    def greet(self, found: FoundShard, hello: Hello, deadline_s: float) -> Answer | None:
        """Say hello to a shard; return its answer."""
        name = self.keys.name if self.keys is not None else hello.actor
        key = _key(found, hello, identity_of(name, hello.host, hello.pid))
        wait_s = max(SHORTEST_S, deadline_s - time.monotonic())
        sample = next(self.replies(key, hello, wait_s), None)
        return answer_in(sample, found.shard) if sample is not None else None

    def replies(self, key: str, message: Request, timeout_s: float) -> Iterator[zenoh.Sample]:
        """Send a query now; return an iterator that waits for its replies."""
        return self._checked(send_query(self.session, key, message, timeout_s=timeout_s))

    def _checked(self, replies: Replies | None) -> Iterator[zenoh.Sample]:
        for reply in replies or ():
            if reply.ok is not None:
                if self.names is not None:
                    self.names.check(reply, parse_request_key(str(reply.ok.key_expr))[1])
                yield reply.ok


def _key(shard: FoundShard, message: Request, identity: str = NAMELESS) -> str:
    return request_key(shard.cell, shard.shard, verb_of(message), identity)
