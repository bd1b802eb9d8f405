"""Checks whether shards are alive and ready, with one query to each, without joining the cell.

It opens no session at a shard, so a check leaves nothing behind.  It imports only Zenoh and the
wire.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from enact_dist.core.protocol.messages import Ping, Pong
from enact_dist.errors import ShardUnreachableError
from enact_dist.link.zenoh.config import to_reach
from enact_dist.link.zenoh.discovery import FoundShard, ask_shards, find_shards
from enact_dist.link.zenoh.tls import KeyFiles, why_refused


@dataclass(frozen=True, slots=True)
class ShardHealth:
    """The health of one shard.

    Attributes:
        alive: It answers.
        ready: It answers and grants locks.
        state: "open", "waits for older leases", "drains" or "unreachable".
        endpoint: Where the query was sent, comma separated.
        epoch: Changes with every start; 0 if it does not answer.
        uptime_s: Time since that start.
        took_s: Duration of the whole check, connections included.
        problem: Why it is unreachable, where a certificate is refused.
    """

    name: str
    alive: bool
    ready: bool
    state: str
    endpoint: str
    epoch: int = 0
    uptime_s: float = 0.0
    took_s: float = 0.0
    problem: str = ""

    def __str__(self) -> str:
        """Return one line for people."""
        if not self.alive:
            why = f"; {self.problem}" if self.problem else ""
            where = f"no answer at {self.endpoint} in {self.took_s:.1f} s"
            return f"{self.name}: unreachable, {where}{why}"
        word = "ready" if self.ready else "alive, not ready"
        return f"{self.name}: {word} ({self.state}), epoch {self.epoch}, up {self.uptime_s:.0f} s"


def of_shards(
    cell: str,
    endpoints: Mapping[str, Sequence[str]],
    *,
    timeout_s: float,
    keys: KeyFiles | None = None,
) -> list[ShardHealth]:
    """Ask shards of a cell, given by name, each with its endpoints.

    Raises:
        ConfigError: An endpoint cannot be read.
        ProtocolError: An answer cannot be read.
    """
    reached = {name: tuple(dict.fromkeys(map(to_reach, some))) for name, some in endpoints.items()}
    everywhere = tuple(dict.fromkeys(chain.from_iterable(reached.values())))
    places = {FoundShard(cell, name): ", ".join(some) for name, some in reached.items()}
    return _asked(everywhere, places, time.monotonic(), timeout_s, keys)


def of_endpoint(
    endpoint: str, name: str | None, *, timeout_s: float, keys: KeyFiles | None = None
) -> list[ShardHealth]:
    """Ask the shards at one endpoint, or only the one called `name`.

    Raises:
        ConfigError: The endpoint cannot be read.
        ShardUnreachableError: No shard answers there, or not the one named.
        ProtocolError: An answer cannot be read.
    """
    started_s = time.monotonic()
    found = find_shards([endpoint], timeout_s=timeout_s, keys=keys)
    wanted = [shard for shard in found if name in (None, shard.shard)]
    if not wanted:
        there = ", ".join(shard.shard for shard in found)
        who = f"no shard {name}" if name else "no shard"
        refused = why_refused([endpoint], keys, name or "")
        advice = refused or "is one running there? (enact shard run)"
        raise ShardUnreachableError(
            f"{who} answers at {endpoint} (waited {timeout_s:g} s)"
            + (f"; there is {there}" if there else f"; {advice}"),
            shard=name or "",
            endpoint=endpoint,
        )
    return _asked([endpoint], dict.fromkeys(wanted, endpoint), started_s, timeout_s, keys)


def _asked(
    endpoints: Sequence[str],
    places: Mapping[FoundShard, str],
    started_s: float,
    timeout_s: float,
    keys: KeyFiles | None,
) -> list[ShardHealth]:
    """Ask shards at endpoints; `places` says for people where each is expected."""
    answers = ask_shards(endpoints, tuple(places), Ping(), timeout_s=timeout_s, keys=keys)
    took_s = time.monotonic() - started_s
    found = [
        _health(shard.shard, answers.get(shard), place, took_s) for shard, place in places.items()
    ]
    return [
        one
        if one.alive
        else replace(one, problem=why_refused(one.endpoint.split(", "), keys, one.name))
        for one in found
    ]


def _health(name: str, answer: object, endpoint: str, took_s: float) -> ShardHealth:
    if not isinstance(answer, Pong):
        return ShardHealth(name, False, False, "unreachable", endpoint, took_s=took_s)
    return ShardHealth(
        name,
        alive=True,
        ready=answer.open,
        state=answer.state,
        endpoint=endpoint,
        epoch=answer.epoch,
        uptime_s=answer.uptime_ns / 1e9,
        took_s=took_s,
    )
