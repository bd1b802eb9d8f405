"""Whose session a message speaks for, and how much of a shard one identity may take.

The identity under which a message came decides.  An identity is a short text.  The transport says
it with each message (`Shard.handle`), and this module is all that asks for it, so that what vouches
for an identity may change without the rules.  A client says its own: name, host and process, in the
key of its requests and when it opens a socket.  That stops a fault or a stray tool.  Against malice
a cell needs keys: then certificates prove the names (`enact_dist.link.zenoh.access`).

Rules to keep

- The first `Hello` of a session binds it to its identity, on the disk too; everything else that
  names the session has to come under that identity.  What became of a commit anybody may ask: the
  session that made it may be gone; once it is, anybody may release its locks before he asks.
- `Finish`, `Resolve` and a `ListPlaces` that names a shard come from that shard, under
  `shard_identity`.
- The identity "" is this process itself: an embedded shard, or a simulated one.

Shares are bounded so that one client never leaves the others nothing.  An identity is one process
of a client as yet, so two hundred processes of one name on one host have two hundred shares, and a
fault in one of them uses up its own.  The bounds are far from what any program of a cell needs.
Against one that gives itself a new identity with each message they do not help; where that has
filled the table of sessions, those that never showed a further sign of life make room
(`SessionTable.unproven`).
"""

from __future__ import annotations

import dataclasses
from operator import attrgetter
from typing import TYPE_CHECKING, Final, get_args

from enact_dist.core.protocol.messages import (
    OVERLOAD,
    PERMISSION,
    PROTOCOL,
    Break,
    DropWorld,
    EpochChanged,
    Finish,
    ForceAbort,
    Fork,
    Hello,
    KeepVersions,
    ListPlaces,
    Outcome,
    Refused,
    Release,
    Request,
    Resolve,
)
from enact_dist.core.protocol.records import Effect, Event, LogEvent, Reply

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.state.sessions import SessionTable

SESSIONS_MAX: Final = 256
"""Sessions of one identity: a process needs one for each cell that it has open."""
WAITERS_MAX: Final = 2_048
"""Locks of one identity, granted or waiting: twice as many as a session has threads."""
ITEMS_WAITING_MAX: Final = 65_536
"""Requests in the locks of one identity that wait."""
TOLD_MAX: Final = 1_000
"""So many identities the log names, each once, until the shard starts again."""
SHARD_PREFIX: Final = "shard."
"""So begins the identity of a shard, and the name of its key."""


def shard_identity(shard: str) -> str:
    """Return the identity under which a shard calls the others."""
    return SHARD_PREFIX + shard


def is_shard(identity: str) -> bool:
    """Whether an identity is that of a shard; that of a client names its host, too."""
    return identity.startswith(SHARD_PREFIX) and "@" not in identity


def _session_getter(kind: type) -> Callable[[object], str] | None:
    fields = {field.name for field in dataclasses.fields(kind)}
    path = "lock.session" if "lock" in fields else "session" if "session" in fields else ""
    return attrgetter(path) if path and kind not in (Finish, Resolve) else None


SESSION_OF: Final = {kind: _session_getter(kind) for kind in get_args(Request)}
"""How to read from each request for which session it speaks; None for what speaks for none."""
_OF_SHARDS: Final = frozenset((Finish, Resolve, ListPlaces))
_SAY_EPOCH: Final = frozenset((Break, DropWorld, ForceAbort, Fork, KeepVersions))


def named_session(message: object) -> str:
    """Return the session for which a request speaks, or nothing."""
    getter = SESSION_OF.get(type(message))
    return getter(message) if getter is not None else ""


def refusal(
    message: Request | Event, identity: str, sessions: SessionTable, epoch: int
) -> Refused | EpochChanged | None:
    """Return why a message under this identity is not for the shard to handle, else None."""
    kind = type(message)
    getter = SESSION_OF.get(kind)
    if getter is None:
        if kind in _OF_SHARDS:
            return _not_its_shard(message, identity)  # type: ignore[arg-type]  # one of these
    elif kind is not Outcome:
        session = getter(message)
        found = sessions.by_id.get(session)
        if found is not None and found.identity == identity != "":
            return None if kind not in _SAY_EPOCH else _says_epoch(message)  # the usual case
        owner = sessions.owner(session)
        ended = kind is Release and session not in sessions.by_id  # it takes nothing from anybody
        if owner and owner != identity and not ended:
            return not_yours(session, owner, identity)
        if owner == "" and kind is not Hello and session in sessions.by_id:
            return EpochChanged(epoch)  # kept by a release that noted no owner: who greets has it
    return _says_epoch(message) if kind in _SAY_EPOCH else None


def _says_epoch(message: Request | Event) -> Refused | None:
    if message.epoch:  # type: ignore[union-attr]  # those that have to say it have one
        return None
    kind = type(message).__name__
    return Refused(PROTOCOL, f"a {kind} came that names no epoch of this shard")


def not_yours(session: str, owner: str, asker: str) -> Refused:
    """Refuse to let one client speak for another's session."""
    return Refused(
        PERMISSION,
        f"session {session[:8]} belongs to {owner}; {asker} asked and may not speak for it",
    )


def _not_its_shard(message: Finish | Resolve | ListPlaces, identity: str) -> Refused | None:
    if isinstance(message, Finish):
        named = message.position.shard
    else:
        named = message.asker if isinstance(message, Resolve) else message.shard
        if not named and isinstance(message, ListPlaces):
            return None
    if identity == shard_identity(named):
        return None
    said = f"{type(message).__name__} in the name of shard {named}"
    return Refused(PERMISSION, f"{identity} asked a {said}; only that shard itself may")


class Quotas:
    """Refuses requests beyond a share, counts them, and logs each identity once."""

    __slots__ = ("_count", "_told")

    def __init__(self, count: Callable[[str], None]) -> None:
        self._count = count
        self._told: set[str] = set()

    def refuse(self, reply_to: int, identity: str, bound: str) -> Iterator[Effect]:
        """Refuse a request because its identity has all of a bound, such as "256 sessions"."""
        self._count("quota_refused")
        text = f"{identity} has {bound} at this shard, which is all that one process may have"
        if identity not in self._told and len(self._told) < TOLD_MAX:
            self._told.add(identity)
            yield LogEvent("quota.refused", f"{text}; further refusals are only counted")
        yield Reply(reply_to, Refused(OVERLOAD, f"{text}; end some, or wait for their end"))
