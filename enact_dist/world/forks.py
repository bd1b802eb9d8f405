"""World contexts are forked and dropped in one step on each shard, reported as one.

Every shard forks as of the same timestamp.  A fork that only some shards have is not a world
context yet: no caller gets a handle of it, and a repeated call with the same source and timestamp
completes it.  If a shard no longer has the data of that timestamp, the fork cannot be completed;
the client then drops it on the other shards.
"""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Final

from enact_dist.access.arguments import checked_as
from enact_dist.access.asking import ask_all, expected, present_ns
from enact_dist.core.protocol.messages import (
    MERELY_KEPT,
    OVERLOAD,
    Dropped,
    DropWorld,
    Forgotten,
    Fork,
    Forked,
    ListLocks,
    Locks,
    Refused,
    WorldEntry,
)
from enact_dist.errors import EnactError, LinkError, MisuseError, ShardUnreachableError
from enact_dist.link.client.session import FINISH_S
from enact_dist.link.refusals import error_of, holder_line, moment_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from enact_dist.access.session import Session
    from enact_dist.core.protocol.messages import Answer

UNDO_S: Final = 2.0
"""Time to drop a fork that cannot be completed; the log names shards that may still have it."""

PAUSE_S: Final = 0.05
"""Pause before a busy shard is asked again."""

_log = logging.getLogger("enact")


def fork_world(session: Session, source: str, name: str, *, at_ns: int = 0) -> None:
    """Make world context `name` a fork of `source` on every shard; see `WorldContext.fork`."""
    checked_as("world context", name)
    client = session.client
    session.check_world(source)
    there = client.worlds_at(name)
    if not at_ns:
        _refuse_existing(name, there)
        at_ns = present_ns(session.client)
    wanted = WorldEntry(name, source, at_ns)
    _refuse_existing(name, {s: entry for s, entry in there.items() if entry != wanted})

    def request_of(_shard: str, epoch: int, count: int) -> Fork:
        return Fork(client.core.session, name, source, at_ns, epoch, count)

    done: list[str] = []
    left, refusal = list(client.shards()), ""
    deadline_s = time.monotonic() + FINISH_S
    while left and (left_s := deadline_s - time.monotonic()) > 0.0:
        answers = client.ask_each(left, request_of, timeout_s=left_s)
        done += [shard for shard, answer in answers.items() if isinstance(answer, Forked)]
        forgotten = [answer for answer in answers.values() if isinstance(answer, Forgotten)]
        latest = max(forgotten, key=lambda each: each.oldest_ns, default=None)
        for answer in answers.values():
            if isinstance(answer, Refused) and _is_busy(answer):
                refusal = answer.text  # an undecided commit blocks it: ask again
            elif answer is not None and not isinstance(answer, Forked):
                _take_back(session, name, [shard for shard in done if shard not in there])
                if latest is not None:
                    raise error_of(latest)
                expected(Forked, Fork, answer)
        left = [shard for shard in left if shard not in done]
        if left:
            client.rest(PAUSE_S)
    _learn_worlds(session)
    if left:
        raise _incomplete(session, wanted, left, refusal)


def _learn_worlds(session: Session) -> None:
    """Learn from every shard that answers at once which world contexts there are now."""
    client = session.client
    client.call_once([(shard, client.core.hello(shard)) for shard in client.shards()])


def _refuse_existing(name: str, there: Mapping[str, WorldEntry]) -> None:
    """Raise if a shard has a world context of that name that is not the wanted fork."""
    for shard, (_, source, at_ns) in there.items():
        what = f"a fork of {source!r} as of {moment_name(at_ns)}" if source else "no fork"
        remedy = f"take another name, or drop it: enact world drop {name}, or cell.drop_world(…)"
        if source:
            remedy += (
                "; if it is not complete, because a shard was away, ask again with"
                f" --at {at_ns}@{shard}, or at=Position({at_ns}, {shard!r})"
            )
        raise MisuseError(f"there is a world context {name!r} on shard {shard}, {what}; {remedy}")


def _take_back(session: Session, name: str, shards: list[str]) -> None:
    """Drop a fork on the shards that have just made it; others may have it from another client."""
    for shard, answer in _dropped(session, name, shards, timeout_s=UNDO_S).items():
        if not isinstance(answer, Dropped):
            _log.warning("shard %s may have a part of the fork %s: drop it", shard, name)


def _incomplete(session: Session, wanted: WorldEntry, left: list[str], refusal: str) -> EnactError:
    client = session.client
    done = [shard for shard in client.shards() if shard not in left]
    name, source, at_ns = wanted
    text = (
        f"the fork {name!r} of {source!r} is made on {', '.join(done) or 'no shard'} and not on"
        f" {', '.join(left)}, so it is no world context yet: "
        + (refusal or f"no answer came for {FINISH_S:g} s")
        + f"; complete it with enact world fork {source} {name} --at {at_ns}@{left[0]}, or"
        f" fork({name!r}, at=Position({at_ns}, {left[0]!r})); or give it up with enact world drop"
        f" {name}, or cell.drop_world({name!r})"
    )
    if refusal:
        return LinkError(text)
    endpoint = client.carrier.endpoint_of(left[0])
    return ShardUnreachableError(text, shard=left[0], endpoint=endpoint)


def drop_world(session: Session, name: str) -> int:
    """Drop a world context on every shard and return its slots; see `Cell.drop_world`."""
    client = session.client
    if not client.worlds_at(name):
        client.greet()
        if not client.worlds_at(name):
            raise session.unknown_world(name)
    _refuse_locked(session, name)
    answers = _dropped(session, name, client.shards(), timeout_s=FINISH_S)
    _learn_worlds(session)
    done = {shard: each.slots for shard, each in answers.items() if isinstance(each, Dropped)}
    for shard, answer in answers.items():
        if shard not in done:
            raise _not_dropped(session, name, list(done), shard, answer)
    return sum(done.values())


def _dropped(
    session: Session, name: str, shards: Iterable[str], *, timeout_s: float
) -> dict[str, Answer | None]:
    """Ask shards to drop a context; repeat while one works on it for another client."""
    client = session.client

    def request_of(_shard: str, epoch: int, count: int) -> DropWorld:
        return DropWorld(client.core.session, name, epoch, count)

    answers: dict[str, Answer | None] = dict.fromkeys(shards)
    left, deadline_s = list(answers), time.monotonic() + timeout_s
    while left and (left_s := deadline_s - time.monotonic()) > 0.0:
        answers.update(client.ask_each(left, request_of, timeout_s=left_s))
        left = [s for s in left if _is_busy(answers[s])]
        if left:
            client.rest(PAUSE_S)
    return answers


def _is_busy(answer: Answer | None) -> bool:
    """Whether a shard cannot do it now but may do it if it is asked again."""
    return isinstance(answer, Refused) and answer.code == OVERLOAD


def _refuse_locked(session: Session, name: str) -> None:
    """Raise while a slot of a context is locked, before any shard has dropped it."""
    for _, answer in ask_all(session.client, Locks, ListLocks()):
        for holder in answer.holders:
            used = holder.kept not in MERELY_KEPT  # else its shard takes the grant back
            if used and any(slot.startswith(f"{name}:") for slot in holder.slots):
                raise MisuseError(
                    f"world context {name!r} is not dropped: {holder_line(holder)}; end that lock"
                    " first (enact lock ls)"
                )


def _not_dropped(
    session: Session, name: str, done: list[str], shard: str, answer: Answer | None
) -> EnactError:
    """Return the error for a shard that has not dropped a context, which others may have."""
    state = f"world context {name!r} is not dropped"
    remedy = ""
    if done:
        state = f"world context {name!r} is dropped on {', '.join(done)}, but not on {shard}"
        remedy = (
            f"; it is no world context any more; to delete what {shard} still has of it, call"
            f" enact world drop {name}, or cell.drop_world({name!r}), again"
        )
    if isinstance(answer, Refused):
        found = error_of(answer)
        return type(found)(f"{state}: {found}{remedy}") if done else found
    if answer is not None:
        expected(Dropped, DropWorld, answer)
    return ShardUnreachableError(
        f"{state}: no answer came for {FINISH_S:g} s{remedy}",
        shard=shard,
        endpoint=session.client.carrier.endpoint_of(shard),
    )
