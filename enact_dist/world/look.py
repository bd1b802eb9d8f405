"""One look at a whole cell: its shards, actors, locks and slots, from the shards that answer.

A look asks each shard three questions at once, each once.  A shard that does not answer in time is
described as not reachable, and its part is missing; nothing waits for it a second time.  A shard
answers listings in pages, between which it serves others, so a look at a large cell delays no lock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from enact_dist.access.snapshot import slot_info
from enact_dist.core.protocol.messages import (
    ListLocks,
    ListSessions,
    Locks,
    Refused,
    Sessions,
    Survey,
    Surveyed,
)
from enact_dist.errors import LinkError
from enact_dist.world.listings import (
    ActorInfo,
    LockInfo,
    ShardInfo,
    actor_infos,
    answered_info,
    lock_info,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.link.client.locks import CellClient

    Call = tuple[str, Request]


@dataclass(frozen=True, slots=True)
class Look:
    """What the shards of a cell that answered told of it.

    Attributes:
        unix_s: When it was taken, seconds since 1970 by the clock of this host.
        took_s: How long it took.
        shards: All shards; those that did not answer are not `reachable`.
        actors: The sessions of named actors, this process's own left out.
        locks: All locks held or awaited, the oldest first within each shard.
        slots: The newest version of each slot, null ones too.
    """

    unix_s: float
    took_s: float = 0.0
    shards: tuple[ShardInfo, ...] = ()
    actors: tuple[ActorInfo, ...] = ()
    locks: tuple[LockInfo, ...] = ()
    slots: Mapping[Slot, SlotInfo] = field(default_factory=dict)


def look_at(client: CellClient, entities: str = "**", worlds: tuple[str, ...] = ()) -> Look:
    """Take a look at a cell; see `Cell.look`."""
    client.check_usable()
    started_s, unix_s = time.monotonic(), time.time()
    shards, problems = client.shards(), dict[str, str]()
    hellos = [
        (shard, client.core.hello(shard)) for shard in shards if client.core.needs_hello(shard)
    ]
    silent = {
        shard
        for (shard, _), answer in zip(hellos, _answers(client, hellos, problems), strict=True)
        if answer is None
    }
    asked = [shard for shard in shards if shard not in silent]
    questions = (ListSessions(), ListLocks(), Survey(worlds, (entities,), ()))
    calls: list[Call] = [(shard, question) for question in questions for shard in asked]
    asked_s = time.monotonic()
    answers = _answers(client, calls, problems)
    round_trip_s = time.monotonic() - asked_s
    sessions = dict(zip(asked, answers, strict=False))
    there = [(shard, one) for shard, one in sessions.items() if isinstance(one, Sessions)]
    infos = {shard: answered_info(client, shard, one, round_trip_s) for shard, one in there}
    others = list(zip(calls, answers, strict=True))
    return Look(
        unix_s,
        time.monotonic() - started_s,
        tuple(infos.get(shard) or _away(client, shard, problems) for shard in shards),
        tuple(one for one in actor_infos(there) if one.session != client.core.session),
        tuple(
            lock_info(shard, holder)
            for (shard, _), answer in others
            if isinstance(answer, Locks)
            for holder in answer.holders
        ),
        {
            state.slot: slot_info(shard, state)
            for (shard, _), answer in others
            if isinstance(answer, Surveyed)
            for state in answer.states
        },
    )


def _answers(
    client: CellClient, calls: Sequence[Call], problems: dict[str, str]
) -> list[Answer | None]:
    """Make calls at once; where one cannot be made, each by itself, and note why it cannot."""
    found: list[Answer | None]
    try:
        found = client.call_once(calls) if calls else []
    except LinkError:
        found = []
        for shard, request in calls:
            try:
                found += client.call_once([(shard, request)])
            except LinkError as error:
                problems[shard] = str(error)
                found.append(None)
    for (shard, _), answer in zip(calls, found, strict=True):
        if isinstance(answer, Refused):
            problems[shard] = answer.text
    return found


def _away(client: CellClient, shard: str, problems: Mapping[str, str]) -> ShardInfo:
    endpoint = client.carrier.endpoint_of(shard)
    return ShardInfo(shard, endpoint, reachable=False, problem=problems.get(shard, ""))
