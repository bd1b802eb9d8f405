"""What may pass through the listening Zenoh session of a shard: its own traffic, and nothing else.

A session that listens relays between those who connect to it in Zenoh's client or router mode:
without rules a stranger's queryable gets every request of every client, commits with their data
included, and its notices reach every watcher.  With these rules the shard alone answers its
requests, publishes its notices and hears tokens.  They cost 15 us a call, need no keys, and look at
key expressions only: what they let in the shard itself compares (see `enact_dist.core.owners`).

What is not allowed Zenoh drops without a word: a query gets no reply, a declaration reaches nobody.
A query passes only where its key is *included* in an allowed one, so one with wildcards that asks
several shards or verbs at once does not; the question who is there is the exception.
"""

from __future__ import annotations

from typing import Final

from enact_dist.core.messages import Ping
from enact_dist.wire.keys import ANY, ROOT, notice_key, queryable_key, token_key, verb_of

ANYBODY: Final = "anybody"
EARLIER_QUESTION: Final = "await_stamp"
"""With which releases of frames before 7 look for shards: they are told which version is spoken."""
ACCEPT_PENDING: Final = 10_000
"""Connections that may be without a greeting at one time: 100, which is Zenoh's own limit, let
three hundred silent ones keep everybody out for as long as they liked."""
ACCEPT_S: Final = 1.0
"""How long whoever connects has for its greeting."""


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
