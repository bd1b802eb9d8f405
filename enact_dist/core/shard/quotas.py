"""How much of a shard one identity may take, so that one client never leaves the others nothing.

An identity is one process of a client as yet (`enact_dist.core.shard.owners`), so two hundred
processes of one name on one host have two hundred shares, and a fault in one of them uses up its
own.  The bounds are far from what any program of a cell needs.  Against one that gives itself a
new identity with each message they do not help; where that has filled the table of sessions, those
that never showed a further sign of life make room (`SessionTable.unproven`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Refused
from enact_dist.core.protocol.records import Reply, Story

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from enact_dist.core.protocol.records import Effect

SESSIONS_MAX: Final = 256
"""Sessions of one identity: a process needs one for each cell that it has open."""
WAITERS_MAX: Final = 2_048
"""Locks of one identity, granted or waiting: twice as many as a session has threads."""
ITEMS_WAITING_MAX: Final = 65_536
"""Requests in the locks of one identity that wait."""
TOLD_MAX: Final = 1_000
"""So many identities the log names, each once, until the shard starts again."""


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
            yield Story("quota.refused", f"{text}; further refusals are only counted")
        yield Reply(reply_to, Refused("overload", f"{text}; end some, or wait for their end"))
