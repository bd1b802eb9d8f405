"""Names of the cell's parts on Zenoh: which key carries what.

============================================  ================================================
key                                           what
============================================  ================================================
`enact/<cell>/<shard>/<verb>/<identity>`     a request; the shard holds it to its verb and identity
`enact/<cell>/<shard>/**`                    where the shard receives all of them
`enact/<cell>/@notices/<shard>`              the notices that the shard publishes
`enact/<cell>/@sessions/<identity>/<session>`  the liveliness token of a session
============================================  ================================================

No name starts with ``@`` and Zenoh's wildcards do not match a chunk that does, so requests and the
rest cannot collide.  `ANY` stands for all shards, all sessions, or (in requests) all cells.  An
identity (`identity_of`) is the sender: the access rules of a Zenoh session and the shard itself
compare it, see `enact_dist.core.shard.owners`.
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
    from enact_dist.core.protocol.messages import Message

ROOT: Final = "enact"
ANY: Final = "*"
NOBODY: Final = "-"
"""Represents the absence of an identity; no name starts with a hyphen."""
SAME_NAME: Final = "@$*"
"""Behind a name in the key of an access rule: whatever its host and process."""
SHOWN_CHARACTERS: Final = 64
"""So much of an actor's and a host's name goes into an identity."""
KEY_CHARACTERS_MAX: Final = 4096
"""Longest key of a request: two names, a verb, and an identity of characters beyond ASCII."""
NAMELESS: Final = "client"
"""Part of the identity of a client without a name."""

_NOTICES: Final = "@notices"
_SESSIONS: Final = "@sessions"
_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


class RequestKey(NamedTuple):
    """The parts of a request's key."""

    cell: str
    shard: str
    verb: str
    identity: str


def identity_of(actor: str, host: str, pid: int) -> str:
    """Return the identity of a client: its actor, host and process, in printable ASCII.

    The process is a part of it: what one process may take of a shard is bounded, and two hundred
    processes of one name must not share one bound.
    """
    return f"{quoted_name(actor or NAMELESS)}@{quoted_name(host or '-')}:{pid}"


def quoted_name(name: str) -> str:
    """Return a name as it stands in an identity: without an ``@`` that would end it."""
    return quote(name[:SHOWN_CHARACTERS], safe="")


@lru_cache(maxsize=1024)
def name_in(identity: str) -> str:
    """Return the name in an identity: the actor that `identity_of` got, or that of a shard."""
    return unquote(identity.partition("@")[0])


@lru_cache(maxsize=1024)
def request_key(cell: str, shard: str, verb: str, identity: str) -> str:
    """Return the key on which a client or shard of that identity sends a request.

    Args:
        cell: Name of the cell, or `ANY`.
        shard: Name of the shard, or `ANY`.
        verb: See `verb_of`.
        identity: Any text; characters that cannot stand in a key are written as ``%XX`` of their
            UTF-8 bytes.

    Raises:
        ValueError: A part cannot stand in a key.
    """
    who = quoted_identity(identity)
    return f"{ROOT}/{_part('cell', cell)}/{_part('shard', shard)}/{_name('verb', verb)}/{who}"


def quoted_identity(identity: str) -> str:
    """Return an identity as it travels: printable ASCII, which Zenoh's wildcards match."""
    who = quote(identity, safe="%@:") or NOBODY
    return f"%40{who[1:]}" if who.startswith("@") else who


def queryable_key(cell: str, shard: str) -> str:
    """Return the key expression on which a shard receives its requests."""
    return f"{ROOT}/{_name('cell', cell)}/{_name('shard', shard)}/**"


def notice_key(cell: str, shard: str) -> str:
    """Return the key on which a shard (or `ANY`) publishes its notices."""
    return f"{ROOT}/{_name('cell', cell)}/{_NOTICES}/{_part('shard', shard)}"


def token_key(cell: str, identity: str, session: str) -> str:
    """Return the key of the liveliness token of a session, either of which may be `ANY`."""
    who = ANY if identity == ANY else quoted_identity(identity)
    return f"{ROOT}/{_name('cell', cell)}/{_SESSIONS}/{who}/{_part('session', session)}"


def verb_of(message: Message) -> str:
    """Return the verb of a request: its class name in lower case, `take_view` for `TakeView`."""
    return _verb(type(message).__name__)


@lru_cache(maxsize=256)
def _verb(class_name: str) -> str:
    return _HUMP.sub("_", class_name).lower()


@lru_cache(maxsize=4096)
def parse_request_key(key: str) -> RequestKey:
    """Take a request's key apart; the identity stays encoded.

    Raises:
        ProtocolError: It is no such key.
    """
    chunks = key.split("/", 5) if len(key) <= KEY_CHARACTERS_MAX else []
    if len(chunks) != 5 or chunks[0] != ROOT or chunks[2].startswith("@") or not all(chunks):
        raise ProtocolError(
            f"a request came on the key {key[:200]!r} instead of"
            " enact/<cell>/<shard>/<verb>/<identity>"
        )
    if "*" in chunks[3] or quoted_identity(chunks[4]) != chunks[4]:
        raise ProtocolError(
            f"the key {key[:200]!r} names no single verb and identity, so it gets no answer"
        )
    return RequestKey(*chunks[1:])


def token_of(key: str) -> tuple[str, str]:
    """Return identity and session of a token's key, or nothing where it is no such key."""
    chunks = key.split("/")
    fits = len(chunks) == 5 and chunks[0] == ROOT and chunks[2] == _SESSIONS
    return (chunks[3], chunks[4]) if fits else ("", "")


def shard_of(key: str) -> str:
    """Return the shard of a notice's key, or nothing where it is no such key."""
    chunks = key.split("/")
    fits = len(chunks) == 4 and chunks[0] == ROOT and chunks[2] == _NOTICES
    return chunks[3] if fits else ""


def _name(kind: str, name: str) -> str:
    return checked_name(kind, name, slashes=False)


def _part(kind: str, name: str) -> str:
    return ANY if name == ANY else _name(kind, name)
