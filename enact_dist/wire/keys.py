"""Names of the cell's parts on Zenoh: which key carries what.

==================================  ==========================================================
key                                 what
==================================  ==========================================================
`enact/<cell>/<shard>/<verb>/<actor>`  a request; verb and actor are there for access rules
`enact/<cell>/<shard>/**`              where the shard receives all of them
`enact/<cell>/@notices/<shard>`        the notices that the shard publishes
`enact/<cell>/@sessions/<session>`     the liveliness token of a session
==================================  ==========================================================

No name starts with ``@`` and Zenoh's wildcards do not match a chunk that does, so requests and the
rest cannot collide.  `ANY` stands for all shards, all sessions, or (in requests) all cells.
Rules to keep: a key holds only characters that Zenoh allows (no ``# ? $``, no empty chunk), and
making a key from the parts of one gives the same key again.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import quote, unquote

from enact_dist.errors import ProtocolError
from enact_dist.terms import checked_name

if TYPE_CHECKING:
    from enact_dist.core.messages import Message

ROOT: Final = "enact"
ANY: Final = "*"
NOBODY: Final = "-"
"""Stands for a client without an actor name; no name starts with a hyphen."""

_NOTICES: Final = "@notices"
_SESSIONS: Final = "@sessions"
_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


class RequestKey(NamedTuple):
    """The parts of a request's key; `actor` is empty for a client without a name."""

    cell: str
    shard: str
    verb: str
    actor: str


@lru_cache(maxsize=1024)
def request_key(cell: str, shard: str, verb: str, actor: str) -> str:
    """Return the key on which `actor` sends a request.

    Args:
        cell: Name of the cell, or `ANY`.
        shard: Name of the shard, or `ANY`.
        verb: See `verb_of`.
        actor: Any text; characters outside names are written as ``%XX`` of their UTF-8 bytes.

    Raises:
        ValueError: A part cannot stand in a key.
    """
    who = quote(actor, safe="%") if actor else NOBODY
    return f"{ROOT}/{_part('cell', cell)}/{_part('shard', shard)}/{_name('verb', verb)}/{who}"


def queryable_key(cell: str, shard: str) -> str:
    """Return the key expression on which a shard receives its requests."""
    return f"{ROOT}/{_name('cell', cell)}/{_name('shard', shard)}/**"


def notice_key(cell: str, shard: str) -> str:
    """Return the key on which a shard (or `ANY`) publishes its notices."""
    return f"{ROOT}/{_name('cell', cell)}/{_NOTICES}/{_part('shard', shard)}"


def token_key(cell: str, session: str) -> str:
    """Return the key of the liveliness token of a session (or `ANY`)."""
    return f"{ROOT}/{_name('cell', cell)}/{_SESSIONS}/{_part('session', session)}"


def verb_of(message: Message) -> str:
    """Return the verb of a request: its class name in lower case, `take_view` for `TakeView`."""
    return _verb(type(message).__name__)


@lru_cache(maxsize=256)
def _verb(class_name: str) -> str:
    return _HUMP.sub("_", class_name).lower()


def parse_request_key(key: str) -> RequestKey:
    """Take a request's key apart.

    Raises:
        ProtocolError: It is no such key.
    """
    chunks = key.split("/")
    if len(chunks) != 5 or chunks[0] != ROOT or chunks[2].startswith("@") or not all(chunks):
        raise ProtocolError(
            f"a request came on the key {key[:200]!r} instead of"
            " enact/<cell>/<shard>/<verb>/<actor>"
        )
    actor = "" if chunks[4] == NOBODY else unquote(chunks[4])
    return RequestKey(chunks[1], chunks[2], chunks[3], actor)


def session_of(key: str) -> str:
    """Return the session of a token's key, or nothing where it is no such key."""
    return _last(key, _SESSIONS)


def shard_of(key: str) -> str:
    """Return the shard of a notice's key, or nothing where it is no such key."""
    return _last(key, _NOTICES)


def _last(key: str, kind: str) -> str:
    chunks = key.split("/")
    fits = len(chunks) == 4 and chunks[0] == ROOT and chunks[2] == kind
    return chunks[3] if fits else ""


def _name(kind: str, name: str) -> str:
    return checked_name(kind, name, slashes=False)


def _part(kind: str, name: str) -> str:
    return ANY if name == ANY else _name(kind, name)
