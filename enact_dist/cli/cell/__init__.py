"""`enact cell`: the table of its verbs; the module beside carries them out."""

from __future__ import annotations

from typing import Final

from enact_dist.cli.arguments import CELL_FILE, JSON, file_of
from enact_dist.cli.verbs import Verb, option

_AUTHORITY: Final = file_of(
    "--authority", "DIR",
    "folder with the authority's private key (default: `authority` beside the key folder)",
)  # fmt: skip
_NAMES: Final = option(
    "names", "NAME", "shard.NAME, or the name of an actor or operator", nargs="*"
)
_REVOKED: Final = option("names", "NAME", "the name of an actor, operator or program", nargs="+")

VERBS: Final = (
    Verb(
        "keys init", "make the authority of a cell, once; its private key never leaves this host",
        "keys:init",
        "enact cell keys init\nenact cell keys init --authority /media/safe/authority",
        (_AUTHORITY, CELL_FILE, JSON),
    ),
    Verb(
        "keys make",
        "make keys for the shards, actors and operators of cell.toml that have none",
        "keys:make",
        "enact cell keys make\nenact cell keys make shard.left camera",
        (_NAMES, _AUTHORITY, CELL_FILE, JSON),
    ),
    Verb(
        "keys ls", "list the keys in the key folder: how long they are valid, for which hosts",
        "keys:list_keys",
        "enact cell keys ls\nenact cell keys ls --json",
        (CELL_FILE, JSON),
        columns=("name", "use", "ends", "hosts", "to do"),
        empty="no keys",
    ),
    Verb(
        "keys renew",
        "make new keys for the named, or for all that end within 30 days or do not fit cell.toml",
        "keys:renew",
        "enact cell keys renew\nenact cell keys renew shard.left",
        (_NAMES, _AUTHORITY, CELL_FILE, JSON),
    ),
    Verb(
        "keys revoke",
        "bar all keys so far of the named actors, operators and programs, once shards reload",
        "keys:revoke",
        "enact cell keys revoke camera",
        (_REVOKED, CELL_FILE, JSON),
    ),
)  # fmt: skip
