"""One look at a whole cell: its shards, actors, locks and slots, from the shards that answer.

A look asks each shard for its sessions and locks at once, and then for its slots, each once.  A
shard that does not answer in time is described as not reachable, and its part is missing.  A shard
answers listings in pages, between which it serves others, so a look at a large cell delays no lock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
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
    Welcome,
)
from enact_dist.errors import LinkError
from enact_dist.world.cell import session_behind
from enact_dist.world.listings import (
    ActorInfo,
    LockInfo,
    ShardInfo,
    actor_infos,
    answered_info,
    away_info,
    lock_info,
    raise_denied,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from enact_dist.access.snapshot import SlotInfo
    from enact_dist.core.protocol.datum import Slot
    from enact_dist.core.protocol.messages import Answer, Request
    from enact_dist.link.client.locks import CellClient
    from enact_dist.world.cell import Cell

    Call = tuple[str, Request]


@dataclass(frozen=True, slots=True)
class Look:
    """What the shards of a cell that answered told of it.

    Attributes:
        unix_s: When it was taken, seconds since 1970 by the clock of this host.
        took_s: How long it took, without the slots.
        shards: All shards; those that did not answer are not `reachable`.
        actors: The sessions of named actors, this process's own left out.
        locks: All locks held or awaited, the oldest first within each shard.
        slots: The newest version of each slot, null ones too; None: they were not looked at.
        unlisted: Shards that answered, but did not list their slots, and why.
        slots_took_s: How long these took.
    """

    unix_s: float
    took_s: float = 0.0
    shards: tuple[ShardInfo, ...] = ()
    actors: tuple[ActorInfo, ...] = ()
    locks: tuple[LockInfo, ...] = ()
    slots: Mapping[Slot, SlotInfo] | None = field(default_factory=dict)
    unlisted: Mapping[str, str] = field(default_factory=dict)
    slots_took_s: float = 0.0


def look_at(cell: Cell, slots: Survey | None = None) -> Look:
    """Return what all shards that answer tell of a cell now, `slots` too if they are asked.

    A shard that does not answer is one that is not `reachable`; no error is raised for it.
    """
    client = session_behind(cell).client
    client.check_usable()
    started_s, unix_s, problems = time.monotonic(), time.time(), dict[str, str]()
    shards = client.shards()
    strange = [shard for shard in shards if client.core.needs_hello(shard)]
    greeted = _answers(client, [(shard, client.core.hello(shard)) for shard in strange], problems)
    silent = {shard for shard, answer in zip(strange, greeted, strict=True) if answer is None}
    asked = [shard for shard in shards if shard not in silent]
    asked_s = time.monotonic()
    calls: list[Call] = [(shard, ListSessions()) for shard in asked]
    calls += [(shard, ListLocks()) for shard in asked]
    answers = list(zip(calls, _answers(client, calls, problems), strict=True))
    round_trip_s = time.monotonic() - asked_s
    there = [(shard, one) for (shard, _), one in answers if isinstance(one, Sessions)]
    infos = {shard: answered_info(client, shard, one, round_trip_s) for shard, one in there}
    look = Look(
        unix_s,
        time.monotonic() - started_s,
        tuple(
            infos.get(shard) or away_info(client, shard, problems.get(shard, ""))
            for shard in shards
        ),
        tuple(one for one in actor_infos(there) if one.session != client.core.session),
        tuple(
            lock_info(shard, holder)
            for (shard, _), answer in answers
            if isinstance(answer, Locks)
            for holder in answer.holders
        ),
        None,
    )
    return look if slots is None else _with_slots(client, look, slots, list(infos))


def welcomes(cell: Cell) -> dict[str, Welcome]:
    """Return how each shard that answers at once describes the cell: placement, contexts."""
    client = session_behind(cell).client
    names = client.shards()
    answers = client.call_once([(name, client.core.hello(name)) for name in names])
    pairs = zip(names, answers, strict=True)
    return {name: answer for name, answer in pairs if isinstance(answer, Welcome)}


def _with_slots(client: CellClient, look: Look, survey: Survey, shards: Sequence[str]) -> Look:
    """Add the slots of the shards that have answered."""
    started_s = time.monotonic()
    problems: dict[str, str] = {}
    answers = _answers(client, [(shard, survey) for shard in shards], problems)
    listed = {
        shard: answer.states
        for shard, answer in zip(shards, answers, strict=True)
        if isinstance(answer, Surveyed)
    }
    return replace(
        look,
        slots={s.slot: slot_info(shard, s) for shard, states in listed.items() for s in states},
        unlisted={one: problems.get(one, "no answer") for one in shards if one not in listed},
        slots_took_s=time.monotonic() - started_s,
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
        raise_denied(answer)
        if isinstance(answer, Refused):
            problems[shard] = answer.text
    return found
