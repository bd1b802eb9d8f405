"""Who may do what on a shard's Zenoh session: its own traffic, and clients under their own names.

A listening session relays between peers that connect in Zenoh's client or router mode.  Without
rules, a stranger's queryable would receive every request of every client, including committed data,
and its notices would reach every watcher.  With `access_rules` only the shard answers its requests,
publishes its notices and sees tokens.  They cost 15 us a call, and check only key expressions; the
shard itself checks everything else (see `enact_dist.core.shard.owners`).

In a cell with keys, the rules bind the name in the key of each request and token to the name that
the sender's certificate proves.  Names that the cell does not know may only ping, without a name,
so that a client can tell a shard that is down from one that does not let it in.  A session's id
(`new_session_id`) ends with a mark of its owner's name: otherwise a client could greet a shard with
the id of another one, which listings show, before that one does.  The rest of the id is the hash of
a secret that only shards of the client's own host hear, over their sockets: no other process can
open a connection for the session, and so none can end it with its own end.

Zenoh drops forbidden messages silently: a query gets no reply, a declaration reaches no peer.  A
query passes only if its key is *included* in an allowed one, so a query with wildcards for several
shards, verbs or names does not, except for the discovery of shards.

A certificate's common name is that of its owner, with `~N` behind it once the owner's keys have
been revoked N times.  `revoked.toml` in the key folder says how often: ``camera = 1``.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from enact_dist.core.protocol.messages import Ping
from enact_dist.core.shard.owners import shard_identity
from enact_dist.errors import ConfigError, PermissionDeniedError
from enact_dist.wire.keys import (
    ANY,
    NAMELESS,
    ROOT,
    SAME_NAME,
    SHOWN_CHARACTERS,
    name_in,
    notice_key,
    queryable_key,
    quoted_name,
    token_key,
    verb_of,
)
from enact_dist.wire.limits import NAME_CHARACTERS_MAX

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

REVOKED_FILE: Final = "revoked.toml"
SESSION_CHARACTERS: Final = 40
"""Of a session's id: 32 of the hash of its secret, 8 of the mark of its owner's name."""
ALL_PEERS: Final = "all-peers"
EARLIER_QUESTION: Final = "await_stamp"
"""Discovery query of releases with frames before 7: the answer names our version."""
_OF_SHARDS: Final = ("finish", "resolve", "list_places", "ping")
"""The verbs of what a shard may ask another one; see `core.shard.owners`."""


def access_rules(
    cell: str, shard: str, names: Mapping[str, str] | None = None, shards: Iterable[str] = ()
) -> dict[str, object]:
    """Return the access rules of a shard's listening session.

    Args:
        cell: Name of the cell.
        shard: Name of the shard.
        names: The names of clients, each with the common name of its certificate; None: a cell
            without keys, where a client's name is its own word.
        shards: Names of the cell's shards.
    """
    own = queryable_key(cell, shard)
    requests = own.removesuffix("**")
    anywhere = [f"{ROOT}/{ANY}/{ANY}/{verb}/{ANY}" for verb in (verb_of(Ping()), EARLIER_QUESTION)]
    ask = anywhere if names is None else [f"{ROOT}/{ANY}/{ANY}/{verb_of(Ping())}/{NAMELESS}"]
    tokens, notices = token_key(cell, ANY, ANY), notice_key(cell, ANY)
    rules = _Rules()
    everybody = members = [ALL_PEERS]
    rules.add("ask", "ingress", ["query"], ask, everybody)
    rules.add("answers", "egress", ["reply", "declare_queryable"], [own, *anywhere], everybody)
    if names is None:
        rules.add("requests", "ingress", ["query"], [f"{requests}*/*"], everybody)
        rules.add("tokens", "ingress", ["liveliness_token"], [tokens], everybody)
    else:
        names = {**names, **{shard_identity(one): shard_identity(one) for one in shards}}
        members = [*names]
    for name in names or ():
        quoted = quoted_name(name)
        rules.add(f"as {name}", "ingress", ["query"], [f"{requests}*/{quoted}{SAME_NAME}"], [name])
        token = tokens.replace(f"{ANY}/{ANY}", f"{quoted}{SAME_NAME}/{ANY}")
        rules.add(f"token {name}", "ingress", ["liveliness_token"], [token], [name])
    rules.add("watch", "ingress", ["declare_subscriber"], [notices], members)
    rules.add("notices", "egress", ["put"], [notice_key(cell, shard)], members)
    see = ["declare_liveliness_subscriber", "liveliness_query"]
    rules.add("see", "egress", see, [tokens], members)
    subjects: list[dict[str, object]] = [{"id": ALL_PEERS}]
    for name, proof in (names or {}).items():
        subjects.append({"id": name, "cert_common_names": [proof]})
    for name in map(shard_identity, shards if names is not None else ()):
        asks = [f"{requests}{verb}/{name}" for verb in _OF_SHARDS]
        rules.add(f"between shards {name}", "ingress", ["query"], asks, [name])
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules.rules,
        "subjects": subjects,
        "policies": rules.policies,
    }


class _Rules:
    """Rules and their policies, as Zenoh's settings have them."""

    def __init__(self) -> None:
        self.rules: list[dict[str, object]] = []
        self.policies: list[dict[str, object]] = []

    def add(
        self, name: str, flow: str, kinds: list[str], keys: list[str], subjects: list[str]
    ) -> None:
        """Allow messages of some kinds on some keys to some subjects."""
        self.rules.append(
            {
                "id": name,
                "permission": "allow",
                "flows": [flow],
                "messages": kinds,
                "key_exprs": keys,
            }
        )
        if subjects:
            self.policies.append({"rules": [name], "subjects": subjects})


def actor_said(name: str, actor: str) -> str:
    """Return what a client calls itself: the name of its key, and behind that its own word."""
    return name if actor in {name, ""} else f"{name}:{actor}"[:NAME_CHARACTERS_MAX]


def new_session_id(name: str, secret: str = "") -> str:
    """Return a new id for a session of a name.

    Its first part is the hash of `secret` (default: one that is not kept), which opens a shard's
    socket for the session (`opens`).
    """
    return _hash_of(secret or secrets.token_hex(16)) + _mark_of(name)


def _hash_of(secret: str) -> str:
    return hashlib.blake2s(secret.encode(), digest_size=16).hexdigest()


def opens(secret: str, session: str) -> bool:
    """Say whether a secret opens a socket for a session.

    An id of another length than those of `new_session_id` is no hash, and needs no secret.
    """
    if len(session) != SESSION_CHARACTERS:
        return True
    return secrets.compare_digest(_hash_of(secret).encode(), session[:32].encode())


@lru_cache(maxsize=1024)
def _mark_of(name: str) -> str:
    return hashlib.blake2s(name.encode(), digest_size=4).hexdigest()


def refuse_other_name(actor: str, identity: str, session: str = "") -> None:
    """Refuse a hello in which a client calls itself by a name that is not proven.

    Args:
        actor: What it calls itself.
        identity: With the proven name.
        session: The id of its session, which must be one of that name; "": it may be any.

    Raises:
        PermissionDeniedError: It does; holders, causes and listings would name another client.
    """
    name = name_in(identity)
    if session and not session.endswith(_mark_of(name)):
        raise PermissionDeniedError(f"session {session[:8]} is none of {name}; {identity} greeted")
    said = (actor or NAMELESS)[:SHOWN_CHARACTERS]
    if said != name and not said.startswith(f"{name}:"):
        raise PermissionDeniedError(
            f"{identity} called itself {said!r}; it is {name}, or {name}: and a word of its own"
        )


def barred(name: str, shard: str) -> str:
    """Return why a shard that is there answers no request of a name."""
    return (
        f"shard {shard} is running, but admits no client with this key of {name}: its keys were"
        " revoked, or the shard's cell.toml names no such actor, operator or program; add it there"
        f" or make new keys (enact cell keys renew {name}), then run enact shard reload"
    )


def common_name(name: str, revoked: int) -> str:
    """Return the common name of the certificates of a name whose keys were revoked so often."""
    return f"{name}~{revoked}" if revoked else name


def split_common_name(text: str) -> tuple[str, int]:
    """Return the name that a certificate proves, and how often its keys had been revoked."""
    name, _, number = text.partition("~")
    return (name, int(number)) if number.isdecimal() else (text, 0)


def read_revoked(folder: Path) -> dict[str, int]:
    """Return how often the keys of each name were revoked, from a key folder.

    Raises:
        ConfigError: The file cannot be read or used.
    """
    import tomllib  # no client needs it

    file = folder / REVOKED_FILE
    try:
        found = tomllib.loads(file.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"cannot read {file}: {error}", path=str(file)) from error
    for name, number in found.items():
        if type(number) is not int or number < 1:
            raise ConfigError(
                f"{file}: {name} = {number!r} is no count; `enact cell keys revoke` writes how"
                f" often its keys were revoked, such as {name} = 1",
                path=str(file),
            )
    return found


def text_of_revoked(revoked: Mapping[str, int]) -> str:
    """Return `revoked.toml` with these names."""
    lines = ["# Written by `enact cell keys revoke`: how often the keys of a name were revoked."]
    lines += [f"{json.dumps(name)} = {number}" for name, number in sorted(revoked.items())]
    return "\n".join((*lines, ""))
