"""Access rules of a shard's listening Zenoh session: its own traffic, and nothing else.

A listening session relays between peers that connect in Zenoh's client or router mode.  Without
rules, a stranger's queryable would receive every request of every client, including committed data,
and its notices would reach every watcher.  With these rules only the shard answers its requests,
publishes its notices and sees tokens.  They cost 15 us a call, need no keys, and check only key
expressions; the shard itself checks everything else (see `enact_dist.core.shard.owners`).

Zenoh drops forbidden messages silently: a query gets no reply, a declaration reaches no peer.  A
query passes only if its key is *included* in an allowed one, so a query with wildcards for several
shards or verbs does not, except for the discovery of shards.
"""

from __future__ import annotations

from typing import Final

from enact_dist.core.protocol.messages import Ping
from enact_dist.wire.keys import ANY, ROOT, notice_key, queryable_key, token_key, verb_of

ANYBODY: Final = "anybody"
EARLIER_QUESTION: Final = "await_stamp"
"""Discovery query of releases with frames before 7: the answer names our version."""
ACCEPT_PENDING: Final = 10_000
"""Connections that may be without a greeting at one time.  Zenoh's limit of 100 would let
three hundred silent ones lock everybody else out indefinitely.
"""
ACCEPT_S: Final = 1.0
"""How long a new connection may take for its greeting."""


def listening_settings(cell: str, shard: str) -> dict[str, object]:
    """Return the settings of a shard's listening session."""
    return {
        "access_control": access_rules(cell, shard),
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": round(ACCEPT_S * 1e3),
    }


def access_rules(cell: str, shard: str) -> dict[str, object]:
    """Return the rules of a shard's listening session."""
    own = queryable_key(cell, shard)
    requests = f"{own.removesuffix('**')}*/*"
    anywhere = [f"{ROOT}/{ANY}/{ANY}/{verb}/{ANY}" for verb in (verb_of(Ping()), EARLIER_QUESTION)]
    tokens = token_key(cell, ANY, ANY)
    seen = ["declare_liveliness_subscriber", "liveliness_query"]
    rules = [
        _rule("requests", "ingress", ["query"], [requests, *anywhere]),
        _rule("tokens", "ingress", ["liveliness_token"], [tokens]),
        _rule("watch", "ingress", ["declare_subscriber"], [notice_key(cell, ANY)]),
        _rule("answers", "egress", ["reply", "declare_queryable"], [own, *anywhere]),
        _rule("notices", "egress", ["put"], [notice_key(cell, shard)]),
        _rule("see", "egress", seen, [tokens]),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": ANYBODY}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": [ANYBODY]}],
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, object]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": messages,
        "key_exprs": keys,
    }
